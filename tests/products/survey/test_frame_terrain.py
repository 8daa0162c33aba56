"""Terrain of single frames: exact distances give the true hill, noise its σ, too little parallax nothing."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from scipy import ndimage

from dappled.cli import main
from dappled.decode.depth import Ranging
from dappled.findings import Code, text
from dappled.products.maps.earth import Projection
from dappled.products.maps.eye import Eye
from dappled.products.maps.georeference import Survey
from dappled.products.maps.ground import Flat, Raster
from dappled.products.survey import frame_terrain
from dappled.products.survey.frame_depths import InverseDepth
from dappled.products.survey.frame_terrain import FrameTerrain, FrameTerrainError
from tests.products.maps.test_eye import GRID, eye_at
from tests.products.maps.test_map_grid import photograph, survey
from tests.products.survey import hills

BLOCK = 13  # px with one error, as under a window of a depth map


def quiet(*_: object) -> None:
    pass


def true_hill(eye: Eye) -> Raster:
    """A hill of 12 m under the eye."""
    axis = np.arange(-60.0, 61.0, 2.0)
    values = 12 * np.exp(-(axis[:, None] ** 2 + axis[None, :] ** 2) / 2 / 18.0**2)
    east, north = eye.centre[:2]
    return Raster(values, float(east) - 60, float(north) + 60, 2.0, 0.1, "hill")


def told(eye: Eye, ground: Raster, sigma: float, rng: np.random.Generator | None = None) -> InverseDepth:
    """The inverse distances that rays to the ground have, with errors of σ (in blocks) where `rng` is given."""
    rows, columns = eye.shape
    y, x = np.arange(0, rows + 8, 8.0), np.arange(0, columns + 8, 8.0)  # between them the hill is as good as straight
    met = ground.meet(eye, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    distance = ((met - eye.centre) / (eye.scale, eye.scale, 1)) @ eye.rotation[:, 2]
    at = np.meshgrid(np.arange(rows) / 8, np.arange(columns) / 8, indexing="ij")
    inverse = ndimage.map_coordinates((1 / distance).reshape(len(y), len(x)), np.array(at), order=1)
    if rng is not None:
        errors = rng.normal(0, sigma, (rows // BLOCK + 1, columns // BLOCK + 1))
        inverse = inverse + np.kron(errors, np.ones((BLOCK, BLOCK)))[:rows, :columns]
    sigmas = np.full((rows, columns), sigma, np.float32)
    return InverseDepth(inverse.astype(np.float32), sigmas, Ranging(1.0, 0.0, source="a test"), GRID)


def flight(count: int, ground: Flat | Raster | None = None, height_m: float = 40.0) -> Survey:
    """Frames on a small circle over the hill, each turned and tilted otherwise."""
    first = eye_at(height_m=height_m, tilt_deg=(0.0, 0.0, 0.0))
    eyes = [first]
    for number in range(1, count):
        one = eye_at(height_m=height_m, tilt_deg=(3.0, -2.0, 70.0 * number))
        aside = np.array([math.cos(number), math.sin(number), 1.0])
        eyes.append(replace(one, centre=first.centre + aside))
    image = np.zeros(first.shape, np.float32)
    photos = [photograph(eye, image, f"{number:06d}") for number, eye in enumerate(eyes)]
    return survey(*photos, ground=ground or Flat(0.0))


def measured(made: Survey, sigma: float, seed: int | None = None) -> dict[str, InverseDepth]:
    hill = true_hill(made.photographs[0].eye)
    rng = None if seed is None else np.random.default_rng(seed)
    return {one.name: told(one.eye, hill, sigma, rng) for one in made.photographs}


def errors(made: Survey, found: FrameTerrain) -> NDArray[np.float64]:
    """Found less true heights of the cells that are known."""
    east, north = found.grid.places(made.projection)
    off = found.height_m - true_hill(made.photographs[0].eye).heights(east, north)
    return off[np.isfinite(found.height_m)]


@pytest.mark.parametrize("count", [1, 3])
def test_exact_distances_give_the_hill(count: int) -> None:
    made = flight(count)
    found = frame_terrain.of(made, measured(made, 1e-5), quiet)
    off = errors(made, found)
    assert off.size > 500
    assert np.abs(off).max() < 0.15  # of 12 m; cells are means
    assert np.median(np.abs(off)) < 0.01
    assert found.difference_m is None
    middle = found.frames[np.isfinite(found.height_m)].max()
    assert middle == count


def test_sigmas_hold_and_shrink_with_the_number_of_frames() -> None:
    made = flight(9)
    alone = replace(made, photographs=made.photographs[:1])
    depths = measured(made, 1e-3, seed=4)
    one, nine = frame_terrain.of(alone, depths, quiet), frame_terrain.of(made, depths, quiet)
    for found, of_frames in ((one, alone), (nine, made)):
        off = errors(of_frames, found)
        sigma = found.sigma_m[np.isfinite(found.height_m)]
        assert 0.58 < np.mean(np.abs(off) < sigma) < 0.85
        assert abs(np.mean(off)) < 0.35  # in 1/Z there is no bias towards far
    assert np.nanmedian(one.single_sigma_m) == pytest.approx(0.85, abs=0.1)  # Eq 5: Z² σ(1/Z), Z is 28 to 31 m
    many = nine.frames >= 8
    assert many.sum() > 300
    assert np.nanmedian(nine.sigma_m[many]) == pytest.approx(np.nanmedian(one.sigma_m) / math.sqrt(8.5), rel=0.35)


def test_a_frame_that_is_wrong_is_outvoted() -> None:
    made = flight(5)
    depths = measured(made, 2e-4)
    bad = depths["000002"]
    depths["000002"] = replace(bad, inverse_per_m=bad.inverse_per_m * np.float32(1.4))
    right = errors(made, frame_terrain.of(made, depths, quiet))
    assert np.median(np.abs(right)) < 0.4  # the mean would be 2 m off


def test_what_parallax_cannot_tell_is_unknown_and_never_zero() -> None:
    made = flight(1)
    depth = measured(made, 1e-3)["000000"]
    half = depth.sigma_per_m.copy()
    half[:, : half.shape[1] // 2] = 0.02  # 1/40 is not clear of 0 by 2 σ
    found = frame_terrain.of(made, {"000000": replace(depth, sigma_per_m=half)}, quiet)
    known = np.isfinite(found.height_m)
    assert 0.2 < known.mean() < 0.6
    for band in (found.height_m, found.sigma_m, found.single_sigma_m, found.frames):
        assert np.array_equal(np.isfinite(band), known)
    everywhere = replace(depth, sigma_per_m=np.full_like(half, 0.02))
    with pytest.raises(FrameTerrainError, match=r"can't be told from that of infinity \(Eq 5\)"):
        frame_terrain.of(made, {"000000": everywhere}, quiet)
    with pytest.raises(FrameTerrainError, match="no frame has distances of its own"):
        frame_terrain.of(made, {}, quiet)


def test_frames_that_each_cannot_tell_can_tell_together() -> None:
    """1/Z is about 0.034 there, and one frame's σ 0.025."""
    made = flight(12)
    depths = measured(made, 0.025, seed=2)
    alone = frame_terrain.of(replace(made, photographs=made.photographs[:1]), depths, quiet)
    together = frame_terrain.of(made, depths, quiet)
    area = 14.7 * 11.1 / 2 / alone.grid.step_x**2  # at least so many cells are in a frame
    assert np.isfinite(alone.height_m).sum() < 0.6 * area
    assert np.isfinite(together.height_m).sum() > 0.8 * area
    assert (together.frames > 1).sum() > 0.8 * area


