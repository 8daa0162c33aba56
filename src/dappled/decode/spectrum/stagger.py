"""Chips whose every second row sits half a column to the right: the Super CCD's 45° lattice, as it is stored.

Read as a rectangle such a frame is sampled unevenly, and each carrier gets a false twin. Spread out over twice as many
columns, every sample stands where it was taken; half of the places are empty. Empty places repeat the spectrum around
(½, ½) cycles/pixel, which a 45° lattice does by nature: what lies within |fy| + |fx| < ½ is free of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dappled.decode.optics.carriers import Sensor
from dappled.decode.spectrum.plane import Plane


def spread(plane: Plane) -> Plane:
    """float32 (H, 2W) of a plane (H, W): sample (r, c) at column 2c + (r mod 2), twice its value, the rest 0.

    Local means stay as they are.
    """
    wide = np.zeros((plane.shape[0], 2 * plane.shape[1]), dtype=np.float32)
    np.multiply(plane[0::2], 2, out=wide[0::2, 0::2])
    np.multiply(plane[1::2], 2, out=wide[1::2, 1::2])
    return wide


def spread_sensor(sensor: Sensor) -> Sensor:
    """The geometry of the spread plane."""
    y, x = sensor.column_mm
    return replace(sensor, shape=(sensor.shape[0], 2 * sensor.shape[1]), column_mm=(y / 2, x / 2))
