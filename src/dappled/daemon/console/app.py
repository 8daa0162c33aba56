"""The console's web application: one page, its events, its pictures, and the few things that may be asked of it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from dappled.daemon.console import access, globe, pictures
from dappled.daemon.console.access import Refusal
from dappled.daemon.console.control import ControlError
from dappled.daemon.console.feed import FeedError
from dappled.daemon.console.guard import Guard, refused
from dappled.daemon.console.parts import Parts, file, make_picture, rectified_png
from dappled.daemon.console.studio import StudioError
from dappled.daemon.health import metrics
from dappled.errors import DappledError

_PICTURES = (
    "thumb.jpg, mean.jpg, slices.jpg, spectrum.jpg, views.jpg, views.json, refocus.jpg, depth.png, "
    "and map.png, which is north up"
)
_DISPARITY_PX = 8.0
_MAP_PX = 320


def make(parts: Parts) -> ASGIApp:
    """The application, behind its rules."""
    static = str(resources.files("dappled.daemon.console") / "static")
    routes = [
        Route("/", _page(Path(static) / "index.html")),
        Mount("/static", StaticFiles(directory=static)),
        Route("/api/login", _login(parts), methods=["POST"]),
        Route("/api/events", _events(parts)),
        Route("/api/state", _state(parts)),
        Route("/api/shoot", _act(parts, _shoot), methods=["POST"]),
        Route("/api/interval", _act(parts, _interval), methods=["POST"]),
        Route("/api/interval/stop", _act(parts, _stop), methods=["POST"]),
        Route("/api/frames/{frame:int}/{name}", _picture(parts)),
        Route("/api/map", _map(parts)),
        Route("/metrics", _metrics(parts)),
        Route("/kml", globe.link(parts)),
        Route("/kml/latest.kml", globe.latest(parts)),
        Route("/kml/{frame:int}.png", globe.picture(parts)),
    ]
    return Guard(Starlette(routes=routes, exception_handlers={DappledError: _told}), parts.access)


Endpoint = Callable[[Request], Any]


def _page(path: Path) -> Endpoint:
    async def page(_: Request) -> Response:
        return FileResponse(path)

    return page


def _login(parts: Parts) -> Endpoint:
    async def login(request: Request) -> Response:
        body = await _body(request)
        token = body.get("token")
        refusal = parts.access.try_token(
            token if isinstance(token, str) else "", request.client.host if request.client else ""
        )
        if refusal is not None:
            return refused(refusal)
        answer = JSONResponse({"ok": True})
        if parts.access.open:  # nothing to remember
            return answer
        answer.set_cookie(access.COOKIE, str(token), httponly=True, samesite="strict", max_age=7 * 86400)
        return answer

    return login


def _events(parts: Parts) -> Endpoint:
    async def events(_: Request) -> Response:
        feed = parts.feed
        first = [_about(parts), feed.state(), *(feed.frame_event(index) for index in feed.frames), {"is": "ready"}]
        if log := await _log(parts, 0):
            first.append(log)
        if parts.hub.full:
            return refused(Refusal(503, "too many pages are open: close one"))
        return StreamingResponse(_stream(parts.hub.listen(first)), media_type="text/event-stream")

    return events


async def _stream(events: AsyncIterator[str]) -> AsyncIterator[str]:
    async for text in events:
        yield text


def _state(parts: Parts) -> Endpoint:
    async def state(_: Request) -> Response:
        hub, rules = parts.hub, parts.access
        own = {"pages": len(hub), "events_dropped": hub.dropped, "refused": rules.refused}
        return JSONResponse({**parts.feed.state(), "console": own, "newest": parts.feed.newest()})

    return state


def _metrics(parts: Parts) -> Endpoint:
    async def answer(_: Request) -> Response:
        health = parts.feed.health
        if health is None:
            return refused(Refusal(503, "the daemon has not been heard yet: ask again"))
        return Response(metrics.text(health), media_type=metrics.CONTENT_TYPE)

    return answer


def _about(parts: Parts) -> dict[str, Any]:
    background = parts.background
    return {
        "is": "about",
        "start": parts.feed.start,
        "map": None if background is None else background.bounds(),
        "path": list(parts.feed.path),
    }


async def _log(parts: Parts, after: int) -> dict[str, Any] | None:
    """The daemon's log lines after a number, as an event; None where there are none."""
    try:
        answer = await _ask(parts, {"do": "log", "after": after})
    except ControlError:
        return None
    return {"is": "log", "lines": answer["lines"]} if answer.get("lines") else None


