"""A short simulated flight with everything that only the simulation knows: poses, relief, the ground's true picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from dappled.clock import RecordedClock
from dappled.decode.geometry import Pose, Quaternion, camera_pose, metres_per_radian
from dappled.drivers.raw.recipe import Recipe
from dappled.flight import Recording, recording
from dappled.mocks import simulation
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene import landscape
from dappled.mocks.scene.flyover import TerrainScene
from dappled.mocks.scene.landscape import DETAIL_TEXEL_M, EXTENT_M, TEXEL_M
from dappled.mocks.scene.masked_camera import MaskedCamera, Truth, reference_camera
from dappled.mocks.simulation import CAMERA, MASK
from tests.flight.makers import deliver, hot_shoe_tag, request

START_NS = 1_795_256_103_000_000_000
F_NUMBER = 14.8


Told = Callable[[int, TruePose], TruePose]


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """The flight on disk, how to decode it, and the truth of each frame."""

    folder: Path
    recipe: Recipe
    path: FlightPath
    truths: tuple[Truth, ...]
    ground: landscape.Landscape

    def to_geodetic(
        self, north_m: NDArray[np.float64], east_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(latitude, longitude) in degrees of places near home, as the simulated path counts them."""
        per_north, per_east = metres_per_radian(
            math.radians(self.path.home_latitude_deg), self.path.home_altitude_msl_m
        )
        return (
            self.path.home_latitude_deg + np.degrees(north_m / per_north),
            self.path.home_longitude_deg + np.degrees(east_m / per_east),
        )


def half_camera(seed: int, path: FlightPath) -> MaskedCamera:
    """The reference camera with the inner half of its sensor."""
    return reference_camera(seed, scale=0.5, path=path)


def fly(
    folder: Path,
    *,
    seed: int = 3,
    times_s: Sequence[float] = (1.0, 1.6, 2.2),
    path: FlightPath | None = None,
    told: Told = lambda _, pose: pose,
    noise: bool = True,
) -> Flown:
    """Frames triggered at these times; the ledger gets the pose that `told` makes of each true one."""
    path = path or FlightPath(seed)
    camera = half_camera(seed, path)
    if not noise:
        camera = replace(camera, sensor=replace(camera.sensor, shot_noise=False, read_noise_e=0.0))
    scene = camera.scene
    assert isinstance(scene, TerrainScene)
    begun = recording.begin(folder / "flights", RecordedClock(START_NS))
    truths = []
    for index, time_s in enumerate(times_s):
        exposure = camera.expose(time_s, index, f_number=F_NUMBER)
        truth = exposure.truth
        assert truth.pose is not None
        truths.append(truth)
        record(begun, index, exposure.file, F_NUMBER, as_recorded(told(index, truth.pose)))
    begun.close()
    calibration = simulation.write_calibration(camera, folder)
    recipe = Recipe(camera=CAMERA, mask=MASK, calibration=str(calibration))
    return Flown(begun.folder.path, recipe, path, tuple(truths), scene.ground)


def record(begun: Recording, index: int, data: bytes, f_number: float, pose: Pose) -> None:
    """A frame of a shot, with its tag by the hot shoe."""
    request(begun, index)
    frame = deliver(begun, index, data, f"IMG_{index:04d}.DNG")
    begun.ledger.add_tag(hot_shoe_tag(frame, pose, f_number))


def as_recorded(true: TruePose) -> Pose:
    """A pose as the daemon would have noted it."""
    utc_ns = START_NS + round(true.t_s * 1e9)
    return Pose(
        source="interpolated",
        utc_ns=utc_ns,
        boot_us=None,
        latitude_rad=math.radians(true.latitude_deg),
        longitude_rad=math.radians(true.longitude_deg),
        altitude_msl_m=true.altitude_msl_m,
        height_above_home_m=-true.position_ned_m[2],
        velocity_ned_m_s=true.velocity_ned_m_s,
        attitude=true.attitude,
        position_sigma_m=0.02,
        attitude_sigma_rad=0.001,
        age_ms=1.0,
        telemetry_packets=1,
    )


def turned(attitude: Quaternion, by: NDArray[np.float64]) -> Quaternion:
    """An attitude turned by a small rotation matrix about body axes."""
    x, y, z, w = (float(v) for v in Rotation.from_matrix(camera_pose.matrix_of(attitude) @ by).as_quat())
    return w, x, y, z


def true_ground(truth: Truth, row: int, column: int) -> NDArray[np.float64]:
    """(north, east, height above home) that a sample of the truth's views shows."""
    assert truth.pose is not None
    assert truth.depth_m is not None
    shape = truth.depth_m.shape
    row, column = row % shape[0], column % shape[1]
    rows, columns = 1388, 1844
    y = (truth.grid[0, 0] * row - (rows - 1) / 2) * 0.01 / 50.0
    x = (truth.grid[1, 1] * column - (columns - 1) / 2) * 0.01 / 50.0
    turn = camera_pose.matrix_of(truth.pose.attitude)
    ned = np.array(truth.pose.position_ned_m) + turn @ np.array([-y, x, 1.0]) * float(truth.depth_m[row, column])
    return np.array([ned[0], ned[1], -ned[2]])


def write_relief(flown: Flown, path: Path) -> Path:
    """The landscape's true heights above sea level as a GeoTIFF in degrees."""
    heights = flown.ground.relief[None] + np.float32(flown.path.home_altitude_msl_m)
    return _write(flown, path, heights, TEXEL_M)


def write_base_map(flown: Flown, path: Path, step_m: float = 0.025) -> Path:
    """The landscape's true picture, as an orthophoto would show it."""
    n = round(EXTENT_M / step_m)
    index = (np.arange(n) + 0.5 - 0.5 * TEXEL_M / step_m) * step_m / TEXEL_M  # cell centres, in landscape texels
    at = np.stack(np.meshgrid(index, index, indexing="ij"))
    smooth = ndimage.gaussian_filter(flown.ground.detail, 0.3 * step_m / DETAIL_TEXEL_M, mode="wrap")
    detail = ndimage.map_coordinates(smooth, at * (TEXEL_M / DETAIL_TEXEL_M), order=1, mode="grid-wrap")
    texture = 1 + detail * ndimage.map_coordinates(flown.ground.roughness, at, order=1, mode="grid-wrap")
    colours = np.stack(
        [ndimage.map_coordinates(plane, at, order=1, mode="grid-wrap") * texture for plane in flown.ground.albedo]
    )
    eight = np.clip(255 * np.sqrt(np.clip(colours, 0, None) / 0.4), 0, 255).astype(np.uint8)
    return _write(flown, path, eight, step_m)


def _write(flown: Flown, path: Path, values: NDArray[np.generic], step_m: float) -> Path:
    rows, columns = values.shape[1:]
    # the first texel's centre lies half the extent north and west of home
    north = np.array([EXTENT_M / 2 + TEXEL_M / 2, EXTENT_M / 2 + TEXEL_M / 2 - step_m])
    east = np.array([-EXTENT_M / 2 - TEXEL_M / 2, -EXTENT_M / 2 - TEXEL_M / 2 + step_m])
    latitude, longitude = flown.to_geodetic(north, east)
    transform = rasterio.Affine(longitude[1] - longitude[0], 0, longitude[0], 0, latitude[1] - latitude[0], latitude[0])
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=len(values), dtype=values.dtype, crs="EPSG:4326",
        transform=transform,
    ) as target:  # fmt: skip
        target.write(values)
    return path
