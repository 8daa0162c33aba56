"""Read PX4's own log (ULog, .ulg) as the MAVLink packets that a telemetry link would have carried.

Positions are `vehicle_global_position` with the velocities of `vehicle_local_position`, attitudes `vehicle_attitude`,
the receiver `vehicle_gps_position` (or `sensor_gps`). UTC comes from the receiver's time (`log_packets.log_clock`). https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

import contextlib
import errno
import io
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dappled import durable
from dappled.decode.array_types import Floats
from dappled.drivers.mavlink import log_packets
from dappled.drivers.mavlink.log_packets import (
    FIX_3D,
    AutopilotLogError,
    LogClock,
    LoggedTrigger,
    ReceiverFix,
    Timed,
    TriggerLog,
)
from dappled.errors import first_line, install_extra

_PLACES, _SPEEDS, _TURNS, _HOME = (
    "vehicle_global_position",
    "vehicle_local_position",
    "vehicle_attitude",
    "home_position",
)
_TRIGGERS, _CAPTURES = "camera_trigger", "camera_capture"
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
_EXTRAPOLATED = 8  # of PX4; MAVLink's 8 is another
_HEADER_BYTES = 16
_MESSAGE = struct.Struct("<HB")  # before each message: its length and its kind
_GAP_US = 1_000_000  # a velocity further away is not that of a position
_BOOT_MAX_US = 2**32 * 1000  # MAVLink's milliseconds since boot
_EPOCH_US = 1_483_228_800 * 10**6  # 2017: a receiver that says an earlier time doesn't know it yet
_MOST_M = 100_000.0
_MOST_M_S = 300.0
_HIGHEST_DOP = 600.0

Columns = Mapping[str, Any]  # name of a field → its values (n,)


class ULogError(AutopilotLogError):
    """A log of PX4 can't be used; one sentence."""


def packets(path: Path, report: Callable[[str], object] = lambda _: None) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time. `report` gets a sentence where the log was cut
    short. Raises ULogError."""
    with _sound(path):
        topics = _topics(path, [_PLACES, _SPEEDS, _TURNS, _HOME])
        found = next((topics[name] for name in _RECEIVERS if name in topics), None)
        fixes, clock = _fixes(path, found)
        messages = [*_positions(path, topics), *_attitudes(path, topics)]
        for fix in fixes:
            messages += log_packets.receiver(fix, clock)
        if _cut_short(path.read_bytes()):
            report(f"{path}: {log_packets.CUT_SHORT}")
    yield from log_packets.packets(messages, clock)


def triggers(path: Path) -> TriggerLog:
    """The camera's triggers: camera_trigger, of which some may be contacts of a feedback pin, or without it
    camera_capture. Raises ULogError."""
    with _sound(path):
        topics = _topics(path, [_PLACES, _TRIGGERS, _CAPTURES])
        _, clock = _fixes(path, next((topics[name] for name in _RECEIVERS if name in topics), None))
        given = topics.get(_TRIGGERS, topics.get(_CAPTURES))
        if given is None or "seq" not in given:
            raise ULogError(
                f"{path} holds no trigger ({_TRIGGERS} or {_CAPTURES}): was TRIG_MODE set, and are they logged?"
            )
        at, numbers = _times(given, "timestamp"), given["seq"].astype(np.int64)
        told = _within(at, 0, _BOOT_MAX_US)
        back = given["feedback"] != 0 if "feedback" in given else np.zeros(len(at), dtype=bool)
        found = [
            LoggedTrigger(int(numbers[n]), int(at[n]), _place_at(topics.get(_PLACES), int(at[n])))
            for n in np.flatnonzero(told & ~back)
        ]
        if not found:
            raise ULogError(
                f"{path} holds no trigger ({_TRIGGERS}), only contacts of a feedback pin: nothing to compare"
            )
        all_us = np.concatenate([_times(topic, "timestamp") for topic in topics.values()])
        all_us = all_us[_within(all_us, 0, _BOOT_MAX_US)]
        contacts = int((told & back).sum()) if back.any() else None
        ordered = tuple(sorted(found, key=lambda one: one.boot_us))
        return TriggerLog("PX4", ordered, contacts, int(all_us.min()), int(all_us.max()), clock)


@contextlib.contextmanager
def _sound(path: Path) -> Iterator[None]:
    """What damage left of a topic is used, or is one sentence."""
    try:
        yield
    except (ValueError, TypeError, KeyError, IndexError, ArithmeticError) as error:
        raise ULogError(f"{path} is damaged as a log of PX4 ({first_line(error)}): copy it again") from None


def _cut_short(data: bytes) -> bool:
    """Whether the last message (its length, its kind, its bytes) ends after the file does."""
    at = _HEADER_BYTES
    while at + _MESSAGE.size <= len(data):
        at += _MESSAGE.size + int(_MESSAGE.unpack_from(data, at)[0])
    return at != len(data)


def _place_at(topic: Columns | None, boot_us: int) -> tuple[float, float] | None:
    """Latitude and longitude (degrees) of the estimate nearest in time; None without one within a second."""
    if topic is None or "lat" not in topic or "lon" not in topic:
        return None
    away = np.abs(_sampled(topic) - boot_us)
    nearest = int(away.argmin())
    place = float(topic["lat"][nearest]), float(topic["lon"][nearest])
    sound = away[nearest] <= _GAP_US and abs(place[0]) <= 90 and abs(place[1]) <= 180
    return place if sound else None


def _topics(path: Path, names: Sequence[str]) -> dict[str, Columns]:
    """These topics and the receiver's, of the first instance each. A log that was cut off is read up to there."""
    try:
        from pyulog import ULog  # noqa: PLC0415  an extra; only this log needs it
        from pyulog.exceptions import ULogException  # noqa: PLC0415
    except ImportError:
        raise ULogError(f"{path} is a log of PX4, and that needs pyulog; {install_extra('ground')}") from None
    wanted = [*names, *_RECEIVERS]
    try:
        with open(path, "rb", opener=durable.without_waiting) as file, contextlib.redirect_stdout(io.StringIO()):
            log = ULog(file, wanted)  # it prints what it skips
    except OSError as error:
        if error.errno != errno.EINVAL:  # pyulog seeks to before the start of a file in which nothing makes sense
            raise ULogError(f"{path} can't be read: {error.strerror}") from None
        raise ULogError(f"{path} is damaged as a log of PX4 (cut off, or not one): copy it again") from None
    except (
        ULogException,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        RecursionError,
        struct.error,
    ) as error:
        raise ULogError(f"{path} is damaged as a log of PX4 ({first_line(error)}): copy it again") from None
    return {one.name: one.data for one in reversed(log.data_list) if one.multi_id == 0}


