"""Where a picture is out of focus: what parallax over the stop leaves of the mask's pattern, and what to show there.

Out of focus a carrier's band holds another function of the scene than its local mean times a constant, so the frame
over the shadow keeps a ghost: about Σ e^{2πi k·F x} a_k·∇L with L the band around the mean, which has no ghost and no
detail beyond half of the carriers' distance. Detail of the scene itself goes with ∇L at the carriers no more than
between them. Block by block the two are compared; where the ghost stands out, sharp picture and band are mixed as their
errors tell (a Wiener weight). So they are where all that is finer than the band is hardly more than noise, and
neighbouring pixels, of other colours too, share next to nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.blocks import PatternPlace, block_sums, wave_sums
from dappled.decode.picture.shadow import Shadow, period_of

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

_BLOCK_PX, _BLOCK_PERIODS = 64, 8  # a block's side is at least both
_EDGE = (0.45, 0.55)  # of the carriers' distance: where the band ends
_SEEN, _SURE = 3.0, 8.0  # ghost and detail over detail: from where on it counts, and counts in full
_GEOMETRIC = 1.2  # mean of Gamma(2) variables over the exponential of their mean logarithm, of four
_QUIET, _DETAILED = 1.2, 2.0  # what is finer than the band over its noise: up to where it is weighed, and is not
_FALLS = 2.5  # times: neighbouring pixels share at least one part in so many of the flattest detail
_AROUND = ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))
_ALONG = 60.0  # times what is on diagonals: edges along rows or columns have all their detail on a line of carriers
_GAIN = 0.2  # a square period: by how much a ghost gains on detail, found for f^-1.1 to f^-1.5, 1 to 5 px a view
_MARGIN_PERIODS = 4  # reflected around the frame before it is transformed


@dataclass(frozen=True, slots=True, eq=False)
class Sharp:
    """The samples of one place of the colour pattern: over the shadow, before that, and the variance of their noise."""

    place: PatternPlace
    picture: Singles
    frame: Singles
    noise: Singles


@dataclass(frozen=True, slots=True, eq=False)
class Mixed:
    """The picture's samples with the band in place of ghosts and of noise; for each, the share of the noise's standard
    error that is left, None where all is. `soft_share` of the blocks lose more than half of their detail to ghosts."""

    pictures: list[Singles]
    sigma_left: list[Singles] | None
    soft_share: float


def band_of(frame: Singles, step: tuple[int, int], shadow: Shadow) -> Singles:
    """What a frame's samples (h, w) hold around the mean, up to half of the way to the carriers."""
    margins = [
        min(side - 1, round(_MARGIN_PERIODS * period_of(shadow.lattice) / one))
        for side, one in zip(frame.shape, step, strict=True)
    ]
    size = [fft.next_fast_len(n + 2 * margin, real=True) for n, margin in zip(frame.shape, margins, strict=True)]
    widths = [(margin, whole - n - margin) for n, margin, whole in zip(frame.shape, margins, size, strict=True)]
    padded = np.pad(frame, [(a, min(b, n - 1)) for (a, b), n in zip(widths, frame.shape, strict=True)], mode="reflect")
    waves = fft.rfft2(padded)
    inverse = np.linalg.inv(shadow.lattice.matrix()) / (_EDGE[1] - _EDGE[0])
    fy, fx = fft.fftfreq(padded.shape[0]) / step[0], fft.rfftfreq(padded.shape[1]) / step[1]
    for column in (0, 1):
        down, across = (np.float32(f * inverse[axis, column]) for axis, f in enumerate((fy, fx)))
        share = np.abs(np.add.outer(down, across))
        np.subtract(np.float32(_EDGE[1] / (_EDGE[1] - _EDGE[0])), share, out=share)
        waves *= np.clip(share, 0, 1, out=share)
    made = fft.irfft2(waves, s=padded.shape)
    top, left = margins
    return np.ascontiguousarray(made[top : top + frame.shape[0], left : left + frame.shape[1]], dtype=np.float32)


