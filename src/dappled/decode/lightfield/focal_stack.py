"""Pictures focused at many depths, and one picture that is sharp everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import windowed
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.decode.lightfield.view_stack import Image, ViewStack

_WINDOW = 9  # px that sharpness is judged over


@dataclass(frozen=True, slots=True, eq=False)
class FocalStack:
    """`pictures` float32 (D, h, w) or (D, h, w, 3), focused on `disparities` (D,)."""

    pictures: NDArray[np.float32]
    disparities: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class AllInFocus:
    """`picture` (h, w(, 3)): each pixel from the picture of the stack that is sharpest there. `index` int16 (h, w) says
    which, −1 where nothing is sharp: there the picture is the stack's middle one."""

    picture: Image
    index: NDArray[np.int16]


def focal_stack(
    stack: ViewStack, disparities: Sequence[float] | NDArray[np.float64], *, workers: int = 1
) -> FocalStack:
    """The pictures focused on each disparity. Raises DecodeError for none."""
    if len(disparities) == 0:
        raise DecodeError("a focal stack needs at least one plane")
    made = np.stack([shift_and_add(stack, float(d), workers=workers) for d in disparities])
    return FocalStack(made, np.asarray(disparities, dtype=np.float64))


def all_in_focus(stack: FocalStack, *, least_contrast: float = 1e-4) -> AllInFocus:
    """The sharpest of the stack at every pixel: the largest local energy of the Laplacian.

    `least_contrast` (rms of the Laplacian, of white 1.0): what is smoother has no sharpest picture.
    """
    pictures = np.nan_to_num(stack.pictures)
    grey = pictures.mean(axis=3) if pictures.ndim == 4 else pictures
    energy = np.stack([ndimage.laplace(p, mode="nearest") for p in grey]) ** 2
    sharpness, _ = windowed(energy.astype(np.float32), _WINDOW)
    weight = windowed(np.ones((1, *grey.shape[1:]), dtype=np.float32), _WINDOW)[0]
    index = ndimage.median_filter(sharpness.argmax(axis=0), 3)
    smooth = sharpness.max(axis=0) / weight[0] < least_contrast**2
    chosen = np.where(smooth, len(pictures) // 2, index)
    gather = chosen[None, ..., None] if pictures.ndim == 4 else chosen[None]
    picture = np.take_along_axis(pictures, gather, axis=0)[0]
    return AllInFocus(picture, np.where(smooth, -1, index).astype(np.int16))
