"""Where a picture is out of focus: what parallax over the stop leaves of the mask's pattern, and what to show there.

Out of focus a carrier's band holds another function of the scene than its local mean times a constant, so the frame
over the shadow keeps a ghost: about Σ e^{2πi k·F x} a_k·∇L with L the band around the mean, which has no ghost and no
detail beyond half of the carriers' distance. Detail of the scene itself goes with ∇L at the carriers no more than
between them: what is more is the ghost's variance, carrier by carrier and block by block. It lies around the carrier as
∇L does around the mean. What is finer than the band is kept as far as it stands above ghosts and noise
(`local_spectra`); where that is all of it the picture is the frame over the shadow, where it is nothing the band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.blocks import PatternPlace, block_sums, wave_sums
from dappled.decode.picture.local_spectra import SIDE, Disturbed, between, filtered
from dappled.decode.picture.noise import noise_share
from dappled.decode.picture.shadow import Shadow, ShadowFrom, period_of

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

_BLOCK_PX, _BLOCK_PERIODS = 64, 8  # a block's side is at least both
_EDGE = (0.45, 0.55)  # of the carriers' distance: where the band ends
_SEEN, _SURE = 3.0, 8.0  # ghost and detail over detail: from where on it counts, and counts in full
_GEOMETRIC = 1.2  # mean of Gamma(2) variables over the exponential of their mean logarithm, of four
_AROUND = ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))
_ALONG = 60.0  # times what is on diagonals: edges along rows or columns have all their detail on a line of carriers
_WAVES = 0.3  # a period: the mean frequency of slopes within the band
_MARGIN_PERIODS = 4  # reflected around the frame before it is transformed
_FALL = -1.0  # exponent of a ghost's power around its carrier


@dataclass(frozen=True, slots=True, eq=False)
class Sharp:
    """The samples of one place of the colour pattern: over the shadow, before that, and the variance of their noise."""

    place: PatternPlace
    picture: Singles
    frame: Singles
    noise: Singles


@dataclass(frozen=True, slots=True, eq=False)
class Mixed:
    """The picture's samples without ghosts and noise, and the variances of what is left of both. `soft_share` of the
    blocks lose more than half of their detail to ghosts; `sure_noise` of the noise's variance is no detail for sure."""

    pictures: list[Singles]
    variances: list[Singles]
    soft_share: float
    sure_noise: float


def bands_of(samples: Sequence[Sharp], shadow: Shadow) -> list[Singles]:
    """What a frame's samples hold around the mean, up to half of the way to the carriers: those of one colour
    together, as of what repeats with the pattern they have only the sum in common with the scene."""
    made: list[Singles] = [one.frame for one in samples]
    inverse = np.linalg.inv(shadow.lattice.matrix()) / (_EDGE[1] - _EDGE[0])
    for colour in {one.place.colour for one in samples}:
        own = [index for index, one in enumerate(samples) if one.place.colour == colour]
        step = samples[own[0]].place.step
        shape = [max(samples[index].frame.shape[axis] for index in own) for axis in (0, 1)]
        margins = [
            min(side - 1, round(_MARGIN_PERIODS * period_of(shadow.lattice) / one))
            for side, one in zip(shape, step, strict=True)
        ]
        size = [fft.next_fast_len(n + 2 * margin, real=True) for n, margin in zip(shape, margins, strict=True)]
        fy, fx = fft.fftfreq(size[0]) / step[0], fft.rfftfreq(size[1]) / step[1]
        share = np.full((len(fy), len(fx)), np.float32(1))
        for column in (0, 1):
            down, across = (np.float32(f * inverse[axis, column]) for axis, f in enumerate((fy, fx)))
            share *= np.clip(np.float32(_EDGE[1] / (_EDGE[1] - _EDGE[0])) - np.abs(np.add.outer(down, across)), 0, 1)
        rows, columns = (np.flatnonzero(share.any(axis=axis)) for axis in (1, 0))
        inside = np.ix_(rows, columns)
        share = share[inside] / np.float32(len(own))
        turns = [
            np.outer(np.exp(2j * np.pi * fy[rows] * place.row), np.exp(2j * np.pi * fx[columns] * place.column)).astype(
                np.complex64
            )
            for place in (samples[index].place for index in own)
        ]
        whole = np.zeros(share.shape, dtype=np.complex64)
        for index, turn in zip(own, turns, strict=True):
            frame = samples[index].frame
            widths = [
                (margin, whole_side - n - margin)
                for n, margin, whole_side in zip(frame.shape, margins, size, strict=True)
            ]
            whole += fft.rfft2(np.pad(frame, widths, mode="reflect"))[inside] * turn.conj()
        whole *= share
        for index, turn in zip(own, turns, strict=True):
            waves = np.zeros((len(fy), len(fx)), dtype=np.complex64)
            waves[inside] = whole * turn
            n = samples[index].frame.shape
            back = fft.irfft2(waves, s=size)
            made[index] = np.ascontiguousarray(
                back[margins[0] : margins[0] + n[0], margins[1] : margins[1] + n[1]], dtype=np.float32
            )
    return made


