"""A camera on the map, against a model that never leaves Earth-centred coordinates."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dappled.config.profiles import Lens
from dappled.decode.geometry import camera_pose, from_euler
from dappled.decode.geometry.camera_pose import NADIR
from dappled.decode.optics.carriers import Sensor
from dappled.products.maps import eye as eyes
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.eye import Eye, EyeError
from dappled.products.maps.ground import Flat

SENSOR = Sensor((1388, 1844), (0.01, 0.0), (0.0, 0.01))
GRID = np.array([[6.5, 0.0, 0.0], [0.0, 6.5, 0.0]])
SHAPE = (214, 284)
BENT = Lens(50.0, 50.4, (0.05, -0.08), (-0.2, 0.8, 1e-3, -2e-3, 0.3))


def eye_at(
    latitude: float = 41.6,
    longitude: float = -91.5,
    *,
    height_m: float = 100.0,
    tilt_deg: tuple[float, float, float] = (4.0, -6.0, 120.0),
    lens: Lens = BENT,
) -> Eye:
    attitude = from_euler(*(math.radians(angle) for angle in tilt_deg))
    at = Projection(utm(latitude, longitude)).at(latitude, longitude)
    return Eye(
        eyes.intrinsics(SENSOR, lens, GRID),
        lens.distortion,
        at.from_ned() @ camera_pose.matrix_of(attitude) @ NADIR,
        np.array([at.east, at.north, height_m]),
        at.scale,
        SHAPE,
    )


def by_ecef(
    pixel: NDArray[np.float64],
    latitude: float,
    longitude: float,
    *,
    height_m: float,
    tilt_deg: tuple[float, float, float],
    lens: Lens,
) -> NDArray[np.float64]:
    """(latitude, longitude) where the ray meets the ellipsoid's surface at height 0, by steps along it."""
    matrix = eyes.intrinsics(SENSOR, lens, GRID)
    flat = np.linalg.inv(matrix) @ [pixel[0], pixel[1], 1.0]
    x, y = eyes.undistorted(flat[None, :2], lens.distortion)[0]
    attitude = from_euler(*(math.radians(angle) for angle in tilt_deg))
    ned = camera_pose.matrix_of(attitude) @ NADIR @ [x, y, 1.0]
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    start = np.array(to_ecef.transform(longitude, latitude, height_m))
    step = 1e-6
    axes = np.stack(
        [
            (np.array(to_ecef.transform(longitude, latitude + step, height_m)) - start),
            (np.array(to_ecef.transform(longitude + step, latitude, height_m)) - start),
            (np.array(to_ecef.transform(longitude, latitude, height_m - 1.0)) - start),
        ]
    )
    ray = (axes / np.linalg.norm(axes, axis=1)[:, None]).T @ ned
    along = height_m / ned[2]
    for _ in range(8):
        x, y, z = start + along * ray
        there = to_ecef.transform(x, y, z, direction="INVERSE")
        along += there[2] / ned[2]
    return np.array([there[1], there[0]])


PLACES = [
    (0.0, 10.2),
    (41.6, -91.5),
    (60.0, 24.05),
    (-33.9, 18.4),
    (-17.0, 179.99999),
    (-17.0, -179.99999),
    (86.0, 40.0),
]


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (4.0, -6.0, 120.0), (-10.0, 25.0, -70.0)])
def test_rays_meet_the_ground_where_the_round_earth_has_them(
    latitude: float, longitude: float, tilt: tuple[float, float, float]
) -> None:
    """Convergence, scale and the antimeridian: within a millimetre from 100 m above the ellipsoid."""
    eye = eye_at(latitude, longitude, tilt_deg=tilt)
    projection = Projection(utm(latitude, longitude))
    for corner in eye.corners():
        there = by_ecef(corner, latitude, longitude, height_m=100.0, tilt_deg=tilt, lens=BENT)
        expected = np.array(projection.to_map(*there))
        met = Flat(0.0).meet(eye, corner[None])[0]
        assert met[:2] == pytest.approx(expected, abs=2e-3)


