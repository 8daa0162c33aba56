"""The console's addresses for virtual globes: a network link, the latest frame on the ground, its picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from dappled.daemon.console import kml
from dappled.daemon.console.feed import FeedError
from dappled.daemon.console.parts import Parts, file, rectified, rectified_png

_BOUNDS_PX, _PICTURE_PX = 320, 1024

Endpoint = Callable[[Request], Any]


def link(parts: Parts) -> Endpoint:
    """What a globe opens once."""

    async def answer(request: Request) -> Response:
        parts.globe_s = time.monotonic()
        return Response(kml.network_link(_absolute(request, "/kml/latest.kml")), media_type=kml.MEDIA_TYPE)

    return answer


def latest(parts: Parts) -> Endpoint:
    """What it then asks for again and again."""

    async def answer(request: Request) -> Response:
        parts.globe_s = time.monotonic()
        frame, one = parts.feed.newest(), None
        if frame is not None:
            try:
                one = await rectified(parts, frame, _BOUNDS_PX)
            except FeedError:  # not decoded: the track is shown all the same
                one = None
        picture = _absolute(request, f"/kml/{frame}.png")
        return Response(kml.latest(f"frame {frame}", picture, one, parts.feed.track()), media_type=kml.MEDIA_TYPE)

    return answer


def picture(parts: Parts) -> Endpoint:
    """A frame's picture, north up."""

    async def answer(request: Request) -> Response:
        parts.globe_s = time.monotonic()
        return file(await rectified_png(parts, request.path_params["frame"], _PICTURE_PX, sharp=True), "x.png")

    return answer


def _absolute(request: Request, path: str) -> str:
    token = request.query_params.get("token")
    tail = f"?token={token}" if token else ""
    return f"{request.url.scheme}://{request.headers['host']}{path}{tail}"
