"""A colour mosaic in blocks: its samples by place of the colour pattern, their local means, and sums over plane waves.

Rows and columns are counted from the frame's centre, so that no phase depends on the frequency that it is taken at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles

EMPTY = -1  # in a pattern: no sample there, as on the spread plane of a staggered chip
_PASSES = 3  # of a running mean as long as the carriers' period: what is left of them is its cube
_AT_ONCE = 64  # samples of a line that are averaged by one product


@dataclass(frozen=True, slots=True, eq=False)
class MosaicPlane:
    """A linear plane float32 (H, W), 1.0 = sensor white. `pattern` (a, b) repeats over it: a colour's index from 0, or
    `EMPTY`. `valid` (H, W) is False for clipped and defective pixels; None: all are good."""

    plane: Singles
    pattern: NDArray[np.intp]
    valid: NDArray[np.bool_] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.plane.shape[0], self.plane.shape[1]

    @property
    def colours(self) -> int:
        """How many colours there are."""
        return int(self.pattern.max()) + 1

    @property
    def there(self) -> NDArray[np.bool_]:
        """(H, W) where the chip has samples."""
        repeats = [-(-side // n) for side, n in zip(self.shape, self.pattern.shape, strict=True)]
        return np.asarray(np.tile(self.pattern != EMPTY, repeats)[: self.shape[0], : self.shape[1]])

    def places(self) -> Iterator[PatternPlace]:
        """The samples of each place of the pattern that has any."""
        for (row, column), colour in np.ndenumerate(self.pattern):
            if colour != EMPTY:
                yield PatternPlace(int(row), int(column), int(colour), (self.pattern.shape[0], self.pattern.shape[1]))


@dataclass(frozen=True, slots=True)
class PatternPlace:
    """One place of a colour pattern of the size `step`."""

    row: int
    column: int
    colour: int
    step: tuple[int, int]

    @property
    def cut(self) -> tuple[slice, slice]:
        """What cuts its samples from a frame."""
        return slice(self.row, None, self.step[0]), slice(self.column, None, self.step[1])

    def at(self, shape: tuple[int, int]) -> tuple[Floats, Floats]:
        """Rows and columns of its samples, from the frame's centre."""
        rows, columns = (
            np.arange(first, side, step, dtype=np.float64) - (side - 1) / 2
            for first, side, step in zip((self.row, self.column), shape, self.step, strict=True)
        )
        return rows, columns


def kept_by_mean(frequencies: Floats, reach_px: float, step: tuple[int, int]) -> NDArray[np.complex128]:
    """(K,) what `local_mean` keeps of waves of these frequencies (K, 2), in cycles a pixel: next to nothing, but of
    those that fold to low ones on samples that stand far apart. Its middle lies half a sample on where it has none."""
    kept = np.ones(len(frequencies), dtype=np.complex128)
    for f, one in zip(frequencies.T, step, strict=True):
        size, around = _width(reach_px, one), _PASSES * (_width(reach_px, one) - 1)
        shares = np.exp(-2j * np.pi * np.outer(f * one, np.arange(size) - (size - 1) / 2)).mean(axis=1).real
        kept *= shares**_PASSES * np.exp(1j * np.pi * f * one * (around % 2))
    return kept


def local_mean(values: Singles, reach_px: float, step: tuple[int, int], weights: Singles | None = None) -> Singles:
    """Values (h, w) of one place averaged over about `reach_px` pixels of the frame; `weights` 0 leaves samples out.

    With weights the values have been multiplied by them already, and are divided by the weights' own mean.
    """
    sizes = [_width(reach_px, one) for one in step]
    if weights is None:
        return _smooth(values, sizes)
    mean = _smooth(weights, sizes)
    return np.asarray(_smooth(values, sizes) / np.maximum(mean, 1e-3), dtype=np.float32)


def _width(reach_px: float, step: int) -> int:
    return max(1, round(reach_px / step))


def _smooth(values: Singles, sizes: list[int]) -> Singles:
    made = values
    for axis, size in enumerate(sizes):
        if size > 1:
            made, one = np.empty(values.shape, dtype=np.float32), made
            for own, near, shares in _averages(values.shape[axis], size):
                if axis == 0:
                    np.matmul(shares, one[near], out=made[own])
                else:
                    np.matmul(one[:, near], shares.T, out=made[:, own])
    return made


@lru_cache(maxsize=32)
def _averages(side: int, size: int) -> tuple[tuple[slice, slice, Singles], ...]:
    """Running means of `size` samples, `_PASSES` times over, as products of matrices: which samples of a line each is
    for, of which ones, and their shares."""
    made, beside = [], _PASSES * size
    for start in range(0, side, _AT_ONCE):
        end = min(side, start + _AT_ONCE)
        first, last = max(0, start - beside), min(side, end + beside)
        shares = np.eye(last - first)
        for turn in range(_PASSES):  # an even number of samples to either side by turns
            origin = -1 if size % 2 == 0 and turn != 1 else 0
            shares = ndimage.uniform_filter1d(shares, size, 0, mode="nearest", origin=origin)
        made.append((slice(start, end), slice(first, last), shares[start - first : end - first].astype(np.float32)))
    return tuple(made)


def block_sums(values: Singles, down: NDArray[np.intp], across: NDArray[np.intp]) -> Floats:
    """Sums over blocks that begin at these rows and columns."""
    left, right = (
        (np.arange(length) >= starts[:, None]).astype(np.float32)
        - (np.arange(length) >= np.append(starts[1:], length)[:, None])
        for starts, length in zip((down, across), values.shape, strict=True)
    )
    return np.asarray((left.astype(np.float32) @ values).astype(np.float64) @ right.T)


def wave_sums(
    values: Singles,
    rows: Floats,
    columns: Floats,
    frequencies: Floats,
    edges: tuple[NDArray[np.intp], NDArray[np.intp]],
) -> NDArray[np.complex64]:
    """(…, blocks down, blocks across, K): sums of values (…, h, w) · e^{−2πi f·x} over blocks that begin at `edges`."""
    down = plane_waves(rows, frequencies[:, 0])
    parts = plane_waves(columns, frequencies[:, 1]).view(np.float32)  # of each wave, real and imaginary
    starts, ends = edges[1], [*edges[1][1:], len(columns)]
    made = np.empty((*values.shape[:-2], len(edges[0]), len(starts), len(frequencies)), dtype=np.complex64)
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        whole = (values[..., start:end] @ parts[start:end]).view(np.complex64)
        whole *= down
        made[..., index, :] = np.add.reduceat(whole, edges[0], axis=-2)
    return made


def plane_waves(places: Floats, frequencies: Floats) -> NDArray[np.complex64]:
    """(n, K) e^{−2πi f·x}. Whole turns are taken off first: then single precision, which is fast, tells the rest."""
    turns = np.outer(places, frequencies)
    turns -= np.rint(turns)
    phases = (-2 * np.pi * turns).astype(np.float32)
    made = np.empty(phases.shape, dtype=np.complex64)
    made.real, made.imag = np.cos(phases), np.sin(phases)
    return made
