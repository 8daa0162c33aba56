"""What the application is made of, and how its parts make pictures together."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from starlette.responses import Response

from dappled.daemon.console import pictures
from dappled.daemon.console.access import Access
from dappled.daemon.console.background import Background
from dappled.daemon.console.control import Control
from dappled.daemon.console.feed import Feed, FeedError
from dappled.daemon.console.footprint import Rectified
from dappled.daemon.console.hub import Hub
from dappled.daemon.console.studio import Studio

GLOBE_S = 30.0  # a virtual globe that asked this long ago still watches


@dataclass(slots=True)
class Parts:
    """What the application is made of. `workers` makes pictures, one at a time; `askers` wait for the daemon."""

    feed: Feed
    hub: Hub
    studio: Studio
    control: Control
    access: Access
    background: Background | None
    globe_s: float = -1e9
    workers: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "pictures"))
    askers: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "questions"))

    def watched(self) -> bool:
        """Whether anybody looks."""
        return len(self.hub) > 0 or time.monotonic() - self.globe_s < GLOBE_S


async def make_picture(parts: Parts, function: Callable[..., Any], *arguments: Any) -> Any:
    """Make a picture on the one thread for that."""
    return await asyncio.get_running_loop().run_in_executor(parts.workers, function, *arguments)


async def rectified(parts: Parts, frame: int, longest_side: int, *, sharp: bool = False) -> Rectified | None:
    """A frame on the ground; `sharp` from its slices instead of its small picture. None where its place is unknown."""
    seen = parts.feed.frames.get(frame)
    if seen is None:
        raise FeedError(f"there is no frame {frame} here")
    picture, header = seen.thumb, dict(seen.tag)
    if sharp or picture is None:
        message = await parts.feed.slices(frame)
        header["frame_shape"] = message.header["frame_shape"]
        picture = await make_picture(parts, parts.studio.full, message)
    found: Rectified | None = await make_picture(parts, parts.studio.rectified, header, picture, longest_side)
    return found


async def rectified_png(parts: Parts, frame: int, longest_side: int, *, sharp: bool = False) -> bytes:
    """The same as a PNG file. Raises FeedError where its place is unknown."""
    one = await rectified(parts, frame, longest_side, sharp=sharp)
    if one is None:
        raise FeedError(f"where frame {frame} lies on the ground is not known")
    made: bytes = await make_picture(parts, pictures.png, one.picture)
    return made


def file(data: bytes, name: str) -> Response:
    """An answer with a file, its kind by its name."""
    kind = {"jpg": "image/jpeg", "png": "image/png", "json": "application/json"}[name.rpartition(".")[2]]
    return Response(data, media_type=kind)
