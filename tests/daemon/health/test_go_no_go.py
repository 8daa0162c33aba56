"""Go or no-go: each thing that can be amiss, by the health record that says so."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from dappled.daemon.health import go_no_go
from dappled.daemon.health.go_no_go import Check

VEHICLE = {"latitude_deg": 41.0, "longitude_deg": 1.0, "yaw_deg": 3.0, "position_sigma_m": 1.24, "age_ms": 40.0}
DECODE = {"mask": "mask-2", "calibration": "c.toml", "running": True, "failed": 0, "failed_in_a_row": 0, "failure": "",
          "misfit": ""}  # fmt: skip
HALF_HEARD = [{"in": 9}, {"in": 0}]
LINK = {"urls": 2, "silent": 0, "packets": 500, "positions": 50}
WELL: dict[str, Any] = {
    "utc_ns": 1_800_000_000 * 10**9,
    "camera": {"state": "ready", "reason": ""},
    "link": LINK,
    "stages": [{"name": "decode", "dropped": 0}],
    "dead": [],
    "utc_known": True,
    "disk": {"free_bytes": 50 * 10**9, "folder": "/flights/x"},
    "clock": {"source": "timesync", "sigma_ms": 0.31},
    "vehicle": VEHICLE,
    "decode": DECODE,
    "min_free_bytes": 5 * 10**8,
    "frame_bytes": 17e6,
}


def battery(voltage_v: float | None, remaining_percent: int | None, *, low: bool | None) -> dict[str, Any]:
    return {"voltage_v": voltage_v, "remaining_percent": remaining_percent, "low": low}


def found(name: str, **changes: Any) -> Check:
    health = copy.deepcopy(WELL) | changes
    (check,) = [one for one in go_no_go.checks(health) if one.name == name]
    return check


def test_all_is_well() -> None:
    checks = go_no_go.checks(WELL)
    assert [one.state for one in checks] == ["go"] * 7
    assert go_no_go.verdict(checks) == "go"
    assert [one.text for one in checks if one.name == "Disk"] == ["50.0 GB free, room for 2\u202f911 frames"]
    assert [one.text for one in checks if one.name == "Position"] == ["±1.2 m"]


@pytest.mark.parametrize(
    ("name", "state", "words", "changes"),
    [
        ("Camera", "go", "taking a frame", {"camera": {"state": "busy", "reason": ""}}),
        ("Camera", "caution", "starting", {"camera": {"state": "starting", "reason": ""}}),
        ("Camera", "no-go", "absent: no body", {"camera": {"state": "absent", "reason": "no body"}}),
        ("Camera", "no-go", "faulted", {"camera": {"state": "faulted", "reason": ""}}),
        ("Disk", "no-go", "can't be read", {"disk": {"free_bytes": None}}),
        ("Disk", "no-go", "shots are refused", {"disk": {"free_bytes": 4 * 10**8}}),
        ("Disk", "no-go", "only 3 more files", {"disk": {"free_bytes": 50 * 10**9, "free_files": 3}}),
        ("Disk", "caution", "room for 25 frames", {"disk": {"free_bytes": 10**9}, "frame_bytes": 20e6}),
        ("Disk", "caution", "room for 1 frame", {"disk": {"free_bytes": 53 * 10**7}, "frame_bytes": 20e6}),
        ("Disk", "caution", "unknown before the first", {"disk": {"free_bytes": 10**9}, "frame_bytes": None}),
        ("Disk", "go", "unknown before the first", {"frame_bytes": None}),
        ("Autopilot", "caution", "no link is configured", {"link": {"urls": 0, "packets": 0}}),
        ("Autopilot", "go", "heard; 1 of 2 links silent", {"link": LINK | {"silent": 1, "each": [{"in": 9}] * 2}}),
        ("Autopilot", "go", "heard; nobody yet on 1 of 2 links", {"link": LINK | {"silent": 1, "each": HALF_HEARD}}),
        ("Autopilot", "no-go", "silent", {"link": LINK | {"silent": 2}, "vehicle": VEHICLE | {"age_ms": 9e3}}),
        ("Autopilot", "caution", "sends no position", {"vehicle": None}),
        ("Position", "caution", "unknown", {"vehicle": None}),
        ("Position", "caution", "±22 m", {"vehicle": VEHICLE | {"position_sigma_m": 22.4}}),
        ("Position", "caution", "accuracy unknown", {"vehicle": VEHICLE | {"position_sigma_m": None}}),
        ("Position", "caution", "attitude unknown", {"vehicle": VEHICLE | {"yaw_deg": None}}),
        (
            "Position",
            "caution",
            "the satellite receiver has a 2D fix",
            {"vehicle": VEHICLE, "gnss": {"fix_type": 2, "satellites": 4}},
        ),
        ("Clock", "no-go", "does not know the date", {"utc_ns": 1000}),
        ("Clock", "caution", "autopilot's clock is unknown", {"clock": None}),
        ("Clock", "caution", "by packet arrival, ±80 ms", {"clock": {"source": "arrival", "sigma_ms": 80.0}}),
        ("Decoding", "caution", "kept, not decoded", {"decode": {"mask": "", "calibration": "", "running": False}}),
        ("Decoding", "caution", "off", {"decode": {"mask": "m", "calibration": "", "running": False}}),
        ("Decoding", "caution", "not calibrated", {"decode": {"mask": "m", "calibration": "", "running": True}}),
        ("Decoding", "caution", "fell behind by 2 frames, kept", {"stages": [{"name": "decode", "dropped": 2}]}),
        ("Decoding", "no-go", "will be kept, not decoded: c.toml", {"decode": DECODE | {"misfit": "c.toml was made"}}),
        ("Decoding", "caution", "1 frame could not be decoded, kept in the record: dark",
         {"decode": DECODE | {"failed": 1, "failed_in_a_row": 1, "failure": "dark"}}),
        ("Decoding", "caution", "4 frames could not",
         {"decode": DECODE | {"failed": 4, "failed_in_a_row": 0, "failure": "dark"}}),
        ("Decoding", "no-go", "the last 3 frames could not be decoded, kept in the record: dark",
         {"decode": DECODE | {"failed": 4, "failed_in_a_row": 3, "failure": "dark"}}),
        ("Vehicle battery", "go", "24.8 V, 76 % left", {"vehicle_battery": battery(24.83, 76, low=False)}),
        ("Vehicle battery", "go", "what is left is unknown", {"vehicle_battery": battery(24.83, None, low=None)}),
        ("Vehicle battery", "caution", "low: 21.6 V, 25 % left", {"vehicle_battery": battery(21.6, 25, low=True)}),
        ("Vehicle battery", "caution", "low: voltage unknown", {"vehicle_battery": battery(None, None, low=True)}),
        ("Service", "no-go", "capture ended: restart dappled", {"dead": ["capture"]}),
        ("Clock", "caution", "not known yet", {"utc_known": False}),
    ],
)  # fmt: skip
def test_each_thing_says_what_it_is(name: str, state: str, words: str, changes: dict[str, Any]) -> None:
    check = found(name, **changes)
    assert check.state == state
    assert words in check.text


@pytest.mark.parametrize("unknown", [None, battery(None, None, low=None)])
def test_a_battery_of_which_nothing_is_known_is_no_check(unknown: Any) -> None:
    assert "Vehicle battery" not in [one.name for one in go_no_go.checks(WELL | {"vehicle_battery": unknown})]


def test_the_worst_decides() -> None:
    go, caution, bad = (Check("x", state, "") for state in ("go", "caution", "no-go"))
    assert go_no_go.verdict([go, caution]) == "caution"
    assert go_no_go.verdict([caution, bad, go]) == "no-go"


def test_frames_left_are_counted_by_measured_sizes_or_unknown() -> None:
    assert go_no_go.frames_left(WELL) == 2911
    assert go_no_go.frames_left(WELL | {"frame_bytes": None}) is None
    assert go_no_go.frames_left(WELL | {"disk": {"free_bytes": None}}) is None
    assert go_no_go.frames_left(WELL | {"disk": {"free_bytes": 10**8}}) == 0  # a full disk is no unknown
