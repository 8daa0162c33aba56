"""Add up what the frames of a flight tell of their mask."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dappled.decode.mask_odds import SEEN_NATS
from dappled.findings import Code, Finding, Level, Subject, finding, first_by_name

_MOST_NATS = 20.0  # a mask that falls out is in doubt after five frames with texture: each tells 3.4 nats at most


class FlightMask:
    """The odds that a flight's mask is where it was calibrated, by its frames in their order, each counted once."""

    def __init__(self) -> None:
        self._nats = 0.0
        self._shown: dict[int, bool] = {}

    def add(self, index: int, nats: float | None) -> None:
        """Count a frame by its log odds; None: it tells nothing."""
        if nats is not None and index not in self._shown:
            self._shown[index] = nats > SEEN_NATS
            self._nats = min(max(self._nats + nats, -_MOST_NATS), _MOST_NATS)

    @property
    def there(self) -> bool:
        """Whether the odds are that it is there now."""
        return self._nats > SEEN_NATS

    @property
    def told(self) -> Finding | None:
        """What all frames so far tell together, a note where the mask is there; None where none tells anything."""
        if not self._shown:
            return None
        seen, frames = sum(self._shown.values()), len(self._shown)
        facts = {"seen": seen, "frames": frames, "unseen": frames - seen, "nats": self._nats, "needed": SEEN_NATS}
        return finding(Code.MASK_OVER_FLIGHT, Subject("mask"), Level.NOTE if self.there else None, **facts)

    @property
    def unseen(self) -> tuple[Finding, ...]:
        """`told` where a frame doesn't show it."""
        return () if self.told is None or all(self._shown.values()) else (self.told,)

    def relieved(self, doubts: Sequence[Finding]) -> tuple[Finding, ...]:
        """A frame's doubts: that it can't show the mask is none where the odds are that it is there."""
        return tuple(one for one in doubts if not (self.there and one.code is Code.MASK_UNSEEN))


def doubts_over(frames: Iterable[tuple[str, float | None, Sequence[Finding]]]) -> list[Finding]:
    """What is in doubt about frames of a flight in their order, each by its name, log odds and doubts, and about the
    mask that they tell of together."""
    mask, found = FlightMask(), []
    for index, (name, nats, doubts) in enumerate(frames):
        mask.add(index, nats)
        found.append((name, mask.relieved(doubts)))
    return [*first_by_name(found), *mask.unseen]
