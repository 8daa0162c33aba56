"""How far the σ of depth can be believed on scenes that none of its constants were measured on.

Other seeds, textures, contrasts, apertures, focuses, colours and noise than `test_depth`'s, and many more edges: boards
before each other, a plane seen obliquely, ground under a low flight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import dappled
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.bench import Bench, TexturedPlane
from dappled.mocks.scene.landscape import noise
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera
from dappled.mocks.scene.synthesis import PASS, Grid
from dappled.products.opened import OpenedFrame
from tests.simulated.calibration import from_frame
from tests.system.test_depth import BORDER, CAMERA, MASK, SCALE, sampled, say, with_snr

pytestmark = pytest.mark.long
TEXTURE_SIDE = 2048


@dataclass(frozen=True)
class Case:
    """One frame. `slope`: by which power of frequency texture falls; `contrast` rms over mean; `chroma`: how strongly
    boards are coloured; `f_number` None is the full aperture."""

    name: str
    seed: int
    scene: str = "boards"
    snr: float = 70.0
    slope: float = 0.9
    contrast: float = 0.22
    chroma: float = 0.0
    f_number: float | None = None
    focus_m: float = float("inf")

    def camera(self) -> MaskedCamera:
        if self.scene == "flight":
            camera = reference_camera(self.seed, scale=SCALE, path=FlightPath(self.seed, height_m=9.0))
            return with_snr(camera, self.snr)
        camera = reference_camera(self.seed, scale=SCALE, scene="bench")
        camera = replace(camera, optics=replace(camera.optics, focus_m=self.focus_m))
        return with_snr(replace(camera, scene=self._bench(camera)), self.snr)

    def _bench(self, camera: MaskedCamera) -> Bench:
        rng = np.random.default_rng([self.seed, 91])
        optics, pitch_mm = camera.optics, camera.sensor.pitch_mm
        height, width = (side * pitch_mm for side in camera.sensor.shape)

        def board(
            shift_px: float, extent_mm: tuple[float, float, float, float] | None = None, lean: float = 0
        ) -> TexturedPlane:
            mean = 0.4 + 0.05 * rng.standard_normal(3) + self.chroma * rng.uniform(-0.3, 0.3, 3)
            red, green, blue = (float(v) for v in np.clip(mean, 0.05, 0.6))
            metres = optics.depth_m(shift_px * pitch_mm, optics.mask.views_per_axis)
            return TexturedPlane(metres, (red, green, blue), (0.6 * lean, -0.8 * lean), extent_mm, self.contrast)

        if self.scene == "oblique":
            planes = [board(3.0, lean=0.75 * optics.focal_length_mm / width)]
        elif self.scene == "about the focus":
            planes = [board(-1.5)]
            for k, shift_px in enumerate((-0.7, 0.0, 1.2, 2.6)):
                left = (-0.45 + 0.22 * k) * width
                planes.append(board(shift_px, (-0.4 * height, 0.4 * height, left, left + 0.17 * width)))
        else:
            planes = [board(0.4)]
            for shift_px in np.sort(rng.uniform(0.6, 5.5, 9)):
                h, w = rng.uniform(0.15, 0.4) * height, rng.uniform(0.12, 0.35) * width
                y, x = rng.uniform(-0.5, 0.5) * height, rng.uniform(-0.5, 0.5) * width
                planes.append(board(float(shift_px), (y - h / 2, y + h / 2, x - w / 2, x + w / 2)))
        finest_mm = pitch_mm / (PASS * min(Grid.of(camera.sensor.shape, camera.lattice).half_band))
        texel_mm = finest_mm / 5
        sheet = noise(
            np.random.default_rng([self.seed, 77]), TEXTURE_SIDE, texel_mm, slope=self.slope, finest_m=finest_mm
        )
        return Bench(tuple(planes), sheet, texel_mm)


CASES = (
    Case("nine boards", 21),
    Case("nine boards", 22, snr=30.0),
    Case("rough texture", 24, slope=0.5, contrast=0.3),
    Case("faint texture", 26, contrast=0.07),
    Case("f/10.4", 27, f_number=10.4),
    Case("coloured boards", 34, chroma=1.0),
    Case("about a focus at 1.5 m", 33, scene="about the focus", focus_m=1.5),
    Case("one plane, oblique", 31, scene="oblique"),
    Case("ground from 9 m", 41, scene="flight"),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.name}-{case.seed}")
def test_sigma_on_other_scenes(case: Case, tmp_path: Path) -> None:
    camera = case.camera()
    (tmp_path / "bench.dng").write_bytes(camera.bench_frame().file)
    calibration = from_frame(Darkroom(Recipe(CAMERA, MASK)), tmp_path / "bench.dng")
    (tmp_path / "c.toml").write_text(tomli_w.dumps(calibration.to_dict()))
    exposure = camera.expose(1.0, 0, f_number=case.f_number)
    (tmp_path / "frame.dng").write_bytes(exposure.file)
    frame = dappled.open(tmp_path / "frame.dng", mask=MASK, calibration=str(tmp_path / "c.toml"))
    assert isinstance(frame, OpenedFrame)
    found, truth = frame.light_field, exposure.truth
    assert truth.disparity_mm_per_mm is not None
    step_mm = float(truth.aperture_points_mm[0, 1, 1] - truth.aperture_points_mm[0, 0, 1])
    step_px = step_mm / float(found.field.grid[1, 1] * camera.sensor.pitch_mm)
    true = sampled(truth.disparity_mm_per_mm, truth, found, 0) * step_px
    made = found.depth("combined")
    error, sigma = (v[BORDER:-BORDER, BORDER:-BORDER] for v in (np.abs(made.disparity - true), made.sigma))
    known = np.isfinite(error)
    one, two = (float(np.mean(error[known] <= k * sigma[known])) for k in (1, 2))
    say(
        f"{case.name}, seed {case.seed}, SNR {case.snr:g}: {known.mean():.0%} known, {one:.0%} within σ, {two:.0%} "
        f"within 2 σ, median σ {np.median(sigma[known]):.4f} px/view"
    )
    assert known.mean() > 0.8
    assert 0.55 < one < 0.82
    assert two > 0.84