def test_yaw_against_grid_north_would_be_off_by_decimetres() -> None:
    """2.6° of convergence at 60° N turn a corner 60 m from the middle by metres: the sign matters."""
    eye = eye_at(60.0, 24.05, height_m=120.0, tilt_deg=(0, 0, 0), lens=Lens(50.0, 50.0))
    up = Flat(0.0).meet(eye, np.array([[eye.matrix[0, 2], -0.5]]))[0, :2] - eye.centre[:2]
    azimuth = math.degrees(math.atan2(up[0], up[1]))
    assert azimuth == pytest.approx(2.56, abs=0.01)  # west of the zone's middle true north leans to the east


@given(st.floats(-0.5, 283.5), st.floats(-0.5, 213.5), st.floats(-50, 60))
def test_project_undoes_rays(x: float, y: float, ground_m: float) -> None:
    met = Flat(ground_m).meet(EYE, np.array([[x, y]]))
    assert EYE.project(met) == pytest.approx(np.array([[x, y]]), abs=1e-6)


EYE = eye_at()


def test_one_homography_is_exact_on_flat_ground() -> None:
    eye = eye_at(lens=Lens(50.0, 50.0))
    to_view = eye.homography(12.0)
    places = Flat(12.0).meet(eye, eye.border(5))
    plane = np.concatenate([places[:, :2] - eye.centre[:2], np.ones((len(places), 1))], axis=1) @ to_view.T
    assert plane[:, :2] / plane[:, 2:] == pytest.approx(eye.border(5), abs=1e-6)


def test_pix4d_zero_has_north_at_the_top_and_east_at_the_right() -> None:
    eye = eye_at(0.0, 9.0, tilt_deg=(0, 0, 0), lens=Lens(50.0, 50.0))
    rows, columns = SHAPE
    top, right = Flat(0.0).meet(eye, np.array([[(columns - 1) / 2, 0.0], [columns - 1.0, (rows - 1) / 2]]))
    assert top[1] > eye.centre[1] + 5
    assert top[0] == pytest.approx(eye.centre[0], abs=0.05)
    assert right[0] > eye.centre[0] + 5


def test_above_the_horizon_is_a_sentence() -> None:
    eye_at().check_horizon("frames/000001.dng")
    with pytest.raises(EyeError, match=r"frames/000001\.dng: the camera looks above the horizon"):
        eye_at(tilt_deg=(0.0, 80.0, 0.0)).check_horizon("frames/000001.dng")
    assert np.isnan(Flat(0.0).meet(eye_at(tilt_deg=(0, 120, 0)), np.array([[100.0, 100.0]]))).all()


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_distortion_and_back(x: float, y: float) -> None:
    plane = np.array([[x, y]])
    assert eyes.undistorted(eyes.distorted(plane, BENT.distortion), BENT.distortion) == pytest.approx(plane, abs=1e-10)


def test_distortion_is_opencvs() -> None:
    cv2 = pytest.importorskip("cv2")
    plane = np.random.default_rng(1).uniform(-0.2, 0.2, (20, 2))
    points = np.concatenate([plane, np.ones((20, 1))], axis=1)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(BENT.distortion))
    assert eyes.distorted(plane, BENT.distortion) == pytest.approx(theirs.reshape(-1, 2), abs=1e-12)


def test_another_aperture_point_sees_from_aside() -> None:
    """θ leaves the scene at x·Z/v − θ·(1 − Z/F): at the focus all views agree, at infinity focus the centre moves."""
    eye = eye_at(tilt_deg=(0, 0, 0), lens=Lens(50.0, 50.0))
    pixel = np.array([[100.0, 80.0]])
    focused = eyes.through(eye, (0.3, -0.2), focus_m=100.0)
    assert Flat(0.0).meet(focused, pixel) == pytest.approx(Flat(0.0).meet(eye, pixel), abs=1e-6)
    aside = Flat(0.0).meet(eyes.through(eye, (0.3, -0.2)), pixel) - Flat(0.0).meet(eye, pixel)
    assert aside[0, :2] == pytest.approx(eye.rotation[:2, :2] @ [0.2, -0.3], rel=1e-3)


def test_moving_an_eye_moves_it_in_ground_metres() -> None:
    moved = EYE.moved(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.01]))
    assert (moved.centre - EYE.centre) == pytest.approx(np.array([EYE.scale, 2 * EYE.scale, 3.0]), abs=1e-9)
    turned = moved.rotation @ EYE.rotation.T
    assert turned[1, 0] == pytest.approx(math.sin(0.01), abs=1e-9)
