"""Compute the masked frame from the views of a scene, quickly and without approximation.

The frame is the ray sum I(x) = mean over θ of L_θ(x)·M(where (x, θ) meets the mask). M is a sum of cosines, so the sum
may be taken in another order: first over θ, which gives for each carrier k a smooth image S_k(x) = mean of
L_θ(x)·exp(2πi·k·f_m·α·R·θ), then over carriers, I(x) = Σ_k c_k·S_k(x)·exp(2πi·carrier_k·x). The S_k are band-limited,
so they are made on a coarse grid and their spectra laid around the carriers; one inverse FFT for each of the four sites
of the colour mosaic brings back just the pixels that exist.

The grid is larger than the frame by a margin in which everything fades to zero: the carriers fall between the bins,
and the fraction would otherwise break at the wrap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.optics import Lattice, Order

MARGIN = 24  # view samples outside the frame on each side
FADE = 22  # of which so many fade
Sites = tuple[tuple[tuple[int, int], int], ...]
SITES: Sites = (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2))  # RGGB: (row, column) parity and channel
GREY: Sites = tuple((parity, 1) for parity, _ in SITES)  # no colour filters: every pixel sees the same channel
SHARPER = 2.5
PASS, STOP = 0.82, 0.95  # the views' low-pass, as shares of half the carrier spacing
WORKERS = 2


@dataclass(frozen=True, slots=True)
class Grid:
    """The coarse grid: sample (i, j) of `shape` lies at sensor row `step`·(i − MARGIN), column `step`·(j − MARGIN).

    `half_band` (y, x) in cycles/pixel is half the carrier spacing: what one slice can carry. `sharp`: detail finer than
    that stays in the light behind the mask, as far as the grid holds it, and appears in other slices as in a camera.
    """

    frame: tuple[int, int]
    step: int
    shape: tuple[int, int]
    half_band: tuple[float, float]
    sharp: bool = False

    @classmethod
    def of(cls, frame: tuple[int, int], lattice: Lattice, *, sharp: bool = False) -> Grid:
        """The coarsest grid that holds a slice's band with a quarter to spare; a sharp one is `SHARPER` times finer.

        Raises ValueError where the carriers lie too far apart or too near for this way of making the frame.
        """
        spacing = math.hypot(*lattice.ky), math.hypot(*lattice.kx)
        half_band = spacing[0] / 2, spacing[1] / 2
        step = math.floor(0.4 / max(half_band))
        if not 2 <= step <= 128:
            raise ValueError(
                f"carriers {spacing[0]:.4f} × {spacing[1]:.4f} cycles/pixel apart can't be simulated: "
                "they must be between 0.00625 and 0.4"
            )
        if sharp:
            step = max(2, math.floor(step / SHARPER))
        return cls(frame, step, (_length(frame[0], step), _length(frame[1], step)), half_band, sharp)

    @property
    def fine(self) -> tuple[int, int]:
        """Shape of the padded frame in pixels."""
        return self.shape[0] * self.step, self.shape[1] * self.step

    @property
    def inner(self) -> tuple[slice, slice]:
        """The samples inside the frame."""
        return tuple(slice(MARGIN, MARGIN + -(-side // self.step)) for side in self.frame)  # type: ignore[return-value]  # two sides, two slices

    def places(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sensor rows and columns of the samples."""
        rows, columns = (np.arange(n, dtype=np.float64) for n in self.shape)
        return (rows - MARGIN) * self.step, (columns - MARGIN) * self.step

    def fade(self) -> NDArray[np.float32]:
        """(h, w): one over the frame and the inner margin, falling smoothly to zero at the edges."""
        y, x = (_fade(n) for n in self.shape)
        return np.outer(y, x).astype(np.float32)

    def low_pass(self, axis: int, cycles_per_pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Response of the views' low-pass along one axis: 1 up to PASS of the half band, 0 from STOP."""
        share = np.abs(cycles_per_pixel) / self.half_band[axis]
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip((share - PASS) / (STOP - PASS), 0, 1)))


