"""Read PX4's own log (ULog, .ulg) as the MAVLink packets that a telemetry link would have carried.

Positions are `vehicle_global_position` with the velocities of `vehicle_local_position`, attitudes `vehicle_attitude`,
the receiver `vehicle_gps_position` (or `sensor_gps`). UTC comes from the receiver's time (`log_evidence.utc_clock`). https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

import importlib.util
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from dappled import durable
from dappled.decode.array_types import Floats
from dappled.drivers import reader_process
from dappled.drivers.mavlink import log_evidence, log_packets
from dappled.drivers.mavlink.log_evidence import (
    Chosen,
    LoggedPlaces,
    Missing,
    Receiver,
)
from dappled.drivers.mavlink.log_packets import AutopilotLogError, BootMap, LoggedTrigger, Timed, TriggerLog
from dappled.drivers.mavlink.sample_judge import FASTEST_M_S, HIGHEST_M
from dappled.drivers.reader_process import Budget
from dappled.drivers.utc_choice import ROLLOVER_NS, UtcBounds, rollovers
from dappled.errors import install_extra
from dappled.findings import Finding

_PLACES, _SPEEDS, _TURNS, _HOME = (
    "vehicle_global_position",
    "vehicle_local_position",
    "vehicle_attitude",
    "home_position",
)
_TRIGGERS, _CAPTURES = "camera_trigger", "camera_capture"
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
_BUDGET = Budget(bytes_a_second=1e6, ratio=16)  # pyulog reads some megabytes a second
_HEADER_BYTES = 16
_MESSAGE = struct.Struct("<HB")  # before each message: its length and its kind
_GAP_US = 1_000_000  # an estimate further away says no place

Columns = Mapping[str, Any]  # name of a field → its values (n,)


def packets(
    path: Path, report: Callable[[Finding], object] = lambda _: None, bounds: UtcBounds | None = None
) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time. `report` gets what is to be said of the log;
    `bounds` say which dates can be true (None: up to now). Raises AutopilotLogError."""
    missing = Missing()
    with log_packets.sound(path, "PX4"):
        log = _Topics.read(path, [_PLACES, _SPEEDS, _TURNS, _HOME])
        clock, counting, told = _clock(path, log, bounds)
        messages = [*_positions(path, log, missing), *_attitudes(path, log, missing)]
        for receiver, which in counting:
            messages += receiver.messages(which & receiver.fixed, clock)
        cut = _cut_short(durable.read_plain(path))
    log_packets.tell(path, [*told, *missing.findings(path)], report, cut=cut)
    yield from log_packets.packets(messages, clock)


def triggers(path: Path, _cam_idx: int = 0, bounds: UtcBounds | None = None) -> TriggerLog:
    """The camera's triggers (PX4 has one camera): camera_trigger, of which some may be contacts of a feedback pin, or
    without it camera_capture. Where nothing but contacts is logged, each of them is a trigger. Raises
    AutopilotLogError."""
    with log_packets.sound(path, "PX4"):
        log = _Topics.read(path, [_PLACES, _TRIGGERS, _CAPTURES])
        clock, _, _ = _clock(path, log, bounds)
        topics = log.first
        given = topics.get(_TRIGGERS, topics.get(_CAPTURES))
        found, contacts = [], None
        if given is not None and "seq" in given:
            at, numbers = log.times(given, "timestamp"), given["seq"].astype(np.int64)
            told = log_evidence.in_time(at)
            back = given["feedback"] != 0 if "feedback" in given else np.zeros(len(at), dtype=bool)
            contacts = int((told & back).sum()) if back.any() else None
            commanded = told & ~back
            found = [
                LoggedTrigger(int(numbers[n]), int(at[n]), _place_at(log, int(at[n])))
                for n in np.flatnonzero(commanded if commanded.any() else told)
            ]
        all_us = np.concatenate([clock.boots_us, *(log.times(topic, "timestamp") for topic in topics.values())])
        all_us = all_us[log_evidence.in_time(all_us)]
        ordered = tuple(sorted(found, key=lambda one: one.boot_us))
        return TriggerLog(
            "PX4", ordered, contacts, int(all_us.min()), int(all_us.max()), clock, f"{_TRIGGERS} or {_CAPTURES}"
        )


def _cut_short(data: bytes) -> bool:
    """Whether the last message (its length, its kind, its bytes) ends after the file does."""
    at = _HEADER_BYTES
    while at + _MESSAGE.size <= len(data):
        at += _MESSAGE.size + int(_MESSAGE.unpack_from(data, at)[0])
    return at != len(data)


