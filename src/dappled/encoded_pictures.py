"""Encode pictures as the bytes of a JPEG, PNG or WebP file."""

from __future__ import annotations

import io
from typing import Any

from numpy.typing import NDArray
from PIL import Image


def file_of(picture: NDArray[Any] | Image.Image, kind: str, **options: Any) -> bytes:
    """The file of a picture (h, w) or (h, w, channels): `kind` and `options` as Pillow knows them."""
    file = io.BytesIO()
    (picture if isinstance(picture, Image.Image) else Image.fromarray(picture)).save(file, kind, **options)
    return file.getvalue()
