"""Judge a health record: go, caution or no-go for each thing that a flight needs. All checks are a `Check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dappled import findings
from dappled.errors import counted
from dappled.flight.layout import DiskSpace

State = Literal["go", "caution", "no-go"]
_WEAK_FIXES = {1: "no fix", 2: "a 2D fix"}  # by GPS_FIX_TYPE; 0, no receiver, may fly by other means
_SURE_M, _SLOW_CLOCK_MS, _FRESH_MS = 5.0, 50.0, 3000.0
FAILING = 3  # so many frames in a row that can't be decoded are no accident
_FRAME_BYTES = 20e6  # of a large one: whether little room is left before a flight has shown its own
_FRAMES = ("frames", "frame")
_CARD_FRAMES = 100
_HOT_C = 50.0  # inside a body; Canon's may be used in air of up to 40 °C
_EARLIEST_UTC_NS = 1_700_000_000 * 10**9  # a machine with a date before 2023 has no clock


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check. "go": ready; "caution": a flight is possible, with a loss that the text names;
    "no-go": the flight brings no good frames.

    `todo` says what to do about it, "" where nothing is to be done. `measured` holds the numbers behind the text.
    """

    name: str
    state: State
    text: str
    todo: str = ""
    measured: Mapping[str, Any] = field(default_factory=dict)


def verdict(checks: Sequence[Check]) -> State:
    """The worst state of the checks."""
    states = {one.state for one in checks}
    return "no-go" if "no-go" in states else "caution" if "caution" in states else "go"


def next_step(checks: Sequence[Check]) -> str:
    """What to do first: the `todo` of the first no-go; "" where there is none."""
    return next((one.todo for one in checks if one.state == "no-go" and one.todo), "")


def checks(health: Mapping[str, Any]) -> list[Check]:
    """The checks of one health record."""
    return [
        _camera(health["camera"]),
        *_body(health),
        _disk(health),
        _link(health),
        *_vehicle_battery(health.get("vehicle_battery")),
        _position(health.get("vehicle"), health.get("gnss")),
        _clock(health),
        _decoding(health),
        _service(health.get("dead", [])),
    ]


def _camera(camera: Mapping[str, Any]) -> Check:
    state, reason = camera["state"], camera.get("reason") or ""
    if state in ("ready", "busy"):
        return Check("Camera", "go", "ready" if state == "ready" else "taking a frame")
    if state == "starting":
        return Check("Camera", "caution", "starting")
    return Check("Camera", "no-go", f"{state}: {reason}" if reason else state)


def _body(health: Mapping[str, Any]) -> list[Check]:
    """The body's settings against the plan; none while no camera is ready."""
    body = health.get("body")
    if body is None:
        return []
    room = body["card_frames"]
    if body["wrong"]:
        return [Check("Body", "no-go", "; ".join(body["wrong"]), "make the body as planned, or change [body]")]
    if room == 0:
        return [Check("Body", "no-go", "its card is full", "change the card, or empty it")]
    doubts = [body["drift"]] if body["drift"] else []
    if room is not None and room < _CARD_FRAMES:
        doubts.append(f"its card has room for {counted(room, 'frame')}")
    if body.get("battery_low"):
        doubts.append(f"its battery is nearly empty: {body['battery']}")
    degrees_c = body.get("temperature_c")
    if degrees_c is not None and degrees_c >= _HOT_C:
        doubts.append(f"it is {degrees_c:.0f} °C warm inside")
    if not body["checked"]:
        doubts.append("its settings are not compared with a plan (body.check)")
    elif not body["read"]:
        doubts.append(f"its settings can't be read; look at {', '.join(body['unknown'])}")
    elif body["unknown"]:
        doubts.append(f"it doesn't report {', '.join(body['unknown'])}: look at it")
    if doubts:
        return [Check("Body", "caution", "; ".join(doubts))]
    more = [] if room is None else [f"room for {counted(room, 'frame')}"]
    more += [] if degrees_c is None else [f"{degrees_c:.0f} °C"]
    return [Check("Body", "go", ", ".join(("as planned", *more)))]


def frames_left(health: Mapping[str, Any]) -> int | None:
    """How many more frames the disk takes, by the sizes of this flight's; None where either is unknown."""
    free, each = health["disk"]["free_bytes"], health.get("frame_bytes")
    return None if free is None or not each else _room(health, each)


def _room(health: Mapping[str, Any], frame_bytes: float) -> int:
    return max(0, int((health["disk"]["free_bytes"] - (health.get("min_free_bytes") or 0)) / frame_bytes))


