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


MISSED = (
    ("ArduPilot, CAM1_TYPE 6, pin", "every packet twice, link holds", 1.0, 74),
    ("ArduPilot, servo", "clock steps, late packets", 5.0, 228),
    ("ArduPilot, servo", "clock steps, link holds", 5.0, 468),
    ("PX4, TRIG_INTERFACE 1", "clock steps, every packet twice", 1.0, 413),
    ("ArduPilot, servo", "autopilot crashes", 1.0, 101),
    ("ArduPilot, servo, pin", "autopilot crashes, late packets, link down", 5.0, 421),
    ("ArduPilot, servo", "clock steps, daemon crashes", 1.0, 463),
    ("ArduPilot, CAM1_TYPE 6, pin", "clock steps, link down", 5.0, 2097),
    ("PX4, TRIG_INTERFACE 1", "autopilot crashes, every packet twice, link holds", 1.0, 2253),
    ("ArduPilot, CAM1_TYPE 6, pin", "daemon crashes, glitch", 5.0, 0),
)


@pytest.mark.slow
def test_some_sorties_miss_nothing() -> None:
    """Beside them some that once missed: requests that came all at once, a feedback in UTC right after a step of the
    boot clock, a clock that stepped while the link held its bytes, copies of a trigger around a step, the first
    triggers of an autopilot that has started again, the contact of a frame after a step that is where one before it
    should be, copies of an autopilot's last messages after the first ones of its next start, and a daemon that starts
    while the receiver is off."""
    figures = program("sorties").measure(1, 25)
    assert figures["sorties_missed"] == 0
    assert figures["axes_beyond_6_sigma"] == 0
    assert figures["false_doubts_percent"] < 2
    world, sorties = program("autopilot_cell"), program("sorties")
    for wiring, faults, hz, seed in MISSED:
        cell = world.Cell(wiring, faults, hz)
        assert sorties.wrong(cell, world.fly(cell, sorties.BURSTS, seed)) == [], cell


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
