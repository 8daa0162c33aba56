"""Subscribe to the stream, from a thread or from asyncio; notice lost slices and ask for them again."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import AsyncIterator, Collection, Generator, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

import zmq
import zmq.asyncio

from dappled.daemon.stream import wire
from dappled.daemon.stream.curve import ClientKeys, load_own, load_public
from dappled.daemon.stream.wire import Message, WireError
from dappled.errors import DappledError

MOST_MISSING = 2**16  # as many as a publisher remembers; a header that claims more is not believed
AT_ONCE = 4  # questions under way; the others wait
_LOOK_S = 0.5

_Key = tuple[str, int]  # flight, seq of its slices
_Steps = Generator[Any, Any, Message | None]


class Gaps:
    """Decides which slices to ask for again; has neither a socket nor a clock. Times are seconds of any one clock.

    `gaps` counts the slices that were missed, `recovered` those received by asking, `lost` those given up, `unsent`
    those that the sender dropped. Without `can_ask` all missed ones are lost. With `from_start` what a flight sent, or
    dropped, before the first message counts too.
    """

    def __init__(self, *, can_ask: bool, from_start: bool = False, answer_timeout_s: float = 30.0) -> None:
        self._can_ask, self._from_start, self._answer_timeout_s = can_ask, from_start, answer_timeout_s
        self._next: dict[str, int] = {}
        self._missing: deque[_Key] = deque()
        self._asked: dict[_Key, float] = {}  # the deadline of each
        self._dropped: dict[str, tuple[int, int]] = {}  # by flight: of its slices, at first and by now
        self.gaps = self.recovered = self.lost = 0

    @property
    def waiting_for(self) -> int:
        """How many answers are outstanding."""
        return len(self._asked) + len(self._missing)

    @property
    def unsent(self) -> int:
        """How many slices the sender dropped since the first message."""
        return sum(now - first for first, now in self._dropped.values())

    def received(self, message: Message) -> None:
        """Take note of a message of the stream."""
        header = message.header
        flight, seq = str(header.get("flight", "")), header.get("seq")
        if message.topic == "slices" and isinstance(seq, int):
            until, after, dropped = seq, seq + 1, header.get("dropped")
        elif message.topic == "end" and isinstance(sent := _slices_of(header, "sent"), int):
            until, after, dropped = sent, sent, _slices_of(header, "unsent")
        else:
            return
        if isinstance(dropped, int):
            first_dropped, before = self._dropped.get(flight, (0 if self._from_start else dropped, 0))
            self._dropped[flight] = (first_dropped, max(dropped, before))
        first = self._next.get(flight, 0 if self._from_start else until)
        missed = max(0, until - first)
        wanted = min(missed, MOST_MISSING) if self._can_ask else 0
        self._missing.extend((flight, each) for each in range(until - wanted, until))
        too_many = max(0, len(self._missing) - MOST_MISSING)
        for _ in range(too_many):
            self._missing.popleft()
        self.gaps += missed
        self.lost += missed - wanted + too_many
        self._next[flight] = max(after, self._next.get(flight, 0))

    def answered(self, answer: Message) -> None:
        """Take note of an answer; one to another question changes nothing."""
        question = answer.header.get("asked")
        key = (str(question.get("flight")), question.get("seq")) if isinstance(question, Mapping) else None
        if key in self._asked:
            del self._asked[key]
            if answer.topic == "error":
                self.lost += 1
            else:
                self.recovered += 1

    def questions(self, now_s: float) -> list[dict[str, Any]]:
        """The questions to send now. Questions past their deadline are given up."""
        for key in [key for key, deadline in self._asked.items() if deadline < now_s]:
            del self._asked[key]
            self.lost += 1
        found = []
        while self._missing and len(self._asked) < AT_ONCE:
            flight, seq = key = self._missing.popleft()
            self._asked[key] = now_s + self._answer_timeout_s
            found.append({"get": "slices", "seq": seq, "flight": flight})
        return found


class _SubscriberCore(Gaps):
    """What `Subscriber` and `AsyncSubscriber` share: a SUB for the stream, a DEALER for questions, and the counters.

    A call of a socket returns a value with one and an awaitable with the other. `_receive` yields what the call
    returned, and is sent the value.
    """

    _context: ClassVar[type[zmq.Context[Any]]]
    _poller_of: ClassVar[type[zmq.Poller]]

    def __init__(
        self,
        endpoint: str,
        ask: str = "",
        *,
        topics: Collection[str] = wire.USUAL,
        from_start: bool = False,
        recover: bool = True,
        high_water_mark: int = 8,
        keys: ClientKeys | None = None,
    ) -> None:
        """`endpoint` and `ask` are ZeroMQ endpoints; without `ask`, or without `recover`, gaps are only counted.

        With `from_start` the slices that a flight sent before count as a gap too. `keys` are for a tcp endpoint with
        CURVE. Raises WireError for an invalid endpoint.
        """
        super().__init__(can_ask=bool(ask) and recover, from_start=from_start)
        self.ended = False
        self._zmq = self._context()
        self._poller = self._poller_of()
        self._sub = self._zmq.socket(zmq.SUB)
        self._sub.setsockopt(zmq.RCVHWM, high_water_mark)
        for topic in topics:
            self.listen(topic, True)
        self._dealer = self._zmq.socket(zmq.DEALER) if ask else None
        try:
            for one, where in ((self._sub, endpoint), (self._dealer, ask)):
                if one is not None:
                    _connect(one, where, keys)
                    self._poller.register(one, zmq.POLLIN)
        except WireError:
            self.close()
            raise

    @property
    def finished(self) -> bool:
        """Whether the flight's `end` has come, and no answer is outstanding."""
        return self.ended and not self.waiting_for

    def listen(self, topic: str, wanted: bool) -> None:
        """Subscribe to a topic from now on, or unsubscribe."""
        self._sub.setsockopt(zmq.SUBSCRIBE if wanted else zmq.UNSUBSCRIBE, topic.encode())

    def close(self) -> None:
        """Close the sockets."""
        self._zmq.destroy(linger=0)

    def _send(self, request: Mapping[str, Any]) -> Any:
        if self._dealer is None:
            raise WireError("no endpoint for questions was given")
        return self._dealer.send(json.dumps(request).encode())

    def _receive(self, timeout_s: float) -> _Steps:
        deadline = time.monotonic() + timeout_s
        while True:
            for question in self.questions(time.monotonic()):
                yield self._send(question)
            left = max(0.0, deadline - time.monotonic())
            ready = dict((yield self._poller.poll(round(min(left, _LOOK_S) * 1000))))
            for one in (self._dealer, self._sub):
                if one is not None and one in ready:
                    message = wire.decode([part.buffer for part in (yield one.recv_multipart(copy=False))])
                    self._take(message, answered=one is self._dealer)
                    for question in self.questions(time.monotonic()):
                        yield self._send(question)
                    return message
            if time.monotonic() >= deadline:
                return None

    def _take(self, message: Message, *, answered: bool) -> None:
        if answered:
            self.answered(message)
        else:
            self.received(message)
            self.ended = self.ended or message.topic == "end"


