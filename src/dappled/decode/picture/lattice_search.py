"""Search a frame's lattice of carriers near the predicted one: how far a print is turned and scaled."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import fft

from dappled.decode.array_types import Singles
from dappled.decode.optics import Lattice, Order

# Chosen by hand; tests/decode/picture measures what all such numbers together make.

_STEP_BINS = 0.3  # of the search, at the outermost order
_CLEAR = 5.5  # standard deviations of what the search finds where no carriers are


def searched(part: Singles, lattice: Lattice, orders: Sequence[Order], *, turned: float, scaled: float) -> Lattice:
    """The lattice, turned (radians) and scaled (a share) by no more than given, at which the spectrum of `part` (h, w),
    frame over local mean less 1, has its peaks; the given one where it has none."""
    part = part * np.outer(np.hanning(part.shape[0]), np.hanning(part.shape[1])).astype(np.float32)
    size = [fft.next_fast_len(side, real=True) for side in part.shape]
    power = np.abs(fft.rfft2(part, s=size)) ** 2
    there = np.asarray(orders, dtype=np.float64) @ lattice.matrix()
    largest = float(np.hypot(*(there * part.shape).T).max())
    counts = [math.ceil(reach * largest / _STEP_BINS) for reach in (scaled, turned)]
    scales, turns = (np.linspace(-reach, reach, 2 * n + 1) for reach, n in zip((scaled, turned), counts, strict=True))
    scores = np.zeros((len(scales), len(turns)))
    for fy, fx in there:
        y = (1 + scales[:, None]) * (np.cos(turns) * fy - np.sin(turns) * fx)
        x = (1 + scales[:, None]) * (np.sin(turns) * fy + np.cos(turns) * fx)
        flip = np.where(x - np.round(x) < 0, -1, 1)  # a real frame: the other half is conjugate
        rows = np.round(flip * y * size[0]).astype(np.intp) % size[0]
        columns = np.minimum(np.round(np.abs(x - np.round(x)) * size[1]).astype(np.intp), power.shape[1] - 1)
        near = power[rows, columns]
        scores += np.log1p(near / max(float(np.median(near)) / math.log(2), 1e-12))
    middle, scatter = 0.596 * len(there), 0.62 * math.sqrt(len(there))  # of log(1 + an exponential variable)
    at = np.unravel_index(int(np.argmax(scores)), scores.shape)
    if scores[at] < middle + _CLEAR * scatter:
        return lattice
    turn, scale = turns[at[1]], 1 + scales[at[0]]
    return Lattice.of(scale * lattice.rotated(float(turn)).matrix())
