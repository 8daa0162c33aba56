"""The health record: well when all is well, and one sentence for each thing that isn't."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any, cast
from unittest import mock

import jsonschema
import pytest

from dappled import codec
from dappled.config.settings import DecodeSettings, MaskSettings, MavlinkSettings, RecordSettings, Settings
from dappled.daemon.health import record as health
from dappled.daemon.health.record import DecodingState
from dappled.daemon.navigation import BootClock, Telemetry
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.overlap import FrameOverlap
from dappled.daemon.pipeline.pipeline import DecodeFailures
from dappled.daemon.pipeline.shutter import ShutterStatistics
from dappled.daemon.pipeline.spacing import Spacing, SpacingStatistics
from dappled.daemon.stream.publisher import PublisherStatistics
from dappled.daemon.vehicle_battery import VehicleBattery
from dappled.decode.geometry import Gnss, Pose
from dappled.drivers.camera import BodyState
from dappled.drivers.mavlink import LinkStatistics, SigningStatistics
from dappled.findings import Code, Subject, finding
from dappled.flight import layout
from dappled.workers import Worker
from tests.daemon.fakes import FakeCamera
from tests.schemas import schema
from tests.standing import codes, problems

WELL = Settings(
    mask=MaskSettings("mask-1"),
    decode=DecodeSettings(calibration="c.toml"),
    mavlink=MavlinkSettings(("udpin:127.0.0.1:1",)),
    record=RecordSettings(warn_free_mb=0, min_free_mb=0),
)
S = 10**9
LATE = finding(Code.SERIES_LATE, Subject("series"), apart_m=9.0, spacing_m=8.5)
SAME_IDS = finding(Code.LINK_SAME_IDS, Subject("link", "x"), source="y", system=1, component=100)
NORTH = (1.0, 0.0, 0.0, 0.0)
HERE = Pose("interpolated", 0, None, 0.7, -1.6, 200.0, 20.0, None, NORTH, 0.1, None, None, 9)
CLOCK = BootClock("timesync", 0, 0, 0.0, 10**5)
MISFIT = finding(Code.DECODE_MISFIT, Subject("decoding"), why="c.toml was made with another mask")
ENVELOPE = {"schema": "dappled/health", "version": 1, "flight": "f", "seq": 0, "dropped": 0}
LINK = LinkStatistics("udpin:127.0.0.1:1", 5, 5, 0, 0, 0, 0, 100 * S, None)


def failures(*why: str) -> DecodeFailures:
    return reduce(DecodeFailures.after, why, DecodeFailures())


def record(
    folder: Path, settings: Settings = WELL, link: LinkStatistics = LINK, state: str = "ready", **more: Any
) -> dict[str, Any]:
    stage: Worker[int] = Worker("decode", lambda _: None, capacity=1)
    for number in range(more.pop("items", 0)):
        stage.put(number)
    shots = PendingShots(FakeCamera())
    shots.state, shots.reason = cast(BodyState, state), more.pop("reason", "")
    of_shots = {name: more.pop(name) for name in ("series", "body", "parameters", "overlap") if name in more}
    telemetry = replace(Telemetry().statistics(), positions=more.pop("positions", 0))
    stream = PublisherStatistics({}, {}, 0, 0, 0)
    disk = mock.patch.object(layout, "disk_space", return_value=more.pop("space")) if "space" in more else nullcontext()
    links = [link, *more.pop("links", ())]
    times = health.ServiceTime(1_800_000_000 * S, 101 * S, more.pop("began", 90 * S), more.pop("utc_known", True))
    with disk:
        now = health.ServiceState(
            settings,
            times,
            health.ShootingState(shots, ShutterStatistics(2, 0, 0, 2, 0, 2, None), **of_shots),
            health.VehicleState(
                links, telemetry, more.pop("clock", CLOCK), more.pop("vehicle", HERE), more.pop("battery", None)
            ),
            health.KeepingState(folder, [stage.statistics()], stream, more.pop("frame_bytes", None)),
            more.pop("decoding", DecodingState(True)),
            more.pop("dead", ()),
            more.pop("found", ()),
        )
        return health.record(now, **more)


def test_well(tmp_path: Path) -> None:
    found = record(tmp_path)
    assert found["findings"] == []
    assert [link["age_s"] for link in found["link"]["each"]] == [1.0]
    jsonschema.validate({**ENVELOPE, **found}, schema("health"))


def test_instruments_are_in_the_record_and_what_is_not_known_is_null(tmp_path: Path) -> None:
    unknown = record(tmp_path)
    assert (unknown["gnss"], unknown["frame_bytes"], unknown["settings"]) == (None, None, [])
    iso = {"name": "CAM_ISO", "title": "ISO", "value": "100", "choices": ("100", "200")}
    receiver = Gnss(3, 11, None, None, None, None, None, age_ms=200.0)
    without_a_place = Pose("none", 0, None, None, None, None, None, None, None, None, None, None, 0)
    found = record(tmp_path, vehicle=replace(without_a_place, gnss=receiver), frame_bytes=17e6, parameters=[iso])
    assert (found["gnss"], found["vehicle"]) == ({"fix_type": 3, "satellites": 11}, None)
    assert (found["frame_bytes"], found["settings"]) == (17e6, [iso])
    assert (unknown["vehicle_battery"], found["vehicle_battery"]) == (None, None)
    powered = record(tmp_path, battery=VehicleBattery(24.83, None, None))
    assert powered["vehicle_battery"] == {"voltage_v": 24.83, "remaining_percent": None, "low": None}
    jsonschema.validate({**ENVELOPE, **powered}, schema("health"))
    overlap = FrameOverlap(7, 2.0, 0.75, 4.0)
    followed = record(tmp_path, overlap=overlap)
    assert (unknown["overlap"], followed["overlap"]) == (None, codec.plain(overlap))
    jsonschema.validate({**ENVELOPE, **followed}, schema("health"))
    old = record(tmp_path, vehicle=replace(without_a_place, gnss=replace(receiver, age_ms=9000.0)))
    assert old["gnss"] is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"state": "absent", "reason": "nothing on the bus"}, "the camera is absent: nothing on the bus"),
        ({"state": "faulted"}, "the camera is faulted"),
        ({"link": replace(LINK, last_heard_monotonic_ns=95 * S)}, "nothing was heard for 5 s"),
        ({"link": replace(LINK, last_heard_monotonic_ns=None)}, "nothing was heard for 5 s"),
        ({"link": replace(LINK, error="link down")}, "link down"),
        (
            {"link": replace(LINK, last_heard_monotonic_ns=None, signing=SigningStatistics(0, 3, 1, 0, 7))},
            "7 packets unsigned, 3 forged, 1 too old",
        ),
        ({"settings": replace(WELL, mavlink=MavlinkSettings())}, "no MAVLink link is configured"),
        ({"settings": replace(WELL, mask=MaskSettings())}, "no mask is configured"),
        ({"settings": replace(WELL, record=RecordSettings(min_free_mb=10_000_000))}, "the disk is nearly full"),
        ({"found": [SAME_IDS]}, "sends as 1/100 too"),
        ({"utc_known": False}, "UTC is not known yet"),
        ({"settings": replace(WELL, record=RecordSettings(warn_free_mb=10_000_000))}, "the disk is filling up"),
        ({"decoding": DecodingState(True, failures("dark"))}, "1 frame kept, not decoded: dark"),
        ({"decoding": DecodingState(True, replace(failures(*"dddd"), in_a_row=0))}, "4 frames kept, not decoded: d"),
        ({"decoding": DecodingState(True, failures("far", "dark", "dark"))}, "the last 3 frames are kept, not decoded"),
        ({"decoding": DecodingState(True, failures(*"ddd"), MISFIT)}, "frames can't be decoded: c.toml was made"),
        ({"dead": ["mavlink 0"]}, "thread mavlink 0: it has ended: restart dappled"),
        ({"dead": ["capture"]}, "thread capture: it has ended: restart dappled"),
        ({"items": 3}, "decode fell behind by 2 frames, kept in the record"),
    ],
)
def test_one_problem_one_sentence(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    (problem,) = problems(record(tmp_path, **changes))
    assert words in problem


def test_a_start_is_a_caution_and_no_silence(tmp_path: Path) -> None:
    silent = replace(LINK, last_heard_monotonic_ns=None)
    assert codes(record(tmp_path, link=silent, state="starting", began=100 * S)) == ["camera.starting"]


def test_a_folder_that_is_gone_is_unknown_not_zero(tmp_path: Path) -> None:
    found = record(tmp_path / "gone")
    assert found["disk"]["free_bytes"] is None
    assert codes(found) == ["disk.unreadable"]


@pytest.mark.parametrize(
    ("on_gimbal", "heard", "problem"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_gimbal_that_is_not_heard_is_a_problem_where_the_camera_is_on_it(
    tmp_path: Path, on_gimbal: bool, heard: bool, problem: bool
) -> None:
    settings = replace(WELL, pose=replace(WELL.pose, on_gimbal=on_gimbal))
    level = (1.0, 0.0, 0.0, 0.0)
    vehicle = replace(Pose.unknown(1, 5), age_ms=100.0, gimbal_attitude=level if heard else None)
    found = problems(record(tmp_path, settings, vehicle=vehicle))
    assert any("pose.on_gimbal" in text for text in found) == problem
    silent = replace(vehicle, age_ms=None)  # nothing is heard of the vehicle at all, which is told already
    assert not any("pose.on_gimbal" in text for text in problems(record(tmp_path, settings, vehicle=silent)))


def test_a_link_on_which_no_ground_station_is_yet_is_no_problem(tmp_path: Path) -> None:
    """As long as another link is heard; one that falls silent, or is refused, is a problem."""
    never = replace(LINK, url="udpin:127.0.0.1:2", last_heard_monotonic_ns=None)
    found = record(tmp_path, links=[never], positions=5)
    assert (problems(found), found["link"]["silent"]) == ([], 1)
    (problem,) = problems(record(tmp_path, links=[replace(never, last_heard_monotonic_ns=95 * S)], positions=5))
    assert "udpin:127.0.0.1:2: nothing was heard for 5 s" in problem
    (problem,) = problems(
        record(tmp_path, links=[replace(never, signing=SigningStatistics(0, 3, 1, 0, 7))], positions=5)
    )
    assert "3 forged" in problem
    here = replace(HERE, age_ms=40.0)
    left = replace(never, last_heard_monotonic_ns=95 * S)  # `dappled trigger` came and went
    assert problems(record(tmp_path, links=[left], positions=5, vehicle=here)) == []
    assert problems(record(tmp_path, links=[left], positions=5, vehicle=replace(here, age_ms=6000.0))) != []
    assert len(problems(record(tmp_path, link=never))) == 1
    silent = problems(record(tmp_path, links=[never]))  # the autopilot's cable may be the silent one
    assert any("udpin:127.0.0.1:2: nothing was heard for 5 s" in text for text in silent)


def test_photographs_by_distance_are_an_interval_in_metres(tmp_path: Path) -> None:
    none = record(tmp_path)
    assert none["interval"] is None
    by_overlap = SpacingStatistics(Spacing(overlap=0.7), 8.5, 12, 3, 1, None, LATE, 90 * S)
    found = record(tmp_path, series=by_overlap)
    counts = {"taken": 12, "refused": 3, "began_ms": 90_000}
    assert found["interval"] == {**counts, "count": None, "next_s": None, "distance_m": 8.5}
    jsonschema.validate({**ENVELOPE, **found}, schema("health"))
    assert codes(found) == ["series.late"]
