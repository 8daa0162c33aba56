"""PX4's own log gives the poses that ArduPilot's log and the telemetry link give of one true path."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest

from dappled.decode.geometry import metres_per_radian, turn_rad
from dappled.drivers.mavlink import ulog
from dappled.drivers.mavlink.log_packets import AutopilotLogError
from dappled.drivers.reader_process import Budget
from dappled.mocks.autopilot.path import FlightPath
from tests.drivers.mavlink.true_logs import (
    BOOT_US,
    TIMES_S,
    ULOG_TYPES,
    UTC_US,
    poses,
    same_fix,
    ulog_message,
    ulog_written,
    written,
)

pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")


@pytest.mark.parametrize("older", [False, True])
def test_three_logs_give_the_same_poses(tmp_path: Path, older: bool) -> None:
    own, link = written(tmp_path)
    path = FlightPath(5)
    logs = poses(ulog_written(tmp_path, older=older)), poses(own), poses(link)
    for here, *others, t_s in zip(*logs, TIMES_S, strict=True):
        true = path.pose(t_s)
        assert here.source == "interpolated"
        assert here.boot_us is not None
        assert here.latitude_rad is not None
        assert here.longitude_rad is not None
        assert here.altitude_msl_m is not None
        assert here.height_above_home_m is not None
        assert here.attitude is not None
        north, east = metres_per_radian(here.latitude_rad, 220.0)
        for there in others:
            assert there.boot_us is not None
            assert there.latitude_rad is not None
            assert there.longitude_rad is not None
            assert abs(here.boot_us - there.boot_us) < 1000
            assert abs(here.latitude_rad - there.latitude_rad) * north < 0.01
            assert abs(here.longitude_rad - there.longitude_rad) * east < 0.01
            assert here.altitude_msl_m == pytest.approx(there.altitude_msl_m, abs=0.01)
            assert here.height_above_home_m == pytest.approx(there.height_above_home_m, abs=0.01)
            assert same_fix(here, there)
        assert abs(here.boot_us - BOOT_US - t_s * 1e6) < 1000
        assert abs(here.latitude_rad - math.radians(true.latitude_deg)) * north < 0.02
        assert turn_rad(here.attitude, true.attitude) < 2e-3


def test_a_log_that_was_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    own = ulog_written(tmp_path)
    own.write_bytes(own.read_bytes()[:-1001])
    assert poses(own)[2].source == "interpolated"


def test_damaged_messages_are_left_out(tmp_path: Path) -> None:
    own = ulog_written(tmp_path)
    place = struct.pack("<HQQddf", 0, 2**64 - 1, 2**64 - 1, math.nan, 1e300, 3e38)
    turn = struct.pack("<HQQffff", 2, 2**40 * 10**6, 0, *(4 * [math.inf]))
    speed = struct.pack("<HQQffff", 1, BOOT_US, BOOT_US, 1e38, 0.0, 0.0, 0.0)
    own.write_bytes(own.read_bytes() + b"".join(ulog_message("D", one) for one in (place, turn, speed)))
    assert poses(own) == poses(ulog_written(tmp_path))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "holds no messages of a satellite receiver"),
        (ulog_message("B", bytes(40)) + bytes(400), "holds no messages of a satellite receiver"),
        (struct.pack("<HB", 60_000, ord("D")) + bytes(30), "damaged as a log of PX4 .*copy it again"),
        (ulog_message("F", b"a:b c;") + ulog_message("F", b"vehicle_attitude:vehicle_attitude a;")
         + ulog_message("A", struct.pack("<BH", 0, 1) + b"vehicle_attitude"), "damaged|no messages"),
    ],
)  # fmt: skip
def test_a_log_without_a_flight_is_one_sentence(data: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "1.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + data)
    with pytest.raises(AutopilotLogError, match=f"1.ulg.*({says})"):
        list(ulog.packets(path))


def test_a_log_without_a_fix_has_no_time(tmp_path: Path) -> None:
    with pytest.raises(AutopilotLogError, match="no fix"):
        list(ulog.packets(ulog_written(tmp_path, fix=1)))


def test_utc_is_that_of_the_message_with_the_least_delay(tmp_path: Path) -> None:
    stamps = [stamp_us for _, stamp_us, _ in ulog.packets(ulog_written(tmp_path))]
    assert stamps[0] == UTC_US
    assert stamps == sorted(stamps)


def test_one_receiver_message_with_a_wrong_time_moves_no_other(tmp_path: Path) -> None:
    own = ulog_written(tmp_path)
    number = list(ULOG_TYPES).index("vehicle_gps_position")
    body = struct.pack("<H", number) + struct.pack(
        "<QQdddfffffBB", BOOT_US + 500_000, UTC_US + 2_500_000, 41.6, -91.5, 220.0, 0.02, 0.03, 0.7, 1.1, 0.05, 6, 19
    )
    own.write_bytes(own.read_bytes() + ulog_message("D", body))
    stamps = [stamp_us for _, stamp_us, _ in ulog.packets(own)]
    assert stamps[0] == UTC_US


def test_estimates_that_px4_calls_invalid_are_left_out(tmp_path: Path) -> None:
    good = poses(ulog_written(tmp_path))
    assert poses(ulog_written(tmp_path, invalid=True)) == good


def test_utc_holds_at_the_time_that_the_receivers_message_says(tmp_path: Path) -> None:
    stamps = [stamp_us for _, stamp_us, _ in ulog.packets(ulog_written(tmp_path, ahead_us=40_000))]
    assert stamps[0] == UTC_US


def nested(levels: int) -> bytes:
    """A log of a few hundred bytes whose topic has 8 to the power of `levels` fields: formats within formats."""
    formats = [f"l{n}:" + "".join(f"l{n + 1} {field};" for field in "abcdefgh") for n in range(levels)]
    formats += [f"l{levels}:uint8_t a;", "vehicle_attitude:uint64_t timestamp;l0 a;"]
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    return head + b"".join(ulog_message("F", one.encode()) for one in formats) + ulog_message(
        "A", struct.pack("<BH", 0, 1) + b"vehicle_attitude"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("data", "budget", "says"),
    [
        (nested(8), Budget(1e6, memory=1 << 27), "has more than 10000 fields"),
        (b"ULog\x01\x12\x35\x01" + bytes(600_000), Budget(1e9, patience_s=1.0), "not come to an end|no messages"),
    ],
    ids=["formats in formats", "zeros"],
)
def test_a_log_that_is_made_to_exhaust_the_machine_is_one_sentence(
    data: bytes, budget: Budget, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ulog, "_BUDGET", budget)
    path = tmp_path / "1.ulg"
    path.write_bytes(data)
    assert len(data) < 1000 or not any(data[8:])
    with pytest.raises(AutopilotLogError, match=f"1.ulg.*({says})"):
        list(ulog.packets(path))
