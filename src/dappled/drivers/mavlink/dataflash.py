"""Read ArduPilot's own log (DataFlash, .bin) as the MAVLink packets that a telemetry link would have carried.

Positions are POS with the velocities of XKF1 or NKF1, attitudes ATT, the receiver GPS and GPA. UTC comes from the
receiver's time (`log_evidence.utc_clock`). Triggers of a camera are TRIG, with CAM as contacts of its feedback pin, or,
without a pin, CAM.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.decode.geometry import from_euler
from dappled.drivers import reader_process
from dappled.drivers.gps_time import GPS_EPOCH, gps_to_utc
from dappled.drivers.mavlink import log_evidence, log_packets
from dappled.drivers.mavlink.dataflash_reader import WHERE
from dappled.drivers.mavlink.log_evidence import Chosen, LoggedPlaces, Missing, Receiver
from dappled.drivers.mavlink.log_packets import AutopilotLogError, BootMap, LoggedTrigger, Timed, TriggerLog
from dappled.drivers.reader_process import Budget
from dappled.drivers.utc_choice import UtcBounds, rollovers
from dappled.findings import Code, Finding, Subject, finding

_USED = ["POS", "ATT", "GPS", "GPA", "XKF1", "NKF1", "XKF4", "NKF4"]
_OF_CAMERAS = ["CAM", "TRIG"]
_GPS_EPOCH_US = 315_964_800 * 10**6
_DAY_US = 86400 * 10**6
_WEEK_US = 7 * _DAY_US
_MOST_WEEKS = 2**16
_CORES_AGREE_M_S = 0.5
_METRES_PER_DEG = 111_195.0
_BUDGET = Budget(bytes_a_second=2e5, ratio=32)  # pymavlink reads some megabytes a second


def packets(
    path: Path, report: Callable[[Finding], object] = lambda _: None, bounds: UtcBounds | None = None
) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time. `report` gets what is to be said of the log;
    `bounds` say which dates can be true (None: up to now). Raises AutopilotLogError."""
    missing = Missing()
    with log_packets.sound(path, "ArduPilot"):
        rows, cut = _rows(path, _USED)
        clock, counting, told = _clock(path, rows, bounds)
        messages = [*_positions(path, rows, missing, told), *_attitudes(rows, missing)]
        for receiver, which in counting:
            messages += receiver.messages(which, clock)
    log_packets.tell(path, [*told, *missing.findings(path)], report, cut=cut)
    yield from log_packets.packets(messages, clock)


def triggers(path: Path, cam_idx: int, bounds: UtcBounds | None = None) -> TriggerLog:
    """The triggers of one camera (0 is CAM1). Raises AutopilotLogError."""
    with log_packets.sound(path, "ArduPilot"):
        rows, _ = _rows(path, ["GPS", *_OF_CAMERAS])
        clock, _, _ = _clock(path, rows, bounds)
        # before ArduPilot 4.3 the messages don't say which camera: there is one
        mine = {name: [row for row in rows[name] if getattr(row, "I", 0) == cam_idx] for name in _OF_CAMERAS}
        given = mine["TRIG"] or mine["CAM"]
        if any(not hasattr(row, name) for row in given for name in ("Img", "TimeUS", "Lat", "Lng")):
            raise AutopilotLogError(f"{path} holds messages CAM or TRIG in a form that is not ArduPilot's since 4.0")
        found = sorted(
            (
                LoggedTrigger(
                    int(row.Img), int(row.TimeUS), (float(row.Lat), float(row.Lng)) if row.Lat or row.Lng else None
                )
                for row in given
            ),
            key=lambda one: one.boot_us,
        )
        times_us = [int(row.TimeUS) for name in rows for row in rows[name]]
        contacts = len(mine["CAM"]) if mine["TRIG"] else None
        records = f"CAM or TRIG of CAM{cam_idx + 1}"
        return TriggerLog("ArduPilot", tuple(found), contacts, min(times_us), max(times_us), clock, records)


