"""Go or no-go: each thing that can be amiss, by the facts of the health record that say so."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from dappled.daemon.health import go_no_go
from dappled.findings import Code, Subject, above_note, finding, told

VEHICLE = {"latitude_deg": 41.0, "longitude_deg": 1.0, "yaw_deg": 3.0, "position_sigma_m": 1.24, "age_ms": 40.0}
DECODE = {"mask": "mask-2", "calibration": "c.toml", "running": True}
WELL: dict[str, Any] = {
    "utc_ns": 1_800_000_000 * 10**9,
    "link": {"urls": 2, "silent": 0, "packets": 500, "positions": 50},
    "stages": [{"name": "decode", "dropped": 0, "waiting": 0}],
    "utc_known": True,
    "disk": {"free_bytes": 50 * 10**9, "folder": "/flights/x"},
    "clock": {"source": "timesync", "sigma_ms": 0.31},
    "gnss": None,
    "vehicle": VEHICLE,
    "vehicle_battery": None,
    "decode": DECODE,
    "min_free_bytes": 5 * 10**8,
    "frame_bytes": 17e6,
}


def battery(voltage_v: float | None, remaining_percent: int | None, *, low: bool | None) -> dict[str, Any]:
    return {"voltage_v": voltage_v, "remaining_percent": remaining_percent, "low": low}


def found(**changes: Any) -> list[str]:
    return [str(told(one)) for one in above_note(go_no_go.judge(copy.deepcopy(WELL) | changes))]


def test_all_is_well() -> None:
    assert list(go_no_go.judge(WELL)) == []
    assert go_no_go.state([]) == "go"


@pytest.mark.parametrize(
    ("state", "words", "changes"),
    [
        ("caution", "takes 25 frames more", {"disk": {"free_bytes": 10**9}, "frame_bytes": 20e6}),
        ("caution", "takes 1 frame more", {"disk": {"free_bytes": 53 * 10**7}, "frame_bytes": 20e6}),
        ("caution", "the position is unknown", {"vehicle": None}),
        ("caution", "±22 m", {"vehicle": VEHICLE | {"position_sigma_m": 22.4}}),
        ("caution", "attitude is unknown", {"vehicle": VEHICLE | {"yaw_deg": None}}),
        ("caution", "has a 2D fix", {"gnss": {"fix_type": 2, "satellites": 4}}),
        ("no-go", "does not know the date", {"utc_ns": 1000}),
        ("caution", "autopilot's clock is unknown", {"clock": None}),
        ("caution", "±80 ms", {"clock": {"source": "arrival", "sigma_ms": 80.0}}),
        ("caution", "no mask is configured", {"decode": DECODE | {"mask": "", "running": False}}),
        ("caution", "decoding is off", {"decode": DECODE | {"running": False}}),
        ("caution", "not calibrated", {"decode": DECODE | {"calibration": ""}}),
        ("caution", "fell behind by 2 frames", {"stages": [{"name": "decode", "dropped": 2, "waiting": 0}]}),
        ("caution", "stage tag: it fell behind", {"stages": [{"name": "tag", "dropped": 2, "waiting": 0}]}),
        ("caution", "low, volts: 21.6, per cent left: 25", {"vehicle_battery": battery(21.6, 25, low=True)}),
        ("caution", "the vehicle's battery is low: land", {"vehicle_battery": battery(None, None, low=True)}),
        ("caution", "UTC is not known yet", {"utc_known": False}),
    ],
)  # fmt: skip
def test_each_thing_says_what_it_is(state: str, words: str, changes: dict[str, Any]) -> None:
    (one,) = found(**changes)
    assert words in one
    assert go_no_go.state(go_no_go.judge(WELL | changes)) == state


@pytest.mark.parametrize(
    "changes",
    [
        {"vehicle_battery": battery(24.83, 76, low=False)},
        {"vehicle_battery": battery(None, None, low=None)},
        {"vehicle": VEHICLE | {"position_sigma_m": None}},
        {"frame_bytes": None},
        {"disk": {"free_bytes": None}},  # that is found of the disk itself
    ],
)
def test_what_is_good_or_not_known_stands_in_no_way(changes: dict[str, Any]) -> None:
    assert found(**changes) == []


def test_the_worst_decides() -> None:
    note, caution, stop = (
        finding(code, Subject("camera")) for code in (Code.SERVICE_STOPPING, Code.BODY_UNCHECKED, Code.BODY_CARD_FULL)
    )
    assert go_no_go.state([note]) == "go"
    assert go_no_go.state([note, caution]) == "caution"
    assert go_no_go.state([caution, stop, note]) == "no-go"


def test_frames_left_are_counted_by_measured_sizes_or_unknown() -> None:
    assert go_no_go.frames_left(WELL) == 2911
    assert go_no_go.frames_left(WELL | {"frame_bytes": None}) is None
    assert go_no_go.frames_left(WELL | {"disk": {"free_bytes": None}}) is None
    assert go_no_go.frames_left(WELL | {"disk": {"free_bytes": 10**8}}) == 0  # a full disk is no unknown
