"""Whose telemetry counts, where a .tlog holds that of several vehicles."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from dappled.cli import main
from dappled.drivers.mavlink import MavlinkMessage, mavlink, pack

STAMP_US = 1_795_256_103 * 10**6
Extra = Callable[[int], list[tuple[int, int, MavlinkMessage]]]  # of a step: system, component, message


def nothing_more(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return []


def camera_of_2(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return [(2, 100, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_CAMERA, 8, 0, 0, 4, 3))]


def feedback_of_2(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    values = STAMP_US, 2, 0, step, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0
    return [(2, 1, mavlink.MAVLink_camera_feedback_message(*values))]


def camera_of_both(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return [*camera_of_2(step), (1, 100, camera_of_2(step)[0][2])]


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    (tmp_path / "frames").mkdir()
    Image.new("RGB", (16, 16)).save(tmp_path / "frames" / "1.jpg")
    return tmp_path / "frames"


def logged(folder: Path, *, extra: Extra = nothing_more, moving: tuple[int, ...] = (), version_1: bool = False) -> Path:
    """Ten seconds of vehicles 1 (at 10° north) and 2 (at 20° north); 1 is heard first."""
    data = b""
    for step in range(100):
        packets = list(extra(step))
        for system in (1, 2):
            north = system * 10**8 + (step * 100 if system in moving else 0)
            packets += [
                (system, 1, mavlink.MAVLink_global_position_int_message(
                    9000 + step * 100, north, 0, 10**5, 10**4, 0, 0, 0, 0
                )),
                (system, 1, mavlink.MAVLink_attitude_quaternion_message(9000 + step * 100, 1, 0, 0, 0, 0, 0, 0)),
            ]  # fmt: skip
        for system, component, message in packets:
            packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
            data += struct.pack(">Q", STAMP_US + step * 100_000) + pack(message, packer, version_1=version_1)
    (folder / "flight.tlog").write_bytes(data)
    return folder / "flight.tlog"


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
    assert main(["replay", str(frames), "--telemetry", str(log), "--vehicle", "3"]) == 1
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
    assert round(float(json.loads(shown.out)["tag"]["pose"]["latitude_rad"]) * 57.29577951, 1) == 20.0


def test_two_moving_vehicles_are_not_told_apart(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = logged(frames.parent, moving=(1, 2))
    assert main(["replay", str(frames), "--telemetry", str(log)]) == 1
    assert "vehicles 1 and 2" in capsys.readouterr().err


def test_the_two_vehicles_of_a_report(shared_data: Path, frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(shared_data / "reports" / "two-1-first.tlog")
    assert main(["replay", str(frames), "--telemetry", log]) == 1
    assert main(["replay", str(frames), "--telemetry", log, "--vehicle", "2", "--json"]) == 0
    assert north_deg(capsys) == 47.4
