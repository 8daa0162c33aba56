"""Read a light field from a folder with a picture for each view, as HCI's benchmark and others distribute them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dappled import durable, picture_order
from dappled.bounds import claims
from dappled.bounds.claims import ClaimError
from dappled.bounds.pictures import open_picture
from dappled.decode import srgb
from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.light_field import CAMERAS, centred
from dappled.errors import DappledError, first_line

_ENDINGS = (".png", ".tif", ".tiff", ".jpg", ".jpeg")


def read(folder: Path) -> LightField:
    """All pictures of a folder in the order of their names, row by row from the top left camera. sRGB is made linear.

    The light field has no slices, and `cameras` among its attributes. If the folder contains HCI's `input_Cam….png`,
    other pictures are ignored. Raises DappledError.
    """
    if wrong := not_square(folder):
        raise DappledError(wrong)
    files = _pictures(folder)
    side = math.isqrt(len(files))
    try:
        # Each value is a float32 of a picture, and another of all views.
        claims.check_size(sum(map(_values, files)) * 8, sum(path.stat().st_size for path in files), "views")
    except ClaimError as error:
        raise DappledError(f"{folder}: {error}") from None
    pictures = [_linear(path) for path in files]
    shapes = {picture.shape for picture in pictures}
    if len(shapes) > 1:
        raise DappledError(f"the pictures in {folder} differ in size: {', '.join(map(str, sorted(shapes)))}")
    shape = pictures[0].shape
    axis = centred(side) / side
    return LightField(
        slices=np.zeros((0, *shape[:2]), dtype=np.complex64),
        carriers=np.zeros((0, 4)),
        views=np.stack(pictures).reshape(side, side, *shape),
        view_offsets=np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1),
        grid=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        attributes={CAMERAS: True, "source": folder.name, "shape": list(shape[:2])},
    )


def not_square(folder: Path) -> str:
    """Why the pictures of a folder are no light field; "" where they can be one."""
    count = len(_pictures(folder))
    square = count > 0 and math.isqrt(count) ** 2 == count
    return "" if square else f"{folder} holds {count} pictures: a light field needs n × n, one per view"


def _pictures(folder: Path) -> list[Path]:
    files = picture_order.by_name((p for p in folder.iterdir() if p.suffix.lower() in _ENDINGS), Path.as_posix)
    return [p for p in files if p.name.startswith("input_Cam")] or files


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            yield open_picture(file)
    except Exception as error:  # Pillow raises anything on damaged bytes
        raise DappledError(f"{path} can't be read as a picture: {first_line(error)}") from error


def _values(path: Path) -> int:
    """How many values a picture has, by its head."""
    with _opened(path) as picture:
        return math.prod(picture.size) * (1 if picture.mode in ("L", "I;16", "I") else 3)


def _linear(path: Path) -> NDArray[np.float32]:
    with _opened(path) as picture:
        values = np.asarray(picture if picture.mode in ("L", "I;16", "I", "RGB") else picture.convert("RGB"))
    top = 255 if values.dtype == np.uint8 else 65535
    linear = srgb.decoded(values.astype(np.float32) / np.float32(top)).astype(np.float32)
    grey = linear.ndim == 3 and bool((linear == linear[..., :1]).all())
    return linear[..., 0] if grey else linear
