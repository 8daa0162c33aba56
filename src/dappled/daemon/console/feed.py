"""Receive the stream for the console, keep what the pages need, and send it to them as events."""

from __future__ import annotations

import asyncio
import json
import logging
import time
import weakref
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.daemon.console.pictures import FullSizePicture
from dappled.daemon.console.requests import token
from dappled.daemon.console.seen_ground import SeenGround
from dappled.daemon.console.studio import Studio
from dappled.daemon.health import go_no_go
from dappled.daemon.health.standing import in_record
from dappled.daemon.stream import wire
from dappled.daemon.stream.subscriber import AsyncSubscriber
from dappled.daemon.stream.wire import Message
from dappled.errors import DappledError, report
from dappled.findings import FRAME, Finding, named, remedy, told

log = logging.getLogger(__name__)
FRAMES, STACK_BYTES, PICTURE_BYTES, PATH = 400, 72_000_000, 24_000_000, 3600
_WATCHED = ("slices", "depth")  # topics that are subscribed to while a viewer is there
_LOOKED_AT = ("picture",)  # those that are made for us alone: while it is looked at, too
PAGES, WAITING = 24, 64
GLOBE_S = 30.0  # a virtual globe counts as a viewer for so long after it asked
LOOK_S = 15.0  # a page looks at pictures at full size for so long after it said so
_ASK_S, _KEEP_ALIVE_S = 20.0, 10.0
_END = ""  # in a page's queue: nothing follows

Event = dict[str, Any]


def _shown(one: Finding, row: Mapping[str, Any]) -> dict[str, Any]:
    """A finding as the page shows it."""
    about = {"code": one.code.value, "state": go_no_go.state([one]), "text": str(named(one))}
    return {**about, "todo": str(remedy(one)), "age_s": row["age_s"]}


class FeedError(DappledError):
    """A frame, a picture or a map that does not exist; one sentence."""


@dataclass(slots=True)
class FeedState:
    """What is known of one frame: its tag; from its slices a small picture, the carriers and the frame's shape; its
    depth, if any; how it was judged ("state", "reasons")."""

    tag: dict[str, Any]
    thumb: NDArray[np.uint8] | None = None
    depth: Message | None = None
    corners: list[tuple[float, float]] | None = None
    shape: list[int] | None = None
    slices: dict[str, Any] | None = None
    verdict: dict[str, Any] | None = None


class Hub:
    """Sends events to the open pages. All calls on one event loop.

    Each page has a bounded queue; one that stops reading loses its oldest events, and delays no other.
    """

    def __init__(self) -> None:
        self._pages: weakref.WeakSet[asyncio.Queue[str]] = (
            weakref.WeakSet()
        )  # weak: a stream that was never read goes too
        self._globe_s = self._look_s = -1e9
        self._closed = False
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._pages)

    @property
    def full(self) -> bool:
        """Whether there are as many pages as allowed."""
        return len(self._pages) >= PAGES

    @property
    def watched(self) -> bool:
        """Whether a page is open, or a virtual globe has asked lately."""
        return len(self._pages) > 0 or time.monotonic() - self._globe_s < GLOBE_S

    def globe_asked(self) -> None:
        """Note that a virtual globe has asked."""
        self._globe_s = time.monotonic()

    def looked_at_full_size(self) -> None:
        """Note that a page shows pictures at full size."""
        self._look_s = time.monotonic()

    @property
    def topics(self) -> frozenset[str]:
        """Those of the large topics that somebody sees."""
        looks = time.monotonic() - self._look_s < LOOK_S
        return frozenset((*(_WATCHED if self.watched else ()), *(_LOOKED_AT if looks else ())))

    def send(self, event: Event) -> None:
        """Send an event to every page."""
        text = f"data: {json.dumps(event, separators=(',', ':'))}\n\n"
        for page in self._pages:
            if page.full():
                page.get_nowait()
                self.dropped += 1
            page.put_nowait(text)

    def close(self) -> None:
        """End the streams of all pages in order, after what they still have to read."""
        self._closed = True
        for page in self._pages:
            if page.full():
                page.get_nowait()
            page.put_nowait(_END)

    def listen(self, first: list[Event]) -> AsyncIterator[str]:
        """Server-sent events for a new page: the first ones at once, a comment when there are none for a while."""
        page: asyncio.Queue[str] = asyncio.Queue(WAITING)
        self._pages.add(page)
        return self._stream(page, first)

    async def _stream(self, page: asyncio.Queue[str], first: list[Event]) -> AsyncIterator[str]:
        try:
            for event in first:
                yield f"data: {json.dumps(event, separators=(',', ':'))}\n\n"
            while not (self._closed and page.empty()):
                try:
                    if (text := await asyncio.wait_for(page.get(), _KEEP_ALIVE_S)) == _END:
                        return
                    yield text
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            self._pages.discard(page)


