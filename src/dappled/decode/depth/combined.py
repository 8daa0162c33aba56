"""Estimate depth from contrast, photo-consistency of clean views, slices, and neighbouring pixels together.

Each is a log-likelihood, so they can be added. Refocus contrast tolerates noise, and enlarges near objects by half a
window. Photo-consistency keeps edges where they are, and needs clean views. Of noisy masked frames the slices are asked
instead, in halves of the aperture (see `halves`). Semi-global matching decides where all are weak. The middle view's
edges then decide to which side the pixels at a jump of disparity belong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from dappled.decode.depth import clean
from dappled.decode.depth import contrast as depth_contrast
from dappled.decode.depth.clean import LEAST_VARIANCE, agreement
from dappled.decode.depth.depth_map import DepthMap, Map, Search, Volume, box, confidence, judged, peaked, windowed
from dappled.decode.depth.edges import levelled, sharpened
from dappled.decode.depth.evidence import Evidence
from dappled.decode.depth.halves import Part, best_half, unexplained, voted, whole
from dappled.decode.depth.matching import smoothed
from dappled.decode.depth.photo_consistency import WINDOW, Lines
from dappled.decode.depth.scatter import undecided
from dappled.decode.lightfield import ViewStack

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_CLEAN, _NOISY = 2.0, 200.0  # contrast's share beside photo-consistency, by noise over texture and its square
_NEGLIGIBLE = 0.3  # with a smaller share contrast only enlarges what is near
_SMALL, _LARGE = 4.0, 30.0  # P1 and P2, in units of the log-likelihood
_NARROW = 5  # px: the window in which noisy views are compared
# Of noisy masked frames, measured on the masked frames of benchmarks/depth.py, seeds 1 and 2.
_VOTE_WINDOW = 11  # px
_SMALL_HALVES, _LARGE_HALVES = 8.0, 32.0  # P1 and P2 of the votes
_SPREAD_HALVES, _SAMPLES_HALVES = 2.0, 40.0  # variance over information; of the votes, as in `confidence`
# Of the logarithm of odds. On seeds 1 and 2 (SNR 100 and 50) 76 and 89 % then lie within σ and 2 σ, not 65 and 84; on
# six frames like those of tests/system/test_depth_sigma.py, with other seeds, 73 and 96 %, not 72 and 95.
_ODDS_UNIT = 8.0
_AGREE = 0.1  # px/view: a peak of the whole aperture's likelihood so near is that of the same surface
_SCATTER_WHOLE = 1.15  # the variance of the whole aperture's peak, beyond what `judged` supposes
# What a window leaves beyond noise, in units of it: more than the first is no noise, and is alike in so many pixels
# that it counts as often. On seeds 1 and 2 86 % of rooms then lie within 2 σ at SNR 100, else 80. With a larger second
# one σ is too large for the boards of tests/system/test_depth_sigma.py.
_NOT_NOISE, _ALIKE = 1.0, 4.0
_ONE_SURFACE = 0.4  # px/view: with a larger range of disparities around there is a jump
_HALO = 6  # px: by so much near things are too large before the middle view's edges decide


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map by the methods that suit the evidence."""
    if evidence.white:
        return _of_slices(evidence, search)
    disparities, stack = search.disparities(), evidence.stack
    lines = Lines.of(stack, disparities, window=search.window or WINDOW)
    told = agreement(stack, lines, disparities, workers=search.workers)
    variance = told.typical
    # Where noise is as strong as texture, one view can't be compared with another: contrast takes over.
    noise = variance / max(_texture(stack), LEAST_VARIANCE)
    share = min(1.0, _CLEAN * noise + _NOISY * noise**2)
    if share < _NEGLIGIBLE:
        return _with_shared(clean.depth(stack, lines, search, told), evidence)
    cost = clean.unlikely(lines, search, variance)
    contrast = _by_contrast(evidence, search)
    # The evidence counted in variances of a guessed noise; now it is known how well views agree.
    weight = np.float32(share / contrast.samples * _guessed(evidence) / variance)
    both = np.subtract(np.multiply(contrast.likelihood, weight, out=contrast.likelihood), cost, out=cost)
    samples = contrast.samples * box(_NARROW) ** 2
    return _with_shared(_decided(_Seen(both, contrast.spread, samples), search), evidence)


def _with_shared(found: DepthMap, evidence: Evidence) -> DepthMap:
    """The map, with what whole neighbourhoods of the evidence share of its error."""
    if not evidence.shared:
        return found
    return replace(found, sigma=np.hypot(found.sigma, np.float32(evidence.shared / evidence.stack.reach)))


