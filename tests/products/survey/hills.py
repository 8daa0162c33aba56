"""Flights over simulated boards at any height, with what only the simulation knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dappled.clock import RecordedClock
from dappled.decode.geometry import Quaternion
from dappled.drivers.raw.recipe import Recipe
from dappled.flight import recording
from dappled.mocks import simulation
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene.bench import Bench, TexturedPlane
from dappled.mocks.scene.masked_camera import MaskedCamera, Truth, reference_camera
from dappled.mocks.scene.synthesis import PASS, Grid
from dappled.mocks.simulation import CAMERA, MASK
from tests.products.flown import START_NS, as_recorded, record

F_NUMBER = 7.4  # the widest
LEVEL_NORTH: Quaternion = (1.0, 0.0, 0.0, 0.0)


def slope(seed: int, height_m: float, relief_m: float, scale: float) -> MaskedCamera:
    """A camera above ground that rises by `relief_m` over its footprint, with texture as fine as a slice carries."""
    camera = reference_camera(seed, scale=scale, scene="bench", path=FlightPath(seed, height_m=height_m))
    wide_m = camera.sensor.shape[1] * camera.sensor.pitch_mm / camera.optics.focal_length_mm * height_m
    finest = PASS * min(Grid.of(camera.sensor.shape, camera.lattice).half_band)
    board = TexturedPlane(height_m, tilt=(0.0, relief_m / wide_m))
    return replace(camera, scene=Bench.of(seed, (board,), camera.sensor.pitch_mm / finest))


def frames(folder: Path, camera: MaskedCamera, poses: Sequence[TruePose]) -> tuple[Path, Recipe, list[Truth]]:
    """(flight, how to decode it, truths): a frame at each pose, which the ledger gets as it is."""
    begun = recording.begin(folder / "flights", RecordedClock(START_NS))
    truths = []
    for index, pose in enumerate(poses):
        exposure = camera.expose(float(index), index, f_number=F_NUMBER)
        truths.append(exposure.truth)
        record(begun, index, exposure.file, F_NUMBER, as_recorded(pose))
    begun.close()
    calibration = simulation.write_calibration(camera, folder)
    return begun.folder.path, Recipe(camera=CAMERA, mask=MASK, calibration=str(calibration)), truths


def level(seed: int, height_m: float) -> TruePose:
    """Right above home, looking straight down, the picture's top to the north."""
    path = FlightPath(seed, height_m=height_m)
    return replace(
        path.pose(0.0),
        position_ned_m=(0.0, 0.0, -height_m),
        attitude=LEVEL_NORTH,
        latitude_deg=path.home_latitude_deg,
        longitude_deg=path.home_longitude_deg,
        altitude_msl_m=path.home_altitude_msl_m + height_m,
    )
