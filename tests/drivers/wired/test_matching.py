"""Matching shots and files, against flights whose truth is known."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.wired import matching
from dappled.drivers.wired.matching import DatedFile, FiredShot, in_order, match, seconds
from dappled.findings import text, told


def flown(intervals_s: list[float], offset_s: float, seed: int = 0) -> tuple[list[FiredShot], list[DatedFile]]:
    """Shots at these intervals, and the files of a camera whose clock is off."""
    rng = random.Random(seed)  # noqa: S311  # a simulation
    shots, files, now_s = [], [], 1_700_000_000.25
    for index, step_s in enumerate(intervals_s):
        now_s += step_s
        shots.append(FiredShot(index, now_s))
        shown_s = math.floor(now_s + 0.06 + rng.uniform(-0.015, 0.015) + offset_s)
        files.append(DatedFile(f"DSCF{index + 1:04d}.RAF", float(shown_s)))
    return shots, files


def truth(files: list[DatedFile]) -> tuple[tuple[int, str], ...]:
    return tuple((int(one.name[4:8]) - 1, one.name) for one in files)


intervals = st.lists(st.floats(0.5, 60.0), min_size=1, max_size=30)


@given(intervals, st.floats(-80_000, 80_000), st.integers(0, 100))
def test_as_many_files_as_shots_are_all_matched(steps: list[float], offset_s: float, seed: int) -> None:
    shots, files = flown(steps, offset_s, seed)
    found = match(shots, files)
    assert found.pairs == truth(files)
    assert (found.shots, found.files, found.doubts) == ((), (), ())
    assert found.offset_s is not None
    assert abs(found.offset_s - offset_s) < 1.2


@given(intervals, st.floats(-80_000, 80_000), st.data())
def test_with_files_missing_a_sure_pair_is_a_true_pair(
    steps: list[float], offset_s: float, data: st.DataObject
) -> None:
    shots, files = flown(steps, offset_s)
    kept = data.draw(st.lists(st.sampled_from(files), unique=True))
    known = data.draw(st.sampled_from([None, offset_s]))
    found = match(shots, kept, offset_s=known)
    assert set(found.pairs) <= set(truth(files))
    assert {name for _, name in found.pairs} | set(found.files) == {one.name for one in kept}
    assert {index for index, _ in found.pairs} | set(found.shots) == {shot.index for shot in shots}


def test_an_irregular_flight_shows_which_file_is_missing() -> None:
    shots, files = flown([3, 4, 7, 3, 5, 11, 4, 6], 3600.0)
    del files[3]
    found = match(shots, files)
    assert found.pairs == truth(files)
    assert found.shots == (3,)
    assert found.doubts == ()


def test_a_regular_flight_with_a_file_missing_is_in_doubt_and_says_so() -> None:
    shots, files = flown([5.0] * 6, 3600.0)
    del files[2]
    found = match(shots, files)
    assert all(pair in truth(files) for pair in found.pairs)
    shots, files = flown([5.0] * 6, 3600.0)
    found = match(shots, files[1:])
    assert found.pairs == ()
    assert len(found.doubts) == 5
    assert "DSCF0002.RAF: it may be of shot 0 or 1" in str(told(found.doubts[0]))


def test_a_known_offset_settles_it() -> None:
    shots, files = flown([5.0] * 6, 3600.0)
    assert match(shots, files[1:], offset_s=3600.0).pairs == truth(files[1:])


def test_of_two_shots_in_one_second_with_one_file_neither_is_chosen() -> None:
    shots, files = flown([3, 0.3, 7, 4], 0.0)
    del files[1]
    found = match(shots, files)
    assert found.pairs == ((2, "DSCF0003.RAF"), (3, "DSCF0004.RAF"))
    assert [str(text(one)) for one in found.doubts] == [
        "it may be of shot 0 or 1: order, count and time don't decide it"
    ]


def test_files_of_before_the_flight_are_left() -> None:
    shots, files = flown([3, 4, 7, 3, 5], 0.0)
    old = [DatedFile(f"DSCF{9000 + n}.RAF", 1_699_000_000.0 + 100 * n) for n in range(20)]
    found = match(shots, [*old, *files])
    assert found.pairs == truth(files)
    assert set(found.files) == {one.name for one in old}
    assert found.doubts == ()


def test_a_clock_that_was_never_set_is_doubted() -> None:
    shots, files = flown([3, 4, 7], -500 * 86400.0)
    found = match(shots, files)
    assert found.pairs == ()
    assert "500 days" in str(told(found.doubts[0]))
    assert match(shots, files, plausible_s=math.inf).pairs == truth(files)


def test_files_without_a_time_are_in_doubt_and_may_be_taken_by_order() -> None:
    shots, files = flown([3, 4], 0.0)
    bare = [DatedFile(one.name, None) for one in files]
    found = match(shots, bare)
    assert (found.pairs, len(found.doubts)) == ((), 2)
    assert in_order(shots, bare) == truth(files)
    assert in_order(shots, bare[1:]) is None


def test_windows_that_can_t_hold_as_many_pairs_are_not_looked_into(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = random.Random(3)  # noqa: S311  # a simulation
    shots, files = flown([rng.uniform(2, 9) for _ in range(60)], 3600.0)
    old, _ = flown([rng.uniform(2, 9) for _ in range(200)], 0.0)
    others = [DatedFile(f"OLD{one.index}.RAF", float(math.floor(one.fired_s - 40_000))) for one in old]
    chains, looked = matching._chains, []

    def counted(fits: Any) -> Any:
        looked.append(1)
        return chains(fits)

    monkeypatch.setattr(matching, "_chains", counted)
    assert match(shots, [*others, *files]).pairs == truth(files)
    assert len(looked) < 30
    bounds, dozen = matching._bounds, np.array([0.0, 0.1, 1.6])
    assert list(bounds(np.array([[0.0, 1.0], [1.65, -2.0]]), dozen)) == [1, 2, 1]


def test_nothing_to_match() -> None:
    assert match([], []).pairs == ()
    assert match([FiredShot(1, 0.0)], []).shots == (1,)
    assert match([], [DatedFile("a", 0.0)]).files == ("a",)


@pytest.mark.parametrize(
    ("text", "s"), [("1970-01-01T00:00:10", 10.0), ("1970-01-01T00:00:10.5", 10.5), (None, None), ("x", None)]
)
def test_seconds(text: str | None, s: float | None) -> None:
    assert seconds(text) == s
