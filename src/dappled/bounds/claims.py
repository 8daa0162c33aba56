"""Judge what a file claims before memory is taken for it: sizes of arrays and pictures.

A file of a few bytes can claim any size, and can unpack to a thousand times its own size. A claim up to `FREE_BYTES`
is read in any case. A larger one must be borne out by the bytes that are stored: real frames and light fields pack to a
third at best, and `RATIO` leaves room for synthetic ones. Nothing larger than the memory that is free is read.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

FREE_BYTES = 256 << 20
RATIO = 200
_MOST_DIMENSIONS = 8
_MEMORY = Path("/proc/meminfo")
_GROUP, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
_INFLATE_STEP = 1 << 20


class ClaimError(ValueError):
    """A file or message claims more than is read. The text goes on after the file's name: "its … ; what to do"."""


def check_size(claimed: int, stored: int, what: str, *, free: int = FREE_BYTES, ratio: int = RATIO) -> None:
    """Check that `claimed` bytes in memory are borne out by `stored` bytes, and that there is memory for them.

    Claims up to `free` bytes need no proof. Raises ClaimError.
    """
    most = max(free, ratio * stored)
    if claimed > most:
        raise ClaimError(
            f"its {what} would take {in_words(claimed)} of memory, and the {in_words(stored)} that are stored can't "
            f"hold more than {in_words(most)}: it is damaged, or made to exhaust memory; make it anew"
        )
    if claimed > (left := free_memory()):
        raise ClaimError(
            f"its {what} would take {in_words(claimed)} of memory, and {in_words(int(left))} are free: "
            "close other programs, or use a machine with more memory"
        )


def count(shape: object, what: str) -> int:
    """Count the values of a claimed shape. Raises ClaimError where it is not a short list of whole numbers from 0."""
    if not isinstance(shape, Sequence) or isinstance(shape, str | bytes) or len(shape) > _MOST_DIMENSIONS:
        raise ClaimError(f"the shape of its {what} is not a list of at most {_MOST_DIMENSIONS} sides: make it anew")
    if not all(isinstance(side, int) and not isinstance(side, bool) and 0 <= side < 1 << 63 for side in shape):
        raise ClaimError(f"the shape of its {what} has a side that is not a whole number from 0: make it anew")
    return math.prod(shape)


def check_inflated(packed: bytes, most: int, what: str, *, head: int = zlib.MAX_WBITS) -> None:
    """Check that deflated bytes unpack to `most` bytes at most, without keeping them; `head` is zlib's `wbits`.

    Raises ClaimError; bytes that are damaged pass, for whoever unpacks them reports that.
    """
    inflater, left, data = zlib.decompressobj(head), most, packed
    try:
        while data and not inflater.eof:
            left -= len(inflater.decompress(data, _INFLATE_STEP))
            data = inflater.unconsumed_tail
            if left < 0:
                raise ClaimError(
                    f"its {what} unpacks to more than the {in_words(most)} that it claims: "
                    "it is damaged, or made to exhaust memory; make it anew"
                )
    except zlib.error:
        return


def free_memory() -> float:
    """Return the bytes of memory that this process may still take: the machine's, or its control group's; inf where
    the machine doesn't say."""
    return min([math.inf, *_limits()])


def in_words(size: int) -> str:
    """Return a size as people write it: 512 bytes, 1.5 MB, 20 GB."""
    if size < 1000:
        return f"{size} bytes"
    power = min((len(str(size)) - 1) // 3, 6)
    return f"{size / 1000**power:.3g} {'kMGTPE'[power - 1]}B"


def _limits() -> Iterable[int]:
    try:
        lines = _MEMORY.read_text(encoding="ascii").splitlines()
        group = _GROUP.read_text(encoding="utf-8").rpartition("::/")[2].strip()
    except (OSError, ValueError):
        return
    yield from (int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    own = _GROUPS / group
    for folder in (own, *own.parents):
        if not folder.is_relative_to(_GROUPS):
            return
        try:
            yield int((folder / "memory.max").read_text(encoding="ascii"))
        except (OSError, ValueError):  # "max": no limit
            continue
