"""Downloads against a server on this machine that cuts connections, forgets ranges or refuses."""

import hashlib
import http.server
import threading
import zipfile

import numpy as np
import pytest

from posefilter.data.download import fetch, unpack
from posefilter.errors import UserError

CONTENT = np.random.default_rng(0).bytes(300_000)
SHA = hashlib.sha256(CONTENT).hexdigest()


class Server(http.server.ThreadingHTTPServer):
    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = []  # the Range header of each request
        self.cuts = []  # after how many bytes to cut each of the next answers
        self.ranges, self.status = True, None


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server, wanted = self.server, self.headers.get("Range")
        server.asked.append(wanted)
        if server.status:
            self.send_error(server.status)
            return
        start = (
            int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted and server.ranges else 0
        )
        if start >= len(CONTENT):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(CONTENT)}")
            self.end_headers()
            return
        body = CONTENT[start:]
        self.send_response(206 if wanted and server.ranges else 200)
        if wanted and server.ranges:
            self.send_header("Content-Range", f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        cut = server.cuts.pop(0) if server.cuts else len(body)
        self.wfile.write(body[:cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    server = Server()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def url(server):
    return f"http://127.0.0.1:{server.server_address[1]}/archive.zip"


def get(server, path, **how):
    return fetch(url(server), path, progress=False, timeout=5, **how)


def test_fetched_once_and_whole(server, tmp_path):
    path = tmp_path / "deep" / "a.zip"
    assert get(server, path, sha256=SHA.upper()) == path
    assert path.read_bytes() == CONTENT
    get(server, path, sha256=SHA)
    assert server.asked == [None]
    assert list(path.parent.iterdir()) == [path]


def test_goes_on_after_cuts_within_one_call(server, tmp_path):
    server.cuts = [100_000, 50_000]
    get(server, tmp_path / "a.zip", sha256=SHA)
    assert server.asked == [None, "bytes=100000-", "bytes=150000-"]
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


def test_goes_on_in_a_later_call(server, tmp_path):
    server.cuts = [120_000]
    with pytest.raises(UserError, match=r"cut.*120,000 bytes are kept"):
        get(server, tmp_path / "a.zip", retries=0)
    assert not (tmp_path / "a.zip").exists()  # nothing half done under the real name
    get(server, tmp_path / "a.zip", sha256=SHA)
    assert server.asked == [None, "bytes=120000-"]


def test_a_partial_file_that_is_whole_already(server, tmp_path):
    (tmp_path / "a.zip.part").write_bytes(CONTENT)
    get(server, tmp_path / "a.zip", sha256=SHA)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


def test_a_server_without_ranges_starts_anew(server, tmp_path):
    server.ranges, server.cuts = False, [1000]
    get(server, tmp_path / "a.zip", sha256=SHA)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


def test_a_wrong_checksum_removes_the_file(server, tmp_path):
    with pytest.raises(UserError, match="SHA-256 is") as caught:
        get(server, tmp_path / "a.zip", sha256="0" * 64)
    assert SHA in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_rotten_beginning_is_noticed(server, tmp_path):
    (tmp_path / "a.zip.part").write_bytes(b"x" * 1000)
    with pytest.raises(UserError, match="SHA-256"):
        get(server, tmp_path / "a.zip", sha256=SHA)
    get(server, tmp_path / "a.zip", sha256=SHA)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


@pytest.mark.parametrize(("status", "tries"), [(404, 1), (503, 3)])
def test_refusals_are_final_or_tried_again(server, tmp_path, status, tries):
    server.status = status
    with pytest.raises(UserError, match=str(status)):
        get(server, tmp_path / "a.zip", retries=2)
    assert len(server.asked) == tries


def test_no_server(tmp_path):
    with pytest.raises(UserError, match="refused"):
        fetch("http://127.0.0.1:9/a.zip", tmp_path / "a.zip", retries=0, progress=False)
    with pytest.raises(UserError, match="only http"):
        fetch("file:///etc/passwd", tmp_path / "a.zip")


def test_unpacking_is_whole_or_not_at_all(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("x/y.txt", "hello")
    assert (unpack(tmp_path / "a.zip", tmp_path / "out") / "x" / "y.txt").read_text() == "hello"
    with pytest.raises(UserError, match="exists already"):
        unpack(tmp_path / "a.zip", tmp_path / "out")
    (tmp_path / "b.zip").write_bytes((tmp_path / "a.zip").read_bytes()[:40])
    with pytest.raises(UserError, match=r"b\.zip: cannot be unpacked"):
        unpack(tmp_path / "b.zip", tmp_path / "broken")
    assert not (tmp_path / "broken").exists()