def _place_at(log: _Topics, boot_us: int) -> tuple[float, float] | None:
    """Latitude and longitude (degrees) of the estimate nearest in time; None without one within a second."""
    topic = log.first.get(_PLACES)
    if topic is None or "lat" not in topic or "lon" not in topic:
        return None
    away = np.abs(log.sampled(topic) - boot_us)
    nearest = int(away.argmin())
    place = float(topic["lat"][nearest]), float(topic["lon"][nearest])
    sound = away[nearest] <= _GAP_US and abs(place[0]) <= 90 and abs(place[1]) <= 180
    return place if sound else None


@dataclass(frozen=True, slots=True)
class _Topics:
    """A log's topics: of the first instance each, and all of the receivers'. Stamps count from
    `begins_us` (see `log_evidence.begins_us`)."""

    first: Mapping[str, Columns]
    receivers: Mapping[str, Sequence[Columns]]
    begins_us: int

    @classmethod
    def read(cls, path: Path, names: Sequence[str]) -> Self:
        """A log that was cut off is read up to there."""
        opened = _opened(path, names)
        first = {name: data for (name, instance), data in opened.items() if instance == 0}
        receivers = {name: [opened[key] for key in sorted(opened) if key[0] == name] for name in _RECEIVERS}
        topics = (*first.values(), *(one for each in receivers.values() for one in each))
        begins_us = log_evidence.begins_us([topic["timestamp"].astype(np.float64) for topic in topics])
        return cls(first, receivers, begins_us)

    def times(self, topic: Columns, name: str) -> Any:
        """Times as int64; those of damaged messages, beyond 2^62, as -1."""
        given = topic[name]
        return np.where(given < 2**62, given, self.begins_us).astype(np.int64) - (given >= 2**62) - self.begins_us

    def sampled(self, topic: Columns) -> Any:
        """When each message's values were measured (µs since boot), int64 (n,): not when it was published, where that
        is known."""
        published = self.times(topic, "timestamp")
        if "timestamp_sample" not in topic:
            return published
        sampled = self.times(topic, "timestamp_sample")
        return np.where(topic["timestamp_sample"] > 0, sampled, published)


def _opened(path: Path, names: Sequence[str]) -> dict[tuple[str, int], dict[str, Any]]:
    """These topics and the receivers', by name and instance."""
    if importlib.util.find_spec("pyulog") is None:  # an extra; only this log needs it
        raise AutopilotLogError(f"{path} is a log of PX4, and that needs pyulog; {install_extra('ground')}")
    arrays, _ = reader_process.read(
        "dappled.drivers.mavlink.ulog_reader", path, (*names, *_RECEIVERS), library="pyulog", budget=_BUDGET
    )
    topics: dict[tuple[str, int], dict[str, Any]] = {}
    for name, values in arrays.items():
        topic, instance, field = name.split("/", 2)
        topics.setdefault((topic, int(instance)), {})[field] = values
    return topics


def _clock(
    path: Path, log: _Topics, bounds: UtcBounds | None
) -> tuple[BootMap, list[tuple[Receiver, Chosen]], list[Finding]]:
    """The autopilot's clock, the receiver's messages that count, and what is to be said of both. What PX4 chose or
    blended (`vehicle_gps_position`) counts where it has a fix, else the best of its receivers; UTC is of the first that
    has it. Raises AutopilotLogError without one."""
    needed = ("timestamp", "time_utc_usec", "fix_type", "satellites_used")
    given = [
        [
            _receiver(path, log, number, topic)
            for number, topic in enumerate(log.receivers[name], 1)
            if all(field in topic for field in needed)
        ]
        for name in _RECEIVERS
    ]
    merged, own = given
    if not merged and not own:
        raise AutopilotLogError(f"{path} holds no messages of a satellite receiver: its time in UTC is not known")
    counting, told = log_evidence.chosen(path, merged if any(one.fixed.any() for one in merged) else own or merged)
    clock, doubts = log_evidence.utc_clock(path, counting, [*merged, *own], bounds)
    return clock, log_evidence.in_turn(counting, own), [*told, *doubts]


