"""A whole flight in virtual time: the laws of the pipeline hold over it, and its seed gives every byte of it."""

from __future__ import annotations

from pathlib import Path

from tests.simulated.virtual_flight import Plan, fly
from tests.system.flying import assert_whole


def test_a_flight_over_a_bad_link_balances(tmp_path: Path) -> None:
    flown = fly(Plan(seed=1, frames=3, interval_s=2.0, hz=2.0), tmp_path, b"frame")
    assert len(flown.outcomes) == 3
    assert_whole(flown.folder)
