"""Memory for large messages, used again instead of being given back to the kernel after each one."""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # <malloc.h>
_LARGE_BYTES = 1 << 30


def reuse_large_blocks() -> bool:
    """Have this process' malloc keep blocks up to 1 GiB. False where its libc has no such setting.

    glibc gives every block above 32 MiB back at once, and the next one page by page anew: for slices of that size this
    takes three times as long as receiving them. For programs, not for libraries: it holds for the whole process.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)) and bool(mallopt(_M_TRIM_THRESHOLD, _LARGE_BYTES))
