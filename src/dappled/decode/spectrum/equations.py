"""Decoding as the equations say it, in double precision, one carrier at a time: what the fast path is tested against.

`Exposure`, `Transform` and `Bands` make the same numbers in single precision, all carriers at once, at a small part of
the cost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.padded import padded_shape


def padded_plane(plane: NDArray[np.floating], level: float) -> NDArray[np.float64]:
    """The plane (H, W) less `level`, with zeros at its lower and right edge: float64 (Hp, Wp)."""
    high, wide = padded_shape((plane.shape[0], plane.shape[1]))
    padded = np.zeros((high, wide))
    padded[: plane.shape[0], : plane.shape[1]] = plane.astype(np.float64) - level
    return padded


def slice_at(
    plane: NDArray[np.floating], carrier: Carrier, size: tuple[int, int], *, level: float, wrap: bool = False
) -> NDArray[np.complex128]:
    """The slice of one carrier (Eq 12), complex128 (h, w) over the padded plane.

    S[n] = 1/(Hp Wp) Σ_k F[c + k] e^{2πi k·n/size} · e^{−2πi (f − c)·n/size} for whole bins c + k around the carrier's
    frequency f in bins, c = round(f), −size/2 ≤ k < size/2. F is the padded plane's DFT, 0 beyond Nyquist unless
    `wrap`. The slice of (0, 0) gets the level back.
    """
    padded = padded_plane(plane, level)
    spectrum = np.fft.fft2(padded)
    band = np.zeros(size, dtype=np.complex128)
    f = carrier.fy * padded.shape[0], carrier.fx * padded.shape[1]
    k = [np.arange(side) - side // 2 for side in size]
    rows, columns = (round(f[axis]) + k[axis] for axis in (0, 1))
    band[...] = spectrum[np.ix_(rows % padded.shape[0], columns % padded.shape[1])]
    if not wrap:
        band[np.abs(rows) > padded.shape[0] // 2, :] = 0
        band[:, np.abs(columns) > padded.shape[1] // 2] = 0
    image = np.fft.ifft2(np.fft.ifftshift(band), norm="forward") / padded.size
    n = [np.arange(side) / side for side in size]
    image *= np.exp(-2j * np.pi * (f[0] - round(f[0])) * n[0])[:, None]
    image *= np.exp(-2j * np.pi * (f[1] - round(f[1])) * n[1])[None, :]
    return image + level if (carrier.ky, carrier.kx) == (0, 0) else image
