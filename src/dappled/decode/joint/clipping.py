"""What clipped pixels would hold, which patches of views have them, and what is unknown where they are many."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.joint.frame_views import TakenSlices
from dappled.decode.joint.patch_model import SIDE
from dappled.decode.joint.patches import Patches
from dappled.decode.lightfield import LightField

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

# Of the mask's period: 1 σ of the window in which light is taken as even. It keeps 0.68 of a band's finest detail, 0.17
# with 0.75, which left 1 to 2.3 dB more to a sensor without a white (half the ideal aperture, 1 % clipped, 6 seeds).
_NEAR = 0.35
_LEAST_KNOWN = 1e-3  # of the window
_ROWS = 64  # at a time: complex waves take twice the plane's memory


def unclipped(plane: Singles, clipped: Singles, taken: TakenSlices) -> Singles:
    """A plane (H, W) with clipped pixels, where `clipped` (H, W) is above 0, as bright as what is around them tells.

    The mask lets more light to some pixels than to their neighbours: m(x) = Σ_k T_k W(κk) e^{2πi f_k·x} of it, where a
    scene is even over a few pixels. There the pixels that are not clipped tell the light Σ m·plane / Σ m² (Gaussian
    window), and m times it is what a clipped one would hold. A stop of the ideal aperture and more evens m out to 1: a
    highlight is clipped as a whole then, and nothing is changed.
    """
    pixels = [2j * np.pi * np.arange(side) for side in plane.shape]
    frequencies = np.array([(c.fy, c.fx) for c in taken.carriers])
    down, across = (np.exp(np.outer(at, f)).astype(np.complex64) for at, f in zip(pixels, frequencies.T, strict=True))
    weights = taken.model().common()[: len(frequencies)] * np.where(frequencies.any(axis=1), 2, 1)
    through = np.empty(plane.shape, dtype=np.float32)
    for rows in np.array_split(np.arange(len(plane)), max(1, len(plane) // _ROWS)):
        through[rows] = ((down[rows] * weights.astype(np.complex64)) @ across.T).real
    known = (clipped <= 0) & (plane != 0)  # staggered sensors have places without a sample
    sigma = [_NEAR * step for step in taken.samples_px]
    told, there = (
        ndimage.gaussian_filter(np.where(known, through * values, np.float32(0)), sigma) for values in (plane, through)
    )
    told *= through / np.maximum(there, _LEAST_KNOWN)
    return np.where((clipped <= 0) | (there < _LEAST_KNOWN), plane, np.maximum(plane, told))


def unknown_where_clipped(field: LightField, clipped: Singles, most: float) -> LightField:
    """The light field with `view_sigma` NaN in patches of which more than the share `most` is clipped.

    `clipped` (H, W) is 1 where a pixel of the frame is clipped, else 0 (its local mean counts). The attribute
    `view_sigma`, an rms over the frame, then leaves these patches out; it is None where none is left.
    """
    if field.view_sigma is None:
        return field
    lost = clipped_shares(clipped, field.views.shape[2:4], field.grid) > most
    if not lost.any():
        return field
    sigma = np.where(lost, np.float32(np.nan), field.view_sigma)
    told = None if lost.all() else np.sqrt(np.mean(sigma[:, :, ~lost] ** 2, axis=2)).tolist()
    return replace(field, view_sigma=sigma, attributes={**field.attributes, "view_sigma": told})


def clipped_shares(clipped: Singles, shape: tuple[int, ...], grid: Floats) -> Floats:
    """(m, n) the share of each patch that is clipped, of slices of `shape` (h, w) on this `grid` (see `LightField`)."""
    rows, columns = Patches((shape[0], shape[1]), SIDE).grid
    across = _summed(clipped, _bounds(rows, grid[0, 0], grid[0, 2]))
    total = _summed(across.T, _bounds(columns, grid[1, 1], grid[1, 2])).T
    return np.asarray(total / (SIDE**2 * grid[0, 0] * grid[1, 1]), dtype=np.float64)


def _bounds(patches: int, step: float, first: float) -> Floats:
    """(patches + 2,) in pixels: patch i lies from bound i to bound i + 2, half over each neighbour."""
    half = SIDE // 2
    return np.asarray((half * np.arange(-1, patches + 1) - 0.5) * step + first + 0.5)


def _summed(values: Singles, bounds: Floats) -> Singles:
    """(patches, …) sums over the rows of each patch; a patch beyond the frame has less."""
    ends = np.clip(np.rint(bounds), 0, len(values)).astype(int)
    halves = np.stack([values[a:b].sum(axis=0, dtype=np.float32) for a, b in itertools.pairwise(ends)])
    return np.asarray(halves[:-1] + halves[1:])
