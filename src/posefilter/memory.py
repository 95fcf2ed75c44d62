"""What the C library does with memory that tensors no longer need."""

import ctypes
import platform

# glibc's M_TRIM_THRESHOLD, M_TOP_PAD and M_MMAP_THRESHOLD [bytes]
_MALLOC = {-1: 2**31 - 1, -2: 2**26, -3: 2**30}


def keep_freed_memory() -> bool:
    """Have the C library keep what is freed for the tensors to come; tell whether it can (glibc).

    By default each large tensor is mapped anew and given back, and the system fills its pages with
    zeros every time: more than half of a filter's time on a processor.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    taken = [mallopt(option, value) == 1 for option, value in _MALLOC.items()]
    return all(taken)
