"""When a simulated body's shutter truly opened: one small file for each shot, for what stands in for its hot shoe."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import codec


@dataclass(frozen=True, slots=True)
class ShotTimes:
    """Trigger and middle of the exposure in seconds on the path's clock, and how long after the trigger it opened."""

    trigger_t_s: float
    mid_exposure_t_s: float
    latency_s: float

    def write(self, truth: Path, number: int) -> None:
        """Put them into a folder. Raises OSError."""
        (truth / f"{number:06d}.json").write_bytes(codec.canonical(self))


def read(path: Path) -> ShotTimes:
    """The times in a file. Raises OSError, and ValueError while it is still written."""
    return codec.read_json(ShotTimes, path.read_bytes())
