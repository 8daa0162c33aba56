"""Pictures that claim more than they hold, and kinds of files that are not tried."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, UnidentifiedImageError

from dappled.bounds.claims import ClaimError
from dappled.bounds.pictures import open_picture


def png() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.arange(12, dtype=np.uint8).reshape(3, 4)).save(file, "PNG")
    return file.getvalue()


def test_an_honest_picture_opens() -> None:
    assert np.asarray(open_picture(io.BytesIO(png()))).shape == (3, 4)


@pytest.mark.parametrize("length", [b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x01\x00\x00"])
def test_a_chunk_that_ends_after_the_file(length: bytes) -> None:
    data = png()
    at = data.index(b"IDAT")
    with pytest.raises(ClaimError, match="ends after the file does"):
        open_picture(io.BytesIO(data[: at - 4] + length + data[at:]))


@pytest.mark.parametrize("data", [b"%!PS-Adobe-3.0 EPSF-3.0\n", b"GIF89a", b"BM", b"", b"\x89PNG", b"\xff\xd8\xff\xe0"])
def test_other_kinds_are_not_tried(data: bytes) -> None:
    with pytest.raises(UnidentifiedImageError):
        open_picture(io.BytesIO(data))
