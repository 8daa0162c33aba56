"""Random sorties, several faults at once: what is undoubted is true, and each trigger is in one book."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.benchmarks import program


@pytest.fixture(autouse=True)
def _a_path_for_all() -> Iterator[None]:
    """The flown path is kept for all sorties of a run, and not longer."""
    yield
    program("autopilot_cell").sampled.cache_clear()


@pytest.mark.slow
def test_some_sorties_miss_nothing() -> None:
    """Two of them beside seeds that once missed: a receiver's jump of which nothing earlier was known, requests that
    came all at once, and a feedback in UTC right after a step of the boot clock."""
    figures = program("sorties").measure(1, 25)
    assert figures["sorties_missed"] == 0
    assert figures["axes_beyond_6_sigma"] == 0
    assert figures["false_doubts_percent"] < 2
    for seed in (74, 228):
        assert program("sorties").measure(seed, 1)["sorties_missed"] == 0


@pytest.mark.long
@pytest.mark.timeout(900)  # 60 s alone; it only computes, and may share the machine
def test_in_five_hundred_sorties_undoubted_frames_are_true_and_each_trigger_is_in_one_book() -> None:
    figures = program("sorties").measure(1, 500)
    assert figures["sorties"] == 500
    assert figures["sorties_missed"] == 0
    assert figures["axes_beyond_4_sigma_per_5000"] <= 1
    assert figures["axes_beyond_6_sigma"] == 0
    assert 0.8 < figures["time_of_sigma"] < 1.2
    assert 0.8 < figures["place_of_sigma"] < 1.2
    assert figures["false_doubts_percent"] < 2
