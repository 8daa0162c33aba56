"""Make views from slices: the inverse angular transform.

A slice over its transfer is an angular Fourier coefficient of the light field (see `aperture`). The views are the light
field at N×N points of the aperture: the most probable ones (minimum mean square error) given these coefficients, their
noise, and that all views share one image and differ by a certain power. At κ = 1 and without noise this is the inverse
DFT. With noise it is its Wiener form M²/(M² + λ). At other κ it allows for the aperture's true size. What a mask does
not sample (the missing orders of a diagonal mask, the parallax of a stopped-down frame) stays at the common image and
is not made up.

For lenslets u counts from a lenslet's centre, the coefficient's sign is the other one, and all orders below the
Nyquist frequency are there: the views are the plain Fourier sum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dappled.decode.lightfield.aperture import Aperture, transfer
from dappled.decode.optics import Carrier

Views = NDArray[np.float32]
# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_SHARED = 1e3  # variance of what all views share, over that of what one view has alone
_MODEL_ERROR = 0.45  # over the root of a slice's shorter side: the frame's end rings in a share of each slice
_COLOURED = 0.3  # of a band's finest detail is counted as chroma; all of it would count parallax as chroma, too
_SMALLEST_NOISE = 1e-9  # relative variance of a coefficient: float32 and its transforms


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
        weight = abs(transfers[k]) ** 2  # a strong carrier is known better
        total += weight * max(power, 0.0)
        share += weight * max(float(own[k]), 1e-3 * one)
    floor = 1e-6 * float(np.mean(dc.real**2))
    ceiling = max(float(np.var(dc.real)), floor)  # views differ by where the picture is, not by more than it holds
    return max(min(total / share if share else 0.0, ceiling), floor, 1e-12)


def finest_detail(image: NDArray[np.complexfloating]) -> float:
    """The variance of white noise that would explain what a complex image (h, w) holds against the mask
    [1 −2 1]ᵀ[1 −2 1] (Immerkær 1996): planes and slow changes do not affect it. 0 for images under 3 × 3."""
    if min(image.shape) < 3:
        return 0.0
    rows = image[:-2] - 2 * image[1:-1] + image[2:]
    both = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.mean(both.real**2 + both.imag**2)) / 36


def chroma_noise(slices: NDArray[np.complex64], common: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(K,) variance of chroma in the slices of a colour mosaic, from their finest detail beside `common` (K,) times the
    first slice; 0 for the first."""
    noise = [_COLOURED * finest_detail(s - c * slices[0]) for s, c in zip(slices[1:], common[1:], strict=True)]
    return np.array([0.0, *noise])


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
    angular: NDArray[np.float64],
    transfers: NDArray[np.complex128],
    *,
    aperture: Aperture,
    noise_variance: float,
    model_error: float | None = None,
    colours: bool = False,
) -> Views:
    """Views float32 (V, U, h, w) of a masked frame.

    `slices` complex64 (K, h, w) with DC first and no carrier together with its conjugate; `angular` (K, 2) their
    angular frequencies, `transfers` (K,) their T_k (T_0 = 1); `noise_variance` of a slice pixel; `model_error` the
    relative error of what all views share, in a coefficient (None: what the frame's end rings). With `colours` the
    frame was a colour mosaic: the chroma in a band is estimated from its finest detail and counts as noise; where the
    orders carry no information, the views are the image that they share.
    """
    if model_error is None:
        model_error = _MODEL_ERROR / math.sqrt(min(slices.shape[1:]))
    # What all views share comes through a carrier with the aperture's transform of it, and its error with that.
    shared = np.abs(transfers * aperture.transform(angular)) ** 2 * float(np.mean(slices[0].real ** 2))
    noise = noise_variance + model_error**2 * shared * np.any(angular != 0, axis=1)
    if colours:
        noise += chroma_noise(slices, transfers * aperture.transform(angular))
    alone = view_variance(slices, angular, transfers, aperture, noise)
    coefficients = unmixing(angular, transfers, aperture, noise_variance=noise, view_variance=alone)
    return combine(coefficients, slices).reshape(aperture.views, aperture.views, *slices.shape[1:])


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
