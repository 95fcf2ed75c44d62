"""Weights by name: from a server on this machine that cuts connections, lies or refuses."""

import hashlib
import http.server
import io
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests

import posefilter.weights
from posefilter.cli.checkpoints import find_checkpoint
from posefilter.errors import UserError
from posefilter.weights import (
    FOLDERS,
    expand_weights,
    fetch_weights,
    find_weights,
    is_several,
    list_shipped,
)

CONTENT = np.random.default_rng(0).bytes(300_000)
SHA = hashlib.sha256(CONTENT).hexdigest()


class Server(http.server.ThreadingHTTPServer):
    """Serves `registry.txt` and one file of weights."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked: list[str] = []
        self.cuts: list[int] = []  # after how many bytes to cut each of the next files
        self.status, self.registry = 0, f"duck.ckpt sha256:{SHA}\n"
        self.endless = ""  # the end of an address that sends without an end

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/weights"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        if self.server.status:
            self.send_error(self.server.status)
            return
        index = self.path.endswith("registry.txt")
        if self.path.endswith(self.server.endless or "nothing"):
            self.send_response(200)
            self.end_headers()
            with suppress(OSError):  # the connection is closed
                while True:
                    self.wfile.write(bytes(1 << 20))
            return
        body = self.server.registry.encode() if index else CONTENT
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        cut = len(body) if index or not self.server.cuts else self.server.cuts.pop(0)
        self.wfile.write(body[:cut])

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    """Return a server that runs until the test's end."""
    server = Server()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def test_a_path_is_taken_as_it_is_and_a_name_is_found_among_what_ships(tmp_path: Path) -> None:
    own = tmp_path / "own.ckpt"
    own.touch()
    assert find_weights(own) == own
    assert find_weights(tmp_path) == tmp_path
    assert find_weights("003_cracker_box") in [f / "003_cracker_box.ckpt" for f in FOLDERS]
    assert find_weights("003_cracker_box").is_file()


def test_a_path_may_begin_at_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "own.ckpt").write_bytes(b"")
    assert find_weights("~/own.ckpt") == tmp_path / "own.ckpt"
    assert expand_weights("~/*.ckpt") == [tmp_path / "own.ckpt"]
    with pytest.raises(UserError, match="~nobody_of_that_name"):
        find_weights("~nobody_of_that_name/own.ckpt")


def test_a_pattern_may_stand_for_one_file(tmp_path: Path) -> None:
    """As that of a run whose folder's name is cut."""
    own = tmp_path / "model=patch_pf,see_83de" / "best.ckpt"
    own.parent.mkdir()
    own.touch()
    assert find_weights(tmp_path / "*model=patch_pf,*" / "best.ckpt") == own
    with pytest.raises(UserError, match="no weights there"):
        find_weights(tmp_path / "*model=pixel_pf,*" / "best.ckpt")
    (own.parent / "other.ckpt").touch()
    with pytest.raises(UserError, match=r"stands for 2 files .*; here it must be one"):
        find_weights(tmp_path / "*" / "*.ckpt")


def test_what_ships_is_small_enough_to_be_cloned() -> None:
    sizes = [file.stat().st_size for file in find_weights("003_cracker_box").parent.glob("*.ckpt")]
    assert len(sizes) == 14
    assert sum(sizes) <= 40e6


