"""Convert disparity to metres and back (Eq 5), by focus and focal length or by targets at known distances.

A point at Z moves over the sensor by S = gain/Z + offset pixels (columns) from one end of the aperture to the other:
by Eq 5, gain = A·f/pitch and offset = −gain/(distance in focus), A the aperture's side, f the lens' distance from the
sensor. A disparity of 1 is `ViewStack.sensor_px_per_disparity` of these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.decode.depth.depth_map import CONTRAST_WINDOW, DepthMap, Map
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack

RANGING = "ranging"  # the attribute of light fields, and the table of calibrations
_FARTHEST_SIGMAS = 2.0  # a shift that is not clear of infinity by so many standard errors has no distance
_ROUNDED_MM = 0.5  # files and bodies may round focal lengths to whole millimetres
_NOMINAL = 0.02  # f-numbers and focal lengths are rounded, and nominal
# px from view to view that planes of drawn texture are off by behind a round stop, beyond their scatter: from the line
# through all distances, rms, and together. Behind a square stop 0.0003 and 0.001.
_BENT, _TOGETHER = 0.0017, 0.0075
_FEW = 8  # blocks: the scatter of fewer is known to a quarter at best
_FRESH_DISTANCES = 1.01  # targets whose distances differ by less tell the offset only


@dataclass(frozen=True, slots=True)
class Ranging:
    """S = `gain_px_m`/Z + `offset_px`, for a lens at `f_number` (None: the scale doesn't depend on it, as under
    lenslets) and one focal length (None: unknown). `source` says in words where it is from.

    How well both are known, which all distances have in common: `gain_sigma_share` is the gain's standard error as a
    share of it, `offset_sigma_px` the offset's, `covariance_px2_m` that of both, px²·m. An offset by the lens' focus is
    taken as exact."""

    gain_px_m: float
    offset_px: float
    f_number: float | None = None
    source: str = "calibration"
    gain_sigma_share: float = 0.0
    focal_length_mm: float | None = None
    offset_sigma_px: float = 0.0
    covariance_px2_m: float = 0.0

    def __post_init__(self) -> None:
        """Raises DecodeError for numbers that are impossible for a lens."""
        if not (math.isfinite(self.gain_px_m) and self.gain_px_m > 0 and math.isfinite(self.offset_px)):
            raise DecodeError(
                f"a gain of {self.gain_px_m:g} px·m and an offset of {self.offset_px:g} px describe no lens: "
                "calibrate with targets again"
            )

    @classmethod
    def of_lens(cls, focal_length_mm: float, f_number: float, pixel_mm: float, focus_m: float = math.inf) -> Ranging:
        """By Eq 5 for a lens focused at `focus_m`, f-number and focal length as the frame says them."""
        if not (focal_length_mm > 0 and f_number > 0 and pixel_mm > 0 and focus_m > focal_length_mm * 1e-3):
            raise DecodeError(
                f"focal length {focal_length_mm:g} mm, f/{f_number:g}, pixels of {pixel_mm:g} mm and a focus at "
                f"{focus_m:g} m describe no camera"
            )
        sensor_m = 1e-3 / (1 / focal_length_mm - 1e-3 / focus_m)  # Eq 3
        gain = focal_length_mm / f_number * sensor_m / pixel_mm
        return cls(gain, -gain / focus_m, f_number, "focal length, f-number and focus", _NOMINAL, focal_length_mm)

    def at(self, f_number: float | None, focal_length_mm: float | None) -> Ranging:
        """The same lens at another f-number.

        Raises DecodeError for another focal length, or where only one of the two is known: a zoom changes gain and
        offset in a way that Eq 5 alone doesn't describe. A difference that rounding may hide (half a millimetre) is
        added to their errors, and that f-numbers are nominal where it is another.
        """
        share = self._zoom_share(focal_length_mm)
        if self.f_number is None or f_number is None or f_number == self.f_number:
            return self._less_sure(share)
        made, scale = self._less_sure(math.hypot(share, _NOMINAL)), self.f_number / f_number
        return replace(
            made, gain_px_m=self.gain_px_m * scale, offset_px=self.offset_px * scale, f_number=f_number,
            offset_sigma_px=made.offset_sigma_px * scale, covariance_px2_m=made.covariance_px2_m * scale**2,
        )  # fmt: skip

    def _less_sure(self, share: float) -> Ranging:
        """The same with gain and offset off together by a share of both, as a scale is."""
        return replace(
            self,
            gain_sigma_share=math.hypot(self.gain_sigma_share, share),
            offset_sigma_px=math.hypot(self.offset_sigma_px, share * self.offset_px),
            covariance_px2_m=self.covariance_px2_m + share**2 * self.gain_px_m * self.offset_px,
        )

    def _zoom_share(self, focal_length_mm: float | None) -> float:
        """What a focal length this far from the calibrated one may change of the gain, which grows as its square."""
        ours = self.focal_length_mm
        if ours is None and focal_length_mm is None:
            return 0.0
        if ours is None or focal_length_mm is None or abs(focal_length_mm - ours) > _ROUNDED_MM + 1e-9:
            known = "an unknown focal length" if ours is None else f"a focal length of {ours:g} mm"
            frame = "unknown" if focal_length_mm is None else f"{focal_length_mm:g} mm"
            raise DecodeError(
                f"distances were calibrated at {known}, the frame's is {frame}: calibrate with targets at the frame's"
            )
        return 2 * abs(focal_length_mm - ours) / ours

    def disparity(self, distance_m: float, stack: ViewStack) -> float:
        """The disparity of an object at this distance, inf allowed. Raises DecodeError for a distance of 0 or less."""
        if not distance_m > 0:
            raise DecodeError(f"the distance is {distance_m:g} m: it must be above 0")
        return (self.gain_px_m / distance_m + self.offset_px) / _scale(stack)

    def distances(self, depth: DepthMap, stack: ViewStack) -> DistanceMap:
        """The map in metres. Unknown where the disparity is, and where it could be that of infinity."""
        beyond = depth.disparity * np.float32(_scale(stack)) - np.float32(self.offset_px)
        error = depth.sigma * np.float32(_scale(stack))
        with np.errstate(invalid="ignore", divide="ignore"):
            known = beyond > _FARTHEST_SIGMAS * error
            distance = np.where(known, np.float32(self.gain_px_m) / beyond, np.float32(np.nan))
            sigma = self.sigma_m(distance, error)
        return DistanceMap(distance.astype(np.float32), sigma)

    @overload
    def sigma_m(self, distance_m: float, shift_sigma_px: float = 0.0) -> float: ...
    @overload
    def sigma_m(self, distance_m: Map, shift_sigma_px: Map) -> Map: ...
    def sigma_m(self, distance_m: Map | float, shift_sigma_px: Map | float = 0.0) -> Map | float:
        """How well a distance is known whose shift is known so well: by 1/Z = (S − offset)/gain, with the gain's and
        the offset's errors, which all distances have in common (alone: shift_sigma_px = 0)."""
        inverse = 1 / distance_m
        common = (self.gain_sigma_share * self.gain_px_m * inverse) ** 2 + self.offset_sigma_px**2
        variance = shift_sigma_px**2 + np.maximum(common + 2 * self.covariance_px2_m * inverse, 0)
        sigma = np.sqrt(variance) * distance_m**2 / self.gain_px_m
        return float(sigma) if isinstance(distance_m, float) else np.asarray(sigma, np.float32)

    def focus(self, stack: ViewStack) -> tuple[float, float] | None:
        """(m, σ in m): where the lens is focused, by targets; None at infinity.

        All shifts may be off together, which moves the focus, but no distance of what looks like the targets.
        """
        if self.offset_px >= 0:
            return None
        metres = -self.gain_px_m / self.offset_px
        return metres, self.sigma_m(metres, _TOGETHER * _scale(stack))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Ranging:
        """As a file has it. Raises DecodeError."""
        try:
            return codec.read(cls, values)
        except codec.CodecError as error:
            raise DecodeError(f"the ranging is incomplete or wrong ({error}): calibrate with targets again") from error