def mixed(samples: Sequence[Sharp], pattern: NDArray[np.bool_], shadow: Shadow) -> Mixed:
    """The picture as near to the truth as the frame allows. `pattern` is where the chip has samples."""
    shape = shadow.shape
    bands = bands_of(samples, shadow)
    rest, noise = np.zeros((2, *shape), dtype=np.float32)
    for one, band in zip(samples, bands, strict=True):
        rest[one.place.cut] = one.picture - band
        noise[one.place.cut] = one.noise
    fill = float(np.mean(pattern))
    usual = float(noise.mean(dtype=np.float64)) / fill
    share = noise_share([(one.place, one.picture) for one in samples], usual)
    ghosts, lengths = _ghosts(samples, bands, rest, shadow)
    spectra = _spectra(shadow, pattern)
    found = filtered(rest, Disturbed(noise * np.float32(share.least), ghosts * fill, spectra, lengths))
    counts = found.noise_left.shape
    smooth = [
        between(np.arange(n, dtype=np.float64) + 0.5 - found.first, one, number).astype(np.float32)
        for n, one, number in zip(shape, found.lengths, counts, strict=True)
    ]
    step = samples[0].place.step
    # What reaches into the band from around the carriers is kept.
    in_band = (ghosts @ (spectra * _within_band(shadow) ** 2).mean(axis=(1, 2))).astype(np.float32)
    wide = [
        between(np.arange(n, dtype=np.float64) + 0.5, length, number).astype(np.float32)
        for n, length, number in zip(shape, lengths, in_band.shape, strict=True)
    ]
    # The band's own noise is left in any case.
    least = min(1.0, abs(float(np.linalg.det(shadow.lattice.matrix()))) / fill)
    noise_left = share.mean * np.maximum(found.noise_left, least)
    pictures, variances = [], []
    for one, band in zip(samples, bands, strict=True):
        pictures.append(band + found.kept[one.place.cut])
        down, across = smooth[0][one.place.row :: step[0]], smooth[1][one.place.column :: step[1]]
        noises, ghost = (down @ left.astype(np.float32) @ across.T for left in (noise_left, found.ghosts_left / fill))
        inside = wide[0][one.place.row :: step[0]] @ in_band @ wide[1][one.place.column :: step[1]].T
        variances.append(one.noise * noises + ghost + inside)
    return Mixed(pictures, variances, float(np.mean(found.ghost_share > 0.5)), share.sure)


