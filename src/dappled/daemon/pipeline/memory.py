"""Reuse large blocks of memory instead of returning them to the kernel, and mark processes to be killed first."""

from __future__ import annotations

import contextlib
import ctypes
from pathlib import Path

DECODER_GOES, CONSOLE_GOES = 500, 800  # of 1000: looking before decoding, decoding before recording

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # <malloc.h>
_LARGE_BYTES = 1 << 30


def reuse_large_blocks() -> bool:
    """Have this process' malloc keep blocks up to 1 GiB. False where its libc has no such settings.

    glibc gives every block above 32 MiB back at once, and those of other threads than the first when they outgrow
    64 MiB together; the next one then comes page by page anew, which for slices of that size takes longer than
    receiving them. For programs, not for libraries: it holds for the whole process.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = ((_M_MMAP_THRESHOLD, _LARGE_BYTES), (_M_TRIM_THRESHOLD, _LARGE_BYTES), (_M_ARENA_MAX, 1))
    taken = [mallopt(*one) for one in wanted]
    return all(taken)


def goes_first(score: int) -> None:
    """Let the kernel, when it is short of memory, end this process before those with a lower score (proc(5),
    oom_score_adj); children inherit it. What the system does not allow stays as it is."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(score), encoding="ascii")