def test_the_difference_to_given_terrain() -> None:
    flat = flight(1)
    hill = true_hill(flat.photographs[0].eye)
    raised = replace(hill, values=hill.values + 3.0)
    made = flight(1, raised)
    found = frame_terrain.of(made, measured(made, 1e-5), quiet)
    assert found.difference_m is not None
    assert np.nanmedian(found.difference_m) == pytest.approx(-3.0, abs=0.05)


def test_a_focus_that_was_told_wrong_is_doubted_and_found() -> None:
    made = flight(1, replace(true_hill(flight(1).photographs[0].eye), sigma_m=0.1))
    depth = measured(made, 1e-4)["000000"]
    shifted = replace(depth, inverse_per_m=depth.inverse_per_m - np.float32(1 / 200))  # the focus was at 200 m
    found = frame_terrain.of(made, {"000000": shifted}, quiet)
    _, doubt = frame_terrain.told(made, found)
    assert doubt.code is Code.HEIGHTS_OFF
    assert doubt.facts["focus_m"] == pytest.approx(200, rel=0.03)
    assert "from the given ground as a whole" in str(text(doubt))
    assert f"(--focus), in m: {doubt.facts['focus_m']:.3g}" in str(text(doubt))
    assert found.focus_m == pytest.approx(200, rel=0.03)
    assert len(frame_terrain.told(made, frame_terrain.of(made, {"000000": depth}, quiet))) == 1