def mosaic(
    radiance: NDArray[np.float32],
    grid: Grid,
    lattice: Lattice,
    *,
    angular: NDArray[np.complex128],
    weights: dict[Order, float],
    origin_phase: NDArray[np.float64],
    sites: Sites = SITES,
) -> NDArray[np.float32]:
    """The masked frame (H, W) of views `radiance` (J, 3, h, w) on the grid, in the views' scale (DC weight 1).

    A Bayer mosaic unless `sites` say otherwise. `weights` are the carriers' real coefficients for DC and the upper half
    of the orders, `angular` (K, J) what each aperture point counts there (phase and share), `origin_phase` (K,) the
    carriers' phase in radians at pixel (0, 0).
    """
    orders = list(weights)
    light = radiance.reshape(len(radiance), -1)
    parts = np.stack([angular.real, angular.imag], axis=1).astype(np.float32)
    summed = np.empty((2, *radiance.shape[1:]), dtype=np.float32)  # real and imaginary; used again for each carrier
    shifted = np.empty(radiance.shape[1:], dtype=np.complex64)
    half = grid.fine[0] // 2, grid.fine[1] // 2
    spectra = np.zeros((len(sites), *half), dtype=np.complex64)
    fade = grid.fade()
    matrix = lattice.matrix()
    rows, columns = grid.places()
    for number, order in enumerate(orders):
        carrier = np.array(order) @ matrix
        bins = [round(float(carrier[a]) * grid.fine[a]) for a in (0, 1)]
        rest = [float(carrier[a]) - bins[a] / grid.fine[a] for a in (0, 1)]  # cycles/pixel, under half a bin
        weight = weights[order] * (1 if order == (0, 0) else 2)
        start = weight * np.exp(1j * origin_phase[number])
        # on the padded frame pixel (0, 0) stands MARGIN steps in: the whole bins' phase there is taken out
        start *= np.exp(-2j * np.pi * sum(bins[a] * MARGIN * grid.step / grid.fine[a] for a in (0, 1)))
        ramp_y = (start * np.exp(2j * np.pi * rest[0] * rows)).astype(np.complex64)
        ramp_x = np.exp(2j * np.pi * rest[1] * columns).astype(np.complex64)
        ramp = ramp_y[:, None] * ramp_x[None, :] * fade
        np.matmul(parts[number], light, out=summed.reshape(2, -1))
        shifted.real, shifted.imag = summed
        shifted *= ramp
        spectrum = fft.fft2(shifted, norm="forward", overwrite_x=True, workers=WORKERS)
        at = [_Band.of(grid, axis, bins[axis], rest[axis]) for axis in (0, 1)]
        for channel in {channel for _, channel in sites}:
            box = spectrum[channel][np.ix_(at[0].source, at[1].source)]
            for target, ((parity_y, parity_x), seen) in zip(spectra, sites, strict=True):
                if seen == channel:
                    part = box
                    if (response := at[0].response[parity_y]) is not None:
                        part = part * response[:, None]
                    if (response := at[1].response[parity_x]) is not None:
                        part = part * response
                    _add(target, part, at)
    planes = fft.ifft2(spectra, norm="forward", overwrite_x=True, workers=WORKERS).real
    frame = np.empty(grid.fine, dtype=np.float32)
    for ((parity_y, parity_x), _), plane in zip(sites, planes, strict=True):
        frame[parity_y::2, parity_x::2] = plane
    top = MARGIN * grid.step
    return frame[top : top + grid.frame[0], top : top + grid.frame[1]]


def band_limited(radiance: NDArray[np.float32], grid: Grid) -> NDArray[np.float32]:
    """The views that the frame really holds, (J, 3, rows, columns): low-passed, and cut to the frame."""
    ny, nx = grid.shape
    response = np.outer(
        grid.low_pass(0, fft.fftfreq(ny) / grid.step), grid.low_pass(1, fft.rfftfreq(nx) / grid.step)
    ).astype(np.float32)
    fade = grid.fade()
    inner = grid.inner
    rows, columns = inner[0].stop - inner[0].start, inner[1].stop - inner[1].start
    views = np.empty((*radiance.shape[:2], rows, columns), dtype=np.float32)
    for view, out in zip(radiance, views, strict=True):
        spectrum = fft.rfft2(view * fade, workers=WORKERS) * response
        out[:] = fft.irfft2(spectrum, s=grid.shape, workers=WORKERS)[:, *inner]
    return views


@dataclass(frozen=True, slots=True)
class _Band:
    """One axis of a slice's band: its bins in the coarse FFT, where they begin in the half-size FFT of one mosaic
    site, and what they are multiplied by for sites of even and of odd rows (or columns); None: by one."""

    source: NDArray[np.intp]
    first: int
    response: tuple[NDArray[np.complex64] | None, NDArray[np.complex64]]

    @classmethod
    def of(cls, grid: Grid, axis: int, carrier_bin: int, rest: float) -> _Band:
        n, fine = grid.shape[axis], grid.fine[axis]
        reach = n // 2 - 1
        if not grid.sharp:
            reach = min(math.ceil(STOP * grid.half_band[axis] * fine) + 1, reach)
        bins = np.arange(-reach, reach + 1)
        response = np.ones(len(bins)) if grid.sharp else grid.low_pass(axis, bins / fine - rest)
        odd = response * np.exp(2j * np.pi * (bins + carrier_bin) / fine)
        return cls(
            source=bins % n,
            first=(carrier_bin - reach) % (fine // 2),
            response=(None if grid.sharp else response.astype(np.complex64), odd.astype(np.complex64)),
        )


def _add(target: NDArray[np.complex64], box: NDArray[np.complex64], at: list[_Band]) -> None:
    """Add a box into a cyclic array, beginning at `first` on each axis."""
    for to_y, from_y in _pieces(at[0].first, box.shape[0], target.shape[0]):
        for to_x, from_x in _pieces(at[1].first, box.shape[1], target.shape[1]):
            target[to_y, to_x] += box[from_y, from_x]


def _pieces(first: int, count: int, length: int) -> list[tuple[slice, slice]]:
    """(target, source) slices of a run of `count` that may pass the end of a cyclic axis once."""
    head = min(count, length - first)
    pieces = [(slice(first, first + head), slice(0, head))]
    return pieces if head == count else [*pieces, (slice(0, count - head), slice(head, count))]


def _length(side: int, step: int) -> int:
    """An even, quickly transformed number of samples for a frame's side with its margins."""
    n = -(-side // step) + 2 * MARGIN
    while n % 2 or fft.next_fast_len(n) != n:
        n += 1
    return n


def _fade(n: int) -> NDArray[np.float64]:
    edge = np.minimum(np.arange(n), n - 1 - np.arange(n)).astype(np.float64)
    t = np.clip((edge + 0.5) / FADE, 0, 1)
    return np.asarray(t**4 * (35 - 84 * t + 70 * t**2 - 20 * t**3))  # smooth to the third derivative at both ends
