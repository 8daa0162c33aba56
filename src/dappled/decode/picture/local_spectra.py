"""Wiener's filter in small blocks that overlap: of each frequency as much is kept as stands above what disturbs it.

Blocks have flat windows with slopes of a sine, whose squares add up to 1. What a frequency holds is averaged over its
neighbours, and drawn towards the mean of a wider neighbourhood as far as that one is sure to hold less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from dappled.decode.array_types import Floats, Singles

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

SIDE = 64  # pixels of a block
_HOP = 48  # from block to block
_NEAR = 2  # bins to each side that a spectrum is averaged over; and once more, with the next blocks, the wider mean
_SCATTER = 2.0  # over the bins of an average: the variance of a window's neighbouring bins, which share some of it


@dataclass(frozen=True, slots=True, eq=False)
class Disturbed:
    """`noise` (H, W) is the variance of white noise in each pixel. `ghosts` (blocks down, blocks across, K) are the
    variances of K disturbances with the spectra `spectra` (K, SIDE, SIDE // 2 + 1), of mean 1 over the whole plane, in
    blocks of `lengths` pixels."""

    noise: Singles
    ghosts: Floats
    spectra: Singles
    lengths: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """What is kept, (H, W); per block of `lengths` pixels that begin at `first` the share of the noise's variance that
    is left, the variance that ghosts leave, and of what is no noise the share that is taken for ghosts."""

    kept: Singles
    noise_left: Floats
    ghosts_left: Floats
    ghost_share: Floats
    lengths: tuple[int, int]
    first: int


def filtered(values: Singles, disturbed: Disturbed) -> Filtered:
    """Values (H, W) of zero mean, with as much of each local frequency as is worth keeping."""
    over = SIDE - _HOP
    slope = np.sin(np.pi / 2 * (np.arange(over) + 0.5) / over)
    window = np.concatenate([slope, np.ones(SIDE - 2 * over), slope[::-1]])
    shape = values.shape
    counts = [-(-(side + over) // _HOP) for side in shape]
    widths = [(over, count * _HOP - side) for count, side in zip(counts, shape, strict=True)]
    padded = np.pad(values, widths, mode="reflect")
    noise = _in_blocks(disturbed.noise, window**2, counts, over)
    shares = [
        between(np.arange(count) * _HOP - over + SIDE / 2, length, number)
        for count, length, number in zip(counts, disturbed.lengths, disturbed.ghosts.shape[:2], strict=True)
    ]
    whole = np.einsum("ai,ijk,bj->abk", shares[0], disturbed.ghosts, shares[1])
    power_kept = float(np.mean(window**2)) ** 2  # of a block behind its window
    ghosts = (whole * power_kept).astype(np.float32)
    spectra = disturbed.spectra.reshape(len(disturbed.spectra), -1)
    window2 = np.outer(window, window).astype(np.float32)
    made = np.zeros_like(padded)
    left, ghosts_left, lost = np.zeros((3, *counts))
    starts = np.arange(counts[1]) * _HOP
    for row in range(counts[0]):
        strip = padded[row * _HOP : row * _HOP + SIDE]
        blocks = np.stack([strip[:, start : start + SIDE] for start in starts]) * window2
        waves = fft.rfft2(blocks)
        power = (waves.real**2 + waves.imag**2) * np.float32(1 / SIDE**2)
        ghost = (ghosts[row] @ spectra).reshape(power.shape)
        against = ghost + noise[row].astype(np.float32)[:, None, None]
        weights = _weights(power, against)
        detail = np.maximum(power.sum(axis=(1, 2)) - noise[row] * power[0].size, 0)
        left[row] = weights.mean(axis=(1, 2))
        ghosts_left[row] = (weights * ghost).mean(axis=(1, 2)) / power_kept
        lost[row] = ghost.sum(axis=(1, 2)) / np.maximum(detail, 1e-30)
        back = fft.irfft2(waves * weights, s=(SIDE, SIDE)) * window2
        for block, start in zip(back, starts, strict=True):
            made[row * _HOP : row * _HOP + SIDE, start : start + SIDE] += block
    kept = np.ascontiguousarray(made[over : over + shape[0], over : over + shape[1]])
    return Filtered(kept, left, ghosts_left, lost, (_HOP, _HOP), -over // 2)


def _weights(power: Singles, against: Singles) -> Singles:
    """Wiener's weights of each bin (blocks, SIDE, SIDE // 2 + 1), from its power and that of what disturbs it."""
    near = _mean_of_bins(power)
    wide = _mean_of_bins(near)
    wide[1:-1] = (wide[:-2] + wide[1:-1] + wide[2:]) / 3
    wide = np.maximum(wide - against, 0)
    own = near - against
    scatter = (against + wide) ** 2 * np.float32(_SCATTER / (2 * _NEAR + 1) ** 2)
    square = wide * wide
    detail = np.maximum((own * square + wide * scatter) / (square + scatter + np.float32(1e-30)), 0)
    return np.asarray(detail / (detail + against + np.float32(1e-30)), dtype=np.float32)


def _mean_of_bins(power: Singles) -> Singles:
    """Over `_NEAR` bins to each side along both axes."""
    return np.asarray(_DOWN @ (power @ _ACROSS))


def _near(count: int, whole: int) -> Singles:
    """(count, count) the mean over `_NEAR` bins to each side, of the first `count` of `whole` bins: a real picture's
    spectrum repeats, and where it is cut it is about even."""
    steps = np.arange(-_NEAR, _NEAR + 1)
    at = (np.arange(count) + steps[:, None]) % whole
    at = np.where(at < count, at, whole - at)
    made = np.zeros((count, count), dtype=np.float32)
    np.add.at(made, (at, np.broadcast_to(np.arange(count), at.shape)), np.float32(1 / len(steps)))
    return made


_DOWN, _ACROSS = _near(SIDE, SIDE).T, _near(SIDE // 2 + 1, SIDE)


def _in_blocks(values: Singles, weights: Floats, counts: list[int], over: int) -> Floats:
    """The weighed mean of values (H, W) in each block."""
    sides = []
    for side, count in zip(values.shape, counts, strict=True):
        line = np.zeros((count, side), dtype=np.float32)
        for block in range(count):
            first = block * _HOP - over
            start, end = max(0, first), min(side, first + SIDE)
            line[block, start:end] = weights[start - first : end - first]
        sides.append(line / np.maximum(line.sum(axis=1, keepdims=True), np.float32(1e-6)))
    return np.asarray((sides[0] @ values @ sides[1].T).astype(np.float64)) * float(weights.mean()) ** 2


def between(places: Floats, length: int, count: int) -> Floats:
    """(n, blocks): linear interpolation between the middles of blocks of `length`, constant beyond the outer ones."""
    at = np.clip(np.asarray(places) / length - 0.5, 0, count - 1)
    return np.asarray(np.maximum(0, 1 - np.abs(at[:, None] - np.arange(count))))