class Subscriber(_SubscriberCore):
    """Receives messages in order of arrival; lost `slices` are asked for on `ask`, and received like the others."""

    _context = zmq.Context
    _poller_of = zmq.Poller

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def ask(self, request: Mapping[str, Any]) -> None:
        """Send a question of your own; `receive` returns the answer. Raises WireError without `ask`."""
        self._send(request)

    def receive(self, timeout_s: float) -> Message | None:
        """The next message or answer; None when there was none for that long."""
        steps, value = self._receive(timeout_s), None
        try:
            while True:
                value = steps.send(value)
        except StopIteration as end:
            message: Message | None = end.value
            return message


class AsyncSubscriber(_SubscriberCore):
    """The same for asyncio: `async with AsyncSubscriber(endpoint, ask) as stream`, `await stream.receive(1.0)`."""

    _context = zmq.asyncio.Context
    _poller_of = zmq.asyncio.Poller

    async def __aenter__(self) -> AsyncSubscriber:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    async def ask(self, request: Mapping[str, Any]) -> None:
        """Send a question of your own; `receive` returns the answer. Raises WireError without `ask`."""
        await self._send(request)

    async def receive(self, timeout_s: float) -> Message | None:
        """The next message or answer; None when there was none for that long."""
        steps, value = self._receive(timeout_s), None
        try:
            while True:
                value = await steps.send(value)
        except StopIteration as end:
            message: Message | None = end.value
            return message


