"""Do what the console asks of the daemon, and never late: a press that arrives too late fires nothing.

A page knows the daemon's clock by a token, which comes with every state. It sends the last one back with the time
since then, so the daemon knows by its own clock when the button was pressed. A link that was cut delivers what it held
when it is back; that is refused. The daemon remembers what became of each number, for a page that missed the answer.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Protocol

from dappled.clock import Clock
from dappled.daemon.console.live_view import CameraLook
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.drivers.camera import CameraError

DEADLINE_MS = 2000  # from the press to the daemon
HEARD_MS = 4000  # a page that has heard no state for so long shows no contact, and sends nothing
HELD_MS = 86_400_000  # a stop counts from the last state heard, however long ago that was
_REMEMBERED = 256


def token(run: str, monotonic_ns: int) -> str:
    """The daemon's clock for a page. `run` tells a daemon's clock from that of an earlier one."""
    return f"{run}-{monotonic_ns // 10**6}"


class Settable(Protocol):
    """The settings that a page may change: `camera_protocol.parameters.Parameters`."""

    def change(self, name: str, value: str) -> bool:
        """Ask for another value. Whether it is set already; else the body will report it. Raises CameraError."""


class ConsoleRequests:
    """Answers the console's questions. One thread asks."""

    def __init__(
        self,
        shutter: Shutter,
        parameters: Settable,
        look: CameraLook,
        logbook: Logbook,
        *,
        series: DistanceTrigger,
        clock: Clock,
    ) -> None:
        self.run = secrets.token_hex(4)
        self.logbook = logbook
        self._shutter, self._series = shutter, series
        self._parameters, self._look, self._clock = parameters, look, clock
        self._done: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self._stopped_ms: int | None = None  # when the Stop that ended the last interval was pressed

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Do what is asked: a shot, an interval, its end, a setting, live view, what became of a number, or lines of
        the log."""
        match request.get("do"):
            case "shoot" | "interval" | "set":
                return self._once(request)
            case "outcome":
                return self._outcome(request)
            case "stop interval":
                return self._stop_interval(request)
            case "look":
                return self._look.answer()
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
        open_words = "it may have been set" if request["do"] == "set" else "it may have fired: see the flight's record"
        self._done[number] = {"ok": False, "error": open_words, "index": None}
        if len(self._done) > _REMEMBERED:
            self._done.popitem(last=False)
        answer = {"ok": False, "error": late, "index": None} if late else self._do(request)
        self._done[number] = answer
        return answer

    def _do(self, request: Mapping[str, Any]) -> dict[str, Any]:
        number = request["sequence"]
        if request["do"] == "shoot":
            return _decided(self._shutter.request(CaptureRequest("console", "console", number)))
        if request["do"] == "set":
            return self._set(request["name"], request["value"])
        one = CaptureRequest("console", "console interval", number)
        return _decided(self._shutter.start_interval(one, float(request["interval_s"]), int(request["count"])))

    def _set(self, name: str, value: str) -> dict[str, Any]:
        """Another value for a setting, by the same rules as over MAVLink."""
        try:
            taken = self._parameters.change(name, value)
        except CameraError as error:
            return {"ok": False, "error": str(error)}
        return {"ok": True, "text": f"{name} is {value} from now on" if taken else f"the camera was asked for {value}"}

    def _stop_interval(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """A stop is never too late, but it ends only what ran when it was pressed: held back by a link, it must not
        cut short an interval that somebody began since. The same press again, whose answer was lost, has the same
        answer. Without a token it ends what runs now."""
        asked_ns = pressed_ms = None
        if "token" in request:
            pressed_ms = self._pressed_ms(request, HELD_MS)
            if pressed_ms is None:
                text = "no interval of then is running: the daemon was started again since"
                return {"ok": True, "text": text, "restarted": True}
            asked_ns = (pressed_ms + 1) * 10**6  # the token counts whole milliseconds
        ends = {self._shutter.stop_interval(asked_ns=asked_ns), self._series.end(asked_ns=asked_ns)}
        if "began later" in ends:
            text = "not stopped: this interval was begun after Stop was pressed; press it again to end it"
            return {"ok": False, "error": text}
        if "stopped" in ends:
            self._stopped_ms = pressed_ms
        is_stopped = "stopped" in ends or (pressed_ms is not None and pressed_ms == self._stopped_ms)
        return {"ok": True, "text": "the interval is stopped" if is_stopped else "no interval was running"}

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
        nothing = "nothing was set" if request["do"] == "set" else "nothing was fired"
        if age_ms is None:
            return f"{nothing}: this page is of an earlier start of the daemon, reload it"
        if age_ms <= DEADLINE_MS:
            return None
        return f"{nothing}: the request came {age_ms / 1e3:.0f} s after the button was pressed"

    def _age_ms(self, request: Mapping[str, Any]) -> int | None:
        """Milliseconds since the button was pressed, by this daemon's clock; None for another daemon's token."""
        pressed_ms = self._pressed_ms(request, HEARD_MS)
        return None if pressed_ms is None else self._clock.monotonic_ns() // 10**6 - pressed_ms

    def _pressed_ms(self, request: Mapping[str, Any], longest_ms: int) -> int | None:
        """When the button was pressed, by this daemon's clock; None for another daemon's token. `longest_ms` bounds
        what is believed of the page's own clock."""
        run, _, issued = str(request.get("token", "")).rpartition("-")
        if run != self.run or not (issued.isascii() and issued.isdigit()):
            return None
        return int(issued[:20]) + min(max(int(request.get("elapsed_ms", 0)), 0), longest_ms)


def _decided(decision: ShotDecision) -> dict[str, Any]:
    if not decision.accepted:
        return {"ok": False, "error": decision.words, "index": None}
    return {"ok": True, "index": decision.index, "text": decision.words}
