"""Names of files by what is in them. Pure."""

from __future__ import annotations

import struct

_DNG_VERSION = 50706


def true_name(name: str, head: bytes) -> str:
    """The file's name with the extension that its first bytes call for.

    For pictures from the camera's memory libgphoto2 makes the name up, from a format code that knows no DNG.
    """
    suffix = _suffix(head)
    stem, dot, given = name.rpartition(".")
    if suffix is None or not dot or given.lower() == suffix:
        return name
    return f"{stem}.{suffix.upper() if given.isupper() else suffix}"


def _suffix(head: bytes) -> str | None:
    if head.startswith(b"\xff\xd8\xff"):
        return "jpg"
    if head.startswith(b"FUJIFILMCCD-RAW"):
        return "raf"
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
    if order is None or len(head) < 16:
        return None
    if head[8:10] == b"CR":
        return "cr2"
    (first,) = struct.unpack_from(order + "I", head, 4)
    if first + 2 > len(head):
        return None
    (count,) = struct.unpack_from(order + "H", head, first)
    last = min(first + 2 + 12 * count, len(head) - 1)
    tags = {struct.unpack_from(order + "H", head, at)[0] for at in range(first + 2, last, 12)}
    return "dng" if _DNG_VERSION in tags else None