async def follow_log(parts: Parts) -> None:
    """Tell pages the log's new lines, as long as there are pages."""
    after = 0
    while True:
        await asyncio.sleep(0.7)
        if not len(parts.hub):
            continue
        event = await _log(parts, after)
        if event is not None:
            after = event["lines"][-1]["number"]
            parts.hub.tell(event)


def _act(parts: Parts, question: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Endpoint:
    async def act(request: Request) -> Response:
        answer = await _ask(parts, question(await _body(request)))
        answer.pop("number", None)
        return JSONResponse(answer, status_code=200 if answer.get("ok") else 409)

    return act


def _shoot(body: Mapping[str, Any]) -> dict[str, Any]:
    return {"do": "shoot", "sequence": _whole(body, "sequence", 0, 2**31)}


def _interval(body: Mapping[str, Any]) -> dict[str, Any]:
    seconds = body.get("interval_s")
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds <= 86400:
        raise StudioError("interval_s is a number of seconds from 0 to 86400")
    count, sequence = _whole(body, "count", 0, 10**6), _whole(body, "sequence", 0, 2**31)
    return {"do": "interval", "sequence": sequence, "interval_s": seconds, "count": count}


def _stop(_: Mapping[str, Any]) -> dict[str, Any]:
    return {"do": "stop interval"}


def _whole(body: Mapping[str, Any], name: str, low: int, high: int) -> int:
    value = body.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise StudioError(f"{name} is a whole number from {low} to {high}")
    return value


async def _ask(parts: Parts, question: Mapping[str, Any]) -> dict[str, Any]:
    return await asyncio.get_running_loop().run_in_executor(parts.askers, parts.control.ask, question)


def _picture(parts: Parts) -> Endpoint:
    async def picture(request: Request) -> Response:
        frame, name = request.path_params["frame"], request.path_params["name"]
        seen = parts.feed.frames.get(frame)
        if seen is None:
            raise FeedError(f"there is no frame {frame} here")
        if name == "thumb.jpg" and seen.thumb is not None:
            return file(await make_picture(parts, pictures.jpeg, seen.thumb), name)
        if name == "map.png":
            return file(await rectified_png(parts, frame, _MAP_PX), name)
        if name == "depth.png":
            if seen.depth is None:
                raise FeedError(f"frame {frame} has no depth (any more)")
            return file(await make_picture(parts, parts.studio.depth, seen.depth), name)
        message = await parts.feed.slices(frame)
        studio = parts.studio
        if name == "refocus.jpg":
            return file(await make_picture(parts, studio.refocused, message, _disparity(request)), name)
        makers: dict[str, Callable[..., Any]] = {
            "thumb.jpg": lambda one: pictures.jpeg(studio.thumb(one)),
            "mean.jpg": studio.mean,
            "slices.jpg": studio.slices,
            "spectrum.jpg": studio.spectrum,
            "views.jpg": lambda one: studio.views(one)[1],
            "views.json": lambda one: json.dumps(studio.views(one)[0]).encode(),
        }
        if name not in makers:
            raise FeedError(f"a frame has {_PICTURES}, no {name}")
        return file(await make_picture(parts, makers[name], message), name)

    return picture


def _disparity(request: Request) -> float:
    try:
        disparity = float(request.query_params.get("disparity", "0"))
    except ValueError:
        disparity = float("nan")
    if not abs(disparity) <= _DISPARITY_PX:  # NaN too
        raise StudioError(f"disparity is a number of pixels from {-_DISPARITY_PX:g} to {_DISPARITY_PX:g}")
    return disparity


def _map(parts: Parts) -> Endpoint:
    async def background(_: Request) -> Response:
        if parts.background is None:
            raise FeedError("no map is named in console.map")
        return FileResponse(parts.background.file, headers={"cache-control": "private, max-age=3600"})

    return background


async def _body(request: Request) -> dict[str, Any]:
    try:
        body = json.loads(await request.body() or b"{}")
    except (ValueError, RecursionError):
        body = None
    except ClientDisconnect:
        raise StudioError("a request broke off before its end") from None
    if not isinstance(body, dict):
        raise StudioError("a request's body is one JSON object")
    return body


async def _told(_: Request, error: Exception) -> Response:
    """A failure as its one sentence."""
    status = 504 if isinstance(error, ControlError) else 404 if isinstance(error, FeedError) else 422
    return JSONResponse({"error": str(error)}, status_code=status)
