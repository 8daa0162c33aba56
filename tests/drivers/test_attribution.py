"""Whose a file is, and names of files by their content."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.attribution import BodyClock, Claim, FileClue, FramedShot, attribute, rivals, true_name
from dappled.findings import Code, Subject, finding

SECOND = 10**9
KNOWN = BodyClock((4900.0, 4900.3, 4899.8, 4900.1))


def clue(taken_s: float | None, arrived_s: float = 201.0, since_s: float | None = None, **names: int) -> FileClue:
    return FileClue(taken_s, round(arrived_s * SECOND), None if since_s is None else round(since_s * SECOND), **names)


def claim(shot: int, fired_s: float) -> Claim:
    return Claim(shot, round(fired_s * SECOND))


def test_the_only_shot_left_does_not_get_a_file_that_the_body_s_clock_excludes() -> None:
    found = attribute(clue(5010), [], [claim(4, 200)], KNOWN)
    assert (found.shot, found.doubt) == (None, None)  # a picture of 90 s before


def test_a_time_at_which_no_unknown_picture_can_have_been_made_shows_that_the_clock_was_set() -> None:
    found = attribute(clue(5010, since_s=150.0), [], [claim(4, 200)], KNOWN)
    assert found.shot == 4
    assert found.doubt is not None
    assert found.doubt.kind == (Code.FRAME_CLOCK_DISAGREES, Subject("frame", 4))
    assert found.doubt.facts["off_s"] == pytest.approx(-90, abs=0.2)
    again = attribute(clue(5012, 203.0, 150.0), [], [claim(5, 202)], found.clock)
    assert (again.shot, again.doubt) == (5, None)
    third = attribute(clue(5014, 205.0, 150.0), [], [claim(6, 204)], again.clock)
    assert (third.shot, third.doubt) == (6, None)


@pytest.mark.parametrize(("since_s", "doubt"), [(100.0, None), (141.0, Code.FRAME_RIVAL_SHOTS)])
def test_a_clock_that_was_set_back_to_the_time_of_a_shot_that_was_given_up_is_no_proof(
    since_s: float, doubt: Code | None
) -> None:
    """All pictures made before `since_s` are known: the late shot's would be."""
    found = attribute(clue(5030, 168.0, since_s), [claim(5, 130)], [claim(9, 167)], KNOWN)
    assert found.shot == 5
    assert (found.doubt.code if found.doubt else None) == doubt
    assert found.doubt is None or found.doubt.facts["rival"] == 9
    alone = attribute(clue(5030, 168.0, since_s), [claim(5, 130)], [], KNOWN)
    assert (alone.doubt is None) == (doubt is None)
    counted = attribute(replace(clue(5030, 168.0, since_s), after=4), [claim(5, 130)], [claim(9, 167)], KNOWN)
    assert (counted.shot, counted.doubt) == (5, None)  # the camera's count agrees with its clock


@pytest.mark.parametrize("dated", [True, False])
@pytest.mark.parametrize("came_after_s", [0.6, 7.0])
def test_the_first_frame_is_in_doubt_where_another_picture_comes_soon_after_its_shot(
    dated: bool, came_after_s: float
) -> None:
    """A picture by hand just before the first shot has no rival clock: its own picture is the stray then. Nor has one
    by a body that tells no time; where frames take their time to come, its own does, too."""
    at_s = 200 + came_after_s
    first = attribute(clue(5000 if dated else None, at_s), [], [claim(1, 200)], BodyClock())
    assert (first.shot, first.doubt) == (1, None)
    framed = [FramedShot(claim(1, 200), round(at_s * SECOND))]
    soon, late = (clue(5000 + one_s if dated else None, 200 + one_s) for one_s in (2.3 * came_after_s, 20.5))
    (doubt,) = rivals("2.RAF", soon, framed, first.clock)
    assert doubt.kind == (Code.FRAME_RIVAL_PICTURE, Subject("frame", 1))
    assert rivals("2.RAF", late, framed, first.clock) == []  # the shot's own would have come sooner
    second = attribute(clue(5010, 210.5), [], [claim(2, 210)], first.clock)
    third = [FramedShot(claim(2, 210), round(210.5 * SECOND))]
    if dated:
        assert rivals("3.RAF", clue(5012, 212.5), third, second.clock) == []  # now the clock tells


def test_a_time_between_those_of_two_shots_leaves_the_frame_in_doubt() -> None:
    """One of them has no file, and by whole seconds the time fits both as badly."""
    found = attribute(clue(4900 + 201.5, 205.0), [], [claim(4, 200), claim(5, 204)], BodyClock((4900.0, 4898.5)))
    assert found.shot == 4
    assert found.doubt == finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 4), rival=5)


@pytest.mark.parametrize("offsets", [(4900.0,), (4900.0, 4900.3)])
def test_a_picture_three_seconds_after_its_shot_is_in_doubt_though_few_files_tell_the_clock(
    offsets: tuple[float, ...],
) -> None:
    found = attribute(clue(4900 + 202.9, 203.2), [], [claim(4, 200)], BodyClock(offsets))
    assert found.doubt is not None
    assert found.doubt.code is Code.FRAME_CLOCK_DISAGREES


def test_pictures_by_hand_after_shots_without_one_are_not_taken_for_a_clock_that_was_set() -> None:
    """Twice in a row is chance; from the third on the body is one that takes its time."""
    doubts, clock = [], KNOWN
    for shot in range(4, 7):
        at_s = 200.0 + 20 * shot
        found = attribute(clue(4900 + at_s + 4, at_s + 4.5), [], [claim(shot, at_s)], clock)
        clock = found.clock
        doubts.append(found.doubt is not None)
    assert doubts == [True, True, False]


