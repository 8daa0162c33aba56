"""From a raw mosaic to its spectrum, its carriers and its slices."""

from __future__ import annotations

from dappled.decode.spectrum.lineariser import Lineariser, LinearRows, Plane
from dappled.decode.spectrum.slices import Slices
from dappled.decode.spectrum.transform import Spectrum

__all__ = ["LinearRows", "Lineariser", "Plane", "Slices", "Spectrum"]
