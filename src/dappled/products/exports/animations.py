"""Animate pictures that people send each other: WebP, or MP4 by OpenCV."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, features

from dappled import durable
from dappled.encoded_pictures import file_of
from dappled.errors import DappledError
from dappled.products.exports.prints import Bytes
from dappled.products.extras import need

_A_SECOND = 12  # pictures
_LEAST_PX = 480  # of the shorter side: small views are drawn larger


def save(path: Path, pictures: Sequence[Bytes]) -> None:
    """Write pictures of one size, one after the other, as an animation without end (.webp) or a film (.mp4).

    Raises DappledError where the file or the film can't be written, and MissingExtraError without OpenCV.
    """
    height, width = pictures[0].shape[:2]
    times = max(1, _LEAST_PX // min(height, width))
    size = width * times // 2 * 2, height * times // 2 * 2  # films have even sides
    drawn = [Image.fromarray(one).convert("RGB").resize(size, Image.Resampling.BICUBIC) for one in pictures]
    try:
        durable.write_file(path.absolute(), _film(drawn) if path.suffix == ".mp4" else _webp(drawn))
    except OSError as error:
        raise DappledError(f"{path} can't be written: {error}") from None


def _webp(drawn: Sequence[Image.Image]) -> bytes:
    if not features.check("webp"):
        raise DappledError("this Pillow was built without WebP: install another, or name a .mp4")
    more = {"save_all": True, "append_images": drawn[1:], "duration": 1000 // _A_SECOND, "loop": 0, "quality": 85}
    return file_of(drawn[0], "WEBP", **more)


def _film(drawn: Sequence[Image.Image]) -> bytes:
    cv2 = need("cv2")
    with tempfile.TemporaryDirectory(prefix="dappled-film-") as folder:
        path = Path(folder) / "film.mp4"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), _A_SECOND, drawn[0].size)
        if not writer.isOpened():
            raise DappledError("this OpenCV can't write films: name a .webp")
        for one in drawn:
            writer.write(np.asarray(one)[:, :, ::-1])
        writer.release()
        return path.read_bytes()