def _receiver(path: Path, log: _Topics, number: int, topic: Columns) -> Receiver:
    boot_us, utc_us = log.times(topic, "timestamp"), topic["time_utc_usec"].astype(np.float64)
    # UTC is that of a time relative to the message's own, where the log says so.
    relative = topic.get("timestamp_time_relative")
    known = (utc_us > 0) & (utc_us < 2.0**53)
    utc_us = np.where(known, topic["time_utc_usec"], 0).astype(np.int64)
    if relative is not None:
        utc_us = np.where(known, utc_us - relative.astype(np.int64), 0)
    lat, lon, alt = _receiver_place(path, topic)
    return Receiver(
        number,
        boot_us,
        utc_us,
        topic["fix_type"].astype(np.int64),
        lat,
        lon,
        alt,
        topic["satellites_used"].astype(np.float64),
        _column(topic, "hdop"),
        _column(topic, "vdop"),
        np.stack([_column(topic, name) for name in ("eph", "epv", "s_variance_m_s")]),
        np.array([rollovers(one * 1000) * ROLLOVER_NS // 1000 for one in utc_us.tolist()], dtype=np.int64),
    )


def _receiver_place(path: Path, topic: Columns) -> tuple[Floats, Floats, Floats]:
    """Latitude and longitude (degrees) and height above mean sea level (m): integers before PX4 1.14, doubles since."""
    if "latitude_deg" in topic:
        names, scales = ("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0, 1.0)
    else:
        names, scales = ("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)
    if any(name not in topic for name in names):
        made = "in a form of PX4's: was it made by PX4?"
        raise AutopilotLogError(f"{path} holds no places of the satellite receiver {made}")
    first, second, third = (topic[name] * scale for name, scale in zip(names, scales, strict=True))
    return first, second, third


def _positions(path: Path, log: _Topics, missing: Missing) -> Iterator[Timed]:
    places, speeds = log.first.get(_PLACES), log.first.get(_SPEEDS)
    needed = ("lat", "lon", "alt")
    if (
        places is None
        or speeds is None
        or any(name not in places for name in needed)
        or any(name not in speeds for name in ("vx", "vy", "vz", "z"))
    ):
        raise AutopilotLogError(
            f"{path} holds no positions with velocities ({_PLACES} and {_SPEEDS}): log them (SDLOG_PROFILE, bit 0)"
        )
    at, times = log.sampled(places), log.sampled(speeds)
    moving = np.stack([_column(speeds, name) for name in ("vx", "vy", "vz", "z")])
    moving[3, ~_valid(speeds, "z_valid")] = np.nan  # then a height above home is known only where home is
    steady = _valid(speeds, "v_xy_valid", "v_z_valid")
    times, moving = times[steady], moving[:, steady]
    lat, lon, alt = (_column(places, name) for name in needed)
    above = _above_home(log, at, alt, _local_m(at, times, moving))
    sure = _valid(places, "lat_lon_valid", "alt_valid")
    shown = LoggedPlaces(_PLACES, *(part[sure] for part in (at, lat, lon, alt, above)))
    yield from log_evidence.positions(shown, _SPEEDS, times, moving[:3], missing)


def _local_m(at: Any, times: Any, moving: Floats) -> Floats:
    """The height above the local origin at some times (n,) m, NaN where it is not known within a second."""
    good = (
        log_evidence.in_time(times) & (np.abs(moving[3]) < HIGHEST_M) & (np.abs(moving[:3]) < FASTEST_M_S).all(axis=0)
    )
    times, down = times[good], moving[3, good]
    if not times.size:
        return np.full(len(at), np.nan)
    order = np.argsort(times, kind="stable")
    heights: Floats = -np.interp(at, times[order], down[order])
    return heights


def _above_home(log: _Topics, at: Any, alt: Floats, local_m: Floats) -> Floats:
    """Heights above the home position as it was set at the time, (n,) m; above the local origin where it was not set,
    as PX4 says over MAVLink."""
    topic = log.first.get(_HOME)
    if topic is None:
        return local_m
    set_at, homes = log.times(topic, "timestamp"), _column(topic, "alt")
    known = np.abs(homes) < HIGHEST_M
    if "valid_alt" in topic:  # before the first fix PX4 sets home without a height
        known &= topic["valid_alt"] != 0
    set_at, homes = set_at[known], homes[known]
    last = np.searchsorted(set_at, at, side="right") - 1
    return np.where(last >= 0, alt - np.append(homes, 0.0)[last], local_m)


def _attitudes(path: Path, log: _Topics, missing: Missing) -> Iterator[Timed]:
    topic = log.first.get(_TURNS)
    names = [f"q[{n}]" for n in range(4)]
    if topic is None or any(name not in topic for name in names):
        raise AutopilotLogError(f"{path} holds no attitudes ({_TURNS}): log them (SDLOG_PROFILE, bit 0)")
    turned = np.stack([_column(topic, name) for name in names], axis=-1)
    yield from log_evidence.attitudes(_TURNS, log.sampled(topic), turned, missing)


def _valid(topic: Columns, *flags: str) -> Any:
    """Where PX4's estimator says that these values hold (n,); everywhere by a version that has no such flag."""
    good = np.ones(len(topic["timestamp"]), dtype=bool)
    for flag in flags:
        good &= topic[flag] != 0 if flag in topic else True
    return good


def _column(topic: Columns, name: str) -> Floats:
    """Values as float64, NaN where PX4 had no such field."""
    length = len(topic["timestamp"])
    return topic[name].astype(np.float64) if name in topic else np.full(length, np.nan)
