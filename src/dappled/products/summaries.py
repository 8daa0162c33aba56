"""What a notebook shows of an opened light field, frame or flight: HTML of a line, a small picture and its doubts."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dappled.encoded_pictures import file_of

_LONGEST = 240  # pixels of the picture
_QUALITY = 80


def block(line: str, picture: NDArray[np.floating] | None, remarks: Iterable[str] = ()) -> str:
    """HTML of a line of text, a picture (h, w) or (h, w, 3) from 0 to 1, and remarks below it."""
    parts = [f"<div>{html.escape(line)}</div>"]
    if picture is not None:
        step = max(1, -(-max(picture.shape[:2]) // _LONGEST))
        eight = np.rint(255 * picture[::step, ::step]).astype(np.uint8)
        jpeg = base64.b64encode(file_of(eight, "JPEG", quality=_QUALITY)).decode()
        parts.append(f'<img alt="" src="data:image/jpeg;base64,{jpeg}">')
    parts += [f"<div>{html.escape(one)}</div>" for one in remarks]
    return "".join(parts)


def table(line: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """HTML of a line of text and a table."""
    top = "".join(f"<th>{html.escape(one)}</th>" for one in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(one)}</td>" for one in row) + "</tr>" for row in rows)
    return f"<div>{html.escape(line)}</div><table><tr>{top}</tr>{body}</table>"
