"""Where the camera looks, against geometry done the long way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dappled.config.settings import PoseSettings
from dappled.decode.geometry.field_of_view import EARTH_RADIUS_M, angle_rad, look
from tests.daemon.fakes import no_pose

LEVEL = replace(
    no_pose(),
    latitude_rad=0.8,
    longitude_rad=0.1,
    altitude_msl_m=500.0,
    height_above_home_m=100.0,
    attitude=(1.0, 0.0, 0.0, 0.0),
)

DOWN = PoseSettings().mount


def test_a_camera_that_looks_down_sees_what_is_below() -> None:
    attitude, ground = look(LEVEL, DOWN)
    assert ground == pytest.approx((0.8, 0.1, 400.0))
    assert attitude is not None
    forward = Rotation.from_quat(attitude, scalar_first=True).apply([1, 0, 0])
    assert forward == pytest.approx([0, 0, 1], abs=1e-12)


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.floats(-3.1, 3.1))
def test_the_axis_meets_the_ground_where_it_should(roll: float, pitch: float, yaw: float) -> None:
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    attitude, ground = look(replace(LEVEL, attitude=tuple(turn.as_quat(scalar_first=True))), DOWN)
    axis = turn.apply(np.array(DOWN).reshape(3, 3) @ [0, 0, 1])
    north, east = axis[0] / axis[2] * 100, axis[1] / axis[2] * 100
    assert attitude is not None
    assert ground is not None
    assert (ground[0] - 0.8) * EARTH_RADIUS_M == pytest.approx(north, abs=1e-3)
    assert (ground[1] - 0.1) * EARTH_RADIUS_M * math.cos(0.8) == pytest.approx(east, abs=1e-3)
    found = Rotation.from_quat(attitude, scalar_first=True)
    assert found.apply([1, 0, 0]) == pytest.approx(axis, abs=1e-9)
    assert found.apply([0, 1, 0]) == pytest.approx(turn.apply(np.array(DOWN).reshape(3, 3) @ [1, 0, 0]), abs=1e-9)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda one: math.hypot(*one) > 0.1))
def test_a_camera_in_any_attitude_has_that_attitude(parts: tuple[float, float, float, float]) -> None:
    """Each of the four ways to a quaternion, as any of its numbers may be the largest."""
    turn = Rotation.from_quat(parts, scalar_first=True)
    attitude, _ = look(replace(LEVEL, attitude=tuple(turn.as_quat(scalar_first=True))), DOWN)
    assert attitude is not None
    right, down, forward = (turn.apply(axis) for axis in np.array(DOWN).reshape(3, 3).T)
    found = Rotation.from_quat(attitude, scalar_first=True)
    assert found.as_matrix() == pytest.approx(np.stack([forward, right, down], axis=1), abs=1e-9)


def test_towards_the_sky_without_a_pose_or_a_height_there_is_no_ground() -> None:
    assert look(None, DOWN) == (None, None)
    assert look(no_pose(), DOWN) == (None, None)
    assert look(replace(LEVEL, height_above_home_m=None), DOWN)[1] is None
    assert look(replace(LEVEL, attitude=(0.0, 1.0, 0.0, 0.0)), DOWN)[1] is None


def test_the_angle_of_a_side() -> None:
    assert angle_rad(36.0, 18.0) == pytest.approx(math.pi / 2)
    assert angle_rad(None, 18.0) is None
    assert angle_rad(36.0, None) is None
