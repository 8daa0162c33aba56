"""Views: the inverse angular transform of the slices.

The model. Light from aperture point θ (mm, at distance v in front of the sensor) reaches sensor point x through mask
point (1−α)x + αθ, α = d/v. With a mask Σ_k M_k e^{2πi k·(f_m R ξ + x0)} and R its rotation the plane is

    I(x) = Σ_k M_k e^{2πi k·(F x + x0)} ∫ L(x, θ) e^{2πi ω_k·θ} dθ,   ω_k = κ k·R,   κ = f_m α A,

θ counted in shares of the aperture's diameter A. So slice_k / T_k, with T_k = M_k e^{2πi k·x0}, is the angular Fourier
coefficient of L at ω_k cycles over the aperture, known up to the frame's noise. The views are the light field at N×N
points of the aperture: the most probable ones (minimum mean square error) given these coefficients, their noise, and
that all views share one image and differ by a certain power. At κ = 1 and without noise this is the inverse DFT; with
noise it is its Wiener form M²/(M² + λ); at other κ it allows for the aperture's true size; and what a mask does not
sample (a diagonal mask's missing orders, a stopped-down frame's parallax) is left at the common image, not made up.

For lenslets u counts from a lenslet's centre, the coefficient's sign is the other one, and all orders below the
Nyquist frequency are there: the views are the plain Fourier sum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dappled.decode.optics.carriers import Carrier, Order

Views = NDArray[np.float32]
Shape = Literal["beams", "filled", "round"]
_SHARED = 1e3  # variance of what all views share, over that of what one view has alone
_MODEL_ERROR = 0.45  # over the root of a slice's shorter side: the frame's end rings in a share of each slice
_COLOURED = 0.3  # of a band's finest detail is taken for chroma; all of it would take parallax for chroma, too
_PARTS = 15  # of a cell's side, where a circle cuts through cells
_SMALLEST_NOISE = 1e-9  # relative variance of a coefficient: float32 and its transforms


@dataclass(frozen=True, slots=True)
class Aperture:
    """How light comes through the aperture in the model: N views an axis over its full width, each one cell of it.

    "beams": through the middle of each cell. "filled": through the whole of each cell. "round": through what of each
    cell lies in the circle; a view whose cell lies outside keeps its place, and shows what the others say about it.
    """

    views: int
    shape: Shape = "beams"

    def points(self) -> NDArray[np.float64]:
        """(V·U, 2) the cells' middles (v, u) in shares of the full aperture, −0.5 to 0.5, rows first."""
        return _middles(self.views)

    def offsets(self) -> NDArray[np.float64]:
        """(V, U, 2) the views' own points."""
        return self.points().reshape(self.views, self.views, 2)

    def cells(self, angular: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(K, V·U) ∫ e^{2πi ω·θ} dθ over each view's cell for (K, 2) frequencies ω in cycles over the aperture, as a
        share of the whole aperture: at 0 the share of the light that each view has."""
        angular, n = np.asarray(angular), self.views
        if self.shape != "round":
            cells = np.asarray(np.exp(2j * np.pi * angular @ self.points().T) / n**2, dtype=np.complex128)
            if self.shape == "filled":
                cells *= np.sinc(angular / n).prod(axis=1)[:, None]
            return cells
        fine = n * _PARTS
        parts = np.exp(2j * np.pi * angular @ _middles(fine).T) * _in_circle(fine)
        parts *= np.sinc(angular / fine).prod(axis=1)[:, None]
        return np.asarray(parts.reshape(-1, n, _PARTS, n, _PARTS).sum(axis=(2, 4)).reshape(-1, n * n))

    def transform(self, angular: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(K,) the same over the whole aperture; 1 at 0."""
        if self.shape != "round":
            return np.asarray(self.cells(angular).sum(axis=1), dtype=np.complex128)
        turns = np.pi * np.hypot(*np.asarray(angular).T)
        whole = 2 * special.j1(turns) / np.where(turns > 0, turns, 1.0)
        return np.where(turns > 0, whole, 1.0).astype(np.complex128)


def _middles(n: int) -> NDArray[np.float64]:
    """(n², 2) the middles of n × n cells over the full aperture, rows first."""
    axis = (np.arange(n) - (n - 1) / 2) / n
    return np.array(list(itertools.product(axis, axis)), dtype=np.float64)


@cache
def _in_circle(n: int) -> NDArray[np.float64]:
    """(n²,) what each of n × n cells has of the circle, as a share of the circle."""
    fine = 16
    axis = (np.arange(n * fine) - (n * fine - 1) / 2) / (n * fine)
    inside = (np.hypot(axis[:, None], axis[None, :]) <= 0.5).reshape(n, fine, n, fine).sum(axis=(1, 3)).ravel()
    return np.asarray(inside / inside.sum(), dtype=np.float64)


def kappa(frequency_per_mm: float, mask_distance_mm: float, focal_length_mm: float, f_number: float) -> float:
    """κ = f_m · α · A: cycles of the mask's fundamental that the aperture A = v / f-number sweeps over."""
    return frequency_per_mm * mask_distance_mm / focal_length_mm * (focal_length_mm / f_number)


def angular_frequencies(orders: Sequence[Order], kappa_cycles: float, rotation_rad: float) -> NDArray[np.float64]:
    """(K, 2) ω_k = κ k·R in cycles over the aperture, rotated as `Lattice.rotated` rotates the carriers."""
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    turn = np.array([[c, s], [-s, c]])
    rotated: NDArray[np.float64] = kappa_cycles * np.asarray(orders, dtype=np.float64).reshape(-1, 2) @ turn
    return rotated


def transfer(
    orders: Sequence[Order], magnitudes: Sequence[float] | NDArray[np.float64], origin: tuple[float, float]
) -> NDArray[np.complex128]:
    """(K,) T_k = M_k e^{2πi k·x0}, lattice-linear phases from one origin x0 (cycles of ky and of kx)."""
    turns = np.asarray(orders, dtype=np.float64).reshape(-1, 2) @ np.asarray(origin)
    transfers: NDArray[np.complex128] = np.asarray(magnitudes) * np.exp(2j * np.pi * turns)
    return transfers


def unmixing(
    angular: NDArray[np.float64],
    transfers: NDArray[np.complex128],
    aperture: Aperture,
    *,
    noise_variance: float | NDArray[np.float64],
    view_variance: float,
) -> NDArray[np.complex128]:
    """(V·U, K) coefficients G: views = Re(G @ slices), for the half plane of carriers with DC first.

    `noise_variance` of a slice's pixel (real and imaginary part together; one, or one per slice), `view_variance`
    of what one view has beside the image that all share; both in squared plane units.
    """
    kernel = aperture.cells(angular)
    is_dc = np.all(angular == 0, axis=1)
    parts = np.concatenate([kernel.real, kernel.imag[~is_dc]])
    noise = noise_variance / np.abs(transfers) ** 2 / np.where(is_dc, 1.0, 2.0)
    noise = np.concatenate([noise, noise[~is_dc]]) / max(view_variance, 1e-30) + _SMALLEST_NOISE
    shared = _SHARED * np.outer(parts.sum(axis=1), parts.sum(axis=1))  # parts @ 11ᵀ @ partsᵀ
    data = parts @ parts.T + shared + np.diag(noise)
    cross = parts.T + _SHARED * parts.sum(axis=1)
    solution = np.linalg.solve(data, cross.T).T
    count = len(transfers)
    coefficients = solution[:, :count].astype(np.complex128)
    coefficients[:, ~is_dc] -= 1j * solution[:, count:]
    unmixed: NDArray[np.complex128] = coefficients / transfers
    return unmixed


def view_variance(
    slices: NDArray[np.complex64],
    angular: NDArray[np.float64],
    transfers: NDArray[np.complex128],
    aperture: Aperture,
    noise_variance: NDArray[np.float64],
) -> float:
    """The mean square of what one view has beside the common image, from the slices themselves less their noise."""
    common, cells = aperture.transform(angular), aperture.cells(angular)
    total, share = 0.0, 0.0
    one = float((np.abs(cells[0]) ** 2).sum())
    own = (np.abs(cells - common[:, None] * cells[0]) ** 2).sum(axis=1)  # what comes through of views' own power
    step = max(1, math.isqrt(slices[0].size // 16384))
    height, width = slices.shape[1:]
    # The tenth at each edge is left out: there the frame's end rings in every band.
    inner = slice(height // 10, height - height // 10, step), slice(width // 10, width - width // 10, step)
    dc = slices[0][inner]
    for k in range(1, len(slices)):
        alone = slices[k][inner] / transfers[k] - common[k] * dc
        power = float(np.mean(alone.real**2 + alone.imag**2)) - noise_variance[k] / abs(transfers[k]) ** 2
        weight = abs(transfers[k]) ** 2  # a strong carrier knows better
        total += weight * max(power, 0.0)
        share += weight * max(float(own[k]), 1e-3 * one)
    floor = 1e-6 * float(np.mean(dc.real**2))
    ceiling = max(float(np.var(dc.real)), floor)  # views differ by where the picture is, not by more than it holds
    return max(min(total / share if share else 0.0, ceiling), floor, 1e-12)


def finest_detail(image: NDArray[np.complexfloating]) -> float:
    """The variance of white noise that would explain what a complex image (h, w) holds against the mask
    [1 −2 1]ᵀ[1 −2 1] (Immerkær 1996): blind to planes and slow changes. 0 for images under 3 × 3."""
    if min(image.shape) < 3:
        return 0.0
    rows = image[:-2] - 2 * image[1:-1] + image[2:]
    both = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.mean(both.real**2 + both.imag**2)) / 36


def combine(coefficients: NDArray[np.complex128], slices: NDArray[np.complex64]) -> Views:
    """Re(G @ slices) as float32 (rows of G, h, w)."""
    count, height, width = slices.shape
    flat = np.empty((2 * count, height * width), dtype=np.float32)
    flat[:count].reshape(count, height, width)[...] = slices.real
    flat[count:].reshape(count, height, width)[...] = slices.imag
    weights = np.concatenate([coefficients.real, -coefficients.imag], axis=1).astype(np.float32)
    views: Views = (weights @ flat).reshape(-1, height, width)
    return views


def from_slices(
    slices: NDArray[np.complex64],
    orders: Sequence[Order],
    transfers: NDArray[np.complex128],
    *,
    kappa_cycles: float,
    rotation_rad: float,
    aperture: Aperture,
    noise_variance: float,
    model_error: float | None = None,
    colours: bool = False,
) -> tuple[Views, NDArray[np.float64]]:
    """(views float32 (V, U, h, w), view_offsets float64 (V, U, 2)) of a masked frame.

    `slices` complex64 (K, h, w) with DC first and no carrier together with its conjugate; `transfers` (K,) their T_k
    (T_0 = 1); `noise_variance` of a slice pixel; `model_error` the relative error of what all views share, in a
    coefficient (None: what the frame's end rings). With `colours` the frame was a colour mosaic: what chroma a band
    holds is guessed from its finest detail and counts as noise, and where orders tell nothing views fall back to the
    image that they share. The offsets are shares of the frame's own aperture.
    """
    angular = angular_frequencies(orders, kappa_cycles, rotation_rad)
    if model_error is None:
        model_error = _MODEL_ERROR / math.sqrt(min(slices.shape[1:]))
    # What all views share comes through a carrier with the aperture's transform of it, and its error with that.
    shared = np.abs(transfers * aperture.transform(angular)) ** 2 * float(np.mean(slices[0].real ** 2))
    noise = noise_variance + model_error**2 * shared * np.any(angular != 0, axis=1)
    if colours:
        common = transfers * aperture.transform(angular)
        noise[1:] += [_COLOURED * finest_detail(s - c * slices[0]) for s, c in zip(slices[1:], common[1:], strict=True)]
    alone = view_variance(slices, angular, transfers, aperture, noise)
    coefficients = unmixing(angular, transfers, aperture, noise_variance=noise, view_variance=alone)
    n = aperture.views
    return combine(coefficients, slices).reshape(n, n, *slices.shape[1:]), aperture.offsets()


def from_lenslet_slices(
    slices: NDArray[np.complex64],
    carriers: Sequence[Carrier],
    origin: tuple[float, float],
    offsets_px: NDArray[np.float64],
    rolloff: float | None = None,
) -> Views:
    """Views float32 (V, U, h, w) of a lenslet frame at pixel offsets (V, U, 2) from the lenslets' centres.

    view(δ) = Σ_k w_k slice_k e^{−2πi k·x0} e^{2πi f_k·δ} over all carriers, conjugates included. `rolloff` in
    cycles/pixel is where w falls off, w = 1/(1 + (|f|/rolloff)⁶); None: w = 1.
    """
    orders = [(c.ky, c.kx) for c in carriers]
    turns = transfer(orders, np.ones(len(orders)), origin)
    frequencies = np.array([(c.fy, c.fx) for c in carriers])
    kernel = np.exp(2j * np.pi * offsets_px.reshape(-1, 2) @ frequencies.T) * np.conj(turns)
    if rolloff is not None:
        kernel /= 1 + (np.hypot(frequencies[:, 0], frequencies[:, 1]) / rolloff) ** 6
    twice = np.array([1.0 if order == (0, 0) else 2.0 for order in orders])  # a carrier and its conjugate
    n_v, n_u = offsets_px.shape[:2]
    return combine(kernel * twice, slices).reshape(n_v, n_u, *slices.shape[1:])
