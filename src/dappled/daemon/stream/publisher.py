"""Publish the stream and receive questions, in one thread that owns both sockets (XPUB and ROUTER).

Messages wait in one bounded queue. When it is full the oldest picture is dropped first, then previews, health, depth
and slices, and the header's `dropped` counts them; `start`, `frame` and `end` are small and always sent. `seq` counts
the messages of a topic that were really sent, so a gap at a subscriber is that subscriber's own loss, and it can ask
for it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

import zmq

from dappled.clock import Clock, SystemClock
from dappled.config.settings import PublishSettings
from dappled.daemon.stream import curve, wire
from dappled.daemon.stream.sockets import Sockets
from dappled.daemon.stream.wire import Message, WireError
from dappled.errors import report
from dappled.workers import Loop

log = logging.getLogger(__name__)

Reply = Callable[[Message], None]
Answer = Callable[[Mapping[str, Any], Reply], None]
DROP_ORDER = ("picture", "preview", "health", "depth", "slices")
REMEMBERED = 65536  # slices whose frame number is known by sequence
UNREAD_ANSWERS = 4  # with a body, of all askers together
UNREAD_STACKS = 8  # of all subscribers together: those that stop at different times hold different ones
UNREAD_PICTURES = 2  # likewise, and besides: no picture takes the place of slices
_LARGE_BYTES = 1_000_000
_PATIENCE_S, _LARGE_PATIENCE_S = 0.02, 0.1  # after a message, while its bytes are on their way to readers


@dataclass(frozen=True, slots=True)
class PublisherStatistics:
    """Counters by topic; `questions` and `refused` of the ROUTER; peers with a wrong key."""

    sent: Mapping[str, int]
    dropped: Mapping[str, int]
    waiting: int
    questions: int
    refused: int
    wrong_keys: int = 0


class Stream(Protocol):
    """Where the messages of a flight go."""

    def start(self, flight: str, answer: Answer) -> None:
        """Start to send and to listen. `flight` is the name in the headers.

        Questions are passed to `answer(request, reply)`, which replies once, from any thread.
        """

    def publish(self, topic: str, facts: Mapping[str, Any], body: Any = None) -> None:
        """Queue a message; `seq`, `dropped` and the rest of the envelope are added when it is sent. Never waits.

        `body` must not be changed afterwards: it is sent without a copy.
        """

    def wanted(self, topic: str) -> bool:
        """Whether somebody has subscribed to a topic."""

    def statistics(self) -> PublisherStatistics:
        """Counters, taken together."""

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped: never, unless there is a bug."""

    def stop(self) -> None:
        """Send what waits, and close."""


