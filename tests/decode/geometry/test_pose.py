"""Turn rates between two attitudes, against a sway whose rates are known at every instant."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from dappled.decode.geometry import from_euler, turn_rates
from dappled.decode.geometry.pose import slerp


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


QUATERNIONS = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda one: math.hypot(*one) > 0.1)


@given(QUATERNIONS, st.tuples(*[st.floats(-1, 1)] * 3), st.sampled_from([1.0, 1e-3, 0.02]), st.floats(0, 1))
def test_between_two_attitudes_lies_the_shorter_turn(
    parts: tuple[float, float, float, float], turn: tuple[float, float, float], size: float, share: float
) -> None:
    """Small turns too, where the arc is taken for its chord; either sign is the same attitude."""
    first = Rotation.from_quat(parts, scalar_first=True)
    ends = [first, Rotation.from_rotvec([size * one for one in turn]) * first]
    wanted = Slerp([0, 1], Rotation.concatenate(ends))([share])[0]
    a, b = (tuple(one.as_quat(scalar_first=True)) for one in ends)
    for sign in (1, -1):
        found = Rotation.from_quat(slerp(a, tuple(sign * one for one in b), share), scalar_first=True)
        assert (found * wanted.inv()).magnitude() < 1e-6
