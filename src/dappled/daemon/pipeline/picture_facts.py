"""What the pixels of a frame say about exposure, detail and focus: numbers, which verdicts are given by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.config.profiles import VerdictBounds

_FLOOR = 0.05  # of the median: what is darker counts as so bright, because its logarithm is noise
_NOISY = 0.5  # of the finest detail: more noise than this, and its detail says nothing
_STEPS = (1, 2, 4)  # pixels
DIRECTIONS = {"across": (0, 1), "along": (1, 0), "falling": (1, 1), "rising": (1, -1)}


@dataclass(frozen=True, slots=True)
class FineDetail:
    """Of the picture at the sensor's own resolution, in its middle: `detail`, and `noise` of its noise; `step` (rows,
    columns) is how many pixels its samples stand apart."""

    detail: tuple[tuple[float, ...], ...]
    noise: float
    step: tuple[int, int]

    @property
    def circle_px(self) -> float | None:
        """The circle of confusion in pixels of the frame; None where noise covers the finest detail."""
        found = _circles(self.detail, self.noise, self.step)
        return None if found is None else min(found)


@dataclass(frozen=True, slots=True)
class PictureFacts:
    """What the pixels of a decoded frame say, and the geometry of its camera.

    `detail` is of the mean slice, along rows and along columns (see `detail`), and `noise` of its noise, `fine` of the
    picture at the sensor's own resolution (None: not measured); `side_mm` is
    (height, width) of the sensor, `view_mm` and `pixel_mm` the (row, column) pitch of views and of the frame; None
    where the camera has no profile. `bounds` are the profile's.
    """

    clipped_share: float
    black_share: float
    mean_share: float
    detail: tuple[tuple[float, ...], ...]
    noise: float = 0.0
    side_mm: tuple[float, float] | None = None
    view_mm: tuple[float, float] | None = None
    pixel_mm: tuple[float, float] | None = None
    bounds: VerdictBounds = field(default_factory=VerdictBounds)
    fine: FineDetail | None = None


def fineness(picture: NDArray[Any]) -> dict[str, float]:
    """How fine the detail of a picture (rows, columns) is, in four directions: the mean squared difference over one
    step by that over two, of logarithms, so that shade counts like light. 0.25 is perfectly smooth, 1 is noise."""
    logs = np.log(np.maximum(picture, 1e-6 * max(float(picture.max()), 1e-12)))
    found = {}
    for name, step in DIRECTIONS.items():
        one, two = (_differences(logs, (step[0] * n, step[1] * n)) for n in (1, 2))
        found[name] = one / two if two > 0 and math.isfinite(one / two) else 0.0
    return found


def _differences(values: NDArray[Any], step: tuple[int, int]) -> float:
    (rows, columns), (height, width) = step, values.shape
    a = values[_part(height, rows), _part(width, columns)]
    b = values[_part(height, -rows), _part(width, -columns)]
    return float(np.mean((a - b) ** 2))


def _part(length: int, shift: int) -> slice:
    return slice(max(shift, 0), length + min(shift, 0))


def detail(picture: NDArray[Any]) -> tuple[tuple[float, ...], ...]:
    """Mean squared differences of a picture's logarithms over 1, 2 and 4 pixels, down its columns and along its rows.

    Logarithms, so that shade counts like light; what is darker than a twentieth of the median counts as so bright. An
    eighth of the picture is left out on each side: a frame's sides don't match, and what they differ by rings in the
    slices of its spectrum next to the border, as fine as detail can be.
    """
    picture = _middle(picture)
    logs = np.log(np.maximum(picture, _floor(picture)))
    return tuple(tuple(_differences(logs, (down * n, right * n)) for n in _STEPS) for down, right in ((1, 0), (0, 1)))


def noise_of(picture: NDArray[Any], sigma: float | NDArray[Any]) -> float:
    """What white noise of `sigma`, of each pixel or of all, adds to each number of `detail`."""
    sigma = _middle(np.broadcast_to(sigma, picture.shape))
    picture = _middle(picture)
    return float(2 * np.mean((sigma / np.maximum(picture, _floor(picture))) ** 2))


def fine_detail(samples: Sequence[tuple[NDArray[Any], NDArray[Any]]], step: tuple[int, int]) -> FineDetail:
    """Of the pictures of one colour's places, each with the standard error of its noise, whose samples are `step`
    pixels apart: every second pixel where they are neighbours, as circles of four samples are the largest told."""
    apart = tuple(max(1, 2 // one) for one in step)
    samples = [
        (picture[row :: apart[0], column :: apart[1]], sigma[row :: apart[0], column :: apart[1]])
        for picture, sigma in samples
        for row in range(apart[0])
        for column in range(apart[1])
    ]
    each = np.array([detail(picture) for picture, _ in samples]).mean(axis=0)
    noise = float(np.mean([noise_of(picture, sigma) for picture, sigma in samples]))
    return FineDetail(tuple(tuple(one) for one in each.tolist()), noise, (step[0] * apart[0], step[1] * apart[1]))


def _middle(picture: NDArray[Any]) -> NDArray[Any]:
    rows, columns = (side // 8 for side in picture.shape)
    return picture[rows : picture.shape[0] - rows, columns : picture.shape[1] - columns]


def _floor(picture: NDArray[Any]) -> float:
    return max(_FLOOR * float(np.median(picture)), 1e-12)


def blur_circle(seen: PictureFacts) -> float | None:
    """The circle of confusion of a picture in pixels of a view, the smaller ones where they are not square; None where
    noise covers its finest detail.

    Along the axis where it is smaller: motion blurs along one.
    """
    pitch = seen.view_mm or (1.0, 1.0)
    found = _circles(seen.detail, seen.noise, pitch)
    return None if found is None else min(found) / min(pitch)


def _circles(detail: Sequence[Sequence[float]], noise: float, pitch: tuple[float, float]) -> tuple[float, float] | None:
    """The circle of confusion by a picture's detail along each axis, in units of the pitch of its samples; None where
    noise covers the finest detail."""
    found = []
    for along, each in zip(detail, pitch, strict=True):
        if not along[0] > 0 or not noise < _NOISY * along[0]:
            return None
        found.append(defocus(tuple(one - noise for one in along)) * each)
    return found[0], found[1]


def defocus(along: Sequence[float]) -> float:
    """The diameter, in pixels, of the circle that a picture is out of focus by, from its `detail` along an axis.

    Ground without blur looks alike at all scales: its power falls as f^−β. The differences over 2 and 4 pixels say how
    fast, and what those over 1 pixel lack then is blur, by the transfer exp(−(π f d)² / 8) of a circle of diameter d.
    At most 4.
    """
    one, two, four = along
    diameters, fine, coarse = _blurred()
    expected = [float(np.interp(-two / four, -coarse[:, at], fine[:, at])) for at in range(len(diameters))]
    return float(np.interp(-one / two, -np.minimum.accumulate(expected), diameters))


@cache
def _blurred() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Diameters (D,), and of pictures of 51 slopes β from 0 to 5, blurred by them, the mean squared difference over one
    pixel by that over two, and over two by that over four, (B, D) each."""
    diameters, slopes = np.linspace(0, 4, 41), np.linspace(0, 5, 51)
    f = (np.arange(48) + 0.5) / 96
    squared = f[:, None] ** 2 + f[None, :] ** 2
    powers = squared ** (-slopes[:, None, None] / 2)
    sums = np.empty((3, len(slopes), len(diameters)))
    for column, diameter in enumerate(diameters):
        spectrum = (powers * np.exp(-((np.pi * diameter) ** 2) * squared / 4)).sum(axis=1)
        for at, step in enumerate(_STEPS):
            sums[at, :, column] = spectrum @ (1 - np.cos(2 * np.pi * step * f))
    return diameters, sums[0] / sums[1], sums[1] / sums[2]
