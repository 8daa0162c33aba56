"""Ground points appear where the true pose puts them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.geometry import from_euler
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene import flyover, landscape
from dappled.mocks.scene.flyover import TerrainScene
from dappled.mocks.scene.lens import Rays
from tests.mocks.scene import oracles

V_MM = 50.0


@pytest.fixture(scope="module")
def terrain() -> TerrainScene:
    return TerrainScene.of(3)


def rays(points: NDArray[np.float64] | None = None, step_mm: float = 0.1) -> Rays:
    y, x = (np.linspace(-1, 1, n) * (n - 1) * step_mm / 2 for n in (278, 369))
    return Rays(y, x, np.zeros((1, 2)) if points is None else points, V_MM, math.inf)


def above(north: float, east: float, height: float, *, roll: float = 0, pitch: float = 0, yaw: float = 0) -> TruePose:
    return TruePose(
        0.0, (north, east, -height), (0, 0, 0), from_euler(roll, pitch, yaw), (0, 0, 0), 41.0, -91.0, 200 + height
    )


def bowtie_centre(grey: NDArray[np.float32], near: tuple[float, float]) -> tuple[float, float]:
    """Row and column of a painted target: where the picture is most like itself turned by half a turn, and least like
    itself turned by a quarter (two black, two white quarters)."""
    reach = 10
    best, found = -np.inf, (0.0, 0.0)
    for row in range(round(near[0]) - 5, round(near[0]) + 6):
        for column in range(round(near[1]) - 5, round(near[1]) + 6):
            patch = grey[row - reach : row + reach + 1, column - reach : column + reach + 1]
            patch = patch - patch.mean()
            score = float((patch * np.rot90(patch, 2)).sum() - (patch * np.rot90(patch)).sum())
            if score > best:
                best, found = score, (row, column)
    return found


@pytest.mark.long
def test_painted_targets_are_found_where_the_pose_projects_them(terrain: TerrainScene) -> None:
    seen = 0
    for number, target in enumerate(terrain.ground.targets):
        pose = above(target.north_m + 1.0, target.east_m - 0.8, 12.0, roll=0.06, pitch=-0.04, yaw=0.7 * number)
        look = rays()
        y, x = oracles.place_on_sensor_mm(pose, (target.north_m, target.east_m, -target.height_m), V_MM)
        expected = (y - look.y_mm[0]) / 0.1, (x - look.x_mm[0]) / 0.1
        grey = terrain.render(look, pose).radiance[0].mean(axis=0)
        row, column = bowtie_centre(grey, expected)
        assert abs(row - expected[0]) <= 1
        assert abs(column - expected[1]) <= 1
        seen += 1
    assert seen >= 10


def test_the_top_of_the_picture_is_the_nose_and_the_right_is_the_right() -> None:
    north_facing = above(0, 0, 12.0)
    assert oracles.place_on_sensor_mm(north_facing, (2.0, 0.0, 0.0), V_MM)[0] < 0
    assert oracles.place_on_sensor_mm(north_facing, (0.0, 2.0, 0.0), V_MM)[1] > 0
    east_facing = above(0, 0, 12.0, yaw=math.pi / 2)
    assert oracles.place_on_sensor_mm(east_facing, (0.0, 2.0, 0.0), V_MM)[0] < 0
    with pytest.raises(ValueError, match="not below"):
        oracles.place_on_sensor_mm(north_facing, (0.0, 0.0, -20.0), V_MM)


def test_depth_times_ray_lies_on_the_ground(terrain: TerrainScene) -> None:
    pose = FlightPath(3).pose(12.0)
    look = rays(step_mm=0.2)
    depth = terrain.render(look, pose).depth_m
    assert depth is not None
    y, x = np.meshgrid(look.y_mm / V_MM, look.x_mm / V_MM, indexing="ij")
    body = np.stack([-y * depth, x * depth, depth], axis=-1)
    ned = body @ flyover.rotation(pose.attitude).T + np.array(pose.position_ned_m)
    relief = terrain.ground.relief
    n = len(relief)
    row = np.round(-ned[..., 0] / 0.05).astype(int) + n // 2
    column = np.round(ned[..., 1] / 0.05).astype(int) + n // 2
    error = np.abs(-ned[..., 2] - relief[row % n, column % n])
    assert np.quantile(error, 0.9) < 0.05  # half a texel off, on slopes
    assert np.median(error) < 0.01


def test_another_aperture_point_sees_the_ground_shifted_by_its_parallax(terrain: TerrainScene) -> None:
    # 40 cm apart and focused at infinity, 12 m above flat ground: v/Z of it on the sensor
    pose = above(5.0, -3.0, 14.0)
    centre = terrain.render(rays(), pose)
    assert centre.depth_m is not None
    shift_mm = 0.4 * V_MM / float(np.median(centre.depth_m))
    assert 1 < shift_mm < 2
    aside = terrain.render(rays(np.array([[0.0, 400.0]])), pose).radiance[0, 1]
    step = round(shift_mm / 0.1)
    same = np.corrcoef(aside[60:-60, 60:-60].ravel(), centre.radiance[0, 1][60:-60, 60 - step : -60 - step].ravel())
    other = np.corrcoef(aside[60:-60, 60:-60].ravel(), centre.radiance[0, 1][60:-60, 60 + step : -60 + step].ravel())
    assert same[0, 1] > 0.8
    assert other[0, 1] < same[0, 1] - 0.2


def test_bad_views_of_the_ground_are_refused(terrain: TerrainScene) -> None:
    with pytest.raises(ValueError, match="path"):
        terrain.render(rays(), None)
    with pytest.raises(ValueError, match="horizon"):
        terrain.render(rays(), above(0, 0, 12.0, pitch=1.4))
    with pytest.raises(ValueError, match="flies into the ground"):
        terrain.render(rays(), above(0, 0, -3.0))


def test_the_same_seed_builds_the_same_ground(terrain: TerrainScene) -> None:
    landscape.build.cache_clear()  # what is kept would be compared with itself
    again = TerrainScene.of(3).ground
    assert again is not terrain.ground
    np.testing.assert_array_equal(again.relief, terrain.ground.relief)
    np.testing.assert_array_equal(again.albedo, terrain.ground.albedo)
    assert again.targets == terrain.ground.targets


def test_no_texture_is_finer_than_asked_for(terrain: TerrainScene) -> None:
    detail = terrain.ground.detail
    spectrum = np.abs(np.fft.rfft2(detail)) ** 2
    frequency = np.hypot(np.fft.fftfreq(len(detail), 0.0125)[:, None], np.fft.rfftfreq(len(detail), 0.0125)[None, :])
    assert spectrum[frequency > 1 / 0.037].sum() < 0.01 * spectrum[1:].sum()
