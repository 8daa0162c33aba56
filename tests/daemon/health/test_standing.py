"""The one list of a service: what begins, is refreshed and ends in it, and in which order it stands."""

from __future__ import annotations

from dappled.daemon.health.standing import NewFindings, StandingFindings, in_record
from dappled.findings import Code, Subject, finding

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
