"""ArduPilot's own log gives the poses that the telemetry link gave: both are written here from one true path."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest

from dappled.daemon.navigation import ExposureTime
from dappled.daemon.replay.replay import RecordedTelemetry
from dappled.decode.geometry import Pose, metres_per_radian, turn_rad
from dappled.drivers.mavlink import dataflash, mavlink, pack
from dappled.drivers.mavlink.dataflash import DataFlashError
from dappled.mocks.autopilot.path import FlightPath, TruePose

WEEK, WEEK_MS = 2445, 555_321_000  # GPS time
UTC_US = (315_964_800 + WEEK * 7 * 86400 - 18) * 10**6 + WEEK_MS * 1000
BOOT_US = 12_345_678  # of the path's time 0
SPAN_S, STEP_S = 6.0, 0.1
TYPES = {
    "POS": (10, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (11, "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "GPS": (12, "QBBIHBcLLe", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt"),
    "GPA": (13, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
    "XKF1": (14, "QBfff", "TimeUS,C,VN,VE,VD"),
}
CODES = {"Q": "Q", "L": "i", "f": "f", "B": "B", "I": "I", "H": "H", "c": "h", "C": "H", "e": "i"}


def record(name: str, *values: float) -> bytes:
    number, form, _ = TYPES[name]
    return struct.pack("<BBB" + "".join(CODES[one] for one in form), 0xA3, 0x95, number, *values)


def formats() -> bytes:
    def one(number: int, name: str, form: str, columns: str) -> bytes:
        length = 3 + struct.calcsize("<" + "".join(CODES.get(code, "x") for code in form))
        length = 89 if name == "FMT" else length
        return struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 0x80, number, length, name.encode(), form.encode(),
                           columns.encode())  # fmt: skip

    listed = [one(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    return b"".join([*listed, *(one(number, name, form, columns) for name, (number, form, columns) in TYPES.items())])


def told(true: TruePose) -> tuple[int, int, float]:
    return round(true.latitude_deg * 1e7), round(true.longitude_deg * 1e7), true.altitude_msl_m


def angles(true: TruePose) -> tuple[float, float, float]:
    w, x, y, z = true.attitude
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(2 * (w * y - z * x)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def written(folder: Path, *, fix: int = 6) -> tuple[Path, Path]:
    """The same flight as .bin and as .tlog."""
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
                WEEK_MS + round(t_s * 1e3) - late_us // 1000,
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
    (folder / "00000012.bin").write_bytes(b"".join(log))
    (folder / "flight.tlog").write_bytes(b"".join(packets))
    return folder / "00000012.bin", folder / "flight.tlog"


def poses(path: Path) -> list[Pose]:
    telemetry = RecordedTelemetry(path, {}, wait_s=1.0)
    times = [UTC_US * 1000 + round(t_s * 1e9) for t_s in (1.2345, 2.5, 3.777)]
    return [telemetry.pose(n, ExposureTime(utc_ns, 1_000_000, "test"))[1] for n, utc_ns in enumerate(times)]


def test_both_logs_give_the_same_poses(tmp_path: Path) -> None:
    own, link = written(tmp_path)
    path = FlightPath(5)
    for here, there, t_s in zip(poses(own), poses(link), (1.2345, 2.5, 3.777), strict=True):
        true = path.pose(t_s)
        assert here.source == there.source == "interpolated"
        assert here.boot_us is not None
        assert there.boot_us is not None
        assert abs(here.boot_us - there.boot_us) < 1000
        assert abs(here.boot_us - BOOT_US - t_s * 1e6) < 1000
        assert here.latitude_rad is not None
        assert there.latitude_rad is not None
        assert here.longitude_rad is not None
        assert there.longitude_rad is not None
        north, east = metres_per_radian(here.latitude_rad, 220.0)
        assert abs(here.latitude_rad - there.latitude_rad) * north < 0.01
        assert abs(here.longitude_rad - there.longitude_rad) * east < 0.01
        assert here.altitude_msl_m == pytest.approx(there.altitude_msl_m, abs=0.01)
        assert abs(here.latitude_rad - math.radians(true.latitude_deg)) * north < 0.02
        assert here.attitude is not None
        assert turn_rad(here.attitude, true.attitude) < 2e-3
        assert here.gnss == there.gnss


def test_a_log_that_was_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    own, _ = written(tmp_path)
    own.write_bytes(own.read_bytes()[:-1000])
    assert poses(own)[2].source == "interpolated"


@pytest.mark.parametrize(
    ("data", "says"),
    [(formats(), "no fix of a satellite receiver"), (b"\xa3\x95\x80\x80" + bytes(400), "fix|damaged")],
)
def test_a_log_without_a_flight_is_one_sentence(data: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "1.bin"
    path.write_bytes(data)
    with pytest.raises(DataFlashError, match=says):
        list(dataflash.packets(path))


def test_a_log_without_a_fix_has_no_time(tmp_path: Path) -> None:
    own, _ = written(tmp_path, fix=1)
    with pytest.raises(DataFlashError, match="no fix"):
        list(dataflash.packets(own))
