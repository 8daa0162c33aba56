"""Serve the console's page over a recording: the same page and pictures as in flight, without a daemon."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import uvicorn

from dappled.daemon.console import feed as live
from dappled.daemon.console.__main__ import configuration
from dappled.daemon.console.access import Access
from dappled.daemon.console.app import ConsoleApp
from dappled.daemon.console.feed import Event, Feed, FeedError, Hub
from dappled.daemon.console.pictures import FullSizePicture
from dappled.daemon.console.recorded import FrameSource
from dappled.daemon.console.studio import Studio
from dappled.daemon.stream.wire import Message
from dappled.decode.lightfield import LightField
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError, sentence

log = logging.getLogger(__name__)
_LOOK_S = 0.02  # whether the server has started


class RecordedHub(Hub):
    """Tells every new page, after all frames, that the flight has ended."""

    def __init__(self, shots: Mapping[str, int]) -> None:
        super().__init__()
        self._end: Event = {"is": "end", "shots": dict(shots)}

    def listen(self, first: list[Event]) -> AsyncIterator[str]:
        return super().listen([*first, self._end])


class RecordedStudio(Studio):
    """Makes pictures of recorded frames; a light field that came decoded keeps its own views."""

    def __init__(self, source: FrameSource, recipe: Recipe | None, mount: Sequence[float]) -> None:
        super().__init__(recipe, mount)
        self._source = source

    def _light_field(self, message: Message) -> LightField:
        field = self._source.light_field(message.header["frame"])
        if field is None:
            return super()._light_field(message)
        if not field.views.size:
            raise DappledError("this light field has no views, only slices: decode it with a calibration")
        attributes = {"views_from": "the file", **field.attributes}
        return replace(field, attributes=attributes)


class RecordedFeed(Feed):
    """Keeps all frames of a recording from the start. Slices are decoded when a page asks for them, what was asked for
    last first, and one after the other in between, the last frame first, so that every frame has its small picture."""

    recording = True

    def __init__(self, source: FrameSource, hub: Hub, studio: Studio) -> None:
        super().__init__("", "", hub, studio)
        self._source = source
        self._decoder = ThreadPoolExecutor(1, "decoder")
        self._asked_for: dict[int, Future[Message]] = {}
        self._order: list[int] = []  # those of them that wait for the decoder: the next one is the last here
        self._ordering = threading.Lock()
        self._begin(dict(source.start))
        for one in source.frames():
            self._frame(dict(one.header))
            index = one.header["frame"]
            if index in self.frames and one.verdict is not None:
                self.frames[index].verdict = dict(one.verdict)
            self._add_to_path(one.header["pose"])

    async def run(self) -> None:
        """Decode all frames; those that can't be are named in the log."""
        for index in sorted(self.frames, reverse=True):
            try:
                await self._decoded(index, soon=False)
            except FeedError as error:
                log.warning("frame %d: %s", index, error)

    async def slices(self, frame: int) -> Message:
        """The slices of a frame: as kept, or asked for again."""
        return await self._decoded(frame, soon=True)

    def full_size(self, frame: int) -> FullSizePicture:
        """A frame's picture at the sensor's own resolution."""
        return self._source.full_size(frame)

    def has_picture(self, _frame: int) -> bool:
        """Whether `full_size` has one to give: it is made when asked for."""
        return True

    async def _decoded(self, frame: int, *, soon: bool) -> Message:
        if (kept := self._stacks.get(frame)) is not None:
            return kept
        if frame not in self.frames:
            raise FeedError(f"there is no frame {frame} here")
        waiting = self._ask_decoder(frame, soon=soon)
        try:
            message = await asyncio.shield(asyncio.wrap_future(waiting))
        except DappledError as error:
            raise FeedError(sentence(error)) from None
        finally:
            if waiting.done():
                self._asked_for.pop(frame, None)
        if frame not in self._stacks:
            self._slices(message)
        return message

    def _ask_decoder(self, frame: int, *, soon: bool) -> Future[Message]:
        """The frame's place among those that wait: the next one, or (not `soon`) the last one."""
        with self._ordering:
            if (waiting := self._asked_for.get(frame)) is None:
                waiting = self._asked_for[frame] = Future()
                self._order.insert(len(self._order) if soon else 0, frame)
                self._decoder.submit(self._decode_next)
            elif soon and frame in self._order:
                self._order.append(self._order.pop(self._order.index(frame)))
        return waiting

    def _decode_next(self) -> None:
        with self._ordering:
            frame = self._order.pop()
            waiting = self._asked_for[frame]
        try:
            waiting.set_result(self._source.slices(frame))
        except Exception as error:  # noqa: BLE001  who waits for it raises it
            waiting.set_exception(error)

    def close(self) -> None:
        """End the decoding thread, with the frame that it is at."""
        self._decoder.shutdown(cancel_futures=True)


class _NoDaemon:
    """Answers what the page asks of a daemon: there is none."""

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """The daemon's answer."""
        if question.get("do") == "log":
            return {"lines": []}
        return {"ok": False, "error": "this is a recording: nothing can be fired or set"}


def serve(
    listener: socket.socket,
    source: FrameSource,
    recipe: Recipe | None,
    mount: Sequence[float],
    begun: Callable[[], object] = lambda: None,
) -> None:
    """Serve the page on `listener` until the process is interrupted; `begun` is called when it answers."""
    asyncio.run(_serve(listener, source, RecordedStudio(source, recipe, mount), begun))


async def _serve(listener: socket.socket, source: FrameSource, studio: Studio, begun: Callable[[], object]) -> None:
    feed = RecordedFeed(source, RecordedHub(source.shots), studio)
    app = ConsoleApp(feed, studio, _NoDaemon(), Access(""), None)
    server = uvicorn.Server(configuration(app.asgi()))
    beside = [asyncio.create_task(feed.run()), asyncio.create_task(_once_started(server, begun))]
    try:
        await server.serve(sockets=[listener])
    finally:
        for task in beside:
            task.cancel()
        await asyncio.gather(*beside, return_exceptions=True)
        feed.hub.close()
        app.close()
        feed.close()


async def _once_started(server: uvicorn.Server, begun: Callable[[], object]) -> None:
    while not server.started:
        await asyncio.sleep(_LOOK_S)
    begun()


MOST_FRAMES = live.FRAMES