def test_frames_are_fused_by_their_sigmas() -> None:
    def one(values: list[float], sigmas: list[float]) -> tuple[float, float]:
        step, sigma = frame_terrain.fuse(np.array(values)[:, None, None], np.array(sigmas)[:, None, None])
        return float(step[0, 0]), float(sigma[0, 0])

    assert one([2.0], [0.5]) == (2.0, 0.5)
    assert one([0.0, 1.0], [1.0, 1.0]) == pytest.approx((0.5, math.sqrt(0.5)))
    assert one([0.0, 1.0], [1.0, 2.0]) == pytest.approx((0.2, math.sqrt(0.8)))  # by 1/σ²
    _, torn = one([0.0, 10.0], [1.0, 1.0])
    assert torn > 3  # they disagree: neither is to be believed to 0.7
    step, _ = one([0.0, 0.1, -0.1, 0.05, 100.0], [0.2] * 5)
    assert abs(step) < 0.12  # the mean is 20
    assert one([1.0, math.nan], [0.5, math.nan]) == (1.0, 0.5)
    assert all(math.isnan(v) for v in one([math.nan], [math.nan]))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["depth"], "name a decoded light field, or a flight with --flight"),
        (["depth", "--flight", ".", "-o", "x.ply"], "written as .tif (GeoTIFF) or .png, .jpg"),
        (["depth", ".", "--cell", "1"], "--cell goes with --flight FLIGHT and no light field"),
    ],
)
def test_wrong_calls_get_a_sentence(more: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(more) == 2
    assert said in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("height_m", [5.0, 10.0, 20.0, 40.0])
def test_one_frame_is_better_than_a_plane(height_m: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A slope of five σ (Eq 5: σ grows with the square of the height) across a quarter of the reference sensor."""
    camera = hills.slope(5, height_m, 5 * 0.0016 * height_m**2, scale=0.5)
    folder, recipe, _ = hills.frames(tmp_path, camera, [hills.level(5, height_m)])
    out = tmp_path / "heights.tif"
    given = ["--camera", recipe.camera, "--mask", recipe.mask, "--calibration", recipe.calibration]
    assert main(["depth", "--flight", str(folder), *given, "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with rasterio.open(out) as read:
        height, sigma, single, frames = read.read()
        assert read.descriptions[2] == "sigma of one frame (Eq 5), m"
        assert np.isnan(read.nodata)
        assert float(read.tags()["DAPPLED_LEVEL_SIGMA_M"]) == pytest.approx(report["level_sigma_m"], abs=1e-3)
        east = read.transform.c + (np.arange(read.width) + 0.5) * read.transform.a
        crs = Projection(str(read.crs))
    pose = hills.level(5, height_m)
    at = crs.at(pose.latitude_deg, pose.longitude_deg)
    slope = camera.scene.planes[0].tilt[1]  # type: ignore[attr-defined]  # a Bench
    true = np.broadcast_to(203.0 - slope * (east - at.east) / at.scale, height.shape)
    known = np.isfinite(height)
    off = np.abs(height - true)[known]
    plane = np.abs(true[known] - np.median(true[known]))
    told = float(np.median(single[known]))
    with capsys.disabled():
        print(  # noqa: T201  figures for people
            f"\n{height_m:g} m: median error {np.median(off):.3f} m, Eq 5's σ {told:.3f} m, a plane "
            f"{np.median(plane):.3f} m, relief {np.ptp(true[known]):.2f} m = {np.ptp(true[known]) / told:.1f} σ, "
            f"{known.mean():.0%} known, {np.mean(off < sigma[known]):.0%} within σ"
        )
    assert report["frames"] == np.nanmax(frames) == 1
    assert known.mean() == pytest.approx(report["known"])
    if height_m == 10:
        words = ["georeference", str(folder), "-o", str(tmp_path / "maps"), "--as", "frame-terrain", *given]
        assert main(words) == 0
        assert f"one frame tells a height to ±{told:.2g} m (Eq 5)" in capsys.readouterr().err
        with rasterio.open(tmp_path / "maps" / "terrain-frames.tif") as read:
            assert read.read(1)[known] == pytest.approx(height[known], abs=1e-3)
    assert known.mean() > 0.6
    assert np.ptp(true[known]) > 3 * told
    assert np.median(off) < told
    assert np.median(off) < np.median(plane)
