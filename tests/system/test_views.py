"""Views decoded from simulated raw files against what the simulated camera really saw, its secrets never told."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from dappled.cli import main
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.findings import Code
from dappled.mocks import shoot
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera
from tests.simulated.calibration import from_frame
from tests.system.quality import Score, score

CAMERA, MASK = "reference-36mm", "reference-5x5"


@dataclass(frozen=True)
class Wanted:
    """Least PSNR of the views in dB, and by how much they beat the mean over views."""

    views_db: float
    above_mean_db: float


NOISE_FREE, RAW_SNR_100 = Wanted(48, 18), Wanted(35, 8)


def _score(camera: MaskedCamera, folder: Path, *, least_disparity_px: float) -> Score:
    """One frame decoded with a calibration on the stopped-down bench frame of the same camera."""
    (folder / "bench.dng").write_bytes(camera.bench_frame().file)
    calibration = from_frame(Darkroom(Recipe(CAMERA, MASK)), folder / "bench.dng")
    (folder / "calibration.toml").write_text(tomli_w.dumps(calibration.to_dict()))
    exposure = camera.expose(0.0, 0)
    (folder / "frame.dng").write_bytes(exposure.file)
    darkroom = Darkroom(Recipe(CAMERA, MASK, calibration=str(folder / "calibration.toml"), workers=2))
    found = darkroom.decode(folder / "frame.dng").light_field
    assert found.attributes["carriers_from"] == "calibrated"
    assert found.attributes["decoded_from"] == ("grey" if camera.sensor.mono else "mosaic")
    return score(found, exposure.truth, least_disparity_px=least_disparity_px, pixel_mm=camera.sensor.pitch_mm)


def _without_noise(camera: MaskedCamera) -> MaskedCamera:
    return replace(camera, sensor=replace(camera.sensor, shot_noise=False, read_noise_e=0.0))


@pytest.mark.parametrize(
    ("seed", "mono", "noisy"),
    [
        pytest.param(3, False, True, marks=pytest.mark.slow),
        *(
            pytest.param(s, m, noisy, marks=pytest.mark.long)
            for m in (False, True)
            for s in (3, 4, 5)
            for noisy in (False, True)
            if (s, m, noisy) != (3, False, True)
        ),
    ],
)
def test_views_of_the_reference_camera(seed: int, mono: bool, noisy: bool, tmp_path: Path) -> None:
    """Neighbouring views 3 px apart or more; with noise the raw signal is 110 times its noise at the mean level."""
    camera = reference_camera(seed, scale=0.5, scene="bench")
    camera = replace(camera, sensor=replace(camera.sensor, mono=mono))
    seen, wanted = (camera, RAW_SNR_100) if noisy else (_without_noise(camera), NOISE_FREE)
    reached = _score(seen, tmp_path, least_disparity_px=3.0)
    assert reached.pixels > 10_000
    assert reached.views_db >= wanted.views_db, reached
    assert reached.views_db >= reached.mean_db + wanted.above_mean_db, reached


@pytest.mark.long
@pytest.mark.parametrize("seed", [21, 22])
def test_views_of_the_reference_camera_on_the_full_sensor(seed: int, tmp_path: Path) -> None:
    camera = reference_camera(seed, scene="bench")
    for seen, wanted in ((_without_noise(camera), NOISE_FREE), (camera, RAW_SNR_100)):
        reached = _score(seen, tmp_path, least_disparity_px=3.0)
        assert reached.views_db >= wanted.views_db, reached
        assert reached.views_db >= reached.mean_db + wanted.above_mean_db, reached


@pytest.mark.long
def test_the_same_bytes_come_out_for_any_number_of_workers(tmp_path: Path) -> None:
    camera = reference_camera(3, scale=0.5, scene="bench")
    (tmp_path / "bench.dng").write_bytes(camera.bench_frame().file)
    (tmp_path / "frame.dng").write_bytes(camera.expose(0.0, 0).file)
    outcomes = set()
    for workers in (1, 2, 3, 1):
        recipe = Recipe(CAMERA, MASK, workers=workers, colour=True)
        found = from_frame(Darkroom(recipe), tmp_path / "bench.dng")
        text = tomli_w.dumps(found.to_dict())
        (tmp_path / "calibration.toml").write_text(text)
        made = Darkroom(replace(recipe, calibration=str(tmp_path / "calibration.toml"))).decode(tmp_path / "frame.dng")
        field = made.light_field
        outcomes.add((text, field.slices.tobytes(), field.views.tobytes(), field.carriers.tobytes()))
    assert len(outcomes) == 1


@pytest.mark.long
@pytest.mark.parametrize("seed", [6, 7])
def test_views_of_a_scene_with_hardly_any_parallax_are_no_worse_than_their_mean(seed: int, tmp_path: Path) -> None:
    reached = _score(reference_camera(seed, scale=0.5, scene="terrain"), tmp_path, least_disparity_px=0.0)
    assert reached.views_db >= reached.mean_db, reached


def test_the_mask_s_installation_is_found(tmp_path: Path) -> None:
    """Rotation and distance from one stopped-down frame; the simulator drew them from its seed.

    One focal length shows the product of the print's scale and 1 − d/f. The distance stays as the profile states it,
    and the scale takes the difference.
    """
    for seed in (11, 12):
        camera = reference_camera(seed, scale=0.5, scene="white")
        (tmp_path / "bench.dng").write_bytes(camera.bench_frame().file)
        (fit,) = from_frame(Darkroom(Recipe(CAMERA, MASK)), tmp_path / "bench.dng").fits
        assert fit.rotation_rad == pytest.approx(camera.installed.rotation_rad, abs=2e-5)
        assert (fit.mask_distance_mm, fit.distance_fitted) == (0.48, False)
        shadow_per_px = 15.5 * (1 - camera.installed.distance_mm / 50) * 0.01  # 15.5/mm, 50 mm, pixels of 0.01 mm
        assert math.hypot(*fit.lattice.ky) == pytest.approx(shadow_per_px, rel=2e-5)


@pytest.mark.long
def test_nothing_is_told_of_views_where_the_frame_is_clipped(tmp_path: Path) -> None:
    white, frame, calibration = tmp_path / "white.dng", tmp_path / "frame.dng", tmp_path / "calibration.toml"
    shot = ["--scale", "0.25", "--rays"]
    assert shoot.main([str(white), "--scene", "white", "--f-number", "29.8", *shot, "level=0.2"]) == 0
    assert shoot.main([str(frame), *shot, "level=0.6"]) == 0
    assert main(["calibrate", str(white), "--mask", MASK, "-o", str(calibration)]) == 0
    field = Darkroom(Recipe(CAMERA, MASK, calibration=str(calibration))).decode(frame).light_field
    sigma = field.view_sigma
    assert sigma is not None
    share = np.isnan(sigma).mean()
    assert 0 < share < 0.6
    assert Code.FRAME_CLIPPED in {one.code for one in field.doubts}
    assert np.isfinite(field.attributes["view_sigma"]).all()
