"""What a subscriber missed, and what it asks for again: the rules, without a socket or a clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from dappled.daemon.stream.wire import Message

MOST_MISSING = 2**16  # what a publisher remembers; a header that claims more is not to be believed
AT_ONCE = 4  # questions under way; the others wait their turn here

_Key = tuple[str, int]  # flight, seq of its slices


class Gaps:
    """Watches the `seq` of slices. `gaps` counts slices that were missed, `recovered` those had by asking, `lost` those
    not had. Without `can_ask` all missed are lost. With `from_start` what a flight sent before counts as missed too.

    Times are seconds of any one clock.
    """

    def __init__(self, *, can_ask: bool, from_start: bool = False, answer_timeout_s: float = 30.0) -> None:
        self._can_ask, self._from_start, self._answer_timeout_s = can_ask, from_start, answer_timeout_s
        self._next: dict[str, int] = {}
        self._missing: deque[_Key] = deque()
        self._asked: dict[_Key, float] = {}  # → when it is given up
        self.gaps = self.recovered = self.lost = 0

    @property
    def waiting_for(self) -> int:
        """How many answers are still to come."""
        return len(self._asked) + len(self._missing)

    def heard(self, message: Message) -> None:
        """A message of the stream."""
        header = message.header
        flight, seq = str(header.get("flight", "")), header.get("seq")
        if message.topic == "slices" and isinstance(seq, int):
            until, after = seq, seq + 1
        elif message.topic == "end" and isinstance(sent := _sent(header), int):
            until = after = sent
        else:
            return
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
        """An answer to a question, whoever asked it."""
        question = answer.header.get("asked")
        key = (str(question.get("flight")), question.get("seq")) if isinstance(question, Mapping) else None
        if key in self._asked:
            del self._asked[key]
            if answer.topic == "error":
                self.lost += 1
            else:
                self.recovered += 1

    def questions(self, now_s: float) -> list[dict[str, Any]]:
        """What to ask now; what was asked too long ago is given up."""
        for key in [key for key, deadline in self._asked.items() if deadline < now_s]:
            del self._asked[key]
            self.lost += 1
        found = []
        while self._missing and len(self._asked) < AT_ONCE:
            flight, seq = key = self._missing.popleft()
            self._asked[key] = now_s + self._answer_timeout_s
            found.append({"get": "slices", "seq": seq, "flight": flight})
        return found


def _sent(header: Mapping[str, Any]) -> Any:
    """How many slices a flight sent, as its `end` says."""
    sent = header.get("sent")
    return sent.get("slices", 0) if isinstance(sent, Mapping) else None
