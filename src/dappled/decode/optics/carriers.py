"""Masks, the carriers that they make, and where these lie: sensors, lattices, and the two laws that predict a lattice.

A carrier of integer orders (ky, kx) lies at ky·a + kx·b cycles/pixel, where a and b are the two vectors of a
`Lattice`. A law gives the lattice of a mask behind a lens. The lattice of a lenslet array is found, not predicted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError

Vector = tuple[float, float]
Pattern = Literal["full", "diagonal"]
Harmonics = Literal["linear", "octave"]
Order = tuple[int, int]
Window = Literal["box", "cell"]
_TOO_CLOSE = "the carriers lie too close together to cut slices: check mask and focal length"


@dataclass(frozen=True, slots=True)
class Mask:
    """A mask of cosines.

    `frequency_per_mm` is the fundamental at the mask's own plane. `p` counts harmonics: `linear` ones are 1, 2, 3 … p
    times the fundamental (Fig 14), `octave` ones 1, 2, 4, 8 … (the thesis' text; the same for p = 2). `full` is the
    product of Eq 11, (2p+1)² carriers; `diagonal` is Fig 14's sum of cos·cos, 4p+1 carriers. `film_px_per_mm` is the
    printer's density, None where unknown: the film has no harmonic of less than two pixels a period. Masks that differ
    in it alone are equal.
    """

    frequency_per_mm: float
    p: int
    pattern: Pattern = "full"
    harmonics: Harmonics = "linear"
    film_px_per_mm: float | None = field(default=None, compare=False)

    @property
    def multiples(self) -> tuple[int, ...]:
        """The harmonics as integer multiples of the fundamental, rising."""
        return tuple(2**q if self.harmonics == "octave" else q + 1 for q in range(self.p))

    @property
    def views_per_axis(self) -> int:
        """N = 2p + 1, the views that the carriers of one axis can separate."""
        return 2 * self.p + 1

    def orders(self) -> list[Order]:
        """All carriers (ky, kx): DC first, then the others in rising order. Integer multiples of the fundamental."""
        axis = sorted({0, *self.multiples, *(-m for m in self.multiples)})
        if self.pattern == "full":
            found = set(itertools.product(axis, axis))
        else:
            found = {(sy * m, sx * m) for m in self.multiples for sy in (-1, 1) for sx in (-1, 1)}
        return [(0, 0), *sorted(found - {(0, 0)})]

    def half_orders(self) -> list[Order]:
        """DC, then the orders lexicographically greater than (0, 0): a frame is real, the others are conjugates."""
        return [order for order in self.orders() if order >= (0, 0)]


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
    """Two vectors (fy, fx) in cycles/pixel: one step of ky and one step of kx."""

    ky: Vector
    kx: Vector

    @classmethod
    def of(cls, matrix: NDArray[np.float64]) -> Lattice:
        """The lattice that has this `matrix` (2, 2)."""
        (ay, ax), (by, bx) = matrix.tolist()
        return cls((ay, ax), (by, bx))

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

    def neighbours(self) -> NDArray[np.float64]:
        """(8, 2) the eight shortest steps to other lattice points."""
        orders = np.array([order for order in itertools.product(range(-2, 3), repeat=2) if order != (0, 0)])
        vectors: NDArray[np.float64] = orders @ self.matrix()
        lengths = np.hypot(vectors[:, 0], vectors[:, 1])
        return vectors[np.argsort(lengths, kind="stable")][:8]

    def slice_size(self, padded: tuple[int, int], window: Window = "box") -> tuple[int, int]:
        """(height, width) of a slice in bins of a transform of shape `padded`, as large as the spacing allows.

        For "box" the largest rectangle that overlaps none of its neighbours on the lattice and is no longer than the
        lattice's own cell (the points nearer to one carrier than to any other), for "cell" the smallest one around that
        cell. Both sides have small prime factors, and those of the box are even. Raises DecodeError where the carriers
        lie too close together.
        """
        corners = self._cell_corners() * np.array(padded)
        if not len(corners):
            raise DecodeError(_TOO_CLOSE)
        highest, widest = (2 * float(abs(corners[:, axis]).max()) for axis in (0, 1))
        if window == "cell":
            height, width = (2 * math.ceil(side / 2) + 1 for side in (highest, widest))
            return min(_fast_up(height), padded[0]), min(_fast_up(width), padded[1])
        orders = np.array([(a, b) for a, b in itertools.product(range(-3, 4), repeat=2) if (a, b) != (0, 0)])
        steps = [(y * padded[0], x * padded[1]) for y, x in orders @ self.matrix()]
        best = (0, 0)
        for height in {abs(dy) for dy, _ in steps if abs(dy) > 1}:
            between = min((abs(dx) for dy, dx in steps if abs(dy) < height * (1 - 1e-9)), default=math.inf)
            # A lattice that is turned a little has room for strips as long as the spectrum between its rows.
            high, wide = min(height, highest), min(between, widest)
            if high * wide > best[0] * best[1]:
                best = (math.floor(high + 1e-6), math.floor(wide + 1e-6))
        if min(best) < 2:
            raise DecodeError(_TOO_CLOSE)
        return _fast_down(min(best[0], padded[0])), _fast_down(min(best[1], padded[1]))

    def _cell_corners(self) -> NDArray[np.float64]:
        """The corners (fy, fx) of the lattice's cell around DC."""
        vectors = self.neighbours()
        corners = []
        for a, b in itertools.combinations(vectors, 2):
            matrix = np.array([a, b])
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            point = np.linalg.solve(matrix, np.array([a @ a, b @ b]) / 2)
            if np.all(vectors @ point <= (vectors * vectors).sum(axis=1) / 2 + 1e-12):
                corners.append(point)
        return np.array(corners)


def _fast_up(n: int) -> int:
    """The next size that the FFT is fast for."""
    size = n
    while not _is_fast(size):
        size += 1
    return size


def _fast_down(n: int) -> int:
    """The next smaller even size that the FFT is fast for."""
    size = n
    while size > 2 and (size % 2 or not _is_fast(size)):
        size -= 1
    return size


def _is_fast(n: int) -> bool:
    """Whether n has no prime factor above 11, which is what `scipy.fft.next_fast_len` goes by."""
    for factor in (2, 3, 5, 7, 11):
        while n % factor == 0:
            n //= factor
    return n == 1


@dataclass(frozen=True, slots=True)
class Sensor:
    """A raw shape, and the step from row to row and from column to column in millimetres on the chip.

    `row_mm` and `column_mm` are (y, x) vectors: (pitch, 0) and (0, pitch) on an ordinary chip. `picture` is the
    sampling of the same chip on whose DFT the `fd` law counts bins, where that is not this one.
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

    def aperture_px(self, focal_length_mm: float | None, f_number: float | None) -> float | None:
        """The lens' aperture f/N in columns of the sensor; None where focal length or f-number are unknown."""
        if not (focal_length_mm and f_number):
            return None
        return focal_length_mm / f_number / math.hypot(*self.column_mm)

    def spread(self) -> Sensor:
        """The geometry of a staggered chip's plane once `plane.spread` has put it on twice as many columns."""
        y, x = self.column_mm
        return replace(self, shape=(self.shape[0], 2 * self.shape[1]), column_mm=(y / 2, x / 2))


@dataclass(frozen=True, slots=True)
class MaskedOptics:
    """A mask at `distance_mm` from a sensor, as it was stated, and the name of the law by which it makes carriers."""

    sensor: Sensor
    mask: Mask
    law: str
    distance_mm: float

    def __post_init__(self) -> None:
        """Raises DecodeError for an unknown law."""
        if self.law not in LAWS:
            raise DecodeError(f"unknown law {self.law!r}; known are {', '.join(LAWS)}")

    def by(self, law: str) -> MaskedOptics:
        """The same by another law."""
        return replace(self, law=law)

    def lattice(self, focal_length_mm: float) -> Lattice:
        """Where the law has the carriers, of a mask that is not turned."""
        return LAWS[self.law](self.mask, self.sensor, self.distance_mm, focal_length_mm)


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
