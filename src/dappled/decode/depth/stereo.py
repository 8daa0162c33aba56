"""Estimate depth by stereo correspondence (OpenCV's semi-global block matching) between the middle view and outer ones.

Views are enlarged, as a disparity of light-field views is often a fraction of a pixel and the matcher resolves
sixteenths. This is the method of the thesis, on views. It needs clean views.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import DepthMap, Search
from dappled.decode.depth.evidence import Evidence
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.errors import install_extra

_BASE_PX = 8.0  # views are enlarged until the outermost is so many pixels off for a disparity of 1
_MOST_ENLARGED = 4  # times, chosen by hand: interpolation adds nothing to a pair's detail
_BLOCK = 5  # px, of OpenCV's matcher; chosen by hand
_SIXTEENTHS = 16  # OpenCV's matcher counts disparities in sixteenths of a pixel
_LEAST_SIGMA = 0.02  # px/view: what sixteenths and blocks leave at best
_WIDEST = 512  # px that the matcher may search


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map on which the pairs of the middle view with the outermost left, right, upper and lower one agree.

    Unknown where fewer than two pairs found a match. Raises DecodeError without OpenCV, and for ranges too wide.
    """
    cv2 = opencv()
    stack = evidence.stack
    v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
    enlarge = int(np.clip(round(_BASE_PX / stack.reach), 1, _MOST_ENLARGED))
    middle = stack.views[v0, u0]
    low, high = (float(np.quantile(middle, q)) for q in (0.001, 0.999))
    base = _prepared(cv2, middle, enlarge, low, high)
    found = []
    for axis, steps, line in ((1, stack.column_steps, stack.views[v0]), (0, stack.row_steps, stack.views[:, u0])):
        for k in sorted({0, len(steps) - 1}):
            if steps[k] == 0:
                continue
            other = _prepared(cv2, line[k], enlarge, low, high)
            # Along rows; OpenCV finds a point of the first picture so many pixels further left in the second.
            pair = (base, other) if axis == 1 else (base.T, other.T)
            sign = -math.copysign(1, steps[k])
            scale = abs(steps[k]) * enlarge
            ends = sorted((sign * search.low * scale, sign * search.high * scale))
            shift = _matched(
                cv2,
                np.ascontiguousarray(pair[0]),
                np.ascontiguousarray(pair[1]),
                (ends[0], ends[1]),
                search.window or _BLOCK,
            )
            if axis == 0:
                shift = shift.T
            found.append(sign * _reduced(shift, enlarge, middle.shape) / np.float32(scale))
    return _agreed(np.stack(found))


def opencv() -> Any:
    """The module cv2. Raises DecodeError where it is not installed."""
    try:
        import cv2  # noqa: PLC0415  optional: the onboard install leaves it out
    except ImportError as error:
        raise DecodeError(f"stereo matching needs OpenCV; {install_extra('ground')}") from error
    return cv2


def shifts_from_middle(stack: ViewStack) -> NDArray[np.float32]:
    """(V, U, h, w) px: how far each view's picture has moved from the middle view's, along the line between the two
    (Fig 57, on views). By dense inverse search flow; larger is nearer, and 0 all over for the middle view itself.

    Raises DecodeError without OpenCV.
    """
    cv2 = opencv()
    grey = stack.grey().views
    low, high = (float(np.quantile(grey, q)) for q in (0.001, 0.999))
    eight = np.rint(255 * np.clip((grey - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
    matcher = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    matcher.setFinestScale(0)
    out = np.zeros(grey.shape, dtype=np.float32)
    for v, sy in enumerate(stack.row_steps):
        for u, sx in enumerate(stack.column_steps):
            length = math.hypot(sy, sx)
            if (v, u) != (v0, u0) and length:
                flow = matcher.calc(eight[v0, u0], eight[v, u], None)
                out[v, u] = (flow[..., 0] * sx + flow[..., 1] * sy) / length
    return out


def _prepared(cv2: Any, view: Image, enlarge: int, low: float, high: float) -> NDArray[np.uint8]:
    scaled = np.clip((view - low) / max(high - low, 1e-9), 0, 1)
    if enlarge > 1:
        scaled = cv2.resize(scaled, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
    made: NDArray[np.uint8] = np.rint(255 * np.clip(scaled, 0, 1)).astype(np.uint8)
    return made


def _matched(
    cv2: Any, left: NDArray[np.uint8], right: NDArray[np.uint8], between: tuple[float, float], block: int
) -> Image:
    """How many pixels further left the points of the second picture lie, NaN where none was found."""
    low, high = between
    first = math.floor(low) - 1
    count = -(-(math.ceil(high) + 2 - first) // _SIXTEENTHS) * _SIXTEENTHS
    if count > min(_WIDEST, left.shape[1] // 2):
        raise DecodeError(
            f"stereo matching over {count} px is too wide for views of {left.shape[1]} px: narrow the range"
        )
    matcher = cv2.StereoSGBM_create(
        minDisparity=first, numDisparities=count, blockSize=block, P1=8 * block**2, P2=32 * block**2,
        disp12MaxDiff=2, uniquenessRatio=5, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # The matcher finds nothing within `count` of the edge, so the picture is continued there.
    pad = count + abs(first) + block
    wide = [cv2.copyMakeBorder(p, 0, 0, pad, pad, cv2.BORDER_REPLICATE) for p in (left, right)]
    found = matcher.compute(*wide)[:, pad:-pad]
    made: Image = np.where(found < first * _SIXTEENTHS, np.nan, found / _SIXTEENTHS).astype(np.float32)
    return made


def _reduced(shift: Image, enlarge: int, shape: tuple[int, ...]) -> Image:
    """The enlarged map at the views' own pixels: the median of each block's known values."""
    height, width = shape
    blocks = shift[: height * enlarge, : width * enlarge].reshape(height, enlarge, width, enlarge)
    flat = np.sort(blocks.transpose(0, 2, 1, 3).reshape(height, width, -1), axis=2)  # unknown ones go last
    count = np.isfinite(flat).sum(axis=2)
    made: Image = np.take_along_axis(flat, np.maximum(count - 1, 0)[..., None] // 2, axis=2)[..., 0]
    return np.where(count > 0, made, np.float32(np.nan)).astype(np.float32)


def _agreed(maps: NDArray[np.float32]) -> DepthMap:
    """The median of the pairs' results; its error from their spread, its confidence from how many agree with it."""
    ordered = np.sort(maps, axis=0)
    count = np.isfinite(maps).sum(axis=0)
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[None], axis=0)[0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, len(maps) - 1)[None], axis=0)[0]
    middle = (low + high) / 2
    spread = np.where(np.isfinite(maps), np.abs(maps - middle), 0).sum(axis=0) / np.maximum(count, 1)
    sigma = np.sqrt(_LEAST_SIGMA**2 + (1.25 * spread) ** 2)
    agree = (np.abs(maps - middle) < 3 * _LEAST_SIGMA).sum(axis=0)
    known = (count >= min(2, len(maps))) & np.isfinite(middle)
    unknown = np.float32(np.nan)
    return DepthMap(
        np.where(known, ndimage.median_filter(np.where(known, middle, 0), 3), unknown).astype(np.float32),
        np.where(known, sigma, unknown).astype(np.float32),
        np.where(known, agree / len(maps), 0).astype(np.float32),
        "stereo",
    )
