"""Where a frame lies on flat ground, against rays that are drawn by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.geometry import camera_pose, footprint
from dappled.decode.geometry.footprint import OrientedFrame

METRE_DEG = 180 / math.pi / 6378137.0  # of longitude on the equator


def oriented(
    yaw_deg: float = 0.0, pitch_deg: float = 0.0, latitude_deg: float = 0.0, longitude_deg: float = 10.0
) -> OrientedFrame:
    y, p = math.radians(yaw_deg) / 2, math.radians(pitch_deg) / 2
    attitude = (
        math.cos(y) * math.cos(p),
        -math.sin(y) * math.sin(p),
        math.cos(y) * math.sin(p),
        math.sin(y) * math.cos(p),
    )
    rotation = camera_pose.matrix_of(attitude) @ camera_pose.NADIR
    return OrientedFrame((20.0, 40.0), 50.0, rotation, 100.0, latitude_deg, longitude_deg)


def test_straight_down_and_north_the_picture_s_top_is_north() -> None:
    corners = footprint.corners(oriented())
    assert corners is not None
    (top, left), (_, right), (bottom, _), _ = corners
    assert (right - left) / METRE_DEG == pytest.approx(80.0, rel=1e-6)  # 40 mm over 50 mm at 100 m
    assert (left + right) / 2 == pytest.approx(10.0, abs=1e-9)
    assert top > 0 > bottom
    assert (top - bottom) * 110_574.3 == pytest.approx(40.0, rel=1e-4)  # metres a degree at the equator


def test_turned_to_the_east_its_top_is_east() -> None:
    corners = footprint.corners(oriented(yaw_deg=90))
    assert corners is not None
    (lat, lon), *_ = corners
    assert (lon - 10.0) / METRE_DEG == pytest.approx(20.0, rel=1e-6)
    assert lat * 110_574.3 == pytest.approx(40.0, rel=1e-4)


@given(st.floats(0, 360), st.floats(-30, 30), st.floats(-60, 60))
def test_the_middle_of_a_marked_picture_lies_where_the_axis_meets_the_ground(
    yaw: float, pitch: float, latitude: float
) -> None:
    one = oriented(yaw, pitch, latitude)
    picture = np.zeros((100, 200), dtype=np.uint8)
    picture[47:53, 96:104] = 255
    made = footprint.rectify(one, picture, 240)
    assert made is not None
    axis = one.rotation @ np.array([0.0, 0.0, 1.0])
    north, east = axis[:2] / axis[2] * 100.0
    rows, columns = np.nonzero(made.picture[..., 0] > 128)
    height, width = made.picture.shape[:2]
    lat = made.north - (rows.mean() + 0.5) / height * (made.north - made.south)
    lon = made.west + (columns.mean() + 0.5) / width * (made.east - made.west)
    at_lat, at_lon = footprint._degrees(one, float(north), float(east))
    assert lat == pytest.approx(at_lat, abs=1.5e-5)
    assert (lon - at_lon) * math.cos(math.radians(latitude)) == pytest.approx(0, abs=1.5e-5)


def test_towards_the_horizon_there_is_no_footprint() -> None:
    one = oriented(pitch_deg=70)
    assert footprint.corners(one) is None
    assert footprint.rectify(one, np.zeros((4, 8), dtype=np.uint8), 16) is None


def test_over_the_antimeridian_longitudes_stay_within_half_a_turn() -> None:
    corners = footprint.corners(oriented(longitude_deg=179.9999))
    assert corners is not None
    assert min(lon for _, lon in corners) < -179.9
    assert max(lon for _, lon in corners) > 179.9