def _disk(health: Mapping[str, Any]) -> Check:
    free, least = health["disk"]["free_bytes"], health.get("min_free_bytes") or 0
    if free is None:
        return Check("Disk", "no-go", "the flight's folder can't be read")
    known = frames_left(health)
    frames = _room(health, _FRAME_BYTES) if known is None else known
    count = f"{frames:,}".replace(",", "\u202f")  # a thin space that doesn't break
    room = (
        "room for frames: unknown before the first" if known is None else f"room for {count} frame{'s'[: frames != 1]}"
    )
    text = f"{free / 1e9:.1f} GB free, {room}"
    short = DiskSpace(free, 0, free, health["disk"].get("free_files")).shortage(least // 1_000_000)
    if short is not None:
        return Check("Disk", "no-go", f"{findings.text(short)}; shots are refused")
    return Check("Disk", "go" if frames >= 100 else "caution", text)


def _link(health: Mapping[str, Any]) -> Check:
    link = health["link"]
    if not link["urls"]:
        return Check("Autopilot", "caution", "no link is configured: frames have no poses")
    silent = link.get("silent", 0)
    age_ms = (health.get("vehicle") or {}).get("age_ms")
    if age_ms is not None and age_ms < _FRESH_MS:
        return Check("Autopilot", "go", "; ".join(["heard", *_quiet_links(link, silent)]))
    if silent >= link["urls"]:
        return Check("Autopilot", "no-go", "silent for more than 5 s")
    return Check("Autopilot", "caution", "heard, but it sends no position")


def _quiet_links(link: Mapping[str, Any], silent: int) -> list[str]:
    """Words on the links that are silent: those that were heard, and those on which nobody was heard yet."""
    unheard = min(silent, sum(not each["in"] for each in link.get("each", ())))
    counts = [(silent - unheard, "{} of {} links silent"), (unheard, "nobody yet on {} of {} links")]
    return [words.format(count, link["urls"]) for count, words in counts if count]


def _vehicle_battery(battery: Mapping[str, Any] | None) -> list[Check]:
    """The vehicle's battery; none where nothing is known of it."""
    if battery is None or (battery["voltage_v"], battery["remaining_percent"], battery["low"]) == (None, None, None):
        return []
    voltage, left = battery["voltage_v"], battery["remaining_percent"]
    text = f"{'voltage unknown' if voltage is None else f'{voltage:.1f} V'}, {_left(left)}"
    return [Check("Vehicle battery", *(("caution", f"low: {text}") if battery["low"] else ("go", text)))]


def _left(percent: int | None) -> str:
    return "what is left is unknown" if percent is None else f"{percent} % left"


def _position(vehicle: Mapping[str, Any] | None, gnss: Mapping[str, Any] | None) -> Check:
    if vehicle is None or vehicle["latitude_deg"] is None:
        return Check("Position", "caution", "unknown: frames have no position")
    sigma, yaw = vehicle["position_sigma_m"], vehicle["yaw_deg"]
    text = "accuracy unknown" if sigma is None else _about(sigma, "m")
    if fix := None if gnss is None else _WEAK_FIXES.get(gnss["fix_type"]):
        text += f", but the satellite receiver has {fix}"
    if yaw is None:
        text += ", attitude unknown"
    if fix or yaw is None:
        return Check("Position", "caution", text)
    return Check("Position", "go" if sigma is not None and sigma <= _SURE_M else "caution", text)


def _clock(health: Mapping[str, Any]) -> Check:
    if not health.get("utc_known", True):
        return Check("Clock", "caution", "UTC is not known yet: it comes from the autopilot")
    if health["utc_ns"] < _EARLIEST_UTC_NS:
        return Check("Clock", "no-go", "this machine does not know the date")
    clock = health.get("clock")
    if clock is None:
        return Check("Clock", "caution", "the autopilot's clock is unknown")
    how = "synchronised" if clock["source"] == "timesync" else "by packet arrival"
    state: State = "go" if clock["sigma_ms"] <= _SLOW_CLOCK_MS else "caution"
    return Check("Clock", state, f"{how}, {_about(clock['sigma_ms'], 'ms')}")


def _decoding(health: Mapping[str, Any]) -> Check:
    decode = health.get("decode") or {"mask": "", "calibration": "", "running": False}
    if not decode["mask"]:
        return Check("Decoding", "caution", "no mask is configured: frames are kept, not decoded")
    if not decode["running"]:
        return Check("Decoding", "caution", "off: frames are kept, not decoded")
    if (failing := _failing(decode)) is not None:
        return failing
    left = sum(stage["dropped"] for stage in health["stages"] if stage["name"] == "decode")
    if left:
        return Check("Decoding", "caution", f"fell behind by {counted(left, 'frame')}, kept in the record")
    if not decode["calibration"]:
        return Check(
            "Decoding", "caution", f"{decode['mask']}, not calibrated: carriers are predicted by the law alone"
        )
    return Check("Decoding", "go", f"{decode['mask']}, calibrated")


def _failing(decode: Mapping[str, Any]) -> Check | None:
    """What is wrong where frames are in doubt or can't be decoded; None elsewhere. They are recorded in any case."""
    if decode.get("misfit"):
        return Check("Decoding", "no-go", f"frames will be kept, not decoded: {decode['misfit']}")
    failed, in_a_row = decode.get("failed", 0), decode.get("failed_in_a_row", 0)
    if not failed and decode.get("doubt"):
        return Check("Decoding", "caution", f"frames are decoded, in doubt: {decode['doubt']}")
    if in_a_row >= FAILING:
        text = f"the last {counted(in_a_row, 'frame')} could not be decoded, kept in the record: {decode['failure']}"
        return Check("Decoding", "no-go", text)
    if failed:
        text = f"{counted(failed, 'frame')} could not be decoded, kept in the record: {decode['failure']}"
        return Check("Decoding", "caution", text)
    return None


def _service(dead: Sequence[str]) -> Check:
    if dead:
        return Check("Service", "no-go", f"{', '.join(dead)} ended: restart dappled")
    return Check("Service", "go", "all threads are running")


def _about(sigma: float, unit: str) -> str:
    """One sigma with two significant figures: ±0.024 m, ±1.3 m, ±12 m."""
    return f"±{sigma:.{0 if sigma >= 10 else 1 if sigma >= 1 else 2 if sigma >= 0.095 else 3}f} {unit}"