@dataclass(frozen=True, slots=True, eq=False)
class DistanceMap:
    """Distances from the lens along its axis and their standard errors, float32 (h, w), m; NaN where unknown."""

    distance_m: Map
    sigma_m: Map

    def nearest(self, share: float = 0.01) -> tuple[float, float] | None:
        """(m, σ in m): the distance that `share` of the known pixels are nearer than, and how well such pixels are
        known; None where fewer than a tenth are known at all."""
        known = np.isfinite(self.distance_m)
        if known.mean() < 0.1:
            return None
        distance = float(np.quantile(self.distance_m[known], share))
        return distance, float(np.median(self.sigma_m[known & (self.distance_m <= distance)]))


@dataclass(frozen=True, slots=True)
class Target:
    """A target at a known distance and the shift S that it was seen at, with its standard error."""

    distance_m: float
    shift_px: float
    sigma_px: float = 0.0


def fit_targets(
    targets: Sequence[Target],
    *,
    f_number: float | None,
    focal_length_mm: float | None = None,
    lens: Ranging | None = None,
) -> Ranging:
    """The ranging fitted to targets at known distances, by least squares in 1/Z, each weighted by its σ.

    Its errors follow from the targets' σ, or from their misfit where that is larger. A single distance gives only
    the offset (the focus); the gain is then that of `lens`. Raises DecodeError without it.
    """
    if not targets:
        raise DecodeError("no target was seen")
    inverse = np.array([1 / t.distance_m for t in targets])
    shifts = np.array([t.shift_px for t in targets])
    sigmas = np.array([t.sigma_px for t in targets])
    if not np.all(np.isfinite(inverse) & (inverse > 0)):
        raise DecodeError("targets must be at distances above 0 m")
    if inverse.max() / inverse.min() < _FRESH_DISTANCES:
        if lens is None:
            raise DecodeError(
                "targets at a single distance give the focus but not the scale: add one at another distance"
            )
        gain_sigma, away = lens.gain_sigma_share * lens.gain_px_m, float(inverse.mean())
        return replace(
            lens, offset_px=float(np.mean(shifts - lens.gain_px_m * inverse)), f_number=f_number,
            source=f"{len(targets)} target(s) and the lens", focal_length_mm=focal_length_mm,
            offset_sigma_px=math.hypot(float(np.hypot.reduce(sigmas)) / len(targets), gain_sigma * away),
            covariance_px2_m=-(gain_sigma**2) * away,
        )  # fmt: skip
    weights = 1 / sigmas if sigmas.all() else np.ones_like(sigmas)
    design = np.column_stack([inverse, np.ones_like(inverse)]) * weights[:, None]
    solve = np.linalg.pinv(design)
    gain, offset = (float(v) for v in solve @ (shifts * weights))
    if gain <= 0:
        raise DecodeError("nearer targets were seen with smaller shifts: are the distances in the order of the frames?")
    misfit = shifts * weights - design @ [gain, offset]
    reach = float(misfit @ misfit) / (len(targets) - 2) if len(targets) > 2 else 0.0
    covariance = solve @ solve.T * max(reach, float(sigmas.all()))
    return Ranging(
        gain, offset, f_number, f"{len(targets)} targets", math.sqrt(covariance[0, 0]) / gain, focal_length_mm,
        math.sqrt(covariance[1, 1]), float(covariance[0, 1]),
    )  # fmt: skip


