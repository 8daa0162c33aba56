"""One true path as the logs that an autopilot and a ground station would have written of it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from dappled.config.settings import PoseSettings, Settings
from dappled.daemon.navigation import ExposureTime
from dappled.daemon.replay.replay import RecordedTelemetry
from dappled.decode.geometry import Pose
from dappled.drivers.mavlink import mavlink, pack
from dappled.flight import TimeSource
from dappled.mocks.autopilot.path import FlightPath, TruePose

WEEK, WEEK_MS = 2445, 555_321_000  # GPS time
UTC_US = (315_964_800 + WEEK * 7 * 86400 - 18) * 10**6 + WEEK_MS * 1000
BOOT_US = 12_345_678  # of the path's time 0
SPAN_S, STEP_S = 6.0, 0.1
TIMES_S = (1.2345, 2.55, 3.777)  # of exposures, none at the time of a message
TYPES = {
    "POS": (10, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (11, "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "GPS": (12, "QBBIHBcLLe", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt"),
    "GPA": (13, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
    "XKF1": (14, "QBfff", "TimeUS,C,VN,VE,VD"),
    "XKF4": (17, "QBb", "TimeUS,C,PI"),
    "CAM": (15, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
    "TRIG": (16, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
}
Row = tuple[float, ...]
CODES = {"b": "b", "Q": "Q", "L": "i", "f": "f", "B": "B", "I": "I", "H": "H", "c": "h", "C": "H", "e": "i"}


def record(name: str, *values: float) -> bytes:
    number, form, _ = TYPES[name]
    return struct.pack("<BBB" + "".join(CODES[one] for one in form), 0xA3, 0x95, number, *values)


def rewritten(log: Path, change: Callable[[str, Row], Iterable[tuple[str, Row]]], columns: str = "") -> Path:
    """A .bin whose records are as `change` gives them; those of GPS have a further `columns` of one byte."""
    types = TYPES | {"GPS": (12, TYPES["GPS"][1] + "B", f"{TYPES['GPS'][2]},{columns}")} if columns else TYPES
    numbers, data, at = {number: name for name, (number, _, _) in TYPES.items()}, log.read_bytes(), len(formats())
    parts = [formats(types)]
    while at < len(data):
        name = numbers[data[at + 2]]
        form = "<" + "".join(CODES[one] for one in TYPES[name][1])
        for kind, row in change(name, struct.unpack_from(form, data, at + 3)):
            number, codes, _ = types[kind]
            parts.append(struct.pack("<BBB" + "".join(CODES[one] for one in codes), 0xA3, 0x95, number, *row))
        at += 3 + struct.calcsize(form)
    log.write_bytes(b"".join(parts))
    return log


def formats(types: Mapping[str, tuple[int, str, str]] = TYPES) -> bytes:
    def one(number: int, name: str, form: str, columns: str) -> bytes:
        length = 3 + struct.calcsize("<" + "".join(CODES.get(code, "x") for code in form))
        length = 89 if name == "FMT" else length
        return struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 0x80, number, length, name.encode(), form.encode(),
                           columns.encode())  # fmt: skip

    listed = [one(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    return b"".join([*listed, *(one(number, name, form, columns) for name, (number, form, columns) in types.items())])


def told(true: TruePose) -> tuple[int, int, float]:
    return round(true.latitude_deg * 1e7), round(true.longitude_deg * 1e7), true.altitude_msl_m


def angles(true: TruePose) -> tuple[float, float, float]:
    w, x, y, z = true.attitude
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(2 * (w * y - z * x)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def written(folder: Path, *, fix: int = 6, wrong_ms: tuple[int, ...] = (), drift: float = 0.0) -> tuple[Path, Path]:
    """The same flight as ArduPilot's .bin and as .tlog. In .bin the receiver's first messages are wrong by `wrong_ms`
    each, and UTC runs faster by `drift` than the autopilot's clock."""
    paths = folder / "00000012.bin", folder / "flight.tlog"
    for path, data in zip(paths, _logs(fix, wrong_ms, drift), strict=True):
        path.write_bytes(data)
    return paths


