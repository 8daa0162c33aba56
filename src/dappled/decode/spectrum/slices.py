"""Slices: the band around each carrier, brought to baseband and transformed back (Eq 12, with fractional carriers)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.bands import Bands, lay_out
from dappled.decode.spectrum.padded import Complex, Spectrum

Window = Literal["box", "cell"]


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """`values` complex64 (K, h, w), one slice a carrier; `grid` float64 (2, 3), from (y, x, 1) to sensor (row, column).

    `band` is the share of the plane's white noise power that one slice takes up: variance of a slice pixel over
    variance of a plane pixel.
    """

    values: Complex
    carriers: tuple[Carrier, ...]
    grid: NDArray[np.float64]
    band: float


def default_size(lattice: Lattice, padded: tuple[int, int], window: Window = "box") -> tuple[int, int]:
    """(height, width) in bins of the padded transform: as large as the lattice's spacing allows, cut at Nyquist.

    For "box" the largest rectangle that overlaps none of its neighbours on the lattice, for "cell" the smallest one
    around the lattice's own cell (the points nearer to one carrier than to any other). Both sides have small prime
    factors; the box's are even.
    """
    steps = [
        (y * padded[0], x * padded[1])
        for y, x in (
            np.array([(a, b) for a, b in itertools.product(range(-3, 4), repeat=2) if (a, b) != (0, 0)])
            @ lattice.matrix()
        )
    ]
    if window == "cell":
        corners = _cell_corners(lattice) * np.array(padded)
        height, width = (2 * math.ceil(abs(corners[:, axis]).max()) + 1 for axis in (0, 1))
        return min(_fast_up(height), padded[0]), min(_fast_up(width), padded[1])
    best = (0, 0)
    for height in {abs(dy) for dy, _ in steps if abs(dy) > 1}:
        width = min((abs(dx) for dy, dx in steps if abs(dy) < height * (1 - 1e-9)), default=float(padded[1]))
        if height * width > best[0] * best[1]:
            best = (math.floor(height + 1e-6), math.floor(width + 1e-6))
    if min(best) < 2:
        raise DecodeError("the carriers lie too close together to cut slices: is this the right mask and focal length?")
    return _fast_down(min(best[0], padded[0])), _fast_down(min(best[1], padded[1]))


@dataclass(frozen=True, slots=True, eq=False)
class SlicePlan:
    """Where the slices of these carriers lie in spectra of one shape; made by `plan_slices`, applied to many frames."""

    carriers: tuple[Carrier, ...]
    bands: Bands
    padded: tuple[int, int]
    share: float

    def apply(self, spectrum: Spectrum, *, workers: int = 1, beside: Sequence[Callable[[], None]] = ()) -> Slices:
        """The slices of a spectrum; other work is done `beside`."""
        values = np.empty((len(self.carriers), *self.bands.samples), dtype=np.complex64)
        self.bands.cut(spectrum, values, workers=workers, beside=beside)
        (high, wide), (height, width) = self.padded, self.bands.size
        grid = np.array([[high / height, 0.0, 0.0], [0.0, wide / width, 0.0]])
        return Slices(values, self.carriers, grid, self.share)


def extract(
    spectrum: Spectrum,
    carriers: Sequence[Carrier],
    size: tuple[int, int] | None = None,
    *,
    lattice: Lattice | None = None,
    window: Window = "box",
    taper: float = 0.0,
    wrap: bool = False,
    workers: int = 1,
) -> Slices:
    """The slices of these carriers.

    `size` is (height, width) of the band in bins; by default `default_size` of `lattice`, which is otherwise only
    needed for the window "cell". `wrap` lets a band go on cyclically past the edge of the spectrum (sampled lenslet
    arrays); else what lies beyond Nyquist is 0. `taper` is the share of the band, 0 to 1, that falls off to its edges
    as a raised cosine (Tukey's window; 1 is Hann's): less ringing, less detail. Scaled so that the slice of (0, 0) has
    the plane's local mean; phases are those at pixel (0, 0), the fraction of a bin compensated exactly. The slices end
    where the frame ends. The same numbers as `equations.slice_at`, for all carriers at once.
    """
    plan = plan_slices(
        spectrum.shape, spectrum.padded, carriers, size, lattice=lattice, window=window, taper=taper, wrap=wrap
    )
    return plan.apply(spectrum, workers=workers)


def plan_slices(
    shape: tuple[int, int],
    padded: tuple[int, int],
    carriers: Sequence[Carrier],
    size: tuple[int, int] | None = None,
    *,
    lattice: Lattice | None = None,
    window: Window = "box",
    taper: float = 0.0,
    wrap: bool = False,
) -> SlicePlan:
    """`extract` for all frames of `shape`, transformed over `padded`."""
    if not carriers:
        raise DecodeError("no carriers to cut slices at")
    if size is None or window == "cell":
        if lattice is None:
            raise DecodeError("slices need a size, or a lattice to take it from")
        size = size or default_size(lattice, padded, window)
    height, width = size
    if not (2 <= height <= padded[0] and 2 <= width <= padded[1]):
        raise DecodeError(f"a slice of {height}×{width} bins doesn't fit a spectrum of {padded}")
    if not 0 <= taper <= 1:
        raise DecodeError(f"the taper is {taper:g}: it must be a share of the band, from 0 to 1")
    share = height * width / (padded[0] * padded[1])
    cell = None
    if window == "cell" and lattice is not None:
        cell = _cell_weights(lattice, padded, size)
    if taper:
        cell = taper_weights(size, taper) * (1 if cell is None else cell)
    if cell is not None:
        share *= float(np.mean(cell**2))
    samples = _samples(shape[0], padded[0], height), _samples(shape[1], padded[1], width)
    bands = lay_out(padded, carriers, size, samples, wrap=wrap, cell=cell)
    return SlicePlan(tuple(carriers), bands, padded, share)


def taper_weights(size: tuple[int, int], taper: float) -> NDArray[np.float32]:
    """Tukey's window over a band, float32 (h, w): 1 at DC (h//2, w//2), to 0 at the edges."""
    rows, columns = (_tukey(np.abs(np.arange(side) - side // 2) / (side / 2), taper) for side in size)
    return np.outer(rows, columns).astype(np.float32)


def _tukey(out: NDArray[np.float64], taper: float) -> NDArray[np.float64]:
    """Tukey's window at `out`, 0 in the middle and 1 at the edge."""
    falling = np.clip((out - (1 - taper)) / taper, 0, 1)
    weights: NDArray[np.float64] = 0.5 * (1 + np.cos(np.pi * falling))
    return weights


def _samples(side: int, padded: int, size: int) -> int:
    """How many samples of a transform of `size` over `padded` pixels stand on the frame's own pixels."""
    return min(size, (side - 1) * size // padded + 1)


def _cell_weights(lattice: Lattice, padded: tuple[int, int], size: tuple[int, int]) -> NDArray[np.float32]:
    """(h, w), DC at h//2, w//2: 1 where a bin is nearest to the middle carrier, 0 nearer to another, ½ between two."""
    y = (np.arange(size[0]) - size[0] // 2)[:, None] / padded[0]
    x = (np.arange(size[1]) - size[1] // 2)[None, :] / padded[1]
    bin_width = 1 / min(padded)
    weights = np.ones(size)
    for vector in _neighbours(lattice):
        length = math.hypot(*vector)
        beyond = (y * vector[0] + x * vector[1]) / length - length / 2  # distance past the bisector, cycles/pixel
        weights *= np.clip(0.5 - beyond / bin_width, 0, 1)
    return weights.astype(np.float32)


def _neighbours(lattice: Lattice) -> NDArray[np.float64]:
    orders = np.array([order for order in itertools.product(range(-2, 3), repeat=2) if order != (0, 0)])
    vectors: NDArray[np.float64] = orders @ lattice.matrix()
    lengths = np.hypot(vectors[:, 0], vectors[:, 1])
    return vectors[np.argsort(lengths, kind="stable")][:8]


def _cell_corners(lattice: Lattice) -> NDArray[np.float64]:
    """The corners (fy, fx) of the lattice's cell around DC."""
    vectors = _neighbours(lattice)
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
    return int(fft.next_fast_len(n))


def _fast_down(n: int) -> int:
    size = n
    while size > 2 and (size % 2 or int(fft.next_fast_len(size)) != size):
        size -= 1
    return size
