"""How many bytes a link may write into the telemetry log: a rate for each sender and message, then only a count."""

from __future__ import annotations

from dataclasses import dataclass

_SENDERS = 16  # of a link; the others share one rate
_MESSAGES = 64  # of a sender; the others share one rate
_OWN_B_S, _MESSAGE_B_S, _LINK_B_S, _OTHERS_B_S = 4_000, 32_000, 128_000, 1_000
_ANYBODY_B_S = 16_000  # less than 1 MB a minute
_AUTOPILOT = 1  # the component id
_AT_ONCE_S = 2
_GONE_NS = 60 * 10**9


class Rate:
    """An amount a second, and what that is in two seconds at once. Times are monotonic."""

    def __init__(self, per_s: float) -> None:
        self._per_s, self._left, self._at_ns = per_s, per_s * _AT_ONCE_S, 0

    def takes(self, amount: float, now_ns: int) -> bool:
        """Whether so much is within the rate; it counts only then."""
        grown = self._left + (now_ns - self._at_ns) * self._per_s / 1e9
        self._left, self._at_ns = min(self._per_s * _AT_ONCE_S, grown), now_ns
        if amount > self._left:
            return False
        self._left -= amount
        return True


class _Message:
    """One message of one sender: what it has of its own, and the most that it may have."""

    def __init__(self) -> None:
        self.own, self.most = Rate(_OWN_B_S), Rate(_MESSAGE_B_S)


@dataclass(slots=True)
class _Sender:
    messages: dict[int, _Message]
    others: _Message
    heard_ns: int


class LogBudget:
    """The telemetry log's bytes of one link.

    Each message of a sender has 4 kB/s of its own, and up to 32 kB/s while all senders of the link together stay within
    128 kB/s. 16 senders have 64 messages each; of further messages, and of further senders, all share one such rate.

    Where `anybody` may be at the other end, as many senders as they like may be one stranger: all of them have 16 kB/s
    in total, but for one autopilot, the first that is heard from its address until it is silent for a minute.
    """

    def __init__(self, *, anybody: bool = False) -> None:
        self._anybody = Rate(_ANYBODY_B_S) if anybody else None
        self._autopilot: tuple[str, int] | None = None
        self._autopilot_ns = 0
        self._senders: dict[tuple[int, int], _Sender] = {}
        self._link, self._strangers = Rate(_LINK_B_S), Rate(_OTHERS_B_S)

    def takes(self, source: tuple[int, int], message: int, size: int, now_ns: int, address: str = "") -> bool:
        """Whether a packet of so many bytes is written. `source`: the system and component that it says it is of;
        `address`: where it came from."""
        if not self._takes(source, message, size, now_ns):
            return False
        if self._anybody is None or self._is_autopilot(source, address, now_ns):
            return True
        return self._anybody.takes(size, now_ns)

    def _is_autopilot(self, source: tuple[int, int], address: str, now_ns: int) -> bool:
        if source[1] != _AUTOPILOT:
            return False
        if self._autopilot is None or now_ns - self._autopilot_ns > _GONE_NS:
            self._autopilot = (address, source[0])
        if self._autopilot != (address, source[0]):
            return False
        self._autopilot_ns = now_ns
        return True

    def _takes(self, source: tuple[int, int], message: int, size: int, now_ns: int) -> bool:
        sender = self._senders.get(source)
        if sender is None:
            if len(self._senders) >= _SENDERS:
                self._senders = {who: one for who, one in self._senders.items() if now_ns - one.heard_ns < _GONE_NS}
            if len(self._senders) >= _SENDERS:
                return self._strangers.takes(size, now_ns)
            sender = self._senders[source] = _Sender({}, _Message(), now_ns)
        sender.heard_ns = now_ns
        rates = sender.messages.get(message)
        if rates is None and len(sender.messages) < _MESSAGES:
            rates = sender.messages[message] = _Message()
        rates = rates or sender.others
        return rates.most.takes(size, now_ns) and (rates.own.takes(size, now_ns) or self._link.takes(size, now_ns))
