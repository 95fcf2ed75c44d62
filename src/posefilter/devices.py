"""Where to compute."""

import torch


def choose_device() -> str:
    """Return the device to compute on where none is asked for: the GPU where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"
