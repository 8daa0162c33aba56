"""Decoding as the equations say it, step by step in double precision: what the fast path is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.lineariser import Plane
from dappled.decode.spectrum.transform import padded_shape


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


def even_colours(plane: Plane, cfa: NDArray[Any], reference: Sequence[int], *, cell_px: int = 48) -> Plane:
    """The plane with every colour brought to the reference colours' local mean, changed in place.

    `cfa` (a, b) colour indices as in `to_plane`, `reference` the indices of green (of all colours for their plain
    mean). A colour cast that varies slowly modulates the mosaic at the colour pattern's own frequencies, and the mask
    repeats it around all its carriers: into other carriers' bands. Local means are taken over `cell_px`, several
    periods of any mask or lenslet.
    """
    pattern = np.asarray(cfa, dtype=np.intp)
    a, b = pattern.shape
    steps = max(1, cell_px // a), max(1, cell_px // b)
    if plane.shape[0] < a * steps[0] or plane.shape[1] < b * steps[1]:
        return plane
    cells = _cell_means(plane, (a, b), steps)
    means = {
        int(colour): np.mean([cells[at] for at, c in np.ndenumerate(pattern) if c == colour], axis=0)
        for colour in np.unique(pattern)
    }
    known = [means[colour] for colour in reference if colour in means]
    if not known:
        return plane
    wanted = np.mean(known, axis=0)
    floor = 1e-3 * max(float(wanted.mean()), 1e-12)
    for (row, column), colour in np.ndenumerate(pattern):
        mean = means[int(colour)]
        gain = np.where(mean > floor, np.clip(wanted / np.maximum(mean, floor), 0.1, 10), 1.0)
        pixels = plane[row::a, column::b]
        down, across = (
            _between((np.arange(size) + 0.5) / step, blocks)
            for size, step, blocks in zip(pixels.shape, steps, gain.shape, strict=True)
        )
        pixels *= down @ gain.astype(np.float32) @ across.T
    return plane


def _cell_means(
    plane: Plane, period: tuple[int, int], steps: tuple[int, int]
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """The mean of each cell for each place (row, column) of the colour pattern; a cell is `steps` patterns."""
    (a, b), (down, across) = period, steps
    rows, columns = plane.shape[0] // (a * down), plane.shape[1] // (b * across)
    cells = plane[: rows * down * a, : columns * across * b].reshape(rows, down, a, columns, across, b)
    means = cells.mean(axis=(1, 4), dtype=np.float64)
    return {(row, column): means[:, row, :, column] for row in range(a) for column in range(b)}


def _between(places: NDArray[np.floating], blocks: int) -> NDArray[np.float32]:
    """(n, blocks): linear interpolation at n places, counted in blocks from the first one's edge.

    Between the blocks' middles; constant beyond the outer ones.
    """
    middles = np.arange(blocks) + 0.5
    weights = [np.interp(places, middles, block) for block in np.eye(blocks)]
    return np.stack(weights, axis=1).astype(np.float32)