class Feed:
    """Keeps the stream's messages, and tells `hub` of each. `studio` makes small pictures and footprints for the map;
    `run` names the daemon that requests are for, see `requests.token`; `area` is the planned one, if any.

    All calls on one event loop.
    """

    recording = False  # the page leaves out what only a daemon can do or say

    def __init__(
        self,
        endpoint: str,
        ask: str,
        hub: Hub,
        studio: Studio,
        *,
        run: str = "",
        area: SeenGround | None = None,
    ) -> None:
        self.hub = hub
        self._endpoints, self._studio, self._run, self.area = (endpoint, ask), studio, run, area
        self.health: dict[str, Any] | None = None
        self.start: dict[str, Any] | None = None
        self.frames: OrderedDict[int, FeedState] = OrderedDict()
        self._stacks: OrderedDict[int, Message] = OrderedDict()
        self._pictures: OrderedDict[int, FullSizePicture] = OrderedDict()
        self._asked: dict[int, asyncio.Future[Message]] = {}
        self._stream: AsyncSubscriber | None = None
        self.path: deque[tuple[float, float]] = deque(maxlen=PATH)  # (longitude, latitude) of the vehicle

    async def run(self) -> None:
        """Receive until cancelled. What is large is subscribed to only while somebody sees it."""
        topics = [topic for topic in wire.TOPICS if topic not in ("preview", *_WATCHED, *_LOOKED_AT)]
        async with AsyncSubscriber(*self._endpoints, topics=topics, high_water_mark=3, recover=False) as stream:
            self._stream = stream
            if self._endpoints[1]:
                await stream.ask({"get": "start"})
            listening: frozenset[str] = frozenset()
            while True:
                wanted = self.hub.topics
                for topic in wanted ^ listening:
                    stream.listen(topic, topic in wanted)
                listening = wanted
                message = await stream.receive(0.5)
                if message is not None:
                    try:
                        self._take(message)
                    except (KeyError, TypeError, ValueError, DappledError) as error:  # against the schema
                        report(log, f"a {message.topic} message was ignored", error)

    def full_size(self, frame: int) -> FullSizePicture:
        """A frame's picture at the sensor's own resolution, of its middle where it is large. Raises DappledError: in
        flight a frame now and then has one."""
        if (kept := self._pictures.get(frame)) is None:
            raise FeedError(f"frame {frame} has no picture at full size, or no longer has one")
        return kept

    def has_picture(self, frame: int) -> bool:
        """Whether `full_size` has one to give."""
        return frame in self._pictures

    async def slices(self, frame: int) -> Message:
        """The slices of a frame: as kept, or asked for again. Raises FeedError."""
        if (kept := self._stacks.get(frame)) is not None:
            self._stacks.move_to_end(frame)
            return kept
        if self._stream is None or frame not in self.frames:
            raise FeedError(f"there is no frame {frame} here")
        waiting = self._asked.get(frame)
        if waiting is None:
            waiting = self._asked[frame] = asyncio.get_running_loop().create_future()
            await self._stream.ask({"get": "slices", "frame": frame})
        try:
            return await asyncio.wait_for(asyncio.shield(waiting), _ASK_S)
        except TimeoutError:
            self._asked.pop(frame, None)
            raise FeedError(f"the slices of frame {frame} did not arrive: the decoder is busy") from None

    def newest(self) -> int | None:
        """The last frame that has slices; without any, the last frame."""
        if self._stacks:
            return max(self._stacks)
        return next(reversed(self.frames), None)

    def state(self) -> Event:
        """The newest health record as an event, with its findings in words."""
        health = self.health
        if health is None:
            return {"is": "state", "health": None, "findings": [], "verdict": None, "token": self._token()}
        found = in_record(health)
        return {
            "is": "state",
            "health": health,
            "findings": [_shown(one, row) for one, row in zip(found, health["findings"], strict=True)],
            "verdict": go_no_go.state(found),
            "frames_left": go_no_go.frames_left(health),
            "area": None if self.area is None else self.area.facts(),
            "token": self._token(),
        }

    def _token(self) -> str:
        """The daemon's clock, which this process shares."""
        return token(self._run, time.monotonic_ns())

    def frame_event(self, index: int) -> Event:
        """A frame as an event."""
        seen = self.frames[index]
        return {
            "is": "frame",
            "tag": seen.tag,
            "thumb": seen.thumb is not None,
            "depth": seen.depth is not None,
            "picture": self.has_picture(index),
            "corners": seen.corners,
            "slices": seen.slices,
            "verdict": seen.verdict,
        }

    def track(self) -> list[tuple[float, float, float]]:
        """(longitude, latitude, altitude) of the frames with a position, in order."""
        poses = [seen.tag["pose"] for seen in self.frames.values()]
        return [
            (pose["longitude_deg"], pose["latitude_deg"], pose["altitude_msl_m"] or 0.0)
            for pose in poses
            if pose["latitude_deg"] is not None
        ]

    def _take(self, message: Message) -> None:
        header = dict(message.header)
        match message.topic:
            case "health":
                self.health = header
                self._add_to_path(header.get("vehicle"))
                self.hub.send(self.state())
                self._judged((header.get("decode") or {}).get("judged") or {})
            case "start":
                self._begin(header)
            case "frame":
                self._frame(header)
            case "slices":
                self._slices(message)
            case "depth":
                self._depth(message)
            case "picture":
                self._picture(message)
            case "end":
                self.hub.send({"is": "end", "shots": header.get("shots")})
            case "error":
                asked = header.get("asked") or {}
                self._answer(asked.get("frame"), FeedError(str(header.get("error"))))

    def _judged(self, judged: dict[str, Any]) -> None:
        """Take the verdicts of the last frames, and send the frames whose verdict is new."""
        for one in judged.get("last", ()):
            seen = self.frames.get(one["frame"])
            if seen is not None and seen.verdict is None:
                seen.verdict = {
                    "state": one["state"],
                    "reasons": [str(told(why, FRAME)) for why in codec.read(tuple[Finding, ...], one["reasons"])],
                }
                self._count(one["frame"], seen)
                self.hub.send(self.frame_event(one["frame"]))

    def _add_to_path(self, vehicle: dict[str, Any] | None) -> None:
        if vehicle is not None and vehicle["latitude_deg"] is not None:
            place = (vehicle["longitude_deg"], vehicle["latitude_deg"])
            if not self.path or self.path[-1] != place:
                self.path.append(place)

    def _begin(self, header: dict[str, Any]) -> None:
        self.start = header
        self.hub.send({"is": "start", "start": header})

    def _frame(self, header: dict[str, Any]) -> None:
        index = header["frame"]
        seen = self.frames[index] = FeedState(header, corners=self._studio.corners(header))
        self._count(index, seen)
        while len(self.frames) > FRAMES:
            self.frames.popitem(last=False)
        self.hub.send(self.frame_event(index))

    def _count(self, index: int, seen: FeedState) -> None:
        """What a frame saw of the area, unless it is bad: as `flight coverage` counts."""
        if self.area is not None:
            is_bad = seen.verdict is not None and seen.verdict["state"] == "bad"
            self.area.put(index, None if is_bad else seen.corners)

    def _slices(self, message: Message) -> None:
        index = message.header["frame"]
        self._stacks[index] = message
        self._stacks.move_to_end(index)
        while len(self._stacks) > 1 and sum(_bytes(one) for one in self._stacks.values()) > STACK_BYTES:
            self._stacks.popitem(last=False)
        self._answer(index, message)
        seen = self.frames.get(index)
        if seen is None:
            return
        if seen.thumb is None:
            seen.thumb = self._studio.thumb(message)
            seen.slices = _facts(message)
            seen.shape = message.header.get("frame_shape")
            seen.corners = self._studio.corners({**seen.tag, "frame_shape": seen.shape})
            self._count(index, seen)
        self.hub.send(self.frame_event(index))

    def _depth(self, message: Message) -> None:
        seen = self.frames.get(message.header["frame"])
        if seen is not None:
            for older in self.frames.values():
                older.depth = None  # only the newest is kept
            seen.depth = message
            self.hub.send(self.frame_event(message.header["frame"]))

    def _picture(self, message: Message) -> None:
        index, header = message.header["frame"], message.header
        doubts = codec.read(tuple[Finding, ...], header["doubts"])
        self._pictures[index] = FullSizePicture(bytes(message.body or b""), doubts)
        while len(self._pictures) > 1 and sum(len(one.jpeg) for one in self._pictures.values()) > PICTURE_BYTES:
            self._pictures.popitem(last=False)
        if index in self.frames:
            self.hub.send(self.frame_event(index))

    def _answer(self, frame: Any, answer: Message | FeedError) -> None:
        waiting = self._asked.pop(frame, None)
        if waiting is None or waiting.done():
            return
        if isinstance(answer, FeedError):
            waiting.set_exception(answer)
        else:
            waiting.set_result(answer)


def _facts(message: Message) -> dict[str, Any]:
    header = message.header
    shape = header["arrays"][0]["shape"]
    return {
        "shape": shape,
        "doubts": [str(told(one, FRAME)) for one in codec.read(tuple[Finding, ...], header.get("doubts") or ())],
        **{
            name: header.get(name)
            for name in (
                "carriers",
                "carriers_from",
                "carriers_found",
                "grid",
                "frame_shape",
                "predicted",
                "law",
                "histogram",
                "clipped_share",
            )
        },
    }


def _bytes(message: Message) -> int:
    return memoryview(message.body).nbytes
