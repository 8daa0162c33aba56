"""What the console may have the daemon do: shoot, shoot at an interval, stop that, and tell the log's last lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dappled.daemon.health.logbook import Logbook
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter

SOURCE = "console"


def act(request: Mapping[str, Any], shutter: Shutter, logbook: Logbook) -> dict[str, Any]:
    """The answer to one request. A wish follows the same rules as one that came over MAVLink: the page numbers its
    wishes, and a number that comes twice is one wish."""
    match request.get("do"):
        case "shoot":
            return _told(shutter.request(CaptureRequest(SOURCE, "console", request["sequence"])))
        case "interval":
            wish = CaptureRequest(SOURCE, "console interval", request["sequence"])
            return _told(shutter.start_interval(wish, float(request["interval_s"]), int(request["count"])))
        case "stop interval":
            ran = shutter.stop_interval()
            return {"ok": True, "text": "the interval is stopped" if ran else "no interval was running"}
        case "log":
            return {"ok": True, "lines": logbook.after(request["after"])}
        case _:
            return {"ok": True}


def _told(decision: ShotDecision) -> dict[str, Any]:
    if not decision.accepted:
        return {"ok": False, "error": decision.reason, "index": None}
    text = f"shot {decision.index}" if decision.outcome == "shot" else f"already shot {decision.index}"
    return {"ok": True, "index": decision.index, "text": text}
