"""Make pictures for people: tone curve, mosaics with captions, and false colours with a scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dappled.decode import srgb
from dappled.errors import DappledError
from dappled.products.whole_files import whole

Bytes = NDArray[np.uint8]
_GAP = 6  # px between the pictures of a mosaic
_PAPER = 255
# Viridis (S. van der Walt and N. Smith), every ninth part.
_VIRIDIS = np.array(
    [
        (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142),
        (31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37),
    ],
    dtype=np.float64,
)  # fmt: skip
UNKNOWN, HATCH = (205, 205, 205), (110, 110, 110)  # no colours of the scale
_HATCH_STEP = 6  # px between the lines


def white_of(pictures: Sequence[NDArray[np.floating]]) -> float:
    """The brightness that becomes white in all pictures: their 99.5 % quantile."""
    values = np.concatenate([np.ravel(p)[:: max(1, p.size // 200_000)] for p in pictures])
    values = values[np.isfinite(values)]
    return max(float(np.quantile(values, 0.995)), 1e-9) if values.size else 1.0


def toned(picture: NDArray[np.floating], white: float) -> Bytes:
    """uint8 of a linear picture with the sRGB curve; NaN is black."""
    linear = np.clip(np.nan_to_num(picture) / white, 0, 1)
    made: Bytes = np.rint(255 * srgb.encoded(linear)).astype(np.uint8)
    return made


def coloured(values: NDArray[np.floating], low: float, high: float) -> Bytes:
    """uint8 (h, w, 3): viridis from `low` (dark) to `high` (bright), hatched in grey where unknown."""
    share = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-12), 0, 1) * (len(_VIRIDIS) - 1)
    at = np.arange(len(_VIRIDIS))
    made = np.stack([np.interp(share, at, _VIRIDIS[:, c]) for c in range(3)], axis=-1)
    unknown = ~np.isfinite(values)
    rows, columns = (np.arange(side) for side in unknown.shape)
    made[unknown] = UNKNOWN
    made[unknown & ((rows[:, None] + columns) % _HATCH_STEP == 0)] = HATCH
    colours: Bytes = np.rint(made).astype(np.uint8)
    return colours


def with_scale(values: NDArray[np.floating], low: float, high: float, unit: str) -> Bytes:
    """`coloured`, with a scale below it that labels both ends, and what is hatched; as wide as the words need."""
    picture = coloured(values, low, high)
    size = max(11, min(22, picture.shape[1] // 28))
    font = ImageFont.load_default(size - 2)
    ends = [f"{low:.3g} {unit}", f"{high:.3g} {unit}"]
    least = math.ceil(sum(font.getlength(end) for end in ends)) + 4 * size
    width = max(picture.shape[1], least)
    told = [] if np.isfinite(values).all() else ["hatched: unknown"]
    strip = Image.new("RGB", (width, (2 + len(told)) * size + 10), (_PAPER,) * 3)
    bar = coloured(np.broadcast_to(np.linspace(low, high, width - 2 * size), (size, width - 2 * size)), low, high)
    strip.paste(Image.fromarray(bar), (size, 4))
    draw = ImageDraw.Draw(strip)
    y = size + 6
    draw.text((size, y), ends[0], fill=0, font=font)
    draw.text((width - size, y), ends[1], fill=0, font=font, anchor="ra")
    for line in told:
        draw.text((width // 2, y + size), line, fill=(110, 110, 110), font=font, anchor="ma")
    return np.concatenate([_centred(picture, width), np.asarray(strip)], axis=0)


def _centred(picture: Bytes, width: int) -> Bytes:
    """The picture (h, w, 3) on paper that is at least as wide."""
    left = (width - picture.shape[1]) // 2
    right = width - picture.shape[1] - left
    return np.pad(picture, ((0, 0), (left, right), (0, 0)), constant_values=_PAPER)


def mosaic(pictures: Sequence[Bytes], captions: Sequence[str] = (), columns: int | None = None) -> Bytes:
    """Pictures of one size side by side in rows of `columns` (None: as square as may be), captions below.

    Captions that are wider than the pictures move these apart.
    """
    if not pictures:
        raise DappledError("there is no picture to show")
    coloured_ones = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in pictures]
    height, width = coloured_ones[0].shape[:2]
    across = columns or math.ceil(math.sqrt(len(pictures)))
    down = math.ceil(len(pictures) / across)
    size = max(11, min(24, width // 16))
    font = ImageFont.load_default(size)
    below = size + 8 if any(captions) else 0
    cell = max(width, *(math.ceil(font.getlength(caption)) for caption in captions or [""]))
    sheet = Image.new(
        "RGB", (across * (cell + _GAP) + _GAP, down * (height + below + _GAP) + _GAP), (_PAPER, _PAPER, _PAPER)
    )
    draw = ImageDraw.Draw(sheet)
    for number, picture in enumerate(coloured_ones):
        left = _GAP + number % across * (cell + _GAP) + (cell - width) // 2
        top = _GAP + number // across * (height + below + _GAP)
        sheet.paste(Image.fromarray(np.ascontiguousarray(picture)), (left, top))
        if captions:
            draw.text((left + width // 2, top + height + 3), captions[number], fill=0, font=font, anchor="ma")
    return np.asarray(sheet)


def save(path: Path, picture: Bytes | NDArray[np.uint16]) -> None:
    """Write a PNG, JPEG or TIFF under its name, whole or not at all. Raises DappledError."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise DappledError(f"{path}: the name of a picture must end in .png, .jpg or .tif")
    with whole(path) as part:
        Image.fromarray(np.ascontiguousarray(picture)).save(part)
