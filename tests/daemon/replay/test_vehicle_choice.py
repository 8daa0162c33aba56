"""Whose telemetry counts, where a .tlog holds that of several vehicles."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from PIL import Image

from dappled.cli import main
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.flight.log_reading import split
from tests.daemon.replay.two_vehicles import (
    Extra,
    camera_of_2,
    camera_of_both,
    feedback_of_2,
    nothing_more,
    records,
)

STAMP_US = 1_795_256_103 * 10**6


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    (tmp_path / "frames").mkdir()
    Image.new("RGB", (16, 16)).save(tmp_path / "frames" / "1.jpg")
    return tmp_path / "frames"


def logged(folder: Path, *, extra: Extra = nothing_more, moving: tuple[int, ...] = (), version_1: bool = False) -> Path:
    log = folder / "flight.tlog"
    found = records(STAMP_US, extra=extra, moving=moving, version_1=version_1)
    log.write_bytes(b"".join(struct.pack(">Q", stamp_us) + raw for stamp_us, raw in found))
    return log


def north_deg(capsys: pytest.CaptureFixture[str]) -> float:
    return round(float(json.loads(capsys.readouterr().out)["tag"]["pose"]["latitude_rad"]) * 57.29577951, 1)


@pytest.mark.parametrize("version_1", [False, True])
def test_of_two_vehicles_that_nothing_tells_apart_none_is_taken(
    frames: Path, capsys: pytest.CaptureFixture[str], version_1: bool
) -> None:
    log = logged(frames.parent, version_1=version_1)
    assert main(["replay", str(frames), "--telemetry", str(log)]) == 1
    said = capsys.readouterr().err
    assert "vehicles 1 and 2" in said
    assert "--vehicle" in said
    for vehicle in (1, 2):
        assert main(["replay", str(frames), "--telemetry", str(log), "--vehicle", str(vehicle), "--json"]) == 0
        assert north_deg(capsys) == vehicle * 10.0
    assert main(["replay", str(frames), "--telemetry", str(log), "--vehicle", "3"]) == 2
    assert "no positions of vehicle 3: it holds vehicles 1 and 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("extra", "moving", "by"),
    [
        (camera_of_2, (1,), "camera"),
        (feedback_of_2, (), "camera"),
        (nothing_more, (2,), "movement"),
        (camera_of_both, (2,), "movement"),
    ],
)
def test_evidence_says_which_vehicle_counts(
    frames: Path, capsys: pytest.CaptureFixture[str], extra: Extra, moving: tuple[int, ...], by: str
) -> None:
    log = logged(frames.parent, extra=extra, moving=moving)
    assert main(["replay", str(frames), "--telemetry", str(log), "--json"]) == 0
    shown = capsys.readouterr()
    assert f"vehicle 2 counts, by its {by}; vehicle 1 is in it too" in shown.err
    frame, found = map(json.loads, shown.out.splitlines())
    assert round(float(frame["tag"]["pose"]["latitude_rad"]) * 57.29577951, 1) == 20.0
    assert [(one["code"], one["facts"]["by"]) for one in found["findings"]] == [("log.vehicle", by)]


@pytest.mark.parametrize("camera", [True, False])
def test_of_three_vehicles_the_one_that_reports_a_camera_counts(
    frames: Path, capsys: pytest.CaptureFixture[str], camera: bool
) -> None:
    def third(step: int) -> list[tuple[int, int, MavlinkMessage]]:
        there = mavlink.MAVLink_global_position_int_message(9000 + step * 100, 3 * 10**8, 0, 10**5, 10**4, 0, 0, 0, 0)
        return [(3, 1, there), *(camera_of_2(step) if camera else [])]

    log = logged(frames.parent, extra=third)
    assert main(["replay", str(frames), "--telemetry", str(log), "--json"]) == (0 if camera else 1)
    shown = capsys.readouterr()
    assert ("vehicle 2 counts, by its camera" if camera else "vehicles 1, 2 and 3") in shown.err
    for vehicle in (1, 2, 3):
        assert main(["replay", str(frames), "--telemetry", str(log), "--vehicle", str(vehicle), "--json"]) == 0
        assert north_deg(capsys) == vehicle * 10.0


def test_a_vehicle_can_t_be_chosen_without_telemetry(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(frames), "--vehicle", "2"]) == 2
    assert "there is no telemetry; leave it out" in capsys.readouterr().err


def test_an_antenna_tracker_is_no_vehicle(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def tracker(step: int) -> list[tuple[int, int, MavlinkMessage]]:
        return [(1, 1, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ANTENNA_TRACKER, 3, 0, 0, 4, 3))]

    log = logged(frames.parent, extra=tracker, moving=(1, 2))
    assert main(["replay", str(frames), "--telemetry", str(log), "--json"]) == 0
    assert north_deg(capsys) == 20.0


def test_two_moving_vehicles_are_not_told_apart(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = logged(frames.parent, moving=(1, 2))
    assert main(["replay", str(frames), "--telemetry", str(log)]) == 1
    assert "vehicles 1 and 2" in capsys.readouterr().err


def test_the_two_vehicles_of_a_report(shared_data: Path, frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(shared_data / "reports" / "two-1-first.tlog")
    assert main(["replay", str(frames), "--telemetry", log]) == 1
    assert main(["replay", str(frames), "--telemetry", log, "--vehicle", "2", "--json"]) == 0
    assert north_deg(capsys) == 47.4


def test_a_tlog_whose_stamps_were_never_set_is_doubted(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = logged(frames.parent, extra=camera_of_2)
    data = log.read_bytes()
    early = b"".join(struct.pack(">Q", stamp_us - STAMP_US + 60 * 10**6) + raw for stamp_us, raw in split(data))
    log.write_bytes(early)
    assert main(["replay", str(frames), "--telemetry", str(log)]) == 1
    assert "stamps begin at 1970-01-01 00:01, which can't be true" in capsys.readouterr().err


def test_messages_that_can_t_be_true_are_counted_and_told(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def off_the_globe(step: int) -> list[tuple[int, int, MavlinkMessage]]:
        values = 9050 + step * 100, 2**31 - 1, 2**31 - 1, 0, 0, 0, 0, 0, 0
        wrong = (2, 1, mavlink.MAVLink_global_position_int_message(*values))
        return [*camera_of_2(step), *([wrong] if step == 2 else [])]

    log = logged(frames.parent, extra=off_the_globe)
    assert main(["replay", str(frames), "--telemetry", str(log), "--start", "2026-11-21T10:15:06Z"]) == 0
    assert "can't be true count as missing: 1 of its messages" in capsys.readouterr().err