class InFlightLimit:
    """Counts bodies that were sent and that ZeroMQ still holds. One thread calls it.

    ZeroMQ releases a body when every peer that it went to has read it, or was disconnected.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._bodies: list[weakref.ref[memoryview]] = []

    def admit(self, body: memoryview) -> bool:
        """Whether there is room for one more; then `body` counts until it is released."""
        self._bodies = [one for one in self._bodies if one() is not None]
        if len(self._bodies) >= self._most:
            return False
        self._bodies.append(weakref.ref(body))
        return True


class Publisher:
    """Publishes messages, and passes on questions to what answers them.

    `slices` and `ask` are the endpoints; with `ask` "" no question is answered. `sockets` opens them, and is closed
    with this; without one there are no keys. `private` is a further ipc endpoint for processes of the daemon itself;
    its questions go to "`private`.ask". Raises WireError when an endpoint can't be bound.
    """

    def __init__(
        self,
        slices: str,
        ask: str,
        *,
        sockets: Sockets | None = None,
        high_water_mark: int = 12,
        capacity: int = 8,
        private: str = "",
        clock: Clock | None = None,
    ) -> None:
        self._clock = clock or SystemClock()
        self._flight = ""
        self._answer: Answer | None = None
        self._capacity = capacity
        self._lock = threading.Lock()
        self._waiting: deque[tuple[bytes, Message]] = deque()  # (peer of a reply, or b"" for the stream; message)
        self._sent = dict.fromkeys(wire.TOPICS, 0)
        self._dropped = dict.fromkeys(wire.TOPICS, 0)
        self._frame_of: dict[int, int] = {}
        self._questions = self._refused = self._open_questions = 0
        self._grace_s, self._patient_until_ns = 0.0, 0
        self._start: Message | None = None
        self._unread_stacks, self._unread_answers = InFlightLimit(UNREAD_STACKS), InFlightLimit(UNREAD_ANSWERS)
        self._unread_pictures = InFlightLimit(UNREAD_PICTURES)
        self._subscribed: frozenset[bytes] = frozenset()  # what topics of subscribers begin with
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._closed = False
        self._sockets = sockets or Sockets(None, 0o660, self._clock)
        try:
            self._pub = self._sockets.open(zmq.XPUB, [private, slices], high_water_mark)
            asked_at = [private and f"{private}.ask", ask]
            self._router = self._sockets.open(zmq.ROUTER, asked_at, high_water_mark) if any(asked_at) else None
        except WireError:
            os.close(self._wake)
            raise
        self._loop = Loop("publisher", self._run)

    @classmethod
    def of(cls, settings: PublishSettings, *, private: str = "", clock: Clock | None = None) -> Self:
        """A publisher at the endpoints of these settings. Raises WireError, DappledError."""
        keys, mode = curve.server(settings.keys, settings.clients), int(settings.socket_mode, 8)
        sockets = Sockets(keys, mode, clock or SystemClock())
        mark = settings.high_water_mark
        return cls(settings.slices, settings.ask, sockets=sockets, high_water_mark=mark, private=private, clock=clock)

    def start(self, flight: str, answer: Answer) -> None:
        """Start to send and to listen."""
        self._flight, self._answer = flight, answer
        self._loop.start()
        self._sockets.start()

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped: never, unless there is a bug."""
        return [*self._loop.dead_threads(), *self._sockets.dead_threads()]

    def publish(self, topic: str, facts: Mapping[str, Any], body: Any = None) -> None:
        """Queue a message; `seq`, `dropped` and the rest of the envelope are added when it is sent."""
        with self._lock:
            self._waiting.append((b"", Message(topic, facts, body)))
            if sum(not peer for peer, _ in self._waiting) > self._capacity:
                self._drop_one()
        self._ring()

    def wanted(self, topic: str) -> bool:
        """Whether somebody has subscribed to a topic."""
        return topic.encode().startswith(tuple(self._subscribed))

    def statistics(self) -> PublisherStatistics:
        """Counters, taken together."""
        with self._lock:
            return PublisherStatistics(
                dict(self._sent),
                dict(self._dropped),
                len(self._waiting),
                self._questions,
                self._refused,
                self._sockets.wrong_keys,
            )

    def stop(self, grace_s: float = 2.0) -> None:
        """Send what waits, answer questions until none has come for half a second (at most `grace_s`), then close."""
        if self._loop.stopping.is_set():
            return
        self._grace_s = grace_s
        self._loop.stopping.set()
        self._ring()
        self._loop.stop(grace_s + 3)
        self._sockets.close(grace_s)
        with self._lock:
            self._closed = True  # a late answer must not write to a descriptor that is reused by then
            os.close(self._wake)

    def _ring(self) -> None:
        with self._lock:
            if not self._closed:
                os.eventfd_write(self._wake, 1)

    def _drop_one(self) -> None:
        for topic in DROP_ORDER:
            for place, (peer, message) in enumerate(self._waiting):
                if not peer and message.topic == topic:
                    del self._waiting[place]
                    self._dropped[topic] += 1
                    return

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._wake, select.POLLIN)
        poller.register(self._pub.FD, select.POLLIN)
        if self._router is not None:
            poller.register(self._router.FD, select.POLLIN)
        for descriptor in self._sockets.fds:
            poller.register(descriptor, select.POLLIN)
        quiet_rounds = 0
        while True:
            self._sockets.let_in()
            self._read_subscriptions()
            self._send_waiting()
            self._read_questions()
            if self._loop.stopping.is_set():
                quiet_rounds = 0 if self._open_questions or self._waiting else quiet_rounds + 1
                if quiet_rounds > 5 or self._grace_s <= 0:
                    return
                self._grace_s -= 0.1
            poller.poll(100)
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)

    def _send_waiting(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    return
                peer, message = self._waiting.popleft()
            try:
                self._send_reply(peer, message) if peer else self._send(message)
            except Exception as error:  # noqa: BLE001  # a message that can't be sent must not end the stream
                report(log, f"{message.topic} was not sent", error)
                if peer:  # the stream itself lost nothing
                    self._reply_unsendable(peer)
                    continue
                with self._lock:
                    self._dropped[message.topic] = self._dropped.get(message.topic, 0) + 1

    def _send(self, message: Message) -> None:
        header = self._envelope(message, self._sent[message.topic])
        if message.topic == "end":
            header["sent"], header["unsent"] = dict(self._sent), dict(self._dropped)  # what a subscriber missed last
        body = None if message.body is None else memoryview(message.body)
        patience_s = _PATIENCE_S
        if body is not None and body.nbytes >= _LARGE_BYTES:
            patience_s = _LARGE_PATIENCE_S
            unread = self._unread_pictures if message.topic == "picture" else self._unread_stacks
            if not unread.admit(body):
                with self._lock:
                    self._dropped[message.topic] += 1
                return
        self._send_patiently(_parts(message.topic, header, body))
        self._patient_until_ns = max(self._patient_until_ns, self._clock.monotonic_ns() + round(patience_s * 1e9))
        with self._lock:
            self._sent[message.topic] += 1
            self._remember(message, header)

    def _send_patiently(self, parts: list[Any]) -> None:
        """Send to all subscribers; wait briefly for one whose queue is full because of the messages just before.

        So queues can be short, and what follows a stack of slices at once is not lost.
        """
        while (left_ns := self._patient_until_ns - self._clock.monotonic_ns()) > 0:
            self._pub.setsockopt(zmq.XPUB_NODROP, 1)
            try:
                self._pub.send_multipart(parts, flags=zmq.NOBLOCK, copy=False)
            except zmq.Again:
                time.sleep(min(left_ns / 1e9, 0.002))
            else:
                return
        self._pub.setsockopt(zmq.XPUB_NODROP, 0)
        self._pub.send_multipart(parts, copy=False)

    def _send_reply(self, peer: bytes, message: Message) -> None:
        assert self._router is not None  # replies answer questions, which come from there
        self._open_questions -= 1
        header, body = message.header, None if message.body is None else memoryview(message.body)
        if body is not None and not self._unread_answers.admit(body):
            self._refused += 1
            text = f"{UNREAD_ANSWERS} answers are already waiting to be read: ask again later"
            message, body = Message("error", {}), None
            header = {**self._envelope(Message("error", {"error": text}), None), "asked": header["asked"]}
        parts = [peer, *_parts(message.topic, header, body)]
        try:
            self._router.send_multipart(parts, flags=zmq.NOBLOCK, copy=False)
        except zmq.ZMQError as error:  # the peer is gone or does not read
            log.info("an answer could not be delivered: %s", error)

    def _reply_unsendable(self, peer: bytes) -> None:
        assert self._router is not None
        self._refused += 1
        header = self._envelope(Message("error", {"error": "the answer can't be sent: see the daemon's log"}), None)
        with contextlib.suppress(zmq.ZMQError):  # the peer is gone or does not read
            self._router.send_multipart([peer, b"error", wire.encode({**header, "asked": None})], flags=zmq.NOBLOCK)

    def _envelope(self, message: Message, seq: int | None) -> dict[str, Any]:
        return {
            "schema": f"dappled/{message.topic}",
            "version": wire.VERSION,
            "flight": self._flight,
            "seq": seq,
            "dropped": self._dropped.get(message.topic, 0),
            **message.header,
        }

    def _remember(self, message: Message, header: Mapping[str, Any]) -> None:
        if message.topic == "slices":
            self._frame_of[header["seq"]] = header["frame"]
            self._frame_of.pop(header["seq"] - REMEMBERED, None)
        elif message.topic == "start":
            self._start = Message("start", header)

    def _read_subscriptions(self) -> None:
        """ZeroMQ tells the first subscription to what topics begin with, and the end of the last one."""
        while True:
            try:
                told = self._pub.recv(flags=zmq.NOBLOCK)
            except zmq.Again:
                return
            if not any(topic.encode().startswith(told[1:]) for topic in wire.TOPICS):
                continue  # nothing that is sent: a stranger may make up any number of them
            if told[:1] == b"\1":
                self._subscribed |= {told[1:]}
            elif told[:1] == b"\0":
                self._subscribed -= {told[1:]}

    def _read_questions(self) -> None:
        if self._router is None:
            return
        for _ in range(100):  # at most 100 at a time, so that sending goes on in a flood
            try:
                parts = self._router.recv_multipart(flags=zmq.NOBLOCK)
            except zmq.Again:
                return
            peer = parts[0]
            payload = [part for part in parts[1:] if part]
            self._questions += 1
            self._open_questions += 1
            try:
                request = wire.parse_question(payload)
            except WireError as error:
                self._refused += 1
                self._reply_to(peer, None)(Message("error", {"error": str(error)}))
                continue
            reply = self._reply_to(peer, request)
            assert self._answer is not None  # `start` came with it
            try:
                if request["get"] == "start" and self._start is not None:
                    reply(self._start)
                else:
                    self._answer(self._resolved(request), reply)
            except WireError as error:
                self._refused += 1
                reply(Message("error", {"error": str(error)}))

    def _resolved(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        if request.get("flight") not in (None, self._flight):
            raise WireError(f"flight {request['flight']} is over, this is {self._flight}: replay its folder instead")
        if "frame" in request or "seq" not in request:
            return request
        frame = self._frame_of.get(request["seq"])
        if frame is None:
            raise WireError(f"seq {request['seq']} of slices was never sent, or was sent too long ago: ask by frame")
        return {**request, "frame": frame}

    def _reply_to(self, peer: bytes, asked: Mapping[str, Any] | None) -> Reply:
        def reply(message: Message) -> None:
            header = {**self._envelope(message, None), "asked": asked}
            with self._lock:
                self._waiting.append((peer, Message(message.topic, header, message.body)))
            self._ring()

        return reply


def _parts(topic: str, header: Mapping[str, Any], body: memoryview | None) -> list[Any]:
    return [topic.encode(), wire.encode(header), *([] if body is None else [body])]
