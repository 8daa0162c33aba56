"""Depth maps, and the estimate of disparity and its uncertainty from the peak of a likelihood."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError

Volume = NDArray[np.float32]
Map = NDArray[np.float32]
# Measured on simulated masked frames (SNR 100 and 50): the scatter beyond that of noise, the error that the window's
# edge adds on even surfaces as the picture moves across it, and the error of a window that covers two surfaces.
_SCATTER = 1.1
_EDGE, _EDGE_SHARE = 0.0005, 0.0005  # px/view, and of the disparity
_SEAM = 2.0  # of the disparities' spread under the window
_MOST_SIGMA = 0.25  # px/view, chosen by hand: a disparity that is known less well is unknown
_LEAST_CONFIDENCE = 0.5  # chosen by hand: the share that is known is measured by benchmarks/depth.py
_MOST_DISPARITIES = 400  # a volume of more is refused, as it would not fit into memory
CONTRAST_WINDOW = 13  # px a side


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Disparities float32 (h, w) of the middle view's pixels with their standard errors; both NaN where unknown.

    In pixels from view to view, 0 at the focus, larger for what is nearer. `confidence` (h, w), 0 to 1: how far the
    best disparity exceeds all others that were tried.
    """

    disparity: Map
    sigma: Map
    confidence: Map
    method: str

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where the disparity is known."""
        return np.isfinite(self.disparity)

    def known_share(self) -> float:
        """The share of pixels whose disparity is known."""
        return float(self.known.mean())


def nearest_known(values: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
    """(h, w) the values, and those of the nearest known sample where they are not known; as they are where none is."""
    if not known.any():
        return values
    row, column = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(values[row, column])


@dataclass(frozen=True, slots=True)
class Search:
    """The disparities to try, from `low` to `high`, `step` apart, and the window (px a side) of each pixel's estimate.

    `window` None: each method's own. Contrast's windows are boxes smoothed once more: their effective size is `window`.
    """

    low: float
    high: float
    step: float
    window: int | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        """Raises DecodeError for an empty range or an unusable window."""
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high and self.step > 0):
            raise DecodeError(f"disparities from {self.low:g} to {self.high:g} by {self.step:g} are not a range")
        if (self.high - self.low) / self.step > _MOST_DISPARITIES:
            count = (self.high - self.low) / self.step
            raise DecodeError(f"{count:.0f} disparities are too many: narrow {self.low:g} to {self.high:g}")
        if self.window is not None and (self.window < 3 or self.window % 2 == 0):
            raise DecodeError(f"a window of {self.window} px can't be used: it must be odd, and 3 or more")

    @property
    def contrast_window(self) -> int:
        """The window in which refocus contrast is summed, px."""
        return self.window or CONTRAST_WINDOW

    def disparities(self) -> NDArray[np.float64]:
        """All of them, at least five, rising."""
        count = max(5, math.ceil((self.high - self.low) / self.step - 1e-9) + 1)
        return np.linspace(self.low, self.high, count)


def box(window: int) -> int:
    """The side of the box that, used twice, is as wide as a window."""
    half = (window + 1) // 2
    return half if half % 2 else half - 1


def windowed(volume: Volume, window: int) -> tuple[Volume, float]:
    """(the volume summed over smooth windows, its middle sample weighing 1; variance over information).

    With weights w the variance of an estimate from independent samples is Σw²/(Σw)² of one sample's: the second value
    is Σw²/Σw, by which the inverse curvature is to be multiplied.
    """
    side = box(window)
    made = volume
    for axis in (-2, -1):
        for _ in range(2):
            made = ndimage.uniform_filter1d(made, side, axis=axis)
    made *= np.float32(side * side)  # a triangle of base 2·side−1 and height 1 sums to `side`
    one = np.convolve(np.ones(side), np.ones(side)) / side
    return made, float((one**2).sum() / one.sum()) ** 2


def peaked(likelihood: Volume, disparities: NDArray[np.float64], start: NDArray[np.intp]) -> tuple[Map, Map]:
    """(disparity, curvature) of the peak nearest to `start` (h, w), an index into `disparities` (evenly spaced).

    A quartic through five samples (a parabola is biased by hundredths of a pixel), at most one and a half steps away.
    The curvature is minus the second derivative there, 0 where there is no peak.
    """
    step = float(disparities[1] - disparities[0])
    middle = np.clip(start, 2, len(disparities) - 3)
    a, b, c, d, e = (np.take_along_axis(likelihood, (middle + k)[None], axis=0)[0] for k in (-2, -1, 0, 1, 2))
    c1 = (a - 8 * b + 8 * d - e) / 12
    c2 = (-a + 16 * b - 30 * c + 16 * d - e) / 24
    c3 = (-a + 2 * b - 2 * d + e) / 12
    c4 = (a - 4 * b + 6 * c - 4 * d + e) / 24
    x = np.clip((start - middle).astype(np.float32), -2, 2)
    tiny = np.float32(-1e-20)
    for _ in range(6):
        slope = c1 + x * (2 * c2 + x * (3 * c3 + x * 4 * c4))
        bend = np.minimum(2 * c2 + x * (6 * c3 + x * 12 * c4), tiny)
        x = np.clip(x - np.clip(slope / bend, -0.5, 0.5), -2, 2)
    bend = 2 * c2 + x * (6 * c3 + x * 12 * c4)
    at_end = (np.abs(x) >= 2) | (np.abs(middle + x - start) > 1.5)
    curvature = np.where(at_end, 0, np.maximum(-bend, 0)) / step**2
    disparity = disparities[middle].astype(np.float32) + x * np.float32(step)
    return disparity.astype(np.float32), curvature.astype(np.float32)


def confidence(likelihood: Volume, best: Map, samples: float) -> Map:
    """0 to 1: by how much the best likelihood exceeds the mean over all disparities, compared with chance.

    The likelihood of `samples` independent samples of noise alone scatters by √(samples/2).
    """
    margin = (best - likelihood.mean(axis=0)) / np.float32(4 * math.sqrt(samples / 2))
    made: Map = 1 - np.exp(-(np.maximum(margin, 0) ** 2))
    return made.astype(np.float32)


def seams(disparity: Map, variance: Map, window: int) -> Map:
    """(h, w): the rms by which disparities (NaN: unknown) bend under a window, beyond what their `variance` explains.

    A window across the seam of two surfaces covers both, and its disparity may be that of either, or lie between. On a
    plane, however it is tilted, this is 0.
    """
    wide = math.sqrt((box(window) ** 2 - 1) / 6)  # a box used twice has the variance of two
    known = np.isfinite(disparity)

    def summed(values: NDArray[np.floating]) -> NDArray[np.float64]:
        inside = np.where(known, values, 0).astype(np.float64)
        return np.asarray(ndimage.gaussian_filter(inside, wide, truncate=3.0, mode="nearest"))

    share = np.maximum(summed(np.ones_like(disparity)), 1e-6)
    level, square, noise = (summed(values) / share for values in (disparity, disparity**2, variance))
    lean = sum((ndimage.correlate1d(level, [-0.5, 0, 0.5], axis=axis, mode="nearest") * wide) ** 2 for axis in (0, 1))
    made: Map = np.sqrt(np.maximum(square - level**2 - lean - noise, 0)).astype(np.float32)
    return made


def judged(
    disparity: Map,
    curvature: Map,
    sure: Map,
    *,
    spread: float,
    window: int,
    method: str,
) -> DepthMap:
    """The map: standard errors from curvatures of the likelihood, unknown where these or the confidence are too low.

    At seams within the window (px a side) the error is larger, but the disparity is still known. `spread` is
    variance over information, from `windowed`.
    """
    with np.errstate(divide="ignore"):
        noise = np.float32(_SCATTER**2 * spread) / curvature
    edge = _EDGE + _EDGE_SHARE * np.abs(disparity)
    sigma = np.sqrt(noise + edge**2)
    known = (sure >= _LEAST_CONFIDENCE) & (sigma <= _MOST_SIGMA)
    unknown = np.float32(np.nan)
    shown = np.where(known, disparity, unknown).astype(np.float32)
    sigma = np.hypot(sigma, np.float32(_SEAM) * seams(shown, noise, window))
    return DepthMap(shown, np.where(known, sigma, unknown).astype(np.float32), sure.astype(np.float32), method)
