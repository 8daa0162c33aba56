"""Do what the console asks of the daemon, and never late: a press that arrives too late fires nothing.

A page knows the daemon's clock by a token, which comes with every state. It sends the last one back with the time
since then, so the daemon knows by its own clock when the button was pressed. A link that was cut delivers what it held
when it is back; that is refused. The daemon remembers what became of each number, for a page that missed the answer.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from dappled.clock import Clock
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter

DEADLINE_MS = 2000  # from the press to the daemon
HEARD_MS = 4000  # a page that has heard no state for so long shows no contact, and sends nothing
_REMEMBERED = 256


def token(run: str, monotonic_ns: int) -> str:
    """The daemon's clock for a page. `run` tells a daemon's clock from that of an earlier one."""
    return f"{run}-{monotonic_ns // 10**6}"


class ConsoleRequests:
    """Answers the console's questions. One thread asks."""

    def __init__(self, shutter: Shutter, logbook: Logbook, clock: Clock) -> None:
        self.run = secrets.token_hex(4)
        self.logbook = logbook
        self._shutter, self._clock = shutter, clock
        self._done: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Do what is asked: a shot, an interval, its end, what became of a number, or the last lines of the log."""
        match request.get("do"):
            case "shoot" | "interval":
                return self._once(request)
            case "outcome":
                return self._outcome(request)
            case "stop interval":
                ran = self._shutter.stop_interval()
                return {"ok": True, "text": "the interval is stopped" if ran else "no interval was running"}
            case "log":
                return {"ok": True, "lines": self.logbook.after(request["after"])}
            case _:
                return {"ok": True}

    def _once(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The same number twice is one request, which follows the same rules as one over MAVLink."""
        number = request["sequence"]
        if (known := self._done.get(number)) is not None:
            return {**known, "text": f"already {known['text']}"} if known["ok"] else known
        late = self._too_late(request)
        self._done[number] = {"ok": False, "error": "it may have fired: see the flight's record", "index": None}
        if len(self._done) > _REMEMBERED:
            self._done.popitem(last=False)
        answer = {"ok": False, "error": late, "index": None} if late else _decided(self._decide(request))
        self._done[number] = answer
        return answer

    def _decide(self, request: Mapping[str, Any]) -> ShotDecision:
        number = request["sequence"]
        if request["do"] == "shoot":
            return self._shutter.request(CaptureRequest("console", "console", number))
        one = CaptureRequest("console", "console interval", number)
        return self._shutter.start_interval(one, float(request["interval_s"]), int(request["count"]))

    def _outcome(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """What became of a number. "waiting": it may still arrive in time; "never": it did not, and is refused now."""
        known = self._done.get(request["sequence"])
        if known is not None:
            return {"ok": True, "state": "known", "answer": known}
        age_ms = self._age_ms(request)
        if age_ms is None:
            return {"ok": True, "state": "restarted"}
        return {"ok": True, "state": "waiting" if age_ms <= DEADLINE_MS else "never"}

    def _too_late(self, request: Mapping[str, Any]) -> str | None:
        age_ms = self._age_ms(request)
        if age_ms is None:
            return "nothing was fired: this page is of an earlier start of the daemon, reload it"
        if age_ms <= DEADLINE_MS:
            return None
        return f"nothing was fired: the request came {age_ms / 1e3:.0f} s after the button was pressed"

    def _age_ms(self, request: Mapping[str, Any]) -> int | None:
        """Milliseconds since the button was pressed, by this daemon's clock; None for another daemon's token."""
        run, _, issued = str(request.get("token", "")).rpartition("-")
        if run != self.run or not (issued.isascii() and issued.isdigit()):
            return None
        now_ms = self._clock.monotonic_ns() // 10**6
        since_ms = min(max(int(request.get("elapsed_ms", 0)), 0), HEARD_MS)
        return now_ms - int(issued[:20]) - since_ms


def _decided(decision: ShotDecision) -> dict[str, Any]:
    if not decision.accepted:
        return {"ok": False, "error": decision.reason, "index": None}
    text = f"shot {decision.index}" if decision.outcome == "shot" else f"already shot {decision.index}"
    return {"ok": True, "index": decision.index, "text": text}
