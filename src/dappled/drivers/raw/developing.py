"""Develop pictures of full resolution: as DNG of their linear values, and by LibRaw to colours for eyes.

A DNG holds the colour mosaic of a Bayer chip with its own pattern, else values in every pixel (LinearRaw). Its white
level leaves room for what is brighter behind a dark part of the mask.
"""

from __future__ import annotations

import io

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray

from dappled.decode import srgb
from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.picture import interpolated
from dappled.drivers.raw.picture_maker import MadePicture
from dappled.encoded_pictures import file_of

LINEAR_RAW = 34892  # a photometric interpretation, as _CFA
_CFA = 32803
_BYTE, _ASCII, _SHORT, _RATIONAL, _SRATIONAL = 1, 2, 3, 5, 10
_BLACK, _WHITE = 1024, 1024 + 16384  # almost two stops of room above white
_D65 = 21
_SRGB_OF_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)
_GREY_OF_SRGB = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # BT.709
_QUALITY = 90
_CURVE = (2.4, 12.92)  # sRGB's, as LibRaw takes it


def developed(made: MadePicture) -> NDArray[np.uint16]:
    """uint16 (H, W) or (H, W, 3) in sRGB's curve."""
    if _bayer(made) is not None:
        return _by_libraw(made, _CURVE)
    return srgb.sixteen(_everywhere(made))


def jpeg(made: MadePicture) -> bytes:
    """A JPEG in sRGB, to look at."""
    return file_of(srgb.eight(developed(made)), "JPEG", quality=_QUALITY)


def linear(made: MadePicture, *, colour: bool = True) -> Singles:
    """float32 (H, W, 3), or (H, W) where the frame or the caller has no `colour`: linear sRGB, 1.0 = white."""
    if _bayer(made) is None:
        image = np.maximum(_everywhere(made), 0)
    else:
        image = _by_libraw(made, (1, 1)).astype(np.float32)
        image /= 65535
    return image if colour or image.ndim == 2 else np.asarray(image @ _GREY_OF_SRGB)


def _by_libraw(made: MadePicture, curve: tuple[float, float]) -> NDArray[np.uint16]:
    with rawpy.imread(io.BytesIO(dng(made))) as raw:
        settings = rawpy.Params(
            use_camera_wb=True, no_auto_bright=True, adjust_maximum_thr=0, output_bps=16, gamma=curve, user_flip=0
        )
        return np.asarray(raw.postprocess(settings))


def _everywhere(made: MadePicture) -> Singles:
    """Linear values of chips that are no Bayer chips, in sRGB where they have colours."""
    image = interpolated(made.picture)
    return np.asarray(image if image.ndim == 2 else _in_srgb(image[..., _rgb(made)], made), dtype=np.float32)


def _in_srgb(image: Singles, made: MadePicture) -> Floats:
    """Balanced, and by the camera's matrix, to linear sRGB."""
    matrix = _matrix(made) @ np.linalg.inv(_SRGB_OF_XYZ)  # from sRGB to the camera
    matrix /= matrix.sum(axis=1, keepdims=True)
    return np.asarray((image / _neutral(made)) @ np.linalg.inv(matrix).T)


def _rgb(made: MadePicture) -> list[int]:
    """The indices of red, green and blue."""
    names = made.raw.colour_names
    return [names.index(name) for name in "RGB"]


def _bayer(made: MadePicture) -> bytes | None:
    """The pattern as DNG has it, 0 red, 1 green, 2 blue; None for other chips."""
    pattern, names = made.picture.pattern, made.raw.colour_names
    if pattern.shape != (2, 2) or set(names) != set("RGB") or pattern.min() < 0:
        return None
    return bytes("RGB".index(names[index]) for index in pattern.ravel())


def _matrix(made: MadePicture) -> Floats:
    return _SRGB_OF_XYZ if made.colour_matrix is None else made.colour_matrix


def _neutral(made: MadePicture) -> Floats:
    """Red, green and blue of something white: by the file's own balance, else as grey as the whole frame."""
    rgb = _rgb(made)
    if made.raw.balance is not None:
        return 1 / np.array(made.raw.balance)[rgb]
    plane, pattern = made.picture.plane, made.picture.pattern
    first = [made.raw.colour_names.index(name) for name in made.raw.colour_names]
    means = []
    for colour in rgb:
        places = [place for place, index in np.ndenumerate(pattern) if index >= 0 and first[index] == colour]
        a, b = pattern.shape
        means.append(float(np.mean([plane[row::a, column::b].mean() for row, column in places])))
    return np.maximum(means, 1e-6) / max(*means, 1e-6)


def dng(made: MadePicture) -> bytes:
    """The linear values as DNG, without EXIF."""
    pattern = _bayer(made)
    image = made.picture.plane if pattern is not None else interpolated(made.picture)
    colours = pattern is not None or image.ndim == 3
    if image.ndim == 3:
        image = image[..., _rgb(made)]
    values = np.clip(np.round(image * (_WHITE - _BLACK) + _BLACK), 0, 65535).astype(np.uint16)
    samples = 1 if values.ndim == 2 else values.shape[2]
    tags: list[tuple[int, int, int, object, bool]] = [
        (50706, _BYTE, 4, bytes((1, 4, 0, 0)), True),
        (50707, _BYTE, 4, bytes((1, 2, 0, 0)), True),
        (50708, _ASCII, 0, made.raw.model or "dappled", True),
        (50714, _SHORT, samples, (_BLACK,) * samples if samples > 1 else _BLACK, True),
        (50717, _SHORT, samples, (_WHITE,) * samples if samples > 1 else _WHITE, True),
    ]
    if colours:
        matrix = [part for value in _matrix(made).ravel() for part in (round(value * 10000), 10000)]
        neutral = [part for value in _neutral(made) for part in (round(value * 10**6), 10**6)]
        tags += [
            (50721, _SRATIONAL, 9, tuple(matrix), True),
            (50728, _RATIONAL, 3, tuple(neutral), True),
            (50778, _SHORT, 1, _D65, True),
        ]
    if pattern is not None:
        tags += [
            (33421, _SHORT, 2, (2, 2), True),
            (33422, _BYTE, 4, pattern, True),
            (50710, _BYTE, 3, bytes((0, 1, 2)), True),
            (50711, _SHORT, 1, 1, True),
        ]
    buffer = io.BytesIO()
    grey = samples == 1 and pattern is None  # tifffile wants three samples of LinearRaw
    tifffile.imwrite(
        buffer,
        values,
        byteorder="<",
        photometric="minisblack" if grey else LINEAR_RAW if pattern is None else _CFA,
        planarconfig="contig" if samples > 1 else None,
        metadata=None,
        software=False,
        extratags=tags,
    )
    return buffer.getvalue()
