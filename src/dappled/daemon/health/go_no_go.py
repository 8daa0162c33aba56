"""Judge a health record: what stands between a flight and good frames, as findings; go is the absence of any."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

from dappled.findings import Code, Finding, Level, Subject, finding, worst

GoNoGo = Literal["go", "caution", "no-go"]
_STATES: Mapping[Level, GoNoGo] = {Level.NOTE: "go", Level.CAUTION: "caution", Level.STOP: "no-go"}
_WEAK_FIXES = {1: "no fix", 2: "a 2D fix"}  # by GPS_FIX_TYPE; 0, no receiver, may fly by other means
_SURE_M, _SLOW_CLOCK_MS = 5.0, 50.0
_FRAME_BYTES = 20e6  # of a large one: whether little room is left before a flight has shown its own
_FEW_FRAMES = 100
_EARLIEST_UTC_NS = 1_700_000_000 * 10**9  # a machine with a date before 2023 has no clock


def state(found: Iterable[Finding]) -> GoNoGo:
    """Go, caution or no-go: the worst of what was found."""
    return _STATES[worst(found)]


def judge(health: Mapping[str, Any]) -> Iterator[Finding]:
    """What the facts of a health record say."""
    yield from _room(health)
    yield from _vehicle(health)
    yield from _clock(health)
    yield from _decoding(health["decode"])
    for stage in health["stages"]:
        if stage.get("dropped") and "waiting" in stage:
            behind = (Code.DECODE_BEHIND, "") if stage["name"] == "decode" else (Code.STAGE_BEHIND, stage["name"])
            yield finding(behind[0], Subject("stage", behind[1]), frames=stage["dropped"])


def frames_left(health: Mapping[str, Any]) -> int | None:
    """How many more frames the disk takes, by the sizes of this flight's; None where either is unknown."""
    return _frames(health, health.get("frame_bytes"))


def _frames(health: Mapping[str, Any], frame_bytes: float | None) -> int | None:
    free = health["disk"]["free_bytes"]
    return None if free is None or not frame_bytes else max(0, int((free - health["min_free_bytes"]) / frame_bytes))


def _room(health: Mapping[str, Any]) -> Iterator[Finding]:
    frames = _frames(health, health.get("frame_bytes") or _FRAME_BYTES)
    short = frames is not None and health["disk"]["free_bytes"] < health["min_free_bytes"]  # that is found of the disk
    if frames is not None and frames < _FEW_FRAMES and not short:
        yield finding(Code.DISK_FEW_FRAMES, Subject("disk"), frames=frames)


def _vehicle(health: Mapping[str, Any]) -> Iterator[Finding]:
    vehicle, gnss, battery = health["vehicle"], health["gnss"], health["vehicle_battery"]
    if battery is not None and battery["low"]:
        facts = {"voltage_v": battery["voltage_v"], "left_percent": battery["remaining_percent"]}
        yield Finding(Code.BATTERY_VEHICLE_LOW, Subject("vehicle"), facts, Level.CAUTION)
    if not health["link"]["urls"]:
        return  # that is found of the links
    if vehicle is None or vehicle["latitude_deg"] is None:
        yield finding(Code.POSITION_UNHEARD, Subject("vehicle"))
        return
    if fix := None if gnss is None else _WEAK_FIXES.get(gnss["fix_type"]):
        yield finding(Code.POSITION_WEAK_FIX, Subject("vehicle"), fix=fix)
    if (sigma_m := vehicle["position_sigma_m"]) is None:
        yield finding(Code.POSITION_SIGMA_UNKNOWN, Subject("vehicle"))
    elif sigma_m > _SURE_M:
        yield finding(Code.POSITION_UNSURE, Subject("vehicle"), sigma_m=sigma_m)
    if vehicle["yaw_deg"] is None:
        yield finding(Code.POSITION_NO_ATTITUDE, Subject("vehicle"))


def _clock(health: Mapping[str, Any]) -> Iterator[Finding]:
    clock = health["clock"]
    if not health["utc_known"]:
        yield finding(Code.CLOCK_UTC_UNKNOWN, Subject("clock"))
    elif health["utc_ns"] < _EARLIEST_UTC_NS:
        yield finding(Code.CLOCK_DATE_UNKNOWN, Subject("clock"))
    if clock is not None and clock["sigma_ms"] > _SLOW_CLOCK_MS:
        yield finding(Code.CLOCK_LOOSE, Subject("clock"), sigma_ms=clock["sigma_ms"])
    elif clock is None and health["vehicle"] is not None:
        yield finding(Code.CLOCK_AUTOPILOT_UNKNOWN, Subject("clock"))


def _decoding(decode: Mapping[str, Any]) -> Iterator[Finding]:
    about = Subject("decoding")
    if not decode["mask"]:
        yield finding(Code.DECODE_NO_MASK, about)
        return
    if not decode["running"]:
        yield finding(Code.DECODE_OFF, about)
    elif not decode["calibration"]:
        yield finding(Code.DECODE_UNCALIBRATED, about, mask=decode["mask"])