def target_shift(
    depth: DepthMap, stack: ViewStack, share: float = 0.25, window: int = CONTRAST_WINDOW
) -> tuple[float, float]:
    """The shift S of what fills the picture's middle (`share` of its height and width), and its standard error.

    The median, each pixel counting by its variance. Its error is that of the mean of blocks of a `window`, from their
    scatter (of few blocks, by the pixels' σ with one free measurement a block), and `_BENT`. Raises DecodeError where
    less than a tenth of it is known.
    """
    cut = tuple(slice(round(n * (1 - share) / 2), max(round(n * (1 + share) / 2), 1)) for n in depth.disparity.shape)
    values, sigma = depth.disparity[cut], depth.sigma[cut]
    known = np.isfinite(values)
    if known.mean() < 0.1:
        raise DecodeError("the target in the picture's middle has too little texture: hang a printed page there")
    order = np.argsort(values[known])
    weight: NDArray[np.float64] = np.cumsum(1 / sigma[known][order].astype(np.float64) ** 2)
    middle = values[known][order][int(np.searchsorted(weight, weight[-1] / 2))]
    tiles = [values[y : y + window, x : x + window] for y, x in _corners(values.shape, window)]
    medians = [np.median(tile[seen]) for tile in tiles if (seen := np.isfinite(tile)).mean() >= 0.5]
    if len(medians) >= _FEW:
        error = float(np.std(medians, ddof=1)) / math.sqrt(len(medians))
    else:
        free = max(float(known.sum()) / window**2, 1.0)
        error = math.sqrt(math.pi / 2 / free) * float(np.median(sigma[known]))  # a median's, of normal errors
    return float(middle) * _scale(stack), math.hypot(error, _BENT) * _scale(stack)


def _corners(shape: tuple[int, ...], side: int) -> list[tuple[int, int]]:
    """Where squares of a side begin that lie in an area of this shape beside each other."""
    height, width = shape
    return [(y, x) for y in range(0, height - side + 1, side) for x in range(0, width - side + 1, side)]


def _scale(stack: ViewStack) -> float:
    if stack.sensor_px_per_disparity is None:
        raise DecodeError("views from a folder have no sensor, so they give only relative depth")
    return stack.sensor_px_per_disparity
