"""Turn rates between two attitudes, against a sway whose rates are known at every instant."""

from __future__ import annotations

import math

import pytest

from dappled.decode.geometry import from_euler, turn_rates


@pytest.mark.parametrize("phase", [-0.5, -0.25, 0.0, 0.2])
@pytest.mark.parametrize(("span_s", "error"), [(0.1, 0.03), (0.15, 0.1)])
def test_a_sway_between_two_attitudes_is_found_by_the_turn_between_them(
    span_s: float, error: float, phase: float
) -> None:
    """3 Hz: at 10 attitudes a second its rate may be slow at both ends and fast in between."""
    most, turns = 0.35, 2 * math.pi * 3.0  # rad/s
    times = [span_s * (phase - 0.5), span_s * (phase + 0.5)]
    ends = [from_euler(most / turns * math.sin(turns * t), 0.0, 0.0) for t in times]
    rates = [(most * math.cos(turns * t), 0.0, 0.0) for t in times]
    middle = most * math.cos(turns * span_s * phase)
    found = turn_rates((ends[0], ends[1]), (rates[0], rates[1]), span_s, 0.5)
    assert found[0] == pytest.approx(middle, abs=error * most)
    assert found[1:] == pytest.approx((0.0, 0.0), abs=1e-9)
    at_end = turn_rates((ends[0], ends[1]), (rates[0], rates[1]), span_s, 1.0)
    assert at_end == pytest.approx(rates[1])