def test_a_name_elsewhere_is_fetched_once(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("POSEFILTER_WEIGHTS_URL", server.url)
    monkeypatch.setenv("POSEFILTER_CACHE", str(tmp_path))
    path = find_weights("duck")
    assert path == tmp_path / "duck.ckpt"
    assert path.read_bytes() == CONTENT
    assert find_weights("duck") == path
    assert server.asked.count("/weights/duck.ckpt") == 1


@pytest.mark.slow
def test_a_cut_connection_is_tried_again_and_leaves_no_half_file(
    server: Server, tmp_path: Path
) -> None:
    server.cuts = [1000]
    assert fetch_weights("duck", server.url, tmp_path).read_bytes() == CONTENT
    assert server.asked.count("/weights/duck.ckpt") == 2
    server.cuts = [10] * 9
    with pytest.raises(UserError, match="checkpoint=duck"):
        fetch_weights("duck", server.url, tmp_path / "other")
    assert not (tmp_path / "other" / "duck.ckpt").exists()


def test_another_checksum_is_refused_and_nothing_is_kept(server: Server, tmp_path: Path) -> None:
    server.registry = f"duck.ckpt sha256:{'0' * 64}\n"
    with pytest.raises(UserError, match="sent something else") as caught:
        fetch_weights("duck", server.url, tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*.ckpt"))


def test_what_is_in_the_cache_needs_no_network(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched = fetch_weights("duck", server.url, tmp_path)

    def fail(*_: object, **__: object) -> None:
        raise requests.ConnectionError

    monkeypatch.setattr(requests, "get", fail)
    assert fetch_weights("duck", server.url, tmp_path) == fetched
    fetched.write_bytes(CONTENT[:-1])  # damaged: it is not taken as it is
    with pytest.raises(UserError, match="cannot be fetched"):
        fetch_weights("duck", server.url, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"duck.ckpt", "registry.txt"}


def test_a_damaged_file_in_the_cache_is_fetched_anew(server: Server, tmp_path: Path) -> None:
    (tmp_path / "duck.ckpt").write_bytes(CONTENT[:-1])
    assert fetch_weights("duck", server.url, tmp_path).read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("registry", "status", "told"),
    [
        ("goose.ckpt sha256:00\n", 0, "lists goose.ckpt"),
        (f"duck.ckpt md5:{'0' * 32}\n", 0, "gives no sha256"),
        ("a b c d\n", 0, "line 1 of its list should be: NAME.ckpt sha256:DIGEST"),
        ("\n# a\n" + "a" * 800_000, 0, "line 3 of its list is too long"),
        ("\x1b]0;owned\x07.ckpt sha256:00\n", 0, "line 1 of its list is too long, or not to be"),
        (f"duck.ckpt sha256:{SHA} http://\x1b[2J/\n", 0, "line 1 of its list is too long, or not"),
        ("\n".join(f"{i:05}.ckpt sha256:00" for i in range(9999)), 0, "19.ckpt and 9979 more$"),
        (f"duck.ckpt sha256:{SHA} file:///etc/passwd\n", 0, "cannot be fetched"),
        ("", 404, "cannot be fetched"),
        ("", 500, "cannot be fetched"),
    ],
)
def test_what_cannot_be_fetched_is_one_line(
    server: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    registry: str,
    status: int,
    told: str,
) -> None:
    monkeypatch.setattr(posefilter.weights, "_RETRIES", 0)
    server.registry, server.status = registry, status
    with pytest.raises(UserError, match=told) as caught:
        fetch_weights("duck", server.url, tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("what", ["registry.txt", "duck.ckpt"])
def test_what_is_sent_without_an_end_is_neither_held_nor_kept(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(posefilter.weights, "MOST_BYTES", 1 << 22)
    server.endless = what
    with pytest.raises(UserError, match=f"/weights/{what}: too large: more than"):
        fetch_weights("duck", server.url, tmp_path)
    assert not list(tmp_path.glob("*.ckpt"))
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 1000
    assert server.asked.count("/weights/duck.ckpt") == (what == "duck.ckpt")


def test_a_damaged_list_does_not_replace_the_one_before(server: Server, tmp_path: Path) -> None:
    fetch_weights("duck", server.url, tmp_path)
    before = (tmp_path / "registry.txt").read_bytes()
    server.registry = "<html>"
    with pytest.raises(UserError, match="should be: NAME"):
        fetch_weights("duck", server.url, tmp_path)
    assert (tmp_path / "registry.txt").read_bytes() == before


@pytest.mark.parametrize(
    ("place", "told"),
    [("http://other/registry.txt", "is not https"), ("file:///x", "is not https"),
     ("/x", ""), ("https://other/x", "")],
)  # fmt: skip
def test_a_list_by_https_leads_to_no_other(
    place: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checksums are in it: over http anyone on the way may write others."""

    class Redirecting(requests.adapters.BaseAdapter):
        def send(self, request: requests.PreparedRequest, *_: object, **__: object) -> Any:
            response = requests.Response()
            response.request, response.url = request, str(request.url)
            response.raw = io.BytesIO()
            response.status_code = 302 if "first" in response.url else 404
            response.headers["location"] = place
            return response

        def close(self) -> None:
            pass

    monkeypatch.setattr(requests.Session, "get_adapter", lambda *_, **__: Redirecting())
    with pytest.raises(UserError, match=told or "cannot be fetched") as caught:
        fetch_weights("duck", "https://first/weights", tmp_path)
    assert bool(told) == ("leads to" in str(caught.value))


def test_only_names_are_fetched(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="only http and https"):
        fetch_weights("duck", f"file://{tmp_path}", tmp_path)
    monkeypatch.setenv("POSEFILTER_WEIGHTS_URL", server.url)
    for name in ("../duck", "a/b", ".duck", "outputs/runs/x/best.ckpt"):
        with pytest.raises(UserError, match="no such file"):
            find_weights(name)
    assert server.asked == []


def test_a_list_a_pattern_and_all_stand_for_several(tmp_path: Path) -> None:
    shipped = [*list_shipped().values()]
    assert len(shipped) > 5
    assert expand_weights("all") == shipped
    for name in ("b", "a"):
        (tmp_path / f"{name}.ckpt").touch()
    files = [tmp_path / "a.ckpt", tmp_path / "b.ckpt"]
    assert expand_weights(f"{tmp_path}/*.ckpt") == files
    assert expand_weights([str(tmp_path / "*.ckpt"), files[1]]) == files  # none of them twice
    assert expand_weights("003*") == [list_shipped()["003_cracker_box"]]
    assert expand_weights("003_cracker_box") == ["003_cracker_box"]
    assert [is_several(one) for one in ("all", "00?", ["a"], "a.ckpt", files[0], None)] == [
        True,
        True,
        True,
        False,
        False,
        False,
    ]
    for nothing in (f"{tmp_path}/*.pt", []):
        with pytest.raises(UserError, match="no weights there"):
            expand_weights(nothing)


def test_a_folder_that_is_no_runs_is_told_as_one(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"is a folder without checkpoints/best\.ckpt"):
        find_checkpoint(tmp_path)


def test_a_folder_of_images_or_results_does_not_hide_weights_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`checkpoint=003_cracker_box out=003_cracker_box` makes the folder before it looks."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "003_cracker_box").mkdir()
    (tmp_path / "all").mkdir()
    shipped = list_shipped()
    assert find_checkpoint("003_cracker_box") == shipped["003_cracker_box"]
    assert expand_weights("all") == [*shipped.values()]

    # a run's folder is meant, even one that holds no checkpoint yet
    for name in ("003_cracker_box", "all"):
        (tmp_path / name / "checkpoints").mkdir()
        with pytest.raises(UserError, match=r"is a folder without checkpoints/best\.ckpt"):
            find_checkpoint(name)
        best = tmp_path / name / "checkpoints" / "best.ckpt"
        best.touch()
        assert find_checkpoint(name).resolve() == best
    assert expand_weights("all") == ["all"]
