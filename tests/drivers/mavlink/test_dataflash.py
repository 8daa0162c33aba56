"""ArduPilot's own log gives the poses that the telemetry link gave: both are written here from one true path."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from dappled.config.settings import PoseSettings, Settings
from dappled.daemon.navigation import ExposureTime
from dappled.daemon.replay.replay import RecordedTelemetry
from dappled.decode.geometry import metres_per_radian, turn_rad
from dappled.drivers.mavlink import dataflash, log_packets
from dappled.drivers.mavlink.log_packets import AutopilotLogError
from dappled.drivers.reader_process import Budget
from dappled.findings import Code, Finding, Level, text
from dappled.flight import TimeSource
from dappled.mocks.autopilot.path import FlightPath
from tests.drivers.mavlink.true_logs import (
    BOOT_US,
    SPAN_S,
    TIMES_S,
    UTC_US,
    formats,
    poses,
    same_fix,
    ulog_written,
    written,
)


def test_both_logs_give_the_same_poses(tmp_path: Path) -> None:
    own, link = written(tmp_path)
    path = FlightPath(5)
    for here, there, t_s in zip(poses(own), poses(link), TIMES_S, strict=True):
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
        assert same_fix(here, there)


def test_a_log_that_was_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    own, _ = written(tmp_path)
    own.write_bytes(own.read_bytes()[:-1000])
    assert poses(own)[2].source == "interpolated"


@pytest.mark.parametrize("form", ["bin", "ulg", "tlog"])
@pytest.mark.usefixtures("logs_read_here")
@pytest.mark.parametrize("cut", [0, 1, 2, 5])
def test_a_log_that_was_cut_short_is_told_of(form: str, cut: int, tmp_path: Path) -> None:
    if form == "ulg":
        pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
        log = ulog_written(tmp_path)
    else:
        log = written(tmp_path)[form == "tlog"]
    data = log.read_bytes()
    log.write_bytes(data[: len(data) - cut])
    for at_s, level in ((SPAN_S, Level.CAUTION), (SPAN_S / 2, Level.NOTE)):
        telemetry = RecordedTelemetry(Settings(pose=PoseSettings(9000.0)), log, {})
        telemetry.pose(0, ExposureTime((UTC_US + round(at_s * 1e6)) * 1000, 1_000_000, TimeSource.REQUEST))
        told = telemetry.findings()
        if at_s == SPAN_S or form != "tlog":  # a link's log is not read on after its frames
            assert len(told) == (cut > 0)
        assert all(one.subject.which == str(log) and one.level is level for one in told)
        assert all("cut short" in str(text(one)) or "at the end" in str(text(one)) for one in told)


@pytest.mark.parametrize(
    ("data", "says"),
    [(formats(), "no fix of a satellite receiver"), (b"\xa3\x95\x80\x80" + bytes(400), "fix|damaged")],
)
def test_a_log_without_a_flight_is_one_sentence(data: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "1.bin"
    path.write_bytes(data)
    with pytest.raises(AutopilotLogError, match=says):
        list(dataflash.packets(path))


def test_a_log_without_a_fix_has_no_time(tmp_path: Path) -> None:
    own, _ = written(tmp_path, fix=1)
    with pytest.raises(AutopilotLogError, match="no fix"):
        list(dataflash.packets(own))


def test_receiver_messages_with_a_wrong_time_move_no_others(tmp_path: Path) -> None:
    own, _ = written(tmp_path, wrong_ms=(2_000, -18_000, 86_400_000))
    stamps = [stamp_us for _, stamp_us, _ in dataflash.packets(own)]
    assert abs(stamps[0] - UTC_US) < 1000
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("steps", "off_s"),
    [
        (5, -37),
        (40, 3600),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((5, 1), (20, -37), (20, 3600), (40, 1))),
    ],
)
def test_a_receiver_whose_time_is_put_right_counts_as_it_says_from_then_on(
    tmp_path: Path, steps: int, off_s: int
) -> None:
    own, _ = written(tmp_path, wrong_ms=(1000 * off_s,) * steps)
    told: list[Finding] = []
    stamps = [stamp_us for _, stamp_us, _ in dataflash.packets(own, told.append)]
    assert abs(stamps[0] - UTC_US) < 1000
    assert stamps == sorted(stamps)
    assert [(one.code, round(float(str(one.facts["off_s"])))) for one in told] == (
        [] if steps == 5 else [(Code.TIME_PUT_RIGHT, off_s)]
    )


@pytest.mark.parametrize(
    "wrong_ms", [(0, 1_000) * 30, (0,) * 20 + (1_000,) * 20, (0,) * 30 + tuple(range(1_000, 31_000, 1_000))]
)
def test_a_receiver_whose_time_goes_on_changing_is_refused(tmp_path: Path, wrong_ms: tuple[int, ...]) -> None:
    own, _ = written(tmp_path, wrong_ms=wrong_ms)
    with pytest.raises(
        AutopilotLogError, match=r"00000012\.bin: the receiver's time in UTC changes by [0-9.]+ s .*\.tlog"
    ):
        list(dataflash.packets(own))


def test_the_drift_of_the_autopilots_clock_is_followed() -> None:
    boots_us = np.arange(0, 1800 * 10**6, 200_000)
    late_us = np.random.default_rng(1).integers(0, 120_000, len(boots_us))
    drifted_us = 50e-6 * boots_us
    clock = log_packets.log_clock(boots_us, UTC_US + np.round(drifted_us).astype(np.int64) - late_us)
    errors_us = [
        clock.utc_us(int(boot)) - UTC_US - boot - late for boot, late in zip(boots_us, drifted_us, strict=True)
    ]
    assert max(errors_us) < 1000
    assert min(errors_us) > -6_000


def test_a_log_of_holes_is_judged_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "1.bin"
    path.write_bytes(b"\xa3\x95\x80\x80")
    with path.open("ab") as file:
        file.truncate(1 << 40)
    with pytest.raises(AutopilotLogError, match=r"1\.bin.*its content would take"):
        list(dataflash.packets(path))


def of_nothing(count: int) -> bytes:
    """A log of messages that hold nothing, three bytes each: pymavlink takes some hundred times as much for each."""
    told = ((0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"), (0x81, 3, b"GPS", b"", b""))
    heads = [b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *one) for one in told]
    return b"".join(heads) + b"\xa3\x95\x81" * count


@pytest.mark.parametrize(
    ("budget", "says"),
    [
        (Budget(1e9, patience_s=1.0), "come to an end"),
        (Budget(1e9, memory=1 << 22, ratio=0), "more memory"),
    ],
    ids=["time", "memory"],
)
def test_a_log_that_is_made_to_exhaust_the_machine_is_one_sentence(
    budget: Budget, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataflash, "_BUDGET", budget)
    path = tmp_path / "1.bin"
    path.write_bytes(of_nothing(300_000))
    with pytest.raises(AutopilotLogError, match=rf"1\.bin is damaged .*({says})"):
        list(dataflash.packets(path))
