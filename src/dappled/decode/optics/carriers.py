"""Where the carriers lie: sensors, lattices, and the two laws that predict a lattice from the lens.

A carrier of integer orders (ky, kx) stands at ky·a + kx·b cycles/pixel, where a and b are the two vectors of a
`Lattice`. A law gives the lattice of a mask behind a lens; lenslet arrays have a lattice that is found, not predicted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.masks import Mask, Order

Vector = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Carrier:
    """One impulse of the mask in a frame's spectrum: integer orders, and frequency in cycles/pixel, signed."""

    ky: int
    kx: int
    fy: float
    fx: float

    def index(self, shape: tuple[int, int]) -> tuple[float, float]:
        """(row, column) in the DC-centred DFT of `shape` (DC at H//2, W//2), fractional."""
        return shape[0] // 2 + self.fy * shape[0], shape[1] // 2 + self.fx * shape[1]

    @property
    def on_sensor(self) -> bool:
        """Whether the carrier lies below the Nyquist frequency on both axes."""
        return abs(self.fy) < 0.5 and abs(self.fx) < 0.5


@dataclass(frozen=True, slots=True)
class Lattice:
    """Two vectors (fy, fx) in cycles/pixel: what one step of ky and one step of kx mean."""

    ky: Vector
    kx: Vector

    def matrix(self) -> NDArray[np.float64]:
        """(2, 2), rows the two vectors: frequencies = orders @ matrix."""
        return np.array([self.ky, self.kx], dtype=np.float64)

    def carriers(self, orders: Sequence[Order]) -> list[Carrier]:
        """The carriers of these orders, in their order."""
        frequencies = np.asarray(orders, dtype=np.float64).reshape(-1, 2) @ self.matrix()
        return [
            Carrier(int(ky), int(kx), float(fy), float(fx))
            for (ky, kx), (fy, fx) in zip(orders, frequencies, strict=True)
        ]

    def rotated(self, angle_rad: float) -> Lattice:
        """The lattice turned by `angle_rad` from the row axis towards the column axis (square pixels)."""
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        (ay, ax), (by, bx) = self.ky, self.kx
        return Lattice((c * ay - s * ax, s * ay + c * ax), (c * by - s * bx, s * by + c * bx))


@dataclass(frozen=True, slots=True)
class Sensor:
    """A raw shape and what one step of row and of column is in millimetres on the chip.

    `row_mm` and `column_mm` are (y, x) vectors: (pitch, 0) and (0, pitch) on an ordinary chip. `picture` is the shape
    on whose DFT the `fd` law counts bins, where that isn't this one but another sampling of the same chip.
    """

    shape: tuple[int, int]
    row_mm: Vector
    column_mm: Vector
    picture: Sensor | None = None

    def cycles_per_pixel(self, fy_per_mm: float, fx_per_mm: float) -> Vector:
        """A spatial frequency on the chip (cycles/mm, axes y and x) as cycles/pixel along rows and columns."""
        return (
            fy_per_mm * self.row_mm[0] + fx_per_mm * self.row_mm[1],
            fy_per_mm * self.column_mm[0] + fx_per_mm * self.column_mm[1],
        )

    @property
    def size_mm(self) -> Vector:
        """(height, width) of the chip in mm, for an axis-aligned one."""
        return self.shape[0] * math.hypot(*self.row_mm), self.shape[1] * math.hypot(*self.column_mm)


Law = Callable[[Mask, Sensor, float, float], Lattice]


def fd(mask: Mask, sensor: Sensor, mask_distance_mm: float, focal_length_mm: float) -> Lattice:
    """The thesis' law (Eq 30, Tables 11 and 14): bin = k · f_mask · (d / f) · (pixels / mm).

    As printed it reads 1/mm as mm: an unstated constant of 1 mm² makes the units right. Bins count on the frame's DFT,
    so cycles/pixel are f_mask · (d / f) · 1 mm² / side.
    """
    picture = sensor.picture or sensor
    height_mm, width_mm = picture.size_mm
    step = mask.frequency_per_mm * mask_distance_mm / focal_length_mm  # 1/mm, read as mm
    if sensor.picture is None:
        return Lattice((step / height_mm, 0.0), (0.0, step / width_mm))
    down, across = math.hypot(*picture.row_mm), math.hypot(*picture.column_mm)
    return Lattice(
        sensor.cycles_per_pixel(step / height_mm / down, 0.0), sensor.cycles_per_pixel(0.0, step / width_mm / across)
    )


def geometric(mask: Mask, sensor: Sensor, mask_distance_mm: float, focal_length_mm: float) -> Lattice:
    """Heterodyne geometry (Veeraraghavan et al. 2007): harmonic k at k·f_m·(1 − d/v) on the sensor.

    `focal_length_mm` stands for v, the distance of the exit pupil: the same when focused at infinity.
    """
    f_sensor = mask.frequency_per_mm * (1 - mask_distance_mm / focal_length_mm)  # cycles/mm
    return Lattice(sensor.cycles_per_pixel(f_sensor, 0.0), sensor.cycles_per_pixel(0.0, f_sensor))


LAWS: dict[str, Law] = {"fd": fd, "geometric": geometric}
