"""The other end of the stream: a small client that notices what it lost, and asks for it again."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from types import TracebackType
from typing import Any

import zmq

from dappled.daemon import wire
from dappled.daemon.wire import Message, WireError

AT_ONCE = 4  # questions under way; the others wait their turn here


class Subscriber:
    """Receives messages in order of arrival; lost `slices` are asked for on `ask` and handed out when they come.

    `endpoint` and `ask` are ZeroMQ endpoints; without `ask` gaps are only counted. With `from_start` the slices that a
    flight sent before this subscriber came count as a gap too. `gaps` counts slices that were missed, `recovered` those
    had by asking, `lost` those not had. `clock` is monotonic seconds.
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
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._answer_timeout_s = answer_timeout_s
        self._from_start = from_start
        self._next: dict[str, int] = {}  # by flight: the slices' next seq
        self._missing: deque[int] = deque()
        self._asked: dict[int, float] = {}  # seq of slices → deadline
        self.gaps = self.recovered = self.lost = 0
        self._context = zmq.Context()
        self._sub = self._context.socket(zmq.SUB)
        self._sub.setsockopt(zmq.RCVHWM, high_water_mark)
        self._sub.setsockopt(zmq.RECONNECT_IVL, 50)
        for topic in topics:
            self._sub.setsockopt(zmq.SUBSCRIBE, topic.encode())
        self._dealer = self._context.socket(zmq.DEALER) if ask else None
        self._poller = zmq.Poller()
        try:
            self._sub.connect(endpoint)
            self._poller.register(self._sub, zmq.POLLIN)
            if self._dealer is not None:
                self._dealer.setsockopt(zmq.RECONNECT_IVL, 50)
                self._dealer.connect(ask)
                self._poller.register(self._dealer, zmq.POLLIN)
        except zmq.ZMQError as error:
            self.close()
            raise WireError(f"{endpoint}: not a ZeroMQ endpoint ({error.strerror})") from None

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the sockets."""
        self._context.destroy(linger=0)

    def ask(self, request: dict[str, Any]) -> None:
        """Put a question of one's own; the answer comes by `receive`."""
        if self._dealer is None:
            raise WireError("no endpoint to ask was given")
        self._dealer.send(json.dumps(request).encode())

    @property
    def waiting_for(self) -> int:
        """How many answers are still to come."""
        return len(self._asked) + len(self._missing)

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, live or asked for; None when there was none for that long."""
        deadline = self._clock() + timeout_s
        while True:
            self._give_up()
            left = max(0.0, deadline - self._clock())
            ready = dict(self._poller.poll(round(min(left, 0.5) * 1000)))
            if self._dealer is not None and self._dealer in ready:
                answer = wire.decode(self._dealer.recv_multipart(copy=False)[:])
                return self._answered(answer)
            if self._sub in ready:
                message = wire.decode([part.buffer for part in self._sub.recv_multipart(copy=False)])
                self._watch_gaps(message)
                return message
            if self._clock() >= deadline:
                return None

    def _watch_gaps(self, message: Message) -> None:
        header = message.header
        flight, seq = str(header.get("flight", "")), header.get("seq")
        if message.topic == "slices" and isinstance(seq, int):
            until, after = seq, seq + 1
        elif message.topic == "end" and isinstance(sent := header.get("sent"), dict):
            until = after = int(sent.get("slices", 0))
        else:
            return
        for missed in range(self._next.get(flight, 0 if self._from_start else until), until):
            self.gaps += 1
            if self._dealer is None:
                self.lost += 1
            else:
                self._missing.append(missed)
        self._next[flight] = max(after, self._next.get(flight, 0))
        self._ask_next()

    def _ask_next(self) -> None:
        while self._missing and len(self._asked) < AT_ONCE:
            seq = self._missing.popleft()
            self._asked[seq] = self._clock() + self._answer_timeout_s
            self.ask({"get": "slices", "seq": seq})

    def _answered(self, answer: Message) -> Message:
        question = answer.header.get("asked")
        seq = question.get("seq") if isinstance(question, dict) else None
        if isinstance(seq, int) and self._asked.pop(seq, None) is not None:
            if answer.topic == "error":
                self.lost += 1
            else:
                self.recovered += 1
        self._ask_next()
        return answer

    def _give_up(self) -> None:
        now = self._clock()
        for seq in [seq for seq, deadline in self._asked.items() if deadline < now]:
            del self._asked[seq]
            self.lost += 1
        self._ask_next()


def subscribe(
    endpoint: str, ask: str = "", *, topics: Collection[str] = wire.TOPICS, idle_s: float | None = None
) -> Iterator[Message]:
    """Messages until the daemon says `end` and nothing asked for is still to come, or nothing came for `idle_s`."""
    with Subscriber(endpoint, ask, topics=topics) as subscriber:
        ended = False
        while not (ended and not subscriber.waiting_for):
            message = subscriber.receive(idle_s if idle_s is not None else 1.0)
            if message is None:
                if idle_s is not None or ended:
                    return
                continue
            ended = ended or message.topic == "end"
            yield message
