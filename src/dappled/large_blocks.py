"""Keep the memory of large arrays in this process for the next ones."""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # <malloc.h>
_LARGE_BYTES = 1 << 30


def reuse_large_blocks() -> bool:
    """Have this process' malloc keep blocks up to 1 GiB. False where its libc has no such settings.

    glibc gives every block above 32 MiB back at once (where MALLOC_TRIM_THRESHOLD_ is small, as in a Dask worker, also
    small ones), and those of other threads than the first when they outgrow 64 MiB together; the next one then comes
    page by page anew, which for slices of that size takes longer than receiving them. For programs, not for libraries:
    it holds for the whole process.
    """
    try:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    except OSError:
        return False
    if mallopt is None:
        return False
    wanted = ((_M_MMAP_THRESHOLD, _LARGE_BYTES), (_M_TRIM_THRESHOLD, _LARGE_BYTES), (_M_ARENA_MAX, 1))
    taken = [mallopt(*one) for one in wanted]
    return all(taken)
