"""Depth and refocusing of simulated masked frames against what the camera really saw: the figures that are promised.

The frames go the whole way: exposed with noise onto a Bayer sensor, calibrated on a stopped-down bench frame, decoded.
Raw SNR is that of a pixel at the metered level: shot noise alone, set by the full well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray
from scipy import ndimage

import dappled
from dappled.cli.calibrate.target import from_frames as targets_from_frames
from dappled.decode.depth.depth_map import DepthMap
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.scene.bench import Bench, TexturedPlane
from dappled.mocks.scene.masked_camera import LEVEL, MaskedCamera, Truth, reference_camera
from dappled.mocks.scene.synthesis import PASS, Grid
from dappled.products.opened import OpenedFrame, OpenedLightField, with_ranging
from tests.simulated.calibration import from_frame

CAMERA, MASK = "reference-36mm", "reference-5x5"
SCALE, BORDER = 0.5, 12
METRES = (5.0, 10.0, 20.0, 40.0)
FAR_METRES = (5.0, 10.0, 20.0, 200.0)
GREEN = 1
SNRS = [50.0, 100.0]
SEEDS = [3, 4]
Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Shown:
    """A decoded frame, and on its own grid the truth: distance, disparity. `step_px` is what a millimetre a millimetre
    of the aperture is in disparities."""

    found: OpenedLightField
    distance_m: Floats
    disparity: Floats
    step_px: float

    def inner(self, values: Any) -> Any:
        return values[BORDER:-BORDER, BORDER:-BORDER]


def with_snr(camera: MaskedCamera, snr: float) -> MaskedCamera:
    return replace(camera, sensor=replace(camera.sensor, full_well_e=snr**2 / LEVEL))


def strips(camera: MaskedCamera, seed: int, metres: tuple[float, ...] = METRES) -> MaskedCamera:
    """Four boards beside each other, the farthest last."""
    height, width = (side * camera.sensor.pitch_mm for side in camera.sensor.shape)
    finest = PASS * min(Grid.of(camera.sensor.shape, camera.lattice).half_band)
    quarter = width / 4
    left = [-width, *(-width / 2 + k * quarter for k in (1, 2, 3))]
    near = [TexturedPlane(z, extent_mm=(-height, height, left[k], left[k + 1])) for k, z in enumerate(metres[:3])]
    return replace(camera, scene=Bench.of(seed, (TexturedPlane(metres[3]), *near), camera.sensor.pitch_mm / finest))


def target(camera: MaskedCamera, seed: int, metres: float) -> MaskedCamera:
    """One board that fills the picture."""
    finest = PASS * min(Grid.of(camera.sensor.shape, camera.lattice).half_band)
    return replace(camera, scene=Bench.of(seed, (TexturedPlane(metres),), camera.sensor.pitch_mm / finest))


@cache
def shown(scene: str, seed: int, snr: float) -> Shown:
    camera = with_snr(reference_camera(seed, scale=SCALE, scene="bench"), snr)
    if scene == "strips":
        camera = strips(camera, seed)
    if scene == "far strips":
        camera = strips(camera, seed, FAR_METRES)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.dng").write_bytes(camera.bench_frame().file)
        calibration = from_frame(Darkroom(Recipe(CAMERA, MASK)), folder / "bench.dng")
        (folder / "c.toml").write_text(tomli_w.dumps(calibration.to_dict()))
        exposure = camera.expose(0.0, 0)
        (folder / "frame.dng").write_bytes(exposure.file)
        frame = dappled.open(folder / "frame.dng", mask=MASK, calibration=str(folder / "c.toml"))
        assert isinstance(frame, OpenedFrame)
        targets = [1.5, 3.0, 9.0]
        for metres in targets:
            (folder / f"{metres:g}.dng").write_bytes(target(camera, seed, metres).expose(0.0, 1).file)
        recipe = Recipe(CAMERA, MASK, calibration=str(folder / "c.toml"))
        ranging = targets_from_frames(recipe, [folder / f"{m:g}.dng" for m in targets], targets).ranging
        found = OpenedLightField(with_ranging(frame.light_field.field, ranging))
    return _beside_truth(found, exposure.truth, camera)


def _beside_truth(found: OpenedLightField, truth: Truth, camera: MaskedCamera) -> Shown:
    assert truth.depth_m is not None
    assert truth.disparity_mm_per_mm is not None
    step_mm = truth.aperture_points_mm[0, 1, 1] - truth.aperture_points_mm[0, 0, 1]
    step_px = float(step_mm / (found.field.grid[1, 1] * camera.sensor.pitch_mm))
    disparity = sampled(truth.disparity_mm_per_mm, truth, found, 0) * step_px
    return Shown(found, sampled(truth.depth_m, truth, found, 0), disparity, step_px)


def sampled(image: Floats, truth: Truth, found: OpenedLightField, order: int) -> Floats:
    """A picture of the truth's on the decoded views' grid."""
    grid = found.field.grid
    rows, columns = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in found.views.shape[2:4]), indexing="ij")
    at = np.array(
        [(grid[0, 0] * rows + grid[0, 2]) / truth.grid[0, 0], (grid[1, 1] * columns + grid[1, 2]) / truth.grid[1, 1]]
    )
    return np.asarray(ndimage.map_coordinates(image, at, order=order, mode="nearest"), dtype=np.float32)


@cache
def focused(seed: int, metres: float) -> Truth:
    """The same bench through a lens that is really focused there: the simulator traces its rays anew."""
    camera = reference_camera(seed, scale=SCALE, scene="bench")
    truth = replace(camera, optics=replace(camera.optics, focus_m=metres)).expose(0.0, 0).truth
    return replace(truth, views=truth.views[..., GREEN].mean(axis=(0, 1)))


def bad_share(made: DepthMap, truth: Floats, limit: float = 0.07) -> float:
    cut = (slice(BORDER, -BORDER),) * 2
    return float(1 - np.mean(np.abs(made.disparity - truth)[cut] <= limit))


def say(line: str) -> None:
    print(line)  # noqa: T201  figures for people who run with -s


@pytest.mark.long
@pytest.mark.parametrize("snr", SNRS)
@pytest.mark.parametrize("seed", SEEDS)
def test_bad_pixels(seed: int, snr: float) -> None:
    scene = shown("bench", seed, snr)
    made = scene.found.depth("combined")
    share = bad_share(made, scene.disparity)
    known = scene.inner(made.known)
    say(f"seed {seed}, SNR {snr:g}: BadPix 0.07 {share:.1%}, {known.mean():.0%} known")
    assert share <= 0.09
    assert known.mean() > 0.97


@pytest.mark.long
@pytest.mark.parametrize("snr", [50.0, 100.0])
def test_distances_in_metres(snr: float) -> None:
    """Well under a constant-plane guess wherever Eq 5 allows; and within the σ told for 68 ± 7 % of the pixels."""
    scene = shown("strips", 7, snr)
    made = scene.found.depth("combined")
    distances = scene.found.distances(made)
    truth, found, sigma = (scene.inner(v) for v in (scene.distance_m, distances.distance_m, distances.sigma_m))
    plane = float(np.median(truth))
    inside = np.isfinite(found)
    for metres in METRES:
        here = ndimage.binary_erosion(np.abs(truth - metres) < 0.01, iterations=8)
        error = np.abs(found - truth)[here & inside]
        guess = abs(plane - metres)
        told = float(np.median(sigma[here & inside]))
        say(
            f"SNR {snr:g}, {metres:g} m: median error {np.median(error):.2f} m, σ {told:.2f} m, "
            f"{inside[here].mean():.0%} known; a plane at {plane:.3g} m is {guess:.3g} m off"
        )
        assert inside[here].mean() > 0.9
        assert np.median(error) < 0.35 * max(guess, 5.0)
    covered = _covered(found, truth, sigma)
    say(f"SNR {snr:g}: {covered:.0%} of all distances within σ")
    assert covered == pytest.approx(0.68, abs=0.07)


def _covered(found: Floats, truth: Floats, sigma: Floats) -> float:
    inside = np.isfinite(found)
    return float(np.mean(np.abs(found - truth)[inside] <= sigma[inside]))


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("snr", SNRS)
def test_sigmas_hold_on_a_scene_with_edges_and_a_leaning_board(seed: int, snr: float) -> None:
    """All pixels, edges included."""
    scene = shown("bench", seed, snr)
    distances = scene.found.distances(scene.found.depth("combined"))
    truth, found, sigma = (scene.inner(v) for v in (scene.distance_m, distances.distance_m, distances.sigma_m))
    covered = _covered(found, truth, sigma)
    say(f"seed {seed}, SNR {snr:g}: {covered:.0%} of all distances within σ")
    assert covered == pytest.approx(0.68, abs=0.07)


@pytest.mark.long
def test_beyond_what_equation_5_allows_is_unknown() -> None:
    """A board at 200 m moves by a sixth of a pixel over the aperture: it can't be told from infinity."""
    scene = shown("far strips", 7, 50.0)
    found = scene.found.distances(scene.found.depth("combined")).distance_m
    known = {z: float(np.isfinite(found[np.abs(scene.distance_m - z) < 0.01]).mean()) for z in FAR_METRES}
    say(", ".join(f"{z:g} m: {share:.0%} known" for z, share in known.items()))
    assert known[200.0] < 0.4
    assert known[5.0] > 0.9


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("snr", [50.0, 100.0])
def test_refocus_against_the_simulator_s_own(seed: int, snr: float) -> None:
    """Against pictures of a lens that was focused there: none of our own shifts is in the truth."""
    scene = shown("bench", seed, snr)
    optics = reference_camera(seed, scale=SCALE, scene="bench").optics
    worst = np.inf
    for disparity in np.linspace(0, float(scene.disparity.max()), 5):
        slope = float(disparity) / scene.step_px  # dx/dθ = v·(1/Z − 1/F)
        inverse_m = slope / (optics.focal_length_mm * 1e-3) + 1 / optics.focus_m
        truth = focused(seed, 1 / inverse_m if inverse_m else float("inf"))
        error = scene.inner(
            scene.found.refocus(disparity=float(disparity)) - sampled(truth.views, truth, scene.found, 3)
        )
        worst = min(worst, float(-10 * np.log10(np.mean(error**2))))
    say(f"seed {seed}, SNR {snr:g}: refocus at worst {worst:.1f} dB")
    assert worst >= 38
