"""Lenses, masks and their carriers, film, laser bench, mask and survey design."""

from __future__ import annotations

from dappled.decode.optics.carriers import LAWS, Carrier, Lattice, Mask, MaskedOptics, Order, Sensor

__all__ = ["LAWS", "Carrier", "Lattice", "Mask", "MaskedOptics", "Order", "Sensor"]
