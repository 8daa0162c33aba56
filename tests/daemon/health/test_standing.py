"""The one list of a service: what begins, is refreshed and ends in it, and in which order it stands."""

from __future__ import annotations

from dataclasses import replace

from dappled import codec
from dappled.daemon.health.standing import NewFindings, StandingEvents, StandingFindings, in_record
from dappled.findings import Code, Finding, Level, Subject, finding

S = 10**9
CAMERA = finding(Code.CAMERA_ABSENT, Subject("camera"), reason="")
NOTE = finding(Code.SERVICE_STOPPING, Subject("service"))


def test_a_finding_keeps_its_beginning_and_has_the_newest_numbers_until_it_ends() -> None:
    standing = StandingFindings()
    first = finding(Code.DISK_FILLING, Subject("disk"), left_mb=409, least_mb=200)
    standing.refresh([first], 10 * S)
    (row,) = (one.to_json(75 * S) for one in standing.refresh([first.with_facts(left_mb=408)], 75 * S))
    assert (row["age_s"], row["facts"]["left_mb"]) == (65.0, 408)
    assert in_record({"findings": [row]}) == [first.with_facts(left_mb=408)]
    assert standing.refresh([], 76 * S) == []
    assert [one.began_ns for one in standing.refresh([first], 80 * S)] == [80 * S]


def test_the_worst_stands_first_then_the_newest() -> None:
    standing = StandingFindings()
    full = finding(Code.DISK_FULL, Subject("disk"), left_kb=1)
    standing.refresh([NOTE, CAMERA], 1 * S)
    assert [one.finding for one in standing.refresh([NOTE, CAMERA, full], 2 * S)] == [full, CAMERA, NOTE]


def test_a_finding_is_new_once_though_its_numbers_change_and_a_note_is_no_news() -> None:
    new = NewFindings()
    before, after = (finding(Code.DISK_FILLING, Subject("disk"), left_mb=mb, least_mb=200) for mb in (409, 408))
    assert (new.among([NOTE]), bool(new)) == ([], False)
    assert (new.among([before]), bool(new)) == ([before], True)
    assert new.among([after, CAMERA]) == [CAMERA]
    assert new.among([after, CAMERA], again=True) == [after, CAMERA]
    assert (new.among([]), bool(new)) == ([], False)
    assert new.among([before]) == [before]


def health(*found: Finding, age_s: float = 0.0) -> dict[str, object]:
    return {"findings": [{**codec.plain(one), "age_s": age_s} for one in found]}


def test_the_ledger_is_told_what_began_rose_and_ended_and_of_no_note() -> None:
    events, filling = StandingEvents(), finding(Code.DISK_FILLING, Subject("disk"), left_mb=409, least_mb=200)
    risen = replace(filling, level=Level.STOP)
    assert events.of(health(NOTE, filling)) == [("began", filling)]
    assert events.of(health(filling.with_facts(left_mb=408))) == []
    assert events.of(health(risen, CAMERA)) == [("began", risen), ("began", CAMERA)]
    assert events.of(health(CAMERA)) == [("ended", risen)]
    silent = finding(Code.BODY_UNREAD, Subject("camera"), settings="ISO")
    assert events.of(health(CAMERA, silent)) == []  # it usually ends by itself
    assert events.of(health(CAMERA, silent, age_s=6.0)) == [("began", silent)]
    assert events.of(health()) == [("ended", CAMERA), ("ended", silent)]


def test_what_comes_and_goes_all_the_time_does_not_fill_the_ledger() -> None:
    events = StandingEvents()
    told = [one for _ in range(100) for found in ([CAMERA], []) for one in events.of(health(*found))]
    assert told == [("began", CAMERA), ("ended", CAMERA)] * 20
    many = [finding(Code.LINK_DOWN, Subject("link", number), why="") for number in range(500)]
    assert len(events.of(health(*many))) == 199
