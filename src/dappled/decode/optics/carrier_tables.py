"""Tabulate predicted carriers over focal lengths (Tables 11, 14), with what an installed mask adds to a law.

An installed mask is turned, makes crossed orders that are not in its pattern, and loses contrast by diffraction on the
way to the sensor.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Lattice, Mask, MaskedOptics, Order, Sensor
from dappled.decode.optics.lenses import focal_length, within


@dataclass(frozen=True, slots=True)
class HarmonicPlace:
    """The position of one harmonic of a mask at one focal length.

    `horizontal_px` and `vertical_px` are bins of the frame's DFT from its centre; the `_mm` are those distances on a
    DFT drawn as large as the sensor (the thesis' f' of Table 11, for which the `fd` law gives one value on both axes).
    """

    multiple: int
    frequency_per_mm: float
    horizontal_px: float
    vertical_px: float
    horizontal_mm: float
    vertical_mm: float
    horizontal_on_sensor: bool
    vertical_on_sensor: bool
    contrast: float


@dataclass(frozen=True, slots=True)
class FocalRow:
    """One focal length of a table: its harmonics, the lowest first, and the largest slice that does not alias.

    `slice_px` is (height, width) in bins, None where the carriers lie too close together to cut any.
    """

    focal_length_mm: float
    harmonics: tuple[HarmonicPlace, ...]
    slice_px: tuple[int, int] | None


def lattice_of(optics: MaskedOptics, focal_length_mm: float, *, rotation_rad: float = 0.0) -> Lattice:
    """The lattice of a mask turned by `rotation_rad` (from the row axis to the column axis).

    The laws are linear in the mask's frequency vector, so a turned mask's steps are mixtures of the upright one's; on
    pixels that are not square the result is not `Lattice.rotated`. Raises DecodeError for nonsense in any value.
    """
    focal_length(focal_length_mm)
    within(
        "mask distance", optics.distance_mm, "mm", 1e-3, 0.999 * focal_length_mm, hint="it lies between sensor and lens"
    )
    within("mask frequency", optics.mask.frequency_per_mm, "cycles/mm", 1e-3, 1e5)
    within("rotation", rotation_rad, "rad", -math.pi, math.pi, hint="is it in radians?")
    upright = optics.lattice(focal_length_mm)
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    (ay, ax), (by, bx) = upright.ky, upright.kx
    return Lattice((c * ay + s * by, c * ax + s * bx), (-s * ay + c * by, -s * ax + c * bx))


def lattice_rotation(lattice: Lattice, sensor: Sensor) -> float:
    """The rotation of a mask, rad from the row axis to the column axis: the mean turn of its two steps in mm."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])  # (row, column) steps as (y, x) mm
    per_mm = lattice.matrix() @ np.linalg.inv(to_sensor).T  # rows: cycles/mm along y and x
    turns = math.atan2(per_mm[0, 1], per_mm[0, 0]), math.atan2(-per_mm[1, 0], per_mm[1, 1])
    return (turns[0] + turns[1]) / 2


def contrast(mask_distance_mm: float, frequency_per_mm: float, wavelength_nm: float = 550.0) -> float:
    """The contrast of a cosine that is left after diffraction from mask to sensor (Eq 30): cos(π·λ·d·f²), 1 at the
    mask, −1 reversed."""
    return math.cos(math.pi * fresnel_number(mask_distance_mm, frequency_per_mm, wavelength_nm))


def fresnel_number(mask_distance_mm: float, frequency_per_mm: float, wavelength_nm: float = 550.0) -> float:
    """λ·d·f², without unit: a mask is designed to stay at or below 0.25."""
    within("mask distance", mask_distance_mm, "mm", 0, 1e4)
    within("wavelength", wavelength_nm, "nm", 200, 2000)
    return wavelength_nm * 1e-6 * mask_distance_mm * frequency_per_mm**2


def crossed_orders(mask: Mask) -> list[Order]:
    """Orders between the mask's harmonics that are not in its pattern, rising; seen in Tables 12, 13, 15 and 16.

    None for a full pattern, which contains them all.
    """
    asked = set(mask.orders())
    axis = sorted({0, *mask.multiples, *(-m for m in mask.multiples)})
    return [order for order in itertools.product(axis, axis) if order not in asked]


