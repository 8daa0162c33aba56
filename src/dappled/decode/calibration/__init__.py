"""What stopped-down frames show of a masked camera: lattice, law, transfer; reports."""

from __future__ import annotations

from dappled.decode.calibration.calibration import Calibration, LatticeFit

__all__ = ["Calibration", "LatticeFit"]
