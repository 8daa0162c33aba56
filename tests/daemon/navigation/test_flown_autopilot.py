"""Flights of an ArduPilot in software-in-the-loop: replayed by command, against its simulator's truth."""

from __future__ import annotations

import csv
import gzip
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.config import settings as configuration
from dappled.config.schema import TomlSource
from dappled.decode.geometry import metres_per_radian
from dappled.drivers.mavlink import PacketParser, mavlink
from dappled.flight import Cause, Shot, log_reading, recording
from tests.flight.makers import deliver

pytestmark = pytest.mark.slow

_LATENCY_MS = 5.0  # a body that exposes as soon as it is asked, so that the request's place is the photograph's
_SETTINGS = {"camera": {"latency_ms": _LATENCY_MS, "latency_sigma_ms": 3.0}}


def flown(folder: Path, telemetry: Path) -> tuple[Path, list[int]]:
    """The flight of a recorder that heard this telemetry: a photograph for each request of the autopilot's in it. The
    flight's folder, and the numbers of the triggers."""
    packets, parse = list(log_reading.read_telemetry(telemetry)), PacketParser()
    settings = configuration.to_tables(configuration.resolve(configuration.parse(_SETTINGS, TomlSource("test"))))
    names = {"camera": "auto", "mask": "", "law": "identity"}
    flight = recording.begin(folder, RecordedClock(packets[0][1] * 1000), {"settings": settings, "names": names})
    flight.ledger.set_fact("vehicles", [[0, 1]])
    numbers: list[int] = []
    for _, stamp_us, raw in packets:
        flight.telemetry.append(stamp_us, raw)
        message = parse(raw)
        if message is None or message.get_srcComponent() != 1 or message.get_type() != "COMMAND_LONG":
            continue
        if message.command == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            index, at_ns = len(numbers), stamp_us * 1000
            numbers.append(int(message.param4))
            shot = Shot(index, Cause("mavlink:1/1", "IMAGE_START_CAPTURE", numbers[-1]), at_ns, at_ns)
            flight.journal.note(shot)
            flight.ledger.add_shot(shot)
            flight.ledger.fired(index, at_ns, at_ns)
            deliver(flight, index, b"%d" % index, f"IMG_{index}.CR2")
    flight.close()
    return flight.folder.path, numbers


def truth(path: Path) -> tuple[dict[int, float], Any]:
    """When each trigger was given (µs since boot), and where the vehicle was: (4, n), µs, degrees, m."""
    with gzip.open(path, "rt") as file:
        rows = list(csv.DictReader(file))
    columns = ("time_us", "latitude_deg", "longitude_deg", "altitude_m")
    track = np.array([[float(row[column]) for column in columns] for row in rows if row["kind"] == "SIM"]).T
    return {int(row["number"]): float(row["time_us"]) for row in rows if row["kind"] == "CAM"}, track


@pytest.mark.parametrize(("name", "late"), [("survey", 0), ("glitch", 0), ("held-bytes", 5)])
def test_replayed_positions_are_true_or_in_doubt(
    name: str, late: int, shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In `glitch` the receiver is 33 m off for 40 s while the clock steps: 35 of 156 frames were in no doubt; in
    `held-bytes` five photographs were taken at one place, up to 28 m from their triggers'."""
    folder = shared_data / "telemetry" / "ardupilot"
    triggers_us, track = truth(folder / f"{name}.truth.csv.gz")
    flight, numbers = flown(tmp_path, folder / f"{name}.tlog")
    assert sorted(numbers) == sorted(triggers_us)
    main(["replay", str(flight), "--json"])
    frames = [row for line in capsys.readouterr().out.splitlines() if "index" in (row := json.loads(line))]
    assert [row["index"] for row in frames] == list(range(len(numbers)))
    wrong, undoubted = [], 0
    for row, number in zip(frames, numbers, strict=True):
        tag, pose = row["tag"], row["tag"]["pose"]
        if tag["doubts"] or pose["position_sigma_m"] is None:
            continue
        undoubted += 1
        at_us = triggers_us[number] + _LATENCY_MS * 1e3
        latitude, longitude, altitude = (np.interp(at_us, track[0], column) for column in track[1:])
        north_m, east_m = metres_per_radian(pose["latitude_rad"], pose["altitude_msl_m"])
        off_m = math.hypot(
            (pose["latitude_rad"] - math.radians(latitude)) * north_m,
            (pose["longitude_rad"] - math.radians(longitude)) * east_m,
        )
        across = off_m / pose["position_sigma_m"]
        upright = (pose["altitude_msl_m"] - altitude) / pose["vertical_sigma_m"]
        if max(across, abs(upright)) > 4:
            wrong.append((number, off_m, across, upright))
    assert wrong == []
    assert undoubted > len(numbers) / 2
    doubts = [doubt["code"] for row in frames for doubt in row["tag"]["doubts"]]
    assert doubts.count("frame.request_late") == late