def test_a_body_that_took_its_time_to_focus_keeps_its_frame_in_doubt() -> None:
    found = attribute(clue(4900 + 206, 207.0), [], [claim(4, 200)], KNOWN)
    assert found.shot == 4
    assert found.doubt is not None
    assert found.doubt.facts["off_s"] == pytest.approx(6, abs=0.2)


def test_a_clock_that_was_set_back_is_believed_when_files_in_a_row_agree() -> None:
    ends, clock = [], KNOWN
    for shot in range(4, 8):
        at_s = 200.0 + 5 * shot
        found = attribute(clue(round(at_s + 4800), at_s + 1), [], [claim(shot, at_s)], clock)
        clock = found.clock
        ends.append((found.shot, found.doubt is not None))
    assert ends == [(None, False), (5, True), (6, False), (7, False)]


def test_a_picture_by_hand_between_shots_that_fit_does_not_count_as_a_clock_that_was_set() -> None:
    clock = KNOWN
    for shot in range(4, 8):
        at_s = 200.0 + 10 * shot
        by_hand = attribute(clue(at_s + 4892, at_s + 1), [], [claim(shot, at_s)], clock)
        own = attribute(clue(at_s + 4900, at_s + 2), [], [claim(shot, at_s)], by_hand.clock)
        assert (by_hand.shot, own.shot, own.doubt) == (None, shot, None)
        clock = own.clock


@pytest.mark.parametrize(
    ("late", "waiting", "taken_s", "shot", "code"),
    [
        ([], [4], None, 4, None),
        ([], [4, 5], None, 4, None),
        ([], [], 5100, None, None),
        ([3], [], None, 3, Code.FRAME_UNCONFIRMED),
        ([3], [], 5090, 3, None),
        ([3], [4], None, 4, Code.FRAME_RIVAL_SHOTS),
        ([3], [4], 5090, 3, None),
        ([3], [4], 5100, 4, None),
        ([], [3, 4], 5100, 4, None),  # the event of shot 3 was lost
        ([2, 3], [], None, None, None),
        ([3], [], 5110, None, None),
    ],
)
def test_order_and_time(
    late: list[int], waiting: list[int], taken_s: float | None, shot: int | None, code: Code | None
) -> None:
    """Shots are fired each 10 s, shot 4 at 200 s."""
    claims = {one: claim(one, 160.0 + 10 * one) for one in range(6)}
    found = attribute(clue(taken_s, 260.0), [claims[one] for one in late], [claims[one] for one in waiting], KNOWN)
    assert (found.shot, found.doubt and found.doubt.code) == (shot, code)


def test_no_shot_made_a_file_that_came_before_it_was_fired() -> None:
    assert attribute(clue(None, 199.0), [], [claim(4, 200)], BodyClock()).shot is None


def test_names_in_order_exclude_older_and_newer_shots() -> None:
    late, waiting = [claim(2, 180)], [claim(4, 200)]
    assert attribute(clue(None, after=3), late, waiting, BodyClock()).shot == 4
    assert attribute(clue(None, after=3), late, waiting, BodyClock()).doubt is None
    assert attribute(clue(None, before=3), late, waiting, BodyClock()).shot == 2


def test_two_shots_within_the_clock_s_tolerance_are_rivals() -> None:
    found = attribute(clue(5099.6), [claim(3, 199)], [claim(4, 200)], KNOWN)
    assert found.shot == 4
    assert found.doubt == finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 4), rival=3)


def tiff(order: str, *tags: int) -> bytes:
    mark = {"<": b"II*\0", ">": b"MM\0*"}[order]
    rows = b"".join(struct.pack(order + "HHII", tag, 1, 4, 0) for tag in tags)
    return mark + struct.pack(order + "IH", 8, len(tags)) + rows + b"\0" * 4


@pytest.mark.parametrize(
    ("name", "head", "true"),
    [
        ("capt0000.cr2", tiff("<", 256, 50706), "capt0000.dng"),
        ("capt0000.cr2", tiff(">", 256, 50706), "capt0000.dng"),
        ("capt0000.cr2", tiff("<", 256, 257), "capt0000.cr2"),
        ("IMG_0001.DNG", tiff("<", 256, 50706), "IMG_0001.DNG"),
        ("IMG_0001.CR2", tiff("<", 50706), "IMG_0001.DNG"),
        ("capt0000.jpg", b"II*\0\x10\0\0\0CR\x02\0" + b"\0" * 20, "capt0000.cr2"),
        ("capt0000.cr2", b"\xff\xd8\xff\xe0", "capt0000.jpg"),
        ("capt0000.jpg", b"FUJIFILMCCD-RAW 0201", "capt0000.raf"),
        ("capt0000.nef", b"nobody knows", "capt0000.nef"),
        ("noname", b"\xff\xd8\xff\xe0", "noname"),
    ],
)
def test_the_bytes_decide_the_extension(name: str, head: bytes, true: str) -> None:
    assert true_name(name, head) == true


@given(st.sampled_from([b"", b"II*\0", b"MM\0*"]), st.binary(max_size=64))
def test_any_bytes_are_handled(mark: bytes, rest: bytes) -> None:
    assert true_name("a.cr2", mark + rest).startswith("a.")


@pytest.mark.parametrize("name", ["synthetic_450D.CR2", "synthetic_S5200.RAF", "real_Canon_EOS_450D.jpg"])
def test_real_files_keep_their_names(shared_data: Path, name: str) -> None:
    with (shared_data / "raw" / name).open("rb") as file:
        assert true_name(name, file.read(65536)) == name