@cache
def _logs(fix: int, wrong_ms: tuple[int, ...], drift: float) -> tuple[bytes, bytes]:
    path = FlightPath(5)
    log, packets = [formats()], []
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for step in range(round(SPAN_S / STEP_S)):
        t_s = step * STEP_S
        at = BOOT_US + round(t_s * 1e6)
        true = path.pose(t_s)
        lat, lon, alt = told(true)
        up, (vn, ve, vd) = -true.position_ned_m[2], true.velocity_ned_m_s
        roll, pitch, yaw = angles(true)
        late_us = 130_000 if step % 7 else 0  # the receiver's message comes late, but for some
        log += [
            record("XKF1", at - 3_000, 0, vn, ve, vd),
            record("XKF1", at - 2_000, 1, 99.0, 99.0, 99.0),  # another core
            record("POS", at, lat, lon, alt, up, up),
            record("ATT", at, 0, math.degrees(roll), 0, math.degrees(pitch), 0, math.degrees(yaw) % 360),
            record(
                "GPS",
                at,
                0,
                fix,
                WEEK_MS
                + round(t_s * 1e3 * (1 + drift))
                - late_us // 1000
                + (wrong_ms[step] if step < len(wrong_ms) else 0),
                WEEK,
                19,
                70,
                lat,
                lon,
                round(alt * 100),
            ),
            record("GPA", at, 0, 110, 2, 3, 5),
        ]
        messages = [
            mavlink.MAVLink_global_position_int_message(
                at // 1000, lat, lon, round(alt * 1e3), round(up * 1e3), round(vn * 100), round(ve * 100),
                round(vd * 100), 65535,
            ),
            mavlink.MAVLink_attitude_quaternion_message(at // 1000, *true.attitude, *true.rates_body_rad_s),
            mavlink.MAVLink_gps_raw_int_message(
                at, 6, lat, lon, round(alt * 1e3), 70, 110, 65535, 65535, 19, 0, 20, 30, 50
            ),
        ]  # fmt: skip
        stamp_us = UTC_US + round(t_s * 1e6)
        packets += [struct.pack(">Q", stamp_us) + pack(message, packer, version_1=False) for message in messages]
    return b"".join(log), b"".join(packets)


ULOG_TYPES = {
    "vehicle_global_position": "uint64_t timestamp;uint64_t timestamp_sample;double lat;double lon;float alt;"
    "uint8_t[4] _padding0;",
    "vehicle_local_position": "uint64_t timestamp;uint64_t timestamp_sample;float vx;float vy;float vz;float z;",
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
    "home_position": "uint64_t timestamp;float alt;",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float eph;float epv;float hdop;float vdop;float s_variance_m_s;uint8_t fix_type;"
    "uint8_t satellites_used;",
    "camera_trigger": "uint64_t timestamp;uint64_t timestamp_utc;uint32_t seq;bool feedback;uint8_t[3] _padding0;",
}
OLDER_RECEIVER = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float eph;float epv;float hdop;"
    "float vdop;float s_variance_m_s;uint8_t fix_type;uint8_t satellites_used;"
)


def ulog_message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