def _rows(path: Path, used: list[str]) -> tuple[dict[str, list[Any]], bool]:
    """The messages in use, by name, and whether the log was cut short: then it is read up to there."""
    arrays, said = reader_process.read(
        "dappled.drivers.mavlink.dataflash_reader", path, used, library="pymavlink", budget=_BUDGET
    )
    forms: dict[tuple[str, str], dict[str, list[Any]]] = {}
    for key, values in arrays.items():
        name, form, field = key.split("/", 2)
        forms.setdefault((name, form), {})[field] = values.tolist()
    rows: dict[str, list[Any]] = {name: [] for name in used}
    for (name, _), columns in forms.items():
        each = zip(*columns.values(), strict=True)
        rows[name] += [SimpleNamespace(**dict(zip(columns, values, strict=True))) for values in each]
    for name in used:
        rows[name].sort(key=lambda row: getattr(row, WHERE))
    begins_us = log_evidence.begins_us([_times(of_type) for of_type in rows.values()])
    for row in (row for of_type in rows.values() for row in of_type if begins_us):
        row.TimeUS -= begins_us
    return rows, said == "cut"


def _clock(
    path: Path, rows: dict[str, list[Any]], bounds: UtcBounds | None
) -> tuple[BootMap, list[tuple[Receiver, Chosen]], list[Finding]]:
    """The autopilot's clock, the receiver's messages that count, and what is to be said of both. Raises
    AutopilotLogError without a fix."""
    receivers = list(_receivers(rows))
    counting, told = log_evidence.chosen(path, receivers)
    clock, doubts = log_evidence.utc_clock(path, counting, receivers, bounds)
    return clock, log_evidence.in_turn(counting, receivers), [*told, *doubts]


