"""The console's web application: the page, its events, its pictures, requests to the daemon, and KML for globes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from dappled import kml
from dappled.bounds.parsing import parse_json
from dappled.daemon.console import access, pictures
from dappled.daemon.console.access import Access, Refusal, RequestGuard, refused
from dappled.daemon.console.feed import Feed, FeedError
from dappled.daemon.console.placement import Background, latest_kml, network_link_kml
from dappled.daemon.console.process import ConsoleRequestError, DaemonQuestions
from dappled.daemon.console.studio import Studio
from dappled.daemon.health import metrics
from dappled.decode.geometry.footprint import RectifiedFrame
from dappled.errors import DappledError
from dappled.findings import FRAME, told

_PICTURES = (
    "thumb.jpg, mean.jpg, slices.jpg, spectrum.jpg, views.jpg, views.json, refocus.jpg, depth.png, full.jpg, "
    "full.json and map.png, which is north up"
)
_DISPARITY_PX = 8.0
_FRAME_DIGITS = 10
_MAP_PX, _GLOBE_BOUNDS_PX, _GLOBE_PICTURE_PX = 320, 320, 1024
_LOG_EVERY_S = 0.7
_TOKEN_CHARACTERS, _SETTING_CHARACTERS = 40, 200
_STATIC = Path(__file__).with_name("static")


class ConsoleApp:
    """The application's endpoints. Views, which take seconds, are made one at a time on a thread for them, all other
    pictures on another one: what can be shown at once doesn't wait behind them."""

    def __init__(
        self, feed: Feed, studio: Studio, daemon: DaemonQuestions, rules: Access, background: Background | None
    ) -> None:
        self._feed, self._hub, self._studio, self._daemon = feed, feed.hub, studio, daemon
        self._rules, self._background = rules, background
        self._pictures = ThreadPoolExecutor(1, "pictures")
        self._views = ThreadPoolExecutor(1, "views")
        self._questions = ThreadPoolExecutor(2, "questions")  # they wait for the daemon

    def asgi(self) -> ASGIApp:
        """The application behind its rules."""
        routes = [
            Route("/", self._page),
            Mount("/static", StaticFiles(directory=_STATIC)),
            Route("/api/login", self._login, methods=["POST"]),
            Route("/api/events", self._events),
            Route("/api/state", self._state),
            Route("/api/shoot", self._shoot, methods=["POST"]),
            Route("/api/interval", self._interval, methods=["POST"]),
            Route("/api/outcome", self._outcome, methods=["POST"]),
            Route("/api/interval/stop", self._stop_interval, methods=["POST"]),
            Route("/api/setting", self._set, methods=["POST"]),
            Route("/api/live", self._live, methods=["POST"]),
            Route("/api/full", self._look_at_full_size, methods=["POST"]),
            Route("/api/frames/{frame}/{name}", self._frame_picture),
            Route("/api/map", self._map),
            Route("/api/holes.png", self._holes),
            Route("/metrics", self._metrics),
            Route("/kml", self._kml_link),
            Route("/kml/latest.kml", self._kml_latest),
            Route("/kml/{frame}.png", self._kml_picture),
        ]
        return RequestGuard(
            Starlette(routes=routes, exception_handlers={DappledError: _failure, Exception: _unexpected}), self._rules
        )

    async def follow_log(self) -> None:
        """Send new lines of the daemon's log to the pages, while there are pages."""
        after = 0
        while True:
            await asyncio.sleep(_LOG_EVERY_S)
            if not len(self._hub):
                continue
            event = await self._log_after(after)
            if event is not None:
                after = event["lines"][-1]["number"]
                self._hub.send(event)

    def close(self) -> None:
        """End the threads."""
        self._pictures.shutdown()
        self._views.shutdown()
        self._questions.shutdown()

    # the page and its events

    async def _page(self, _: Request) -> Response:
        return FileResponse(_STATIC / "index.html")

    async def _login(self, request: Request) -> Response:
        token = (await _body(request)).get("token")
        client = request.client.host if request.client else ""
        refusal = self._rules.try_token(token if isinstance(token, str) else "", client)
        if refusal is not None:
            return refused(refusal)
        answer = JSONResponse({"ok": True})
        if not self._rules.open:
            answer.set_cookie(access.COOKIE, str(token), httponly=True, samesite="strict", max_age=7 * 86400)
        return answer

    async def _events(self, _: Request) -> Response:
        feed = self._feed
        state = feed.state()  # first the verdict; again for what it says of the newest frame
        first = [self._about(), state, *(feed.frame_event(index) for index in feed.frames), state, {"is": "ready"}]
        if log := await self._log_after(0):
            first.append(log)
        if self._hub.full:
            return refused(Refusal(503, "too many pages are open: close one"))
        return StreamingResponse(self._hub.listen(first), media_type="text/event-stream")

    async def _state(self, _: Request) -> Response:
        own = {"pages": len(self._hub), "events_dropped": self._hub.dropped, "refused": self._rules.refused}
        return JSONResponse({**self._feed.state(), "console": own, "newest": self._feed.newest()})

    async def _metrics(self, _: Request) -> Response:
        health = self._feed.health
        if health is None:
            return refused(Refusal(503, "the daemon has not been heard yet: ask again"))
        return Response(metrics.text(health), media_type=metrics.CONTENT_TYPE)

    def _about(self) -> dict[str, Any]:
        return {
            "is": "about",
            "start": self._feed.start,
            "recording": self._feed.recording,
            "map": None if self._background is None else self._background.bounds(),
            "area": None if self._feed.area is None else self._feed.area.outline(),
            "path": list(self._feed.path),
        }

    async def _log_after(self, number: int) -> dict[str, Any] | None:
        """The lines of the daemon's log after this number, as an event; None without any."""
        try:
            answer = await self._ask({"do": "log", "after": number})
        except ConsoleRequestError:
            return None
        return {"is": "log", "lines": answer["lines"]} if answer.get("lines") else None

    # requests to the daemon

    async def _shoot(self, request: Request) -> Response:
        return await self._do({"do": "shoot", **_numbered(await _body(request))})

    async def _outcome(self, request: Request) -> Response:
        return await self._do({"do": "outcome", **_numbered(await _body(request))})

    async def _interval(self, request: Request) -> Response:
        body = await _body(request)
        seconds = body.get("interval_s")
        if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds <= 86400:
            raise DappledError("interval_s must be a number of seconds from 0 to 86400")
        count = _whole(body, "count", 0, 10**6)
        return await self._do({"do": "interval", **_numbered(body), "interval_s": seconds, "count": count})

    async def _stop_interval(self, request: Request) -> Response:
        body = await _body(request)
        return await self._do({"do": "stop interval", **(_pressed(body) if "token" in body else {})})

    async def _set(self, request: Request) -> Response:
        body = await _body(request)
        name, value = (body.get(key) for key in ("name", "value"))
        if not (isinstance(name, str) and isinstance(value, str) and max(len(name), len(value)) <= _SETTING_CHARACTERS):
            raise DappledError("name and value must be texts: a setting, and one of its choices")
        return await self._do({"do": "set", **_numbered(body), "name": name, "value": value})

    async def _live(self, _: Request) -> Response:
        answer = await self._ask({"do": "look"})
        picture = answer.pop("picture", None)
        if picture is not None:
            return Response(picture, media_type="image/jpeg", headers={"cache-control": "no-store"})
        return _answered(answer)

    async def _look_at_full_size(self, _: Request) -> Response:
        self._hub.looked_at_full_size()
        return JSONResponse({"ok": True})

    async def _do(self, question: Mapping[str, Any]) -> Response:
        return _answered(await self._ask(question))

    async def _ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        return await asyncio.get_running_loop().run_in_executor(self._questions, self._daemon.ask, question)

    # pictures

    async def _frame_picture(self, request: Request) -> Response:
        frame, name = _frame(request), request.path_params["name"]
        known = self._feed.frames.get(frame)
        if known is None:
            raise FeedError(f"there is no frame {frame} here")
        if name == "thumb.jpg" and known.thumb is not None:
            return _file(await self._make(pictures.jpeg, known.thumb), name)
        if name == "map.png":
            return _file(await self._rectified_png(frame, _MAP_PX), name)
        if name == "depth.png":
            if known.depth is None:
                raise FeedError(f"frame {frame} has no depth map, or no longer has one")
            return _file(await self._make(self._studio.depth, known.depth), name)
        if name in ("full.jpg", "full.json"):
            full = await self._make(self._feed.full_size, frame, on=self._views)
            doubts = [str(told(one, FRAME)) for one in full.doubts]
            return _file(full.jpeg if name == "full.jpg" else json.dumps({"doubts": doubts}).encode(), name)
        message = await self._feed.slices(frame)
        studio = self._studio
        if name == "refocus.jpg":
            return _file(await self._make(studio.refocused, message, _disparity(request), on=self._views), name)
        makers: dict[str, Callable[..., Any]] = {
            "thumb.jpg": lambda one: pictures.jpeg(studio.thumb(one)),
            "mean.jpg": studio.mean,
            "slices.jpg": studio.slices,
            "spectrum.jpg": studio.spectrum,
            "views.jpg": lambda one: studio.views(one)[1],
            "views.json": lambda one: json.dumps(studio.views(one)[0]).encode(),
        }
        if name not in makers:
            raise FeedError(f"a frame has {_PICTURES}, but no {name}")
        thread = self._views if name.startswith("views.") else None
        return _file(await self._make(makers[name], message, on=thread), name)

    async def _map(self, _: Request) -> Response:
        if self._background is None:
            raise FeedError("no map is configured in console.map")
        return FileResponse(self._background.file, headers={"cache-control": "private, max-age=3600"})

    async def _holes(self, _: Request) -> Response:
        if self._feed.area is None:
            raise FeedError("no area is configured in console.area")
        return Response(self._feed.area.holes_png(), media_type="image/png", headers={"cache-control": "no-store"})

    async def _make(self, function: Callable[..., Any], *arguments: Any, on: ThreadPoolExecutor | None = None) -> Any:
        return await asyncio.get_running_loop().run_in_executor(on or self._pictures, function, *arguments)

    async def _rectified(self, frame: int, longest_side: int, *, sharp: bool = False) -> RectifiedFrame | None:
        """A frame on the ground; `sharp` from its slices, else from its small picture. None without a position."""
        known = self._feed.frames.get(frame)
        if known is None:
            raise FeedError(f"there is no frame {frame} here")
        picture, header = known.thumb, {**known.tag, "frame_shape": known.shape}
        if sharp or picture is None:
            message = await self._feed.slices(frame)
            header["frame_shape"] = message.header["frame_shape"]
            picture = await self._make(self._studio.full, message)
        found: RectifiedFrame | None = await self._make(self._studio.rectified, header, picture, longest_side)
        return found

    async def _rectified_png(self, frame: int, longest_side: int, *, sharp: bool = False) -> bytes:
        one = await self._rectified(frame, longest_side, sharp=sharp)
        if one is None:
            raise FeedError(f"the position of frame {frame} on the ground is not known")
        made: bytes = await self._make(pictures.png, one.picture)
        return made

    # virtual globes

    async def _kml_link(self, request: Request) -> Response:
        self._hub.globe_asked()
        return Response(network_link_kml(self._absolute(request, "/kml/latest.kml")), media_type=kml.MEDIA_TYPE)

    async def _kml_latest(self, request: Request) -> Response:
        self._hub.globe_asked()
        frame, one = self._feed.newest(), None
        if frame is not None:
            try:
                one = await self._rectified(frame, _GLOBE_BOUNDS_PX)
            except FeedError:  # it is not decoded: the globe shows the track alone
                one = None
        picture = self._absolute(request, f"/kml/{frame}.png")
        return Response(latest_kml(f"frame {frame}", picture, one, self._feed.track()), media_type=kml.MEDIA_TYPE)

    async def _kml_picture(self, request: Request) -> Response:
        self._hub.globe_asked()
        return _file(await self._rectified_png(_frame(request), _GLOBE_PICTURE_PX, sharp=True), "x.png")

    def _absolute(self, request: Request, path: str) -> str:
        """An address for a globe, which has no cookie: with the token that only reads, where one is needed."""
        tail = "" if self._rules.open else f"?token={self._rules.reading_token}"
        return f"{request.url.scheme}://{request.headers['host']}{path}{tail}"


