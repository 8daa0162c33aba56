"""Which camera is simulated: the settings' 450D with their mask, else the reference camera."""

from __future__ import annotations

import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest
import rawpy

from dappled.config import profiles
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.decode.optics import LAWS
from dappled.errors import DappledError
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.masked_camera import eos450d_camera, eos450d_f_number, reference_camera
from dappled.mocks.simulation import SimulatedCamera, World, overlapping_m_s


def settings(camera: str, mask: str) -> Settings:
    plain = configuration.load(None)
    return replace(plain, camera=replace(plain.camera, profile=camera), mask=replace(plain.mask, profile=mask))


@pytest.mark.parametrize(
    ("camera", "mask", "wanted"),
    [
        ("auto", "", SimulatedCamera("reference-36mm", "reference-5x5")),
        ("fujifilm-s5200", "mask-2", SimulatedCamera("reference-36mm", "reference-5x5")),
        ("canon-eos-450d", "mask-3", SimulatedCamera("canon-eos-450d", "mask-3")),
        ("canon-eos-450d", "", SimulatedCamera("canon-eos-450d", "mask-2")),
        ("canon-eos-450d", "lenslet", SimulatedCamera("canon-eos-450d", "mask-2")),
    ],
)
def test_the_camera_is_the_one_of_the_settings(camera: str, mask: str, wanted: SimulatedCamera) -> None:
    assert SimulatedCamera.of(settings(camera, mask)) == wanted


def test_a_450d_s_carriers_stand_where_its_profile_says() -> None:
    rig = SimulatedCamera("canon-eos-450d", "mask-2")
    camera, profile = rig.on_a_bench(World()), profiles.camera("canon-eos-450d")
    lattice = camera.lattice.rotated(-camera.installed.rotation_rad)
    law, chip = LAWS[profile.law], profile.sensor(camera.sensor.shape)
    told = law(profiles.mask("mask-2").mask, chip, camera.installed.distance_mm, 50.0)
    assert lattice.matrix() == pytest.approx(told.matrix(), rel=1e-6)
    views = lattice.slice_size(camera.sensor.shape)
    assert views == pytest.approx((44, 44), abs=5)  # as `dappled plan` says; its mask stands within 10 % of its place


def test_a_mask_that_cannot_be_simulated_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "coarse.toml").write_text("frequency_per_mm = 0.5\n")
    with pytest.raises(DappledError, match=r"^mask\.profile '.*coarse\.toml' can't be simulated: carriers 0\.00"):
        SimulatedCamera("canon-eos-450d", str(tmp_path / "coarse.toml")).on_a_bench(World())


@pytest.mark.parametrize("bench_s", [0.3, 1.0, 10.0])
def test_frames_overlap_on_a_slow_computer_too(bench_s: float) -> None:
    path = FlightPath(1, speed_m_s=overlapping_m_s(bench_s))
    between_s = 4 * bench_s  # twice as long as usual
    camera = reference_camera(1, scale=World().scale, scene="white")
    seen_m = camera.sensor.shape[0] * camera.sensor.pitch_mm / camera.optics.focal_length_mm * path.height_m
    apart_m = math.dist(*(path.pose(at_s).position_ned_m[:2] for at_s in (0.0, between_s)))
    assert apart_m < 0.6 * seen_m


@pytest.mark.long
@pytest.mark.parametrize("mask", ["mask-1", "mask-2", "mask-5"])
def test_its_file_is_a_450d_s(mask: str) -> None:
    camera = eos450d_camera(1, profiles.mask(mask).mask, scene="white")
    shot = camera.expose(0.0, 0, f_number=eos450d_f_number(camera))
    with rawpy.imread(BytesIO(shot.file)) as raw:
        shape = raw.raw_image_visible.shape
    profile = profiles.camera_for_model("Canon EOS 450D")
    assert profile is not None
    assert shape in profile.shapes()