def mixed(samples: Sequence[Sharp], shadow: Shadow) -> Mixed:
    """Sharp picture and band, block by block as each is nearer to the truth."""
    shape, step = shadow.shape, samples[0].place.step
    side = max(_BLOCK_PX, round(_BLOCK_PERIODS * period_of(shadow.lattice)))
    lengths = [-(-side // one) * one for one in step]
    blocks = [max(1, whole // one) for whole, one in zip(shape, lengths, strict=True)]
    edges = [np.arange(number) * (one // each) for number, one, each in zip(blocks, lengths, step, strict=True)]
    carriers, between, nearest = _frequencies(shadow)
    count = len(carriers)
    ghost, detail = np.zeros((2, *blocks))
    total, noise, pixels = np.zeros((3, *blocks))
    bands = []
    for one in samples:
        band = band_of(one.frame, step, shadow)
        bands.append(band)
        rows, columns = one.place.at(shape)
        rest = one.picture - band
        slopes = [np.gradient(band, axis=axis).astype(np.float32) for axis in (0, 1)]
        both = np.concatenate([carriers, between])
        sums = [wave_sums(rest * slope, rows, columns, both, (edges[0], edges[1])) for slope in slopes]
        yy, yx, xx = (block_sums(a * b, *edges) for a, b in ((slopes[0],) * 2, slopes, (slopes[1],) * 2))
        own = np.maximum(yy * xx - yx * yx, 1e-12 * (yy + xx) ** 2 + 1e-30)[..., None]
        power = (
            xx[..., None] * np.abs(sums[0]) ** 2
            + yy[..., None] * np.abs(sums[1]) ** 2
            - 2 * yx[..., None] * (sums[0] * sums[1].conj()).real
        ) / own
        nearby = np.log(power[..., count:][..., nearest] + 1e-30)
        around = _GEOMETRIC * np.exp(nearby[..., :4].mean(axis=-1))
        for pair in (nearby[..., 4:6], nearby[..., 6:]):
            along = np.exp(pair.mean(axis=-1))
            around = np.where(along > _ALONG * around, along, around)
        ghost += power[..., :count].sum(axis=-1)
        detail += around.sum(axis=-1)
        total += block_sums(rest * rest, *edges)
        noise += block_sums(one.noise, *edges)
        pixels += block_sums(np.ones_like(rest), *edges)
    gain = _GAIN * lengths[0] * lengths[1] / period_of(shadow.lattice) ** 2
    sharp = _weights(ghost / np.maximum(detail, 1e-30), gain, total / pixels, noise / pixels)
    detailed = total / np.maximum(noise, 1e-30)
    if (detailed < _DETAILED).any():
        detailed = np.maximum(detailed, 1 / (1 - _shared(samples, bands, shape, lengths, blocks)))
    clean = _weights_of_noise(detailed)
    soft_share = float(np.mean(sharp < 0.5))
    weights = np.minimum(sharp, clean)
    if (weights == 1).all():
        return Mixed([one.picture for one in samples], None, soft_share)
    smooth = [
        _between(np.arange(n, dtype=np.float64) + 0.5, one, number)
        for n, one, number in zip(shape, lengths, blocks, strict=True)
    ]
    least = min(1.0, abs(float(np.linalg.det(shadow.lattice.matrix()))) * step[0] * step[1])  # the band's own noise
    made, left = [], []
    for one, band in zip(samples, bands, strict=True):
        down, across = smooth[0][one.place.row :: step[0]], smooth[1][one.place.column :: step[1]]
        weight = (down @ weights @ across.T).astype(np.float32)
        made.append(band + weight * (one.picture - band))
        left.append((down @ np.sqrt(np.maximum(clean, least)) @ across.T).astype(np.float32))
    return Mixed(made, left, soft_share)


def _shared(
    samples: Sequence[Sharp], bands: list[Singles], shape: tuple[int, int], lengths: list[int], blocks: list[int]
) -> Floats:
    """(blocks down, across): the share of detail in all that is finer than the band, from what neighbouring pixels
    have in common: of noise nothing, of detail as much more as they have more in common than the next but one."""
    rest = np.zeros(shape, dtype=np.float32)
    for one, band in zip(samples, bands, strict=True):
        rest[one.place.cut] = one.picture - band
    # The spread plane of a staggered chip has neighbours on diagonals only.
    diagonal = all((one.place.row + one.place.column) % 2 == 0 for one in samples) and samples[0].place.step != (1, 1)
    edges = [np.arange(number) * one for number, one in zip(blocks, lengths, strict=True)]
    common, own = np.zeros((2, 2, *blocks))
    for index, lag in enumerate((1, 2)):
        if diagonal:
            pairs = [(rest[lag:, lag:], rest[:-lag, :-lag]), (rest[lag:, :-lag], rest[:-lag, lag:])]
        else:
            pairs = [(rest[:, lag:], rest[:, :-lag]), (rest[lag:], rest[:-lag])]
        for first, second in pairs:
            common[index] += block_sums(first * second, *edges)
            own[index] += block_sums(first * first + second * second, *edges) / 2
    one, two = common.sum(axis=(1, 2)) / np.maximum(own.sum(axis=(1, 2)), 1e-30)
    falls = min(one / two, _FALLS) if two > 0 else _FALLS
    return np.asarray(np.clip(max(falls, 1.0) * common[0] / np.maximum(own[0], 1e-30), 0, 0.99))


def _weights_of_noise(ratio: Floats) -> Floats:
    """Weights of what is finer than the band, from its power over its noise's: 1 where it is detail for the most part;
    else as a Wiener filter has them, by which no more than `sqrt(weight)` of the error is left."""
    quiet = np.clip((_DETAILED - ratio) / (_DETAILED - _QUIET), 0, 1)
    return np.asarray(1 - quiet / np.maximum(ratio, 1))


def _weights(ratio: Floats, gain: float, total: Floats, noise: Floats) -> Floats:
    """Weights of the sharp picture: 1 where no ghost stands out; else detail over detail, noise and ghost, which are
    `total`. A ghost adds up over a block, detail doesn't: `ratio` is 1 + `gain` · ghost / (detail and noise)."""
    seen = np.clip((ratio - _SEEN) / (_SURE - _SEEN), 0, 1)
    detail = np.maximum(total / (1 + np.maximum(ratio - 1, 0) / gain) - noise, 0)
    return np.asarray(1 - seen * (1 - detail / np.maximum(total, 1e-30)))


def _frequencies(shadow: Shadow) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Carriers (K, 2), the points (M, 2) midway between carriers, and (K, 8) which of them lie around which: four
    on diagonals, two along each axis."""
    orders = np.array(shadow.orders, dtype=np.float64)
    around = orders[:, None, :] + np.array(_AROUND)
    flipped = np.where((around[..., :1] < 0) | ((around[..., :1] == 0) & (around[..., 1:] < 0)), -around, around)
    points, index = np.unique(flipped.reshape(-1, 2), axis=0, return_inverse=True)
    matrix = shadow.lattice.matrix()
    return orders @ matrix, points @ matrix, index.reshape(len(orders), len(_AROUND))


def _between(places: Floats, length: int, count: int) -> Floats:
    """(n, blocks): linear interpolation between the blocks' middles, constant beyond the outer ones."""
    at = np.clip(places / length - 0.5, 0, count - 1)
    return np.asarray(np.maximum(0, 1 - np.abs(at[:, None] - np.arange(count))))
