"""A recording gives what its function gives, whatever changes from call to call."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tests.simulated_gpu import compute_again
from torch import Tensor

from posefilter import cuda_graphs


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "capture", compute_again)


def test_every_call_has_the_result_of_its_own_tensors() -> None:
    record, calls = cuda_graphs.Recording(), []

    def work(a: Tensor, b: Tensor) -> Tensor:
        calls.append(1)
        return a * 2 + b

    kept, found = torch.ones(3), []
    for number in range(5):
        found.append(record(work, kept, torch.full((3,), float(number))))
        if number == 2:
            kept += 1  # in place
    assert [one[0].item() for one in found] == [2, 3, 4, 7, 8]  # and none was overwritten
    assert len(calls) == 6  # the first, the one that is recorded, and four replays


def test_a_view_is_copied_as_it_is() -> None:
    record = cuda_graphs.Recording()
    for number in range(4):
        whole = torch.arange(12.0).view(3, 4) + number
        parts = (whole.t(), whole[0, :1].expand(4, 3))
        assert torch.equal(record(torch.add, *parts), parts[0] + parts[1])


def test_threads_do_not_take_each_others_tensors() -> None:
    record = cuda_graphs.Recording()

    def work(a: Tensor) -> Tensor:
        time.sleep(0.002)
        return a + 1

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda n: record(work, torch.full((2,), float(n))), range(24)))
    assert [one[0].item() for one in found] == [n + 1 for n in range(24)]


def test_recordings_are_told_apart_and_not_kept_for_ever() -> None:
    find = cuda_graphs.make_recordings(most=2)
    a, b = torch.zeros(2), torch.zeros(2, dtype=torch.float64)
    first = find(cuda_graphs.describe(a))
    assert find(cuda_graphs.describe(torch.ones(2))) is first
    assert find(cuda_graphs.describe(b)) is not first
    assert find(cuda_graphs.describe(a, b)) is not first
    assert find(cuda_graphs.describe(a)) is not first


def test_a_recording_draws_what_its_function_would_draw() -> None:
    def work(a: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        drawn = torch.randn(3, generator=generator)
        return a + drawn, drawn

    record = cuda_graphs.Recording()
    own, plain = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    for number in range(5):
        if number == 3:  # another generator, as of another image
            own, plain = torch.Generator().manual_seed(8), torch.Generator().manual_seed(8)
        a = torch.full((3,), float(number))
        found, expected = record(work, a, generator=own), work(a, plain)
        assert all(map(torch.equal, found, expected))
        assert torch.equal(own.get_state(), plain.get_state())


def test_tensors_of_inference_mode_are_always_read_anew() -> None:
    record = cuda_graphs.Recording()
    with torch.inference_mode():
        kept = torch.ones(2)
        for number in range(4):
            kept.fill_(number)
            assert record(torch.neg, kept)[0].item() == -number


def test_a_cpu_records_nothing() -> None:
    with torch.no_grad():
        assert not cuda_graphs.applies(torch.zeros(2))