def ulog_written(
    folder: Path,
    *,
    fix: int = 6,
    older: bool = False,
    late_us: int = 4_000,
    invalid: bool = False,
    ahead_us: int = 0,
    blended: bool = False,
    on_for_us: int = 0,
) -> Path:
    """The same flight as `written`, as PX4's .ulg: https://docs.px4.io/main/en/dev_log/ulog_file_format.html. Estimates
    are published `late_us` after they hold; `older`: the receiver's places as integers, as before PX4 1.14; `invalid`:
    beside each estimate stands one that is wrong and says so; `blended`: the receiver that counts tells no UTC, only
    `sensor_gps` does; all stamps are later by `on_for_us`; `ahead_us`: the receiver's UTC is that of a later time,
    and its messages say which."""
    path, home_m = FlightPath(5), 0.0
    types = ULOG_TYPES | ({"vehicle_gps_position": OLDER_RECEIVER} if older else {})
    if invalid:
        types["vehicle_global_position"] = types["vehicle_global_position"].replace(
            "uint8_t[4] _padding0;", "bool lat_lon_valid;bool alt_valid;"
        )
        types["vehicle_local_position"] += "bool v_xy_valid;bool v_z_valid;bool z_valid;"
    if blended:
        types["sensor_gps"] = types["vehicle_gps_position"]
    begins_us = BOOT_US + on_for_us
    if ahead_us:
        types["vehicle_gps_position"] += "int32_t timestamp_time_relative;"
    log = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", begins_us), ulog_message("B", bytes(40))]
    log += [ulog_message("F", f"{name}:{fields}".encode()) for name, fields in types.items()]
    numbers = {name: n for n, name in enumerate(types)}
    log += [ulog_message("A", struct.pack("<BH", 0, n) + name.encode()) for name, n in numbers.items()]
    log.append(ulog_message("A", struct.pack("<BH", 1, 9) + b"vehicle_local_position"))  # another estimator

    def data(name: str, form: str, *values: float) -> None:
        number = 9 if name == "other" else numbers[name]
        log.append(ulog_message("D", struct.pack("<H", number) + struct.pack("<" + form, *values)))

    for step in range(round(SPAN_S / STEP_S)):
        t_s = step * STEP_S
        at = begins_us + round(t_s * 1e6)
        true = path.pose(t_s)
        up, velocity = -true.position_ned_m[2], true.velocity_ned_m_s
        if step == 0:
            home_m = true.altitude_msl_m - up
            data("home_position", "Qf", at - 1_000_000, home_m)
        place = true.latitude_deg, true.longitude_deg
        if invalid:
            data("vehicle_local_position", "QQffff???", at + late_us, at, *velocity, -up, True, True, True)
            data("vehicle_local_position", "QQffff???", at + late_us, at + 9, 50.0, 9.0, 9.0, 0.0, False, True, True)
            data("vehicle_global_position", "QQddf??", at + late_us, at, *place, true.altitude_msl_m, True, True)
            data("vehicle_global_position", "QQddf??", at + late_us, at + 9, 41.0, -91.0, 99.0, step % 2, not step % 2)
        else:
            data("vehicle_local_position", "QQffff", at + late_us, at, *velocity, -up)
            data("vehicle_global_position", "QQddf", at + late_us, at, *place, true.altitude_msl_m)
        data("other", "QQffff", at + late_us, at, 99.0, 99.0, 99.0, 0.0)
        data("vehicle_attitude", "QQffff", at + late_us, at, *true.attitude)
        fixed_us = UTC_US + round(t_s * 1e6) - (130_000 if step % 7 else 0) + ahead_us
        quality = 0.02, 0.03, 0.70, 1.10, 0.05, fix, 19
        if older:
            whole = round(place[0] * 1e7), round(place[1] * 1e7), round(true.altitude_msl_m * 1e3)
            data("vehicle_gps_position", "QQiiifffffBB", at, fixed_us, *whole, *quality)
        else:
            relative = ("i", (ahead_us,)) if ahead_us else ("", ())
            exact = *place, true.altitude_msl_m
            told_us = 0 if blended else fixed_us
            data("vehicle_gps_position", "QQdddfffffBB" + relative[0], at, told_us, *exact, *quality, *relative[1])
            if blended:
                data("sensor_gps", "QQdddfffffBB", at, fixed_us, *exact, *quality)
    (folder / "10_15_03.ulg").write_bytes(b"".join(log))
    return folder / "10_15_03.ulg"


def add_triggers(log: Path, times_s: Mapping[int, float], name: str = "CAM", camera: int = 0) -> None:
    """Add ArduPilot's triggers (number: time on the path) of a camera to a .bin, as CAM or TRIG."""
    path = FlightPath(5)
    rows = []
    for number, t_s in times_s.items():
        lat, lon, alt = told(path.pose(t_s))
        high = (round(alt * 100),) * 3
        rows.append(record(name, BOOT_US + round(t_s * 1e6), camera, number, WEEK_MS, WEEK, lat, lon, *high, 0, 0, 0))
    log.write_bytes(log.read_bytes() + b"".join(rows))


def add_px4_triggers(log: Path, times_s: Mapping[int, float], *, contacts: bool = False) -> None:
    """Add PX4's triggers (number: time on the path) to a .ulg, or contacts of its feedback pin."""
    topic = list(ULOG_TYPES).index("camera_trigger")
    rows = [
        struct.pack("<HQQI?", topic, BOOT_US + round(t_s * 1e6), UTC_US + round(t_s * 1e6), number, contacts)
        for number, t_s in times_s.items()
    ]
    log.write_bytes(log.read_bytes() + b"".join(ulog_message("D", row) for row in rows))


def poses(path: Path) -> list[Pose]:
    telemetry = RecordedTelemetry(Settings(pose=PoseSettings(1000.0)), path, {})
    times = [UTC_US * 1000 + round(t_s * 1e9) for t_s in TIMES_S]
    return [telemetry.pose(n, ExposureTime(utc_ns, 1_000_000, TimeSource.REQUEST))[1] for n, utc_ns in enumerate(times)]


def same_fix(here: Pose, there: Pose) -> bool:
    """Whether two poses have the receiver's fix in common, to 1 ms of its age."""
    first, second = here.gnss, there.gnss
    if first is None or second is None or first.age_ms is None or second.age_ms is None:
        return False
    return abs(first.age_ms - second.age_ms) < 1 and replace(first, age_ms=second.age_ms) == second