class Subscription:
    """The messages of a stream, for `for` or `async for`: until the flight has ended and no answer is outstanding.

    Each loop connects anew, and closes its sockets when it is left. `gaps`, `recovered` and `lost` count the slices of
    the last loop.
    """

    def __init__(
        self,
        endpoint: str,
        ask: str,
        *,
        topics: Collection[str],
        from_start: bool,
        idle_s: float | None,
        keys: ClientKeys | None,
    ) -> None:
        self._endpoint, self._ask, self._idle_s = endpoint, ask, idle_s
        self._topics, self._from_start, self._keys = topics, from_start, keys
        self._core: _SubscriberCore | None = None

    @property
    def gaps(self) -> int:
        """Slices that were missed."""
        return 0 if self._core is None else self._core.gaps

    @property
    def recovered(self) -> int:
        """Missed slices that came when they were asked for."""
        return 0 if self._core is None else self._core.recovered

    @property
    def lost(self) -> int:
        """Missed slices that were given up."""
        return 0 if self._core is None else self._core.lost

    def __iter__(self) -> Iterator[Message]:
        with Subscriber(
            self._endpoint, self._ask, topics=self._topics, from_start=self._from_start, keys=self._keys
        ) as core:
            self._core = core
            while not core.finished:
                message = core.receive(self._wait_s)
                if message is not None:
                    yield message
                elif self._silent(core):
                    return

    async def __aiter__(self) -> AsyncIterator[Message]:
        async with AsyncSubscriber(
            self._endpoint, self._ask, topics=self._topics, from_start=self._from_start, keys=self._keys
        ) as core:
            self._core = core
            while not core.finished:
                message = await core.receive(self._wait_s)
                if message is not None:
                    yield message
                elif self._silent(core):
                    return

    @property
    def _wait_s(self) -> float:
        return 1.0 if self._idle_s is None else self._idle_s

    def _silent(self, core: _SubscriberCore) -> bool:
        return self._idle_s is not None or core.ended


def subscribe(
    endpoint: str,
    ask: str | None = None,
    *,
    topics: Collection[str] = wire.USUAL,
    from_start: bool = False,
    idle_s: float | None = None,
    keys: Path | str | None = None,
    server_key: Path | str | None = None,
) -> Subscription:
    """Subscribe to a daemon's stream; iterate over the result with `for` or `async for`.

    `ask` is the endpoint where lost slices are asked for again: by default the one beside an ipc endpoint, "" for none.
    With `from_start` the slices that the flight sent before count as lost too. The loop ends after the flight, or when
    no message came for `idle_s`. A tcp endpoint with CURVE needs both files: `keys`, your own NAME.key_secret, and
    `server_key`, the vehicle's NAME.key. Raises DappledError for the files; the loop raises WireError for an endpoint
    or an invalid message.
    """
    if (keys is None) != (server_key is None):
        raise DappledError("keys and server_key go together: your own secret key, and the vehicle's public one")
    pair = None
    if keys is not None and server_key is not None:
        pair = ClientKeys(load_own(Path(keys)), load_public(Path(server_key)))
    if ask is None:
        ask = f"{endpoint}.ask" if endpoint.startswith("ipc://") else ""
    return Subscription(endpoint, ask, topics=topics, from_start=from_start, idle_s=idle_s, keys=pair)


def _slices_of(end: Mapping[str, Any], counts: str) -> Any:
    """How many slices a flight's `end` counts as `sent` or `unsent`."""
    counted = end.get(counts)
    return counted.get("slices", 0) if isinstance(counted, Mapping) else None


def _connect(one: zmq.Socket[Any], endpoint: str, keys: ClientKeys | None) -> None:
    one.setsockopt(zmq.RECONNECT_IVL, 50)
    if keys is not None and endpoint.startswith("tcp://"):
        one.curve_secretkey, one.curve_publickey = keys.own.secret, keys.own.public
        one.curve_serverkey = keys.server
    try:
        one.connect(endpoint)
    except zmq.ZMQError as error:
        raise WireError(f"{endpoint}: not a ZeroMQ endpoint ({error.strerror})") from None
