"""Mathematics on arrays: masks, carriers, slices, views, depth. No files, no sockets, no clock, no hardware."""

from __future__ import annotations

from dappled.decode.errors import DecodeError

__all__ = ["DecodeError"]
