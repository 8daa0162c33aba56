"""The other end of the stream: a small client that notices what it lost, and asks for it again."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping
from types import TracebackType
from typing import Any

import zmq
import zmq.asyncio

from dappled.daemon.stream import wire
from dappled.daemon.stream.curve import ClientKeys
from dappled.daemon.stream.gaps import Gaps
from dappled.daemon.stream.wire import Message, WireError

_LOOK_S = 0.5


class _Sockets:
    """A SUB for the stream, and a DEALER for questions where there is somebody to ask."""

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        ask: str,
        *,
        topics: Collection[str],
        high_water_mark: int,
        keys: ClientKeys | None,
    ) -> None:
        self.context = context
        self.sub = context.socket(zmq.SUB)
        self.sub.setsockopt(zmq.RCVHWM, high_water_mark)
        for topic in topics:
            self.sub.setsockopt(zmq.SUBSCRIBE, topic.encode())
        self.dealer = context.socket(zmq.DEALER) if ask else None
        try:
            _connect(self.sub, endpoint, keys)
            if self.dealer is not None:
                _connect(self.dealer, ask, keys)
        except WireError:
            self.close()
            raise

    def close(self) -> None:
        self.context.destroy(linger=0)


class Subscriber:
    """Receives messages in order of arrival; lost `slices` are asked for on `ask` and handed out when they come.

    `endpoint` and `ask` are ZeroMQ endpoints; without `ask` gaps are only counted. With `from_start` the slices that a
    flight sent before this subscriber came count as a gap too. `gaps` counts slices that were missed, `recovered` those
    had by asking, `lost` those not had. `keys` are for a tcp endpoint that wants CURVE. `clock` is monotonic seconds.
    """

    def __init__(
        self,
        endpoint: str,
        ask: str = "",
        *,
        topics: Collection[str] = wire.TOPICS,
        from_start: bool = False,
        high_water_mark: int = 8,
        answer_timeout_s: float = 30.0,
        keys: ClientKeys | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._gaps = Gaps(can_ask=bool(ask), from_start=from_start, answer_timeout_s=answer_timeout_s)
        self._sockets = _Sockets(
            zmq.Context(), endpoint, ask, topics=topics, high_water_mark=high_water_mark, keys=keys
        )
        self._poller = zmq.Poller()
        self._poller.register(self._sockets.sub, zmq.POLLIN)
        if self._sockets.dealer is not None:
            self._poller.register(self._sockets.dealer, zmq.POLLIN)

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    @property
    def gaps(self) -> int:
        """Slices that were missed."""
        return self._gaps.gaps

    @property
    def recovered(self) -> int:
        """Of them, those had by asking."""
        return self._gaps.recovered

    @property
    def lost(self) -> int:
        """Of them, those not had."""
        return self._gaps.lost

    @property
    def waiting_for(self) -> int:
        """How many answers are still to come."""
        return self._gaps.waiting_for

    def close(self) -> None:
        """Let go of the sockets."""
        self._sockets.close()

    def ask(self, request: Mapping[str, Any]) -> None:
        """Put a question of one's own; the answer comes by `receive`."""
        if self._sockets.dealer is None:
            raise WireError("no endpoint to ask was given")
        self._sockets.dealer.send(json.dumps(request).encode())

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, live or asked for; None when there was none for that long."""
        deadline = self._clock() + timeout_s
        dealer, sub = self._sockets.dealer, self._sockets.sub
        while True:
            self._ask_next()
            left = max(0.0, deadline - self._clock())
            ready = dict(self._poller.poll(round(min(left, _LOOK_S) * 1000)))
            if dealer is not None and dealer in ready:
                answer = _message(dealer.recv_multipart(copy=False))
                self._gaps.answered(answer)
                self._ask_next()
                return answer
            if sub in ready:
                message = _message(sub.recv_multipart(copy=False))
                self._gaps.heard(message)
                self._ask_next()
                return message
            if self._clock() >= deadline:
                return None

    def _ask_next(self) -> None:
        for question in self._gaps.questions(self._clock()):
            self.ask(question)


class AsyncSubscriber:
    """The same for asyncio: `async with AsyncSubscriber(endpoint, ask) as stream`, `await stream.receive(1.0)`.

    Without `recover` gaps are only counted, also where there is somebody to ask.
    """

    def __init__(
        self,
        endpoint: str,
        ask: str = "",
        *,
        topics: Collection[str] = wire.TOPICS,
        from_start: bool = False,
        recover: bool = True,
        high_water_mark: int = 8,
        answer_timeout_s: float = 30.0,
        keys: ClientKeys | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self.gaps = Gaps(can_ask=bool(ask) and recover, from_start=from_start, answer_timeout_s=answer_timeout_s)
        self._sockets = _Sockets(
            zmq.asyncio.Context(), endpoint, ask, topics=topics, high_water_mark=high_water_mark, keys=keys
        )
        self._poller = zmq.asyncio.Poller()
        self._poller.register(self._sockets.sub, zmq.POLLIN)
        if self._sockets.dealer is not None:
            self._poller.register(self._sockets.dealer, zmq.POLLIN)

    async def __aenter__(self) -> AsyncSubscriber:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the sockets."""
        self._sockets.close()

    def listen(self, topic: str, wanted: bool) -> None:
        """Subscribe to a topic from now on, or no more."""
        self._sockets.sub.setsockopt(zmq.SUBSCRIBE if wanted else zmq.UNSUBSCRIBE, topic.encode())

    async def ask(self, request: Mapping[str, Any]) -> None:
        """Put a question of one's own; the answer comes by `receive`."""
        if self._sockets.dealer is None:
            raise WireError("no endpoint to ask was given")
        await self._sockets.dealer.send(json.dumps(request).encode())

    async def receive(self, timeout_s: float) -> Message | None:
        """The next message, live or asked for; None when there was none for that long."""
        deadline = self._clock() + timeout_s
        dealer, sub = self._sockets.dealer, self._sockets.sub
        while True:
            await self._ask_next()
            left = max(0.0, deadline - self._clock())
            ready = dict(await self._poller.poll(round(min(left, _LOOK_S) * 1000)))
            if dealer is not None and dealer in ready:
                answer = _message(await dealer.recv_multipart(copy=False))
                self.gaps.answered(answer)
                await self._ask_next()
                return answer
            if sub in ready:
                message = _message(await sub.recv_multipart(copy=False))
                self.gaps.heard(message)
                await self._ask_next()
                return message
            if self._clock() >= deadline:
                return None

    async def _ask_next(self) -> None:
        for question in self.gaps.questions(self._clock()):
            await self.ask(question)


