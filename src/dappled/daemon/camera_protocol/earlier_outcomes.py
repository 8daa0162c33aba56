"""Report the outcomes of shots that an earlier run of the daemon accepted, and ended before it had reported them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from dappled.daemon.camera_protocol.camera_status import Captured, captured_image
from dappled.errors import counted
from dappled.flight import ImageIndex

PACE_NS = 100_000_000
_NAMED = 8


class EarlierOutcomes:
    """The unreported outcomes in the index over all flights, the oldest first, ten a second. Each call may read a disk.

    The shots stand in the index until each is sent, so a second crash neither loses nor repeats a report. (If the
    process is killed in the 0.1 ms between sending and noting that, one is sent twice.)
    """

    def __init__(self, images: ImageIndex) -> None:
        self._images = images
        known = images.unreported()
        self._left = list(known)
        self._uncounted = [index for index, was_counted in known.items() if not was_counted]
        self._due_ns = 0

    def summary(self) -> str | None:
        """A sentence that counts the lost photographs among them; None where no new one was lost."""
        if not self._uncounted:
            return None
        lost = [index for index in self._uncounted if not _outcome(index, self._images).ok]
        self._images.note_counted()
        self._uncounted = []
        if not lost:
            return None
        were = "was" if len(lost) == 1 else "were"
        return f"{counted(len(lost), 'photograph')} {were} lost when the daemon ended: {numbers(lost)}"

    def due(self, now_ns: int) -> Sequence[Captured]:
        """The outcomes to send now."""
        if not self._left or now_ns < self._due_ns:
            return ()
        self._due_ns = now_ns + PACE_NS
        return (_outcome(self._left[0], self._images),)

    def sent(self, index: int) -> None:
        """The outcome of this shot was sent, and is not due again."""
        self._images.note_late_report(index)
        self._left.remove(index)


def numbers(indices: Sequence[int]) -> str:
    """Rising image indices in words: "image 4", "images 4 to 9, 12". At most eight runs are named.

    >>> numbers([4, 5, 6, 9])
    'images 4 to 6, 9'
    """
    starts = [indices[0]] + [after for before, after in pairwise(indices) if after != before + 1]
    ends = [before for before, after in pairwise(indices) if after != before + 1] + [indices[-1]]
    runs = [f"{first}" if first == last else f"{first} to {last}" for first, last in zip(starts, ends, strict=True)]
    more = " and more" if len(runs) > _NAMED else ""
    return f"image{'s' if len(indices) > 1 else ''} {', '.join(runs[:_NAMED])}{more}"


def _outcome(index: int, images: ImageIndex) -> Captured:
    """How a shot ended: by its flight's ledger or, where that can't be read, by the index."""
    found = captured_image(index, images)
    if found is not None:
        return found
    entry = images.lookup(index)
    safe = entry is not None and entry.state == "safe"
    return Captured(index, safe, url=entry.frame or "" if entry is not None and safe else "")
