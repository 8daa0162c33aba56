"""Refit where the mask stands, from one frame: a mask that moved or turned since its calibration.

A lens' aperture is symmetric, so at any depth and any spatial frequency f the slice of order k over its transfer T_k is
in phase with the mean slice, or opposed to it: (S_k(f) / T_k) · conj(S_0(f)) is real. Its square is positive whatever
the depth and the texture are, and noise adds nothing to the mean of squares. So a mask that moved by x cycles shows as
a phase of 4π k·x in the sum of these squares, in ordinary frames at any aperture, and one that turned or stretched as
an x that changes over the frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics import Lattice, Order

_BLOCKS = 3  # along each side: places at which the mask's shift is looked at
_REACH = 0.22  # cycles: a shift by more than a quarter can't be told from one the other way
_TURN_RAD = np.radians(0.5)
_SURE = 25.0  # gain in squared standard deviations that a refit must bring


@dataclass(frozen=True, slots=True, eq=False)
class MaskShift:
    """The mask against its calibration: `origin` in cycles of ky and kx at the frame's centre, and `change` of that
    from one end of the frame to the other, (2, 2) rows ky, kx, columns down and across, by a turn of `turn_rad`.
    `gain` is what they explain, in squared standard deviations."""

    origin: tuple[float, float]
    turn_rad: float
    change: NDArray[np.float64]
    gain: float

    def turns(self, orders: Sequence[Order], shape: tuple[int, int]) -> NDArray[np.complex64]:
        """(K, h, w) what the slices of these orders are to be multiplied by to undo the shift."""
        k = np.asarray(orders, dtype=np.float64)
        slope = k @ self.change
        down, across = (_places(side) for side in shape)
        rows = np.exp(-2j * np.pi * (k @ np.array(self.origin))[:, None] - 2j * np.pi * np.outer(slope[:, 0], down))
        columns = np.exp(-2j * np.pi * np.outer(slope[:, 1], across))
        return np.asarray(rows[:, :, None] * columns[:, None, :], dtype=np.complex64)


def mask_shift(
    slices: NDArray[np.complex64],
    transfers: NDArray[np.complex128],
    orders: Sequence[Order],
    *,
    lattice: Lattice,
    shape: tuple[int, int],
) -> MaskShift | None:
    """How far the mask of a frame of this shape is from where `transfers` (K,) have it, by slices complex64 (K, h, w),
    DC first, cut at `lattice`; None where the frame does not say that it moved. A turn is added where it explains more.
    """
    used = [n for n in range(1, len(orders)) if abs(transfers[n]) > 1e-3]
    if not used or np.linalg.matrix_rank([orders[n] for n in used]) < 2:
        return None
    k = np.array([orders[n] for n in used], dtype=np.float64)
    squares, places = _squares(slices, transfers, used)
    turned = lattice.matrix() @ np.array([[0.0, 1.0], [-1.0, 0.0]]) * shape  # cycles over the frame for one radian
    columns = np.stack([*np.broadcast_to(k.T[:, None], (2, len(places), len(k))), places @ turned.T @ k.T], axis=-1)

    def left(unknown: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(squares * np.exp(-4j * np.pi * columns @ unknown))

    steps = np.linspace(-_REACH, _REACH, 23)
    best = max(
        (np.array([y, x, 0.0]) for y, x in itertools.product(steps, steps)), key=lambda one: left(one).real.sum()
    )
    weight = np.sqrt(np.abs(squares)).ravel()
    fits = [np.zeros(3)]
    for free in (2, 3):
        for _ in range(8):  # Gauss–Newton on the doubled phases, weighed by what they hold
            phases = np.angle(left(best)).ravel() / (4 * np.pi)
            design = columns[..., :free].reshape(-1, free)
            best[:free] += np.linalg.lstsq(design * weight[:, None], phases * weight, rcond=None)[0]
        fits.append(best.copy())
    scores = [2 * float(left(one).real.sum()) for one in fits]
    chosen = 2 if scores[2] > scores[1] + _SURE else 1
    gain = scores[chosen] - scores[0]
    y, x, turn = (float(one) for one in fits[chosen])
    if gain < _SURE or max(abs(y), abs(x)) > _REACH + 0.03 or abs(turn) > _TURN_RAD:
        return None
    return MaskShift((y, x), turn, turn * turned, gain)


def _squares(
    slices: NDArray[np.complex64], transfers: NDArray[np.complex128], used: Sequence[int]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """(B, K) sums of squares over the frequencies of each block, in standard deviations of noise alone, and the blocks'
    middles (B, 2) from −0.5 to 0.5 of the frame."""
    found, places = [], []
    cuts = [_cuts(side) for side in slices.shape[1:]]
    for (top, high), (left, wide) in itertools.product(*cuts):
        window = np.outer(np.hanning(high + 2)[1:-1], np.hanning(wide + 2)[1:-1]).astype(np.float32)
        block = slices[:, top : top + high, left : left + wide] * window
        spectra = np.fft.fft2(block)
        mean = spectra[0]
        row = []
        for n in used:
            product = spectra[n] * np.conj(mean) * np.conj(transfers[n]) / abs(transfers[n])
            total = product**2
            row.append(total.sum() / max(float(np.sqrt((np.abs(total) ** 2).sum() / 2)), 1e-30))
        found.append(row)
        places.append(((top + high / 2) / slices.shape[1] - 0.5, (left + wide / 2) / slices.shape[2] - 0.5))
    return np.array(found), np.array(places)


def _cuts(side: int) -> list[tuple[int, int]]:
    """(start, length) of overlapping blocks along a side."""
    length = max(8, 2 * side // (_BLOCKS + 1))
    if length >= side:
        return [(0, side)]
    return [(round(n * (side - length) / (_BLOCKS - 1)), length) for n in range(_BLOCKS)]


def _places(side: int) -> NDArray[np.float64]:
    return (np.arange(side) + 0.5) / side - 0.5
