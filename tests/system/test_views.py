"""Views decoded from simulated raw files against what the simulated camera really saw, its secrets never told."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomli_w

from dappled.cli.calibrate import from_frames
from dappled.drivers.darkroom import Darkroom, Recipe
from dappled.mocks.masked_camera import reference_camera
from tests.system.quality import score

CAMERA, MASK = "reference-36mm", "reference-5x5"


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_views_beat_30_db_and_the_mean_over_views_by_5(seed: int, tmp_path: Path) -> None:
    camera = reference_camera(seed, scale=0.5, scene="bench")
    (tmp_path / "bench.dng").write_bytes(camera.bench_frame().file)
    calibration = from_frames(Darkroom(Recipe(CAMERA, MASK)), [tmp_path / "bench.dng"])
    (tmp_path / "calibration.toml").write_text(tomli_w.dumps(calibration.to_dict()))
    exposure = camera.expose(0.0, 0)
    (tmp_path / "frame.dng").write_bytes(exposure.file)
    darkroom = Darkroom(Recipe(CAMERA, MASK, calibration=str(tmp_path / "calibration.toml")))
    found = darkroom.develop(tmp_path / "frame.dng").light_field
    reached = score(found, exposure.truth, least_disparity_px=3.0, pixel_mm=camera.sensor.pitch_mm)
    assert reached.pixels > 10_000
    assert reached.views_db >= 30
    assert reached.views_db >= reached.mean_db + 5


@pytest.mark.parametrize("seed", [6, 7])
def test_views_of_a_scene_without_parallax_are_no_worse_than_their_mean(seed: int, tmp_path: Path) -> None:
    (tmp_path / "bench.dng").write_bytes(reference_camera(seed, scale=0.5, scene="bench").bench_frame().file)
    calibration = from_frames(Darkroom(Recipe(CAMERA, MASK)), [tmp_path / "bench.dng"])
    (tmp_path / "calibration.toml").write_text(tomli_w.dumps(calibration.to_dict()))
    camera = reference_camera(seed, scale=0.5, scene="terrain")
    exposure = camera.expose(0.0, 0)
    (tmp_path / "frame.dng").write_bytes(exposure.file)
    darkroom = Darkroom(Recipe(CAMERA, MASK, calibration=str(tmp_path / "calibration.toml")))
    found = darkroom.develop(tmp_path / "frame.dng").light_field
    reached = score(found, exposure.truth, least_disparity_px=0.0, pixel_mm=camera.sensor.pitch_mm)
    assert reached.views_db >= reached.mean_db - 0.3, reached


def test_the_mask_s_installation_is_found(tmp_path: Path) -> None:
    """Rotation and distance from one stopped-down frame; the simulator drew them from its seed."""
    for seed in (11, 12):
        camera = reference_camera(seed, scale=0.5, scene="white")
        (tmp_path / "bench.dng").write_bytes(camera.bench_frame().file)
        (fit,) = from_frames(Darkroom(Recipe(CAMERA, MASK)), [tmp_path / "bench.dng"]).fits
        assert fit.rotation_rad == pytest.approx(camera.installed.rotation_rad, abs=2e-5)
        assert fit.mask_distance_mm == pytest.approx(camera.installed.distance_mm, rel=2e-3)
