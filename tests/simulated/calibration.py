"""A calibration as `dappled calibrate` makes it from one frame."""

from __future__ import annotations

from pathlib import Path

from dappled.cli.calibrate.frames import fit_views, view_of
from dappled.decode.calibration.calibration import Calibration
from dappled.drivers.raw.darkroom import Darkroom


def from_frame(darkroom: Darkroom, frame: Path) -> Calibration:
    """The calibration that this frame shows."""
    return fit_views(darkroom, [view_of(darkroom, frame)])