def _answered(answer: dict[str, Any]) -> Response:
    answer.pop("number", None)
    return JSONResponse(answer, status_code=200 if answer.get("ok") else 409)


def _file(data: bytes, name: str) -> Response:
    kind = {"jpg": "image/jpeg", "png": "image/png", "json": "application/json"}[name.rpartition(".")[2]]
    return Response(data, media_type=kind)


def _whole(body: Mapping[str, Any], name: str, low: int, high: int) -> int:
    value = body.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise DappledError(f"{name} must be a whole number from {low} to {high}")
    return value


def _numbered(body: Mapping[str, Any]) -> dict[str, Any]:
    """A request's number, and when it was made by the daemon's clock: see `requests`."""
    return {"sequence": _whole(body, "sequence", 0, 2**31), **_pressed(body)}


def _pressed(body: Mapping[str, Any]) -> dict[str, Any]:
    """When a button was pressed by the daemon's clock: see `requests`."""
    token = body.get("token", "")
    if not isinstance(token, str) or len(token) > _TOKEN_CHARACTERS:
        raise DappledError("token must be the one that came with the last state")
    return {"token": token, "elapsed_ms": _whole(body, "elapsed_ms", 0, 2**31) if "elapsed_ms" in body else 0}


def _frame(request: Request) -> int:
    """The frame that the path names. Not Starlette's own `:int`: it fails for more digits than Python takes."""
    digits: str = request.path_params["frame"]
    if not digits.isascii() or not digits.isdigit() or len(digits) > _FRAME_DIGITS:
        raise FeedError(f"there is no frame {digits[:20]!r} here: a frame is named by its number")
    return int(digits)


def _disparity(request: Request) -> float:
    try:
        disparity = float(request.query_params.get("disparity", "0"))
    except ValueError:
        disparity = float("nan")
    if not abs(disparity) <= _DISPARITY_PX:  # NaN too
        raise DappledError(f"disparity must be a number of pixels from {-_DISPARITY_PX:g} to {_DISPARITY_PX:g}")
    return disparity


async def _body(request: Request) -> dict[str, Any]:
    try:
        body = parse_json(await request.body() or b"{}", access.BODY_BYTES)
    except ValueError:
        body = None
    except ClientDisconnect:
        raise DappledError("the request ended before its body was complete") from None
    if not isinstance(body, dict):
        raise DappledError("a request's body must be one JSON object")
    return body


async def _failure(_: Request, error: Exception) -> Response:
    status = 504 if isinstance(error, ConsoleRequestError) else 404 if isinstance(error, FeedError) else 422
    return JSONResponse({"error": str(error)}, status_code=status)


async def _unexpected(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": f"the console failed ({type(error).__name__}): see its log"}, status_code=500)
