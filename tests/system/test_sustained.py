"""Frames come faster than they can be decoded: nothing is lost, memory stays flat."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks import program


@pytest.mark.parametrize(
    ("seconds", "rate", "megabytes"),
    [(2.0, 8.0, 1.0), pytest.param(20.0, 4.0, 11.0, marks=[pytest.mark.long, pytest.mark.alone])],
)
def test_frames_come_faster_than_they_can_be_decoded(
    tmp_path: Path, seconds: float, rate: float, megabytes: float
) -> None:
    figures = program("sustained").measure(tmp_path, seconds, rate, round(megabytes * 1e6), decode_s=0.5)
    assert figures["shots"] == figures["frames"] == rate * seconds
    assert figures["lost"] == 0
    assert figures["left_undecoded"] > 0
    assert figures["decoded"] + figures["left_undecoded"] == figures["frames"]
    assert figures["resident_growth_mb"] < 3 * megabytes
    assert figures["memfd_growth_mb"] <= 2 * megabytes
