"""The report by source: every request in one column, and the columns add up."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest

from dappled import codec, findings
from dappled.cli import main
from dappled.findings import FRAME, Code, Subject, finding
from dappled.flight import FlightFolder, Recording, Result, flight_report
from dappled.flight.flight_report import SourceReport, by_source
from tests.flight.makers import deliver, request, tag
from tests.standing import failure


@pytest.fixture
def recorded(flight: Recording) -> FlightFolder:
    """A closed flight: shots 0 and 1 safe and tagged, 0 decoded, shot 2 failed."""
    for index in range(3):
        request(flight, index)
    for index in range(2):
        flight.ledger.add_tag(tag(deliver(flight, index, bytes(1000))))
    flight.ledger.add_result(Result(0, "ab", 12, 13, "geometric", "predicted"))
    flight.ledger.failed(2, failure("no file came"))
    flight.close()
    return flight.folder


def test_a_flights_counts_by_source(recorded: FlightFolder) -> None:
    assert by_source(recorded.path) == (SourceReport("mavlink:255/190", 3, 0, 3, 2, 1, 0, 2, 1),)


def test_refused_requests_are_counted_at_their_source(flight: Recording) -> None:
    request(flight, 0)
    for source, times in (("mavlink:7/1", 1), ("console", 1), ("mavlink:7/1", 511), ("other peers", 9)):
        one = finding(Code.CAMERA_ABSENT, Subject("source", source), reason="", times=times)
        flight.ledger.add_event("refused", one)
    with closing(sqlite3.connect(flight.folder.ledger)) as damaged, damaged:
        damaged.execute("INSERT INTO events (utc_ns, kind, text) VALUES (0, 'refused', '{\"code\": \"gibberish\"}')")
    counts = {one.source: one for one in by_source(flight.folder.path)}
    assert (counts["mavlink:7/1"].wishes, counts["mavlink:7/1"].refused) == (512, 512)
    assert counts["other peers"].refused == 9
    assert counts["console"].refused == 1
    balance = flight_report.balance(flight.folder.path)
    assert sum(one.shots for one in counts.values()) == balance.wishes
    assert sum(one.refused for one in counts.values()) == balance.refused


def test_the_report_prints_a_line_for_each_source(recorded: FlightFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flight", "report", str(recorded.path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[1].split() == ["source", "requests", "refused", "shots", "safe", "failed", "open", "tagged", "decoded"]
    assert said[2].split() == ["mavlink:255/190", "3", "0", "3", "2", "1", "0", "2", "1"]


def test_the_report_names_frames_in_doubt_and_what_the_card_holds(
    flight: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    """By what a driver's findings left in the ledger; a frame that may be another shot's makes it exit with 1."""
    card = finding(Code.PICTURE_ON_CARD, Subject("picture", "/DCIM/IMG_0004.CR2"))
    doubt = finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 0), rival=1)
    request(flight, 0)
    deliver(flight, 0, bytes(1000))
    flight.ledger.add_event("noticed", card)
    flight.ledger.add_event("doubt", doubt, 0)
    flight.close()
    assert main(["flight", "report", str(flight.folder.path)]) == 1
    said = capsys.readouterr()
    assert f"card: {findings.told(card)}" in [line.strip() for line in said.out.splitlines()]
    assert said.err == "in doubt: frame 0: it may be of shot 1 as well: compare the picture with its neighbours\n"


def test_the_report_says_what_stood_and_when(flight: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    down = finding(Code.LINK_DOWN, Subject("link", "/dev/ttyS0"), why="no such device")
    filling = finding(Code.DISK_FILLING, Subject("disk"), left_mb=409, least_mb=200)
    full = finding(Code.DISK_FULL, Subject("disk"), left_kb=1)
    for kind, one in (("began", down), ("began", filling), ("ended", down), ("began", full), ("began", down)):
        flight.ledger.add_event(kind, one)
    flight.close()
    stood = flight_report.balance(flight.folder.path).stood
    assert [one.finding for one in stood] == [down, filling, full, down]
    assert [one.ended_utc_ns is None for one in stood] == [False, True, True, True]
    assert stood[0].began_utc_ns is not None
    main(["flight", "report", str(flight.folder.path)])
    said = [line.strip() for line in capsys.readouterr().out.splitlines()]
    (first, *_, last) = [line for line in said if line.startswith("stood: ")]
    assert first.endswith(f": {findings.told(down)}")
    assert last.endswith(f" to the end: {findings.told(down)}")
    assert main(["flight", "report", str(flight.folder.path), "--json"]) == 1  # no shot was taken
    assert json.loads(capsys.readouterr().out)["stood"][1]["finding"]["code"] == "disk.filling"


@pytest.mark.parametrize("verdict", ["good", {"state": 7}, {"state": "good", "reasons": "none"}, None])
def test_a_verdict_that_is_none_leaves_the_rest_of_the_flight_to_be_read(
    flight: Recording, verdict: object, capsys: pytest.CaptureFixture[str]
) -> None:
    request(flight, 0)
    deliver(flight, 0, bytes(1000))
    details = {"verdict": verdict}
    flight.ledger.add_result(Result(0, "ab", 12, 13, "geometric", "predicted", details=details))
    flight.close()
    assert main(["flight", "show", str(flight.folder.path)]) == 0
    assert "12/13 carriers" in capsys.readouterr().out
    assert main(["flight", "report", str(flight.folder.path)]) == 0
    assert "judged" not in capsys.readouterr().out


def test_the_report_says_why_a_frame_is_bad_or_unknown(flight: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    states = ("good", "bad", "unknown")
    for index in range(len(states) + 1):
        request(flight, index)
        deliver(flight, index, bytes(1000))
    dark = finding(Code.FRAME_DARK, FRAME, share=0.01), finding(Code.FRAME_BLACK, FRAME, share=0.8)
    for index, state in enumerate(states):
        details = {"verdict": {"state": state, "reasons": codec.plain(dark if state != "good" else ())}}
        flight.ledger.add_result(Result(index, "ab", 12, 13, "geometric", "predicted", details=details))
    flight.close()
    assert main(["flight", "report", str(flight.folder.path)]) == 0
    said = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    judged = said.index("judged: 1 good, 0 usable, 1 bad, 2 unknown")
    assert said[judged + 1 : judged + 6] == [
        "bad: frame 1: too dark: 1.0% of white on average: expose more",
        "bad: frame 1: 80% of the pixels are black",
        "unknown: frame 2: too dark: 1.0% of white on average: expose more",
        "unknown: frame 2: 80% of the pixels are black",
        "unknown: frame 3: not judged in flight",
    ]


@pytest.mark.parametrize(("nats", "there"), [((120.0, -3.4), True), ((120.0, *[-3.4] * 5), False)])
def test_the_report_says_in_how_many_frames_the_mask_is_seen(
    flight: Recording, nats: Sequence[float], there: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for index, one in enumerate(nats):
        request(flight, index)
        deliver(flight, index, bytes(1000))
        details = {"mask_nats": one}
        flight.ledger.add_result(Result(index, "ab", 1, 13, "geometric", "calibrated", details=details))
    flight.close()
    page = tmp_path / "page.html"
    assert main(["flight", "report", str(flight.folder.path), "--page", str(page)]) == 0
    said = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    (mask,) = [line for line in said if line.startswith("mask: ")]
    odds = 16.6 if there else 3.0
    assert f"the mask is seen in 1 of {len(nats)} frames" in mask
    assert f"(log odds that it is there now: {odds:.0f})" in mask
    assert f"<td>seen in</td><td>1 of {len(nats)} frames</td>" in page.read_text()
