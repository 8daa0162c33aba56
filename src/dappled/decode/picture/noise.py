"""How much of a picture is noise: as bright parts have more of it, and as much as its finest detail leaves open.

The quietest parts tell how noise grows with brightness, and no less than how much there is: where detail up to the
sampling limit is everywhere they hold it, too. The picture's mean spectrum tells one from the other, as detail falls
with frequency like f^-b and noise doesn't. Which b is right is known within limits, and so is the noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.blocks import PatternPlace

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

_NOISE_PX = 16  # samples on a side of the parts that the noise is measured in
_NOISE_LEVELS = 6  # of brightness
_QUIET = 0.1  # of the parts of a level have as little detail as this
_EVEN_OUT = 36.0  # sum of the squares of (1, −2, 1) times itself
_ALIKE = 3.78  # the samples that one independent value of that is spread over: Σ of its autocorrelation squared
_QUIET_SIGMAS = 1.28  # below the mean, where as many values as `_QUIET` lie

_SIDE, _LEAST_SIDE = 48, 12  # samples of a block whose spectrum is taken, and of the smallest that tells anything
_BLOCKS = 8  # of them along a side of the picture, at most
_LOWEST = 4  # bins: below these the window's own width shows
_EXPONENTS = np.arange(1.6, 6.05, 0.1)  # of the power of detail
_BLURS_PX = (0.0, 0.4, 0.6, 0.8, 1.0)  # Gaussian, of lens, pixels and focus over the stop: standard deviations
_LIKELY = 5.0  # twice the log likelihood, of one block alone: exponents that explain a spectrum as badly are left out
_MOST = 2.0  # times the variance that the quietest parts tell
_POOR = 0.05  # mean square of what a power law leaves, relative: it is none, as where a ghost or blur is strong
_ROUNDS = 10  # of the least squares


@dataclass(frozen=True, slots=True)
class NoiseShare:
    """Of what is taken for noise, the shares that are noise at least, and as a mean over all that is likely; of the
    latter the share that no power law explains as detail, all of it where detail follows none."""

    least: float
    mean: float
    sure: float


def noise_of(made: Singles, shadow: Singles) -> tuple[float, float]:
    """(base, slope) of the variance of a frame's noise over its brightness, from the parts of its picture `made` (H, W)
    with least detail.

    Detail up to the sampling limit is taken for noise where it is everywhere.
    """
    bent = np.diff(np.diff(made, 2, axis=0), 2, axis=1)
    rows, columns = (max(1, side // _NOISE_PX) for side in bent.shape)
    high, wide = bent.shape[0] // rows, bent.shape[1] // columns

    def parts(image: NDArray[np.floating]) -> Floats:
        cut = np.asarray(image)[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
        return np.asarray(cut.mean(axis=(1, 3), dtype=np.float64).ravel())

    inner = shadow[1:-1, 1:-1]
    variance = parts(bent * bent) / _EVEN_OUT / parts(np.float32(1) / (inner * inner))
    level = parts(made[1:-1, 1:-1])
    # Of parts that are all alike, the quietest are so by chance.
    variance /= max(0.3, 1 - _QUIET_SIGMAS * math.sqrt(2 * _ALIKE / (high * wide)))
    edges = np.quantile(level, np.linspace(0, 1, _NOISE_LEVELS + 1))
    quiet, at = [], []
    for low, high_level in itertools.pairwise(edges):
        inside = (level >= low) & (level <= high_level)
        if inside.any():
            quiet.append(float(np.quantile(variance[inside], _QUIET)))
            at.append(float(level[inside].mean()))
    slope = max(0.0, float(np.polyfit(at, quiet, 1)[0])) if np.ptp(at) > 0 else 0.0
    base = max(0.0, float(np.median(np.array(quiet) - slope * np.array(at))))
    return base, slope


def noise_share(pictures: Sequence[tuple[PatternPlace, Singles]], variance: float) -> NoiseShare:
    """How much of a mean `variance` a picture's mean spectrum allows to be noise. `pictures` are its samples by place,
    all of one step."""
    side = min(_SIDE, *(min(one.shape) for _, one in pictures))
    if side < _LEAST_SIDE or variance <= 0:
        return NoiseShare(1.0, 1.0, 1.0)
    power = np.mean([_spectrum(one, side) for _, one in pictures], axis=0)
    across = fft.rfftfreq(side)
    known = np.hypot(fft.fftfreq(side)[:, None], across) > _LOWEST / side
    twice = np.broadcast_to(np.where((across == 0) | (across == 0.5), 1.0, 2.0), power.shape)[known]
    seen = power[known]
    falls = _falls(side, pictures[0][0].step)[:, known]
    detail, noise = np.median(seen / falls, axis=1), np.full(len(falls), np.quantile(seen, 0.1))
    for _ in range(_ROUNDS):  # least squares, weighed by what they make of it: Whittle's likelihood
        weights = twice / (detail[:, None] * falls + noise[:, None]) ** 2
        whole, with_falls = weights.sum(axis=1), (weights * falls).sum(axis=1)
        squares, right = (weights * falls**2).sum(axis=1), weights @ seen
        right_falls = (weights * falls) @ seen
        both = np.maximum(squares * whole - with_falls**2, 1e-9 * squares * whole)
        noise = (squares * right - with_falls * right_falls) / both
        detail = np.where(noise > 0, (right_falls * whole - with_falls * right) / both, right_falls / squares)
        noise = np.where(detail > 0, np.maximum(noise, 1e-9 * variance), right / whole)
        detail = np.maximum(detail, 0)
    made = detail[:, None] * falls + noise[:, None]
    unlikely = (twice * (seen / made + np.log(made))).sum(axis=1)
    likely = unlikely - unlikely.min() < _LIKELY
    shares, best = np.clip(noise / variance, 0, _MOST), int(np.argmin(unlikely))
    least = float(shares[likely].min())
    if float((twice * (seen / made[best] - 1) ** 2).sum() / twice.sum()) > _POOR:
        return NoiseShare(min(least, 1.0), 1.0, 1.0)
    odds = np.exp((unlikely[best] - unlikely) / 2)
    mean = float(shares @ odds / odds.sum())
    return NoiseShare(least, mean, least / max(mean, 1e-12))


def _spectrum(image: Singles, side: int) -> Floats:
    """Mean power over blocks (side, side // 2 + 1); of white noise its variance."""
    window = np.hanning(side + 2)[1:-1]
    window = np.outer(window, window).astype(np.float32) / np.mean(window**2)
    starts = [
        np.unique(np.linspace(0, whole - side, min(_BLOCKS, max(1, 2 * (whole // side) - 1))).astype(int))
        for whole in image.shape
    ]
    blocks = np.stack([image[row : row + side, column : column + side] for row, column in itertools.product(*starts)])
    waves = fft.rfft2((blocks - blocks.mean(axis=(1, 2), keepdims=True)) * window)
    power = (waves.real**2 + waves.imag**2).mean(axis=0, dtype=np.float64)
    return np.asarray(power / side**2)


@lru_cache(maxsize=8)
def _falls(side: int, step: tuple[int, int]) -> Floats:
    """f^-b, blurred, up to the sensor's sampling limit for each exponent and blur, as samples `step` apart have it."""
    total = np.zeros((len(_EXPONENTS), len(_BLURS_PX), side, side // 2 + 1))
    blurs = (2 * np.pi * np.array(_BLURS_PX)) ** 2
    for folds in itertools.product(*(range(-(one // 2) - 1, one // 2 + 2) for one in step)):
        y, x = (
            (f + fold) / one for f, fold, one in zip((fft.fftfreq(side), fft.rfftfreq(side)), folds, step, strict=True)
        )
        inside = np.outer(*(np.clip((0.5 - np.abs(one)) * 1e9 + 0.5, 0, 1) for one in (y, x)))  # half on the limit
        if inside.any():
            f = np.maximum(np.hypot(y[:, None], x), 1e-3)
            blurred = inside * np.exp(-blurs[:, None, None] * f**2)
            total += np.exp(-_EXPONENTS[:, None, None] * np.log(f))[:, None] * blurred
    return total.reshape(-1, side, side // 2 + 1)