def _of_slices(evidence: Evidence, search: Search) -> DepthMap:
    """By what disparities leave unexplained of halves of the aperture, and on even surfaces of all of it."""
    part = whole(evidence)
    rough, open_to = _by_votes(part, evidence.shown(), search)
    disparities, window = search.disparities(), search.contrast_window
    likelihood = unexplained(part, disparities, workers=search.workers)
    likelihood, spread = windowed(np.negative(likelihood, out=likelihood), window)
    known = rough.known
    start = np.rint((np.where(known, rough.disparity, disparities[0]) - disparities[0]) / search.step).astype(np.intp)
    start = np.clip(start, 0, len(disparities) - 1)
    fine, curvature = peaked(likelihood, disparities, start)
    left = -np.take_along_axis(likelihood, start[None], axis=0)[0] / np.float32(
        box(window) ** 2 * max(part.of_noise, 0.5)
    )
    # Fine texture, bent surfaces and the frame's end leave what moves the peak, and is no noise.
    astray = 1 + _ALIKE * np.maximum(left - _NOT_NOISE, 0)
    # What a jump spreads over reaches farther than the window.
    reach = 2 * window - 1
    far = np.where(known, rough.disparity, np.inf), np.where(known, rough.disparity, -np.inf)
    even = ndimage.maximum_filter(far[0], reach) - ndimage.minimum_filter(far[1], reach) < _ONE_SURFACE
    agree = even & (np.abs(fine - rough.disparity) < _AGREE)
    found = judged(
        np.where(agree, fine, rough.disparity),
        curvature,
        rough.confidence,
        spread=_SCATTER_WHOLE * spread,
        window=window,
        method="combined",
    )
    share = np.where(agree & found.known, rough.sigma**4 / (rough.sigma**4 + found.sigma**4), np.float32(0))
    both = share > 0
    disparity = np.where(both, rough.disparity + share * (fine - rough.disparity), rough.disparity)
    sigma = np.where(both, np.sqrt(share * astray * found.sigma**2 + (1 - share) * rough.sigma**2), rough.sigma)
    return replace(rough, disparity=disparity, sigma=np.hypot(sigma, open_to))


def _by_votes(part: Part, middle: Map, search: Search) -> tuple[DepthMap, Map]:
    """The disparities that neighbours select among the votes around a pixel, jumps at the edges of the middle view; and
    how far (h, w) others are likely too."""
    disparities = search.disparities()
    window = search.window or _VOTE_WINDOW
    cost = voted(best_half(part, disparities, workers=search.workers), window)
    smooth = smoothed(cost, small=_SMALL_HALVES, large=_LARGE_HALVES, workers=search.workers)
    start = smooth.argmin(axis=0)
    selected = np.negative(smooth, out=smooth)
    disparity, curvature = peaked(selected, disparities, start)
    likelihood = np.negative(cost, out=cost)
    _, own = peaked(likelihood, disparities, start)
    curvature = np.where(own > 0, own, curvature)  # where neighbours overrule a pixel it has no peak there
    sure = confidence(likelihood, np.take_along_axis(likelihood, start[None], axis=0)[0], _SAMPLES_HALVES)
    found = judged(disparity, curvature, sure, spread=_SPREAD_HALVES, window=window, method="combined")
    sharp, sigma = sharpened(found.disparity, found.sigma, middle, near=_HALO - 1, reach=_HALO)
    made = replace(found, disparity=levelled(sharp), sigma=sigma)
    return made, undecided(selected, disparities, made.disparity, unit=_ODDS_UNIT)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A log-likelihood (D, h, w), of the given number of samples per pixel; `spread` as in `windowed`."""

    likelihood: Volume
    spread: float
    samples: float


def _decided(seen: _Seen, search: Search) -> DepthMap:
    """The map of the peaks that neighbours select, each that of a window. Contrast enlarges what is near by half of its
    own: that far the error is that of a jump."""
    disparities = search.disparities()
    smooth = smoothed(-seen.likelihood, small=_SMALL, large=_LARGE, workers=search.workers)
    start = smooth.argmin(axis=0)
    likelihood = windowed(seen.likelihood, _NARROW)[0]
    disparity, curvature = peaked(likelihood, disparities, start)
    best = np.take_along_axis(likelihood, start[None], axis=0)[0]
    sure = confidence(likelihood, best, seen.samples)
    return judged(disparity, curvature, sure, spread=seen.spread, window=search.contrast_window, method="combined")


def _by_contrast(evidence: Evidence, search: Search) -> _Seen:
    raw = depth_contrast.explained(evidence, search.disparities(), workers=search.workers)
    likelihood, spread = windowed(raw, search.contrast_window)
    return _Seen(likelihood, spread, float(box(search.contrast_window) ** 2))


def _guessed(evidence: Evidence) -> float:
    """The variance that plain views' evidence was counted in."""
    return float(1 / evidence.weights[0, 0])


def _texture(stack: ViewStack) -> float:
    """The variance of the middle view's fine detail."""
    middle = stack.middle()
    return float(np.var(middle - ndimage.gaussian_filter(middle, 3.0)))
