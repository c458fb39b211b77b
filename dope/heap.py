"""Keep glibc's heap between training steps."""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # from malloc.h
NEVER = 2**31 - 1


def keep_heap() -> bool:
    """Stop malloc from handing large blocks back to the system; False where the C library is not glibc.

    A step allocates and frees the same gigabytes of activations again and again. By default each block of over 32 MiB
    is mapped and unmapped anew, and the kernel zeroes its pages: several seconds of system time a step on a CPU.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):  # musl
        return False
    return bool(mallopt(M_MMAP_MAX, 0)) and bool(mallopt(M_TRIM_THRESHOLD, NEVER))