def _fixes(path: Path, topic: Columns | None) -> tuple[list[ReceiverFix], LogClock]:
    """The receiver's fixes, and the autopilot's clock by them. Raises ULogError without one."""
    needed = ("timestamp", "time_utc_usec", "fix_type", "satellites_used")
    if topic is None or any(name not in topic for name in needed):
        raise ULogError(f"{path} holds no messages of a satellite receiver: its time in UTC is not known")
    boot_us, utc_us = _times(topic, "timestamp"), topic["time_utc_usec"].astype(np.float64)
    lat, lon, alt = _receiver_place(path, topic)
    good = (
        _within(boot_us, 0, _BOOT_MAX_US)
        & (topic["fix_type"] >= FIX_3D)
        & (topic["fix_type"] < _EXTRAPOLATED)
        & _placed(lat, lon, alt)
    )
    timed = good & (utc_us > _EPOCH_US) & (utc_us < 2.0**53)
    if not timed.any():
        raise ULogError(f"{path} holds no fix of a satellite receiver: its time in UTC is not known")
    # UTC is that of a time relative to the message's own, where the log says so.
    relative = topic.get("timestamp_time_relative")
    held_us = boot_us if relative is None else boot_us + relative.astype(np.int64)
    offsets_us = topic["time_utc_usec"][timed].astype(np.int64) - held_us[timed]
    try:
        clock = log_packets.log_clock(boot_us[timed], offsets_us)
    except AutopilotLogError as error:
        raise ULogError(f"{path}: {error}") from None
    vertical = _column(topic, "vdop")
    accuracies = np.stack([_column(topic, name) for name in ("eph", "epv", "s_variance_m_s")])
    fixes = []
    for n in np.flatnonzero(good):
        hdop = float(_column(topic, "hdop")[n])
        accuracy = accuracies[:, n]
        known = bool(_within(accuracy, 0, _MOST_M).all())
        fixes.append(
            ReceiverFix(
                int(boot_us[n]),
                int(topic["fix_type"][n]),
                float(lat[n]),
                float(lon[n]),
                float(alt[n]),
                min(254, int(topic["satellites_used"][n])),
                hdop if 0 <= hdop < _HIGHEST_DOP else 0.0,
                float(vertical[n]) if 0 < vertical[n] < _HIGHEST_DOP else None,
                (float(accuracy[0]), float(accuracy[1]), float(accuracy[2])) if known else None,
            )
        )
    return fixes, clock