def table(optics: MaskedOptics, focal_lengths_mm: Sequence[float], *, wavelength_nm: float = 550.0) -> list[FocalRow]:
    """Tables 11 and 14: where each harmonic lands over focal lengths (any frame shape, upright pixels)."""
    mask, (height, width) = optics.mask, optics.sensor.shape
    height_mm, width_mm = optics.sensor.size_mm
    rows = []
    for length in focal_lengths_mm:
        lattice = lattice_of(optics, length)
        down, across = abs(lattice.ky[0]), abs(lattice.kx[1])
        harmonics = tuple(
            HarmonicPlace(
                multiple=m,
                frequency_per_mm=m * mask.frequency_per_mm,
                horizontal_px=m * across * width,
                vertical_px=m * down * height,
                horizontal_mm=m * across * width_mm,
                vertical_mm=m * down * height_mm,
                horizontal_on_sensor=m * across < 0.5,
                vertical_on_sensor=m * down < 0.5,
                contrast=contrast(optics.distance_mm, m * mask.frequency_per_mm, wavelength_nm),
            )
            for m in mask.multiples
        )
        rows.append(FocalRow(length, harmonics, slice_size(lattice, optics.sensor.shape)))
    return rows


def beyond_mask(mask: Mask, sensor: Sensor, lattice: Lattice) -> str | None:
    """What is wrong where a lattice puts a mask's highest harmonic at a higher frequency than the mask itself has.

    A shadow of a film on a sensor behind it is never finer than the film. None where the lattice asks for no more.
    """
    limit = None if mask.film_px_per_mm is None else mask.film_px_per_mm / 2
    drawn = [m for m in mask.multiples if limit is None or m * mask.frequency_per_mm <= limit * (1 + 1e-9)]
    top = max(drawn, default=1)
    to_mm = np.linalg.inv(np.array([sensor.row_mm, sensor.column_mm])).T
    asked = top * float(np.hypot(*(lattice.matrix() @ to_mm).T).max())
    own = top * mask.frequency_per_mm
    if asked <= own * 1.02:  # the print's scale is not known to better
        return None
    film = "" if limit is None else f", and its film draws nothing above {limit:.3g}"
    return (
        f"the law puts harmonic ×{top} at {asked:.4g} cycles/mm on the sensor, but on the mask it has {own:.3g}{film}: "
        "no shadow can be finer than the mask"
    )


def slice_size(lattice: Lattice, shape: tuple[int, int]) -> tuple[int, int] | None:
    """(height, width) in bins of the largest slice that overlaps no neighbour; None where there is no room for any."""
    try:
        return lattice.slice_size(shape)
    except DecodeError:
        return None


@dataclass(frozen=True, slots=True)
class BestFocalLength:
    """The focal lengths at which an installed mask just fills the spectrum, in mm.

    At `carriers_mm` the outermost carrier lies on the spectrum's edge, at `slices_mm` the edge of its slice, half a
    step farther out. None where no focal length brings it there.
    """

    carriers_mm: float | None
    slices_mm: float | None


def best_focal_length(optics: MaskedOptics) -> BestFocalLength:
    """The focal length that uses an installed mask's sensor best: by bisection, whatever the law, from 1 to 2000 mm.

    Under `fd` a longer lens draws the carriers together, so the shortest that fits is the best. Under `geometric` it
    spreads them (towards k·f_m), and the answer is the longest that fits, None where all do.
    """
    far, lowest = max(optics.mask.multiples), max(1.0, optics.distance_mm / 0.99)

    def outermost(length_mm: float, orders: float) -> float:
        lattice = lattice_of(optics, length_mm)
        return orders * max(abs(lattice.ky[0]), abs(lattice.kx[1])) - 0.5

    def crossing(orders: float) -> float | None:
        low, high = lowest, 2000.0
        at_low, at_high = outermost(low, orders), outermost(high, orders)
        if at_low * at_high > 0:
            return None
        for _ in range(80):
            middle = (low + high) / 2
            if outermost(middle, orders) * at_low > 0:
                low = middle
            else:
                high = middle
        return high

    return BestFocalLength(crossing(far), crossing(far + 0.5))
