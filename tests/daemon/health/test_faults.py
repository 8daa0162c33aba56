"""Twelve faults of a flight: each is one code, in the health record and on every face, with what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled import codec
from dappled.cli import status
from dappled.config.settings import RecordSettings
from dappled.daemon.body_plan import BodyReport
from dappled.daemon.console.feed import Feed, Hub
from dappled.daemon.console.studio import Studio
from dappled.daemon.health import go_no_go, metrics
from dappled.daemon.health import record as health
from dappled.daemon.health.record import DecodingState
from dappled.daemon.health.standing import in_record
from dappled.daemon.health.status_text import Alarms
from dappled.daemon.pipeline.pipeline import DecodeFailures
from dappled.daemon.pipeline.verdicts import VerdictCounts
from dappled.decode.geometry import Gnss
from dappled.drivers.mavlink import mavlink
from dappled.findings import FRAME, Code, Level, Subject, finding, remedy, told
from dappled.flight.layout import DiskSpace
from tests.daemon.health.test_record import HERE, LINK, WELL, S, record

BODY = BodyReport(True, True, (), (), None, 250, "100%", 100, battery_low=False, temperature_c=24.0)
DARK = finding(Code.FRAME_DARK, FRAME, share=0.001)
STEPPED = finding(Code.CLOCK_STEPPED, Subject("autopilot"), steps=1, by_s=0.3)
ELSEWHERE = finding(Code.CARRIERS_HALF_WAY, FRAME)
MISFIT = finding(Code.DECODE_MISFIT, Subject("decoding"), why="the calibration was made with another mask")
CABLE = "no file came within 30 s: a cable or a card that is too slow"
FAULTS: dict[str, tuple[Code, dict[str, Any]]] = {
    "lens cap": (
        Code.FRAMES_BAD,
        {"decoding": DecodingState(True, verdicts=VerdictCounts({"bad": 3}, 3, DARK))},
    ),
    "full card": (Code.BODY_CARD_FULL, {"body": replace(BODY, card_frames=0)}),
    "slow cable": (Code.CAMERA_FAULTED, {"state": "faulted", "reason": CABLE}),
    "no fix": (
        Code.POSITION_WEAK_FIX,
        {"vehicle": replace(HERE, gnss=Gnss(1, 3, None, None, None, None, None, age_ms=200.0))},
    ),
    "stepped clock": (Code.CLOCK_STEPPED, {"found": [STEPPED]}),
    "wrong mask": (
        Code.CARRIERS_HALF_WAY,
        {"decoding": DecodingState(True, DecodeFailures(found=(ELSEWHERE,)))},
    ),
    "hot battery": (Code.BODY_HOT, {"body": replace(BODY, temperature_c=55.0)}),
    "low disk": (
        Code.DISK_FILLING,
        {
            "settings": replace(WELL, record=RecordSettings()),
            "space": DiskSpace(64 * 10**9, 62 * 10**9, 1_873 * 10**6),
            "frame_bytes": 11e6,  # an S5200's: of larger ones few fit, which is another finding
        },
    ),
    "lost link": (Code.LINK_SILENT, {"link": replace(LINK, last_heard_monotonic_ns=90 * S)}),
    "no camera": (Code.CAMERA_ABSENT, {"state": "absent", "reason": "none is on the bus"}),
    "stale calibration": (
        Code.DECODE_MISFIT,
        {"decoding": DecodingState(True, misfit=MISFIT)},
    ),
    "decode behind": (Code.DECODE_BEHIND, {"items": 3}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_the_same_code_on_every_face_and_says_what_to_do(tmp_path: Path, fault: str) -> None:
    code, changes = FAULTS[fault]
    made = {**record(tmp_path, **changes), "flight": "f"}
    (found,) = in_record(made)
    assert found.code is code
    assert go_no_go.state([found]) == ("no-go" if found.level is Level.STOP else "caution")
    assert remedy(found)
    assert status.screen(made)[-2:] == [
        "NO-GO" if found.level is Level.STOP else "CAUTION",
        f"{found.level.word:9} {told(found)} [{code}]",
    ]
    ((said, severity),) = Alarms().lines({"findings": [{**codec.plain(found), "age_s": 60.0}]})
    assert (said, severity <= mavlink.MAV_SEVERITY_WARNING) == (f"{told(found)} [{code}]", True)
    assert f'dappled_finding{{code="{code}"}} {float(found.level)}' in metrics.text(made).decode()
    assert str(told(found)) in health.line(made)
    feed = Feed("ipc://nowhere", "ipc://nobody", Hub(), Studio(None, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]))
    feed.health = made
    shown = feed.state()
    assert (shown["verdict"], shown["findings"][0]["code"]) == (go_no_go.state([found]), code)


def test_go_never_stands_above_a_finding_that_is_more_than_a_note(tmp_path: Path) -> None:
    made = record(tmp_path, found=[STEPPED])
    assert go_no_go.state(in_record(made)) == "caution"
    assert go_no_go.state(in_record(record(tmp_path))) == "go"