def _receivers(rows: dict[str, list[Any]]) -> Iterator[Receiver]:
    """Each receiver's messages (GPS), with the accuracies (GPA) that are nearest in time."""
    for number in sorted({getattr(row, "I", 0) for row in rows["GPS"]}):
        mine = [row for row in rows["GPS"] if getattr(row, "I", 0) == number]
        told = [row for row in rows.get("GPA", []) if getattr(row, "I", 0) == number]
        at, quality = _times(mine), _times(told)
        nearest = np.abs(quality[None, :] - at[:, None]).argmin(axis=1) if told and len(told) < 2 else None
        if len(told) > 1:
            after = np.clip(np.searchsorted(quality, at), 1, len(quality) - 1)
            nearest = after - (np.abs(quality[after - 1] - at) <= np.abs(quality[after] - at))
        known = {
            name: np.full(len(mine), np.nan) if nearest is None else _column(told, name)[nearest]
            for name in ("VDop", "HAcc", "VAcc", "SAcc")
        }
        weeks, ms = _column(mine, "GWk"), _column(mine, "GMS")
        sound = (weeks > 0) & (weeks < _MOST_WEEKS) & (ms >= 0) & (ms < _WEEK_US / 1000)
        whole_weeks = np.where(sound, weeks, 0).astype(np.int64)
        gps_us = whole_weeks * _WEEK_US + np.where(sound, ms, 0).astype(np.int64) * 1000
        days = (gps_us // _DAY_US).tolist()
        of_day = {day: _leaps_us(day) for day in set(days)}
        leap_us, later_us = np.array([of_day[day] for day in days], np.int64).reshape(-1, 2).T
        yield Receiver(
            number + 1,
            at,
            np.where(sound, _GPS_EPOCH_US + gps_us - leap_us, 0),
            np.nan_to_num(_column(mine, "Status")).astype(np.int64),
            _column(mine, "Lat"),
            _column(mine, "Lng"),
            _column(mine, "Alt"),
            _column(mine, "NSats"),
            _column(mine, "HDop"),
            known["VDop"],
            np.stack([known[name] for name in ("HAcc", "VAcc", "SAcc")]),
            later_us,
            _column(mine, "U") > 0 if all(hasattr(row, "U") for row in mine) else None,
        )


def _leaps_us(day: int) -> tuple[int, int]:
    """By how much GPS time is ahead of UTC on a day of it, and how much later in UTC the date is that its missing
    roll-overs give."""
    gps = GPS_EPOCH + timedelta(days=day)
    later = gps + 1024 * rollovers((_GPS_EPOCH_US + day * _DAY_US) * 1000) * timedelta(weeks=1)
    leap_us, later_leap_us = (round((one - gps_to_utc(one)).total_seconds()) * 10**6 for one in (gps, later))
    return leap_us, (later - gps) // timedelta(microseconds=1) - (later_leap_us - leap_us)


def _positions(path: Path, rows: dict[str, list[Any]], missing: Missing, told: list[Finding]) -> Iterator[Timed]:
    places = LoggedPlaces(
        "POS", _times(rows["POS"]), *(_column(rows["POS"], name) for name in ("Lat", "Lng", "Alt", "RelHomeAlt"))
    )
    name = _estimator(rows)
    if not rows["POS"] or not rows[name]:
        raise AutopilotLogError(
            f"{path} holds no positions with velocities (POS, and XKF1 or NKF1): set LOG_BITMASK for them"
        )
    moving = _core(path, rows, name, places, told)
    velocities = np.stack([_column(moving, axis) for axis in ("VN", "VE", "VD")])
    yield from log_evidence.positions(places, name, _times(moving), velocities, missing)


def _estimator(rows: dict[str, list[Any]]) -> str:
    """Whose velocities count: those of the filter that the attitude says is active, else the newer one's."""
    active = [int(row.AEKF) for row in rows["ATT"] if hasattr(row, "AEKF")]
    older = bool(active) and 2 * active.count(2) > len(active)
    return "NKF1" if rows["NKF1"] and (older or not rows["XKF1"]) else "XKF1"


def _core(path: Path, rows: dict[str, list[Any]], name: str, places: LoggedPlaces, told: list[Finding]) -> list[Any]:
    """The messages of the estimator's cores that count: of the core that was in use at the time, where the log says so
    (XKF4, NKF4); else of the first one whose velocities agree with the positions."""
    cores = sorted({getattr(row, "C", 0) for row in rows[name]})
    of_core = {core: [row for row in rows[name] if getattr(row, "C", 0) == core] for core in cores}
    if len(cores) == 1:
        return of_core[cores[0]]
    said = [row for row in rows[name.replace("1", "4")] if hasattr(row, "PI")]
    primaries = {int(row.PI) for row in said}
    if primaries and primaries <= set(cores):
        at, primary = _times(said), _column(said, "PI")
        before = np.clip(np.searchsorted(at, _times(rows[name]), side="right") - 1, 0, None)
        found = [row for row, core in zip(rows[name], primary[before], strict=True) if getattr(row, "C", 0) == core]
        by, core = name.replace("1", "4"), int(np.median(primary))
    else:
        off_m_s = {core: _off_m_s(places, of_core[core]) for core in cores}
        most = 2.0 * min(off_m_s.values()) + _CORES_AGREE_M_S
        core = next(core for core in cores if off_m_s[core] <= most)
        found, by = of_core[core], "POS"
    if core != cores[0]:
        told.append(finding(Code.LOG_CORE, Subject("log", str(path)), core=core, cores=len(cores), by=by))
    return found


def _off_m_s(places: LoggedPlaces, moving: list[Any]) -> float:
    """By how much velocities differ from those of the positions (median, m/s, north and east); infinite where nothing
    can be compared."""
    times, span_s = _times(moving), np.diff(places.boots_us) / 1e6
    north, east = _column(moving, "VN"), _column(moving, "VE")
    good = np.isfinite(north) & np.isfinite(east)
    if not good.any():
        return math.inf
    middle = places.boots_us[:-1] + np.diff(places.boots_us) // 2
    with np.errstate(divide="ignore", invalid="ignore"):
        moved_n = np.diff(places.lat) * _METRES_PER_DEG / span_s
        turned_deg = np.remainder(np.diff(places.lon) + 180, 360) - 180
        moved_e = turned_deg * _METRES_PER_DEG * np.cos(np.radians(places.lat[:-1])) / span_s
    off = np.hypot(
        moved_n - np.interp(middle, times[good], north[good]), moved_e - np.interp(middle, times[good], east[good])
    )
    off = off[np.isfinite(off)]
    return float(np.median(off)) if off.size else math.inf


def _attitudes(rows: dict[str, list[Any]], missing: Missing) -> Iterator[Timed]:
    angles = np.radians(np.stack([_column(rows["ATT"], name) for name in ("Roll", "Pitch", "Yaw")], axis=-1))
    sound = [all(map(math.isfinite, row)) for row in angles.tolist()]
    turned = [from_euler(*row.tolist()) if good else (0.0,) * 4 for row, good in zip(angles, sound, strict=True)]
    yield from log_evidence.attitudes("ATT", _times(rows["ATT"]), np.array(turned).reshape(-1, 4), missing)


def _times(rows: list[Any]) -> NDArray[np.int64]:
    """Times since boot (µs); those of damaged messages as -1."""
    return np.array([row.TimeUS if 0 <= row.TimeUS < 2**62 else -1 for row in rows], dtype=np.int64)


def _column(rows: list[Any], name: str) -> Floats:
    """Values, NaN where the log has no such column."""
    return np.array([getattr(row, name, np.nan) for row in rows], dtype=np.float64)