def _receiver_place(path: Path, topic: Columns) -> tuple[Floats, Floats, Floats]:
    """Latitude and longitude (degrees) and height above mean sea level (m): integers before PX4 1.14, doubles since."""
    if "latitude_deg" in topic:
        names, scales = ("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0, 1.0)
    else:
        names, scales = ("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)
    if any(name not in topic for name in names):
        raise ULogError(f"{path} holds no places of the satellite receiver in a form of PX4's: was it made by PX4?")
    first, second, third = (topic[name] * scale for name, scale in zip(names, scales, strict=True))
    return first, second, third


def _positions(path: Path, topics: Mapping[str, Columns]) -> Iterator[Timed]:
    places, speeds = topics.get(_PLACES), topics.get(_SPEEDS)
    needed = ("lat", "lon", "alt")
    if (
        places is None
        or speeds is None
        or any(name not in places for name in needed)
        or any(name not in speeds for name in ("vx", "vy", "vz", "z"))
    ):
        raise ULogError(
            f"{path} holds no positions with velocities ({_PLACES} and {_SPEEDS}): log them (SDLOG_PROFILE, bit 0)"
        )
    at, times = _sampled(places), _sampled(speeds)
    moving = np.stack([_column(speeds, name) for name in ("vx", "vy", "vz", "z")])
    steady = _within(times, 0, _BOOT_MAX_US) & (np.abs(moving[:3]) < _MOST_M_S).all(axis=0)
    steady &= _valid(speeds, "v_xy_valid", "v_z_valid")
    moving[3, ~_valid(speeds, "z_valid")] = np.nan  # then a height above home is known only where home is
    order = np.argsort(times[steady], kind="stable")
    times, moving = times[steady][order], moving[:, steady][:, order]
    lat, lon, alt = (_column(places, name) for name in needed)
    if not times.size:
        return
    above = _above_home(topics.get(_HOME), at, alt, -np.interp(at, times, moving[3]))
    usable = _within(at, 0, _BOOT_MAX_US) & _placed(lat, lon, alt) & (np.abs(above) < _MOST_M)
    for n in np.flatnonzero(usable & _valid(places, "lat_lon_valid", "alt_valid")):
        if np.abs(times - at[n]).min() > _GAP_US:
            continue
        north, east, down = (float(np.interp(at[n], times, speed)) for speed in moving[:3])
        place = float(lat[n]), float(lon[n]), float(alt[n])
        yield log_packets.position(int(at[n]), place, float(above[n]), (north, east, down))


def _above_home(topic: Columns | None, at: Any, alt: Floats, local_m: Floats) -> Floats:
    """Heights above the home position as it was set at the time, (n,) m; above the local origin where it was not set,
    as PX4 says over MAVLink."""
    if topic is None:
        return local_m
    set_at, homes = _times(topic, "timestamp"), _column(topic, "alt")
    known = np.abs(homes) < _MOST_M
    if "valid_alt" in topic:  # before the first fix PX4 sets home without a height
        known &= topic["valid_alt"] != 0
    set_at, homes = set_at[known], homes[known]
    last = np.searchsorted(set_at, at, side="right") - 1
    return np.where(last >= 0, alt - np.append(homes, 0.0)[last], local_m)


def _attitudes(path: Path, topics: Mapping[str, Columns]) -> Iterator[Timed]:
    topic = topics.get(_TURNS)
    names = [f"q[{n}]" for n in range(4)]
    if topic is None or any(name not in topic for name in names):
        raise ULogError(f"{path} holds no attitudes ({_TURNS}): log them (SDLOG_PROFILE, bit 0)")
    at = _sampled(topic)
    turned = np.stack([_column(topic, name) for name in names], axis=-1)
    for n in np.flatnonzero(_within(at, 0, _BOOT_MAX_US)):
        w, x, y, z = turned[n].tolist()
        yield log_packets.attitude(int(at[n]), (w, x, y, z))


def _valid(topic: Columns, *flags: str) -> Any:
    """Where PX4's estimator says that these values hold (n,); everywhere by a version that has no such flag."""
    good = np.ones(len(topic["timestamp"]), dtype=bool)
    for flag in flags:
        good &= topic[flag] != 0 if flag in topic else True
    return good


def _sampled(topic: Columns) -> Any:
    """When each message's values were measured (µs since boot), int64 (n,): not when it was published, where that is
    known."""
    published = _times(topic, "timestamp")
    if "timestamp_sample" not in topic:
        return published
    sampled = _times(topic, "timestamp_sample")
    return np.where(sampled > 0, sampled, published)


def _times(topic: Columns, name: str) -> Any:
    """Times as int64; those of damaged messages, beyond 2^62, as -1."""
    given = topic[name]
    return np.where(given < 2**62, given, 0).astype(np.int64) - (given >= 2**62)


def _column(topic: Columns, name: str) -> Floats:
    """Values as float64, NaN where PX4 had no such field."""
    length = len(topic["timestamp"])
    return topic[name].astype(np.float64) if name in topic else np.full(length, np.nan)


def _within(values: Any, low: float, high: float) -> Any:
    return (values >= low) & (values < high)


def _placed(lat: Floats, lon: Floats, alt: Floats) -> Any:
    return (np.abs(lat) <= 90) & (np.abs(lon) <= 180) & (np.abs(alt) < _MOST_M)
