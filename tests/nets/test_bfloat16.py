"""bfloat16 is taken only where the processor has instructions for it."""

import platform
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from posefilter.nets import layers

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _asked_anew() -> Iterator[None]:
    layers._cpu_multiplies_bfloat16.cache_clear()
    yield
    layers._cpu_multiplies_bfloat16.cache_clear()


def tell(patch: pytest.MonkeyPatch, machine: str, onednn: bool, avx512: bool, amx: bool) -> None:
    patch.setattr(platform, "machine", lambda: machine)
    patch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: onednn)
    patch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx512)
    patch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)


@pytest.mark.parametrize(
    ("machine", "onednn", "avx512", "amx", "fast"),
    [
        ("x86_64", True, True, False, True),  # AMD from Zen 4 on
        ("x86_64", True, True, True, True),  # Intel from Sapphire Rapids on
        ("AMD64", True, False, False, False),  # Skylake to Ice Lake: AVX-512 without it
        ("x86_64", False, False, False, False),  # AVX2 alone
        ("aarch64", True, False, False, True),
        ("arm64", False, False, False, False),
    ],
)
def test_emulated_bfloat16_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
    machine: str,
    onednn: bool,
    avx512: bool,
    amx: bool,
    fast: bool,
) -> None:
    tell(monkeypatch, machine, onednn, avx512, amx)
    assert layers.fast_bfloat16(CPU) == fast


@pytest.mark.skipif(
    platform.machine() != "x86_64" or not Path("/proc/cpuinfo").exists(),
    reason="reads the flags that Linux lists of an x86 processor",
)
def test_this_processor_is_judged_as_its_flags_say() -> None:
    flags = set(Path("/proc/cpuinfo").read_text().split())
    assert layers.fast_bfloat16(CPU) <= bool(flags & {"avx512_bf16", "amx_bf16"})
