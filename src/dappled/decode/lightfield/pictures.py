"""Pictures of what the decoder did: the slice mosaic (Fig 43), the views side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]


def slice_mosaic(slices: NDArray[np.complex64], carriers: NDArray[np.float64], *, longest_side: int = 2400) -> Grey:
    """uint8 (H, W): the slices' magnitudes placed by their orders, conjugate halves filled in.

    `slices` (K, h, w) with `carriers` rows [ky, kx, …] as in a LightField. Each slice from its own 0 to its own
    99.5th percentile. Missing orders (of an octave or diagonal mask) take no room where a whole row or column lacks.
    A conjugate has the same magnitude.
    """
    tiles = {}
    for image, (ky, kx) in zip(slices, carriers[:, :2].astype(int).tolist(), strict=True):
        tile = _stretched(np.abs(image))
        tiles[(ky, kx)] = tile
        tiles.setdefault((-ky, -kx), tile)
    rows = sorted({ky for ky, _ in tiles})
    columns = sorted({kx for _, kx in tiles})
    height, width = slices.shape[1:]
    out = np.full((len(rows) * (height + 2), len(columns) * (width + 2)), 255, dtype=np.uint8)
    for (ky, kx), tile in tiles.items():
        top, left = rows.index(ky) * (height + 2) + 1, columns.index(kx) * (width + 2) + 1
        out[top : top + height, left : left + width] = tile
    return _smaller(out, longest_side)


def view_mosaic(views: NDArray[np.float32], *, longest_side: int = 2400) -> NDArray[np.uint8]:
    """uint8 (H, W) or (H, W, 3): all views (V, U, h, w(, 3)) side by side, one common scale from 0, display gamma."""
    v, u, height, width = views.shape[:4]
    flat = np.moveaxis(views, 2, 1).reshape(v * height, u * width, *views.shape[4:])
    step = max(1, -(-max(flat.shape[:2]) // longest_side))
    flat = flat[::step, ::step]
    top = max(float(np.quantile(flat, 0.995)), 1e-9)
    picture: NDArray[np.uint8] = np.rint(255 * np.clip(flat / top, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return picture


def _stretched(image: NDArray[np.floating]) -> Grey:
    high = max(float(np.quantile(image, 0.995)), 1e-12)
    grey: Grey = np.rint(255 * np.clip(image / high, 0, 1)).astype(np.uint8)
    return grey


def _smaller(picture: Grey, longest_side: int) -> Grey:
    step = max(1, -(-max(picture.shape) // longest_side))
    return np.ascontiguousarray(picture[::step, ::step])