def subscribe(
    endpoint: str,
    ask: str = "",
    *,
    topics: Collection[str] = wire.TOPICS,
    idle_s: float | None = None,
    keys: ClientKeys | None = None,
) -> Iterator[Message]:
    """Messages until the daemon says `end` and nothing asked for is still to come, or nothing came for `idle_s`."""
    with Subscriber(endpoint, ask, topics=topics, keys=keys) as subscriber:
        ended = False
        while not (ended and not subscriber.waiting_for):
            message = subscriber.receive(idle_s if idle_s is not None else 1.0)
            if message is None:
                if idle_s is not None or ended:
                    return
                continue
            ended = ended or message.topic == "end"
            yield message


async def subscribe_async(
    endpoint: str,
    ask: str = "",
    *,
    topics: Collection[str] = wire.TOPICS,
    idle_s: float | None = None,
    keys: ClientKeys | None = None,
) -> AsyncIterator[Message]:
    """As `subscribe`, for `async for`."""
    async with AsyncSubscriber(endpoint, ask, topics=topics, keys=keys) as subscriber:
        ended = False
        while not (ended and not subscriber.gaps.waiting_for):
            message = await subscriber.receive(idle_s if idle_s is not None else 1.0)
            if message is None:
                if idle_s is not None or ended:
                    return
                continue
            ended = ended or message.topic == "end"
            yield message


def _connect(one: zmq.Socket[Any], endpoint: str, keys: ClientKeys | None) -> None:
    one.setsockopt(zmq.RECONNECT_IVL, 50)
    if keys is not None and endpoint.startswith("tcp://"):
        one.curve_secretkey, one.curve_publickey = keys.own.secret, keys.own.public
        one.curve_serverkey = keys.server
    try:
        one.connect(endpoint)
    except zmq.ZMQError as error:
        raise WireError(f"{endpoint}: not a ZeroMQ endpoint ({error.strerror})") from None


def _message(parts: Collection[zmq.Frame]) -> Message:
    return wire.decode([part.buffer for part in parts])