def _ghosts(
    samples: Sequence[Sharp], bands: list[Singles], rest: Singles, shadow: Shadow
) -> tuple[Floats, tuple[int, int]]:
    """(blocks down, blocks across, K) the variance of a ghost around each carrier, and the blocks' sides."""
    step = samples[0].place.step
    side = max(_BLOCK_PX, round(_BLOCK_PERIODS * period_of(shadow.lattice)))
    lengths = [-(-side // one) * one for one in step]
    blocks = [max(1, whole // one) for whole, one in zip(shadow.shape, lengths, strict=True)]
    edges = [np.arange(number) * (one // each) for number, one, each in zip(blocks, lengths, step, strict=True)]
    carriers, middles, nearest = _frequencies(shadow)
    both, count = np.concatenate([carriers, middles]), len(carriers)
    ghost, detail, pixels, steep = np.zeros((4, *blocks, count))
    for colour in {one.place.colour for one in samples}:  # its places together: what repeats with the pattern goes
        sums = np.zeros((2, *blocks, len(both)), dtype=np.complex64)
        yy, yx, xx, number = np.zeros((4, *blocks))
        apart = _apart(carriers, [one.place for one in samples if one.place.colour == colour], shadow)
        for one, band in zip(samples, bands, strict=True):
            if one.place.colour == colour:
                rows, columns = one.place.at(shadow.shape)
                own = rest[one.place.cut]
                slopes = np.stack([np.gradient(band, each, axis=axis) for axis, each in enumerate(step)])
                sums += wave_sums(own * slopes, rows, columns, both, (edges[0], edges[1]))
                yy += block_sums(slopes[0] * slopes[0], *edges)
                yx += block_sums(slopes[0] * slopes[1], *edges)
                xx += block_sums(slopes[1] * slopes[1], *edges)
                number += np.outer(*(np.diff(one, append=n) for one, n in zip(edges, own.shape, strict=True)))
        power = (
            xx[..., None] * np.abs(sums[0]) ** 2
            + yy[..., None] * np.abs(sums[1]) ** 2
            - 2 * yx[..., None] * (sums[0] * sums[1].conj()).real
        ) / np.maximum(yy * xx - yx * yx, 1e-12 * (yy + xx) ** 2 + 1e-30)[..., None]
        nearby = np.log(power[..., count:][..., nearest] + 1e-30)
        around = _GEOMETRIC * np.exp(nearby[..., :4].mean(axis=-1))
        for pair in (nearby[..., 4:6], nearby[..., 6:]):
            along = np.exp(pair.mean(axis=-1))
            around = np.where(along > _ALONG * around, along, around)
        ghost += power[..., :count] * apart
        detail += around * apart
        steep += (yy + xx)[..., None] * apart
        pixels += number[..., None] * apart
    ratio = ghost.sum(axis=-1) / np.maximum(detail.sum(axis=-1), 1e-30)
    seen = np.clip((ratio - _SEEN) / (_SURE - _SEEN), 0, 1)[..., None]
    first = seen * np.maximum(ghost - detail, 0)
    # A pattern that is moved by s: s·∇L first, then (s·∇)² L / 2, which does not go with the slope.
    strength = (np.abs(shadow.coefficients[:, :, 0]) ** 2).mean(axis=0)
    moved = 2 * first / np.maximum(steep * strength, 1e-30)
    second = np.minimum(3 / 16 * (2 * np.pi * _WAVES / period_of(shadow.lattice)) ** 2 * moved, 1)
    made = 2 * (1 + second) * first / np.maximum(pixels, 1)
    made *= shadow.source != ShadowFrom.NONE  # else who knows where carriers are
    return np.asarray(made), (lengths[0], lengths[1])


def _apart(carriers: Floats, places: list[PatternPlace], shadow: Shadow) -> NDArray[np.bool_]:
    """(K,) whether samples at these places tell each carrier's band from that around the mean."""
    inverse, step = np.linalg.inv(shadow.lattice.matrix()), np.array(places[0].step)
    made = np.ones(len(carriers), dtype=bool)
    at = np.array([(one.row, one.column) for one in places]) / step
    for repeat in np.ndindex(*step):
        if abs(np.exp(2j * np.pi * at @ repeat).mean()) > 0.1:
            off = carriers - repeat / step
            made &= (np.abs((off - np.round(off)) @ inverse).max(axis=1) >= 1) | (not any(repeat))
    return made


def _spectra(shadow: Shadow, pattern: NDArray[np.bool_]) -> Singles:
    """(K, SIDE, SIDE // 2 + 1) how a ghost's power lies around its carriers, mean 1 within the band
    around each, wherever the pattern of samples repeats it. Slopes of detail that parallax over the stop blurs fall off
    beyond it, however they lie within."""
    matrix = shadow.lattice.matrix()
    inverse, half = np.linalg.inv(matrix), 0.5 / SIDE
    fy, fx = np.meshgrid(fft.fftfreq(SIDE), fft.fftfreq(SIDE), indexing="ij")
    repeats = np.abs(fft.fft2(pattern)) ** 2
    made = np.zeros((len(shadow.orders), SIDE, SIDE))
    for index, carrier in enumerate(np.array(shadow.orders, dtype=np.float64) @ matrix):
        for (down, across), weight in np.ndenumerate(repeats):
            if weight < 1e-6 * repeats.max():
                continue
            for sign in (1, -1):
                y, x = fy - sign * carrier[0] - down / len(repeats), fx - sign * carrier[1] - across / repeats.shape[1]
                y, x = y - np.round(y), x - np.round(x)
                around = np.maximum(np.hypot(y, x), half) ** _FALL
                inside = np.abs(np.stack([y, x], axis=-1) @ inverse).max(axis=-1) < 0.5
                made[index] += weight * around / around[inside].sum()
    made *= SIDE**2 / (2 * repeats.sum())
    return np.ascontiguousarray(made[:, :, : SIDE // 2 + 1], dtype=np.float32)


def _within_band(shadow: Shadow) -> Floats:
    """(SIDE, SIDE // 2 + 1) what `bands_of` keeps of each frequency."""
    inverse = np.linalg.inv(shadow.lattice.matrix())
    f = np.stack(np.meshgrid(fft.fftfreq(SIDE), fft.rfftfreq(SIDE), indexing="ij"), axis=-1)
    return np.asarray(np.clip((_EDGE[1] - np.abs(f @ inverse)) / (_EDGE[1] - _EDGE[0]), 0, 1).prod(axis=-1))


def _frequencies(shadow: Shadow) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Carriers (K, 2), the points (M, 2) midway between carriers, and (K, 8) which of them lie around which: four
    on diagonals, two along each axis."""
    orders = np.array(shadow.orders, dtype=np.float64)
    around = orders[:, None, :] + np.array(_AROUND)
    flipped = np.where((around[..., :1] < 0) | ((around[..., :1] == 0) & (around[..., 1:] < 0)), -around, around)
    points, index = np.unique(flipped.reshape(-1, 2), axis=0, return_inverse=True)
    matrix = shadow.lattice.matrix()
    return orders @ matrix, points @ matrix, index.reshape(len(orders), len(_AROUND))
