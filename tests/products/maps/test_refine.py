"""Refinement of a simulated flight whose truth is known, and what it says where it can't."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from dappled.config.profiles import Lens
from dappled.decode.geometry import metres_per_radian
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.mocks.autopilot.path import TruePose
from dappled.products.maps import georeference, hyperstereo, map_grid, references, refine, self_calibration, terrain
from dappled.products.maps.eye import turn
from dappled.products.maps.georeference import Options, Survey
from dappled.products.maps.ground import Flat
from dappled.products.maps.ground import load as load_ground
from dappled.products.maps.photographs import Photograph
from dappled.products.maps.references import BaseMap, BaseMapError
from dappled.products.maps.refine import RefinedBy
from tests.products import flown
from tests.products.flown import Flown
from tests.products.maps.test_eye import eye_at
from tests.products.maps.test_self_calibration import control

pytestmark = pytest.mark.long
TIMES = tuple(1.0 + 0.6 * k for k in range(5))


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    flown: Flown
    survey: Survey
    folder: Path

    @property
    def base(self) -> BaseMap:
        return BaseMap(self.folder / "base.tif", self.survey.projection, self.survey.gsd_m)

    def corner_errors_m(self, photographs: Sequence[Photograph]) -> NDArray[np.float64]:
        """(n, 4): how far each corner's ground lies from where the simulation knows it, on the ground."""
        errors = []
        for one, truth in zip(photographs, self.flown.truths, strict=True):
            assert truth.depth_m is not None
            for row in (0, truth.depth_m.shape[0] - 1):
                for column in (0, truth.depth_m.shape[1] - 1):
                    north, east, height = flown.true_ground(truth, row, column)
                    place = self.survey.projection.to_map(*self.flown.to_geodetic(north, east))
                    pixel = truth.grid[1, 1] * column / one.grid[1, 1], truth.grid[0, 0] * row / one.grid[0, 0]
                    level = Flat(float(height) + self.flown.path.home_altitude_msl_m)
                    met = level.meet(one.eye, np.array([pixel]))[0]
                    errors.append(math.hypot(met[0] - float(place[0]), met[1] - float(place[1])) / one.eye.scale)
        return np.array(errors).reshape(-1, 4)


def two_metres_and_a_degree_off(seed: int) -> flown.Told:
    """Each pose shifted by 2 m and turned by 1°, in directions of its own."""
    rng = np.random.default_rng(seed)

    def told(_: int, pose: TruePose) -> TruePose:
        shift, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        north_m, east_m = metres_per_radian(math.radians(pose.latitude_deg), 0.0)
        return replace(
            pose,
            latitude_deg=pose.latitude_deg + math.degrees(2 * shift[0] / north_m),
            longitude_deg=pose.longitude_deg + math.degrees(2 * shift[1] / east_m),
            altitude_msl_m=pose.altitude_msl_m + 2 * shift[2],
            attitude=flown.turned(pose.attitude, turn(axis * math.radians(1))),
        )

    return told


def case(folder: Path, told: flown.Told, seed: int, stack: ExitStack) -> Case:
    made = flown.fly(folder, seed=seed, times_s=TIMES, told=told)
    flown.write_relief(made, folder / "relief.tif")
    flown.write_base_map(made, folder / "base.tif")
    options = Options(terrain=folder / "relief.tif")
    survey = georeference.survey(made.folder, made.recipe, options, lambda *_: None, stack)
    return Case(made, survey, folder)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    with ExitStack() as stack:
        yield case(tmp_path_factory.mktemp("exact"), lambda _, pose: pose, 3, stack)


@pytest.fixture(scope="module", params=[3, 7])
def rough(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    with ExitStack() as stack:
        told = two_metres_and_a_degree_off(request.param)
        yield case(tmp_path_factory.mktemp("rough"), told, request.param, stack)


def test_with_true_poses_corners_lie_within_a_pixel(exact: Case) -> None:
    gsd_m = exact.survey.photographs[0].eye.gsd_m(exact.flown.path.home_altitude_msl_m)
    assert not exact.survey.left
    assert exact.corner_errors_m(exact.survey.photographs).max() < 0.1 * gsd_m


def test_from_two_metres_and_a_degree_a_base_map_brings_corners_home(rough: Case) -> None:
    gsd_m = rough.survey.photographs[0].eye.gsd_m(rough.flown.path.home_altitude_msl_m)
    before = rough.corner_errors_m(rough.survey.photographs)
    assert before.mean() > 40 * gsd_m
    better, said = refine.refine(
        rough.survey.photographs, rough.survey.ground, RefinedBy(base=rough.base, sigmas=(2.0, math.radians(1)))
    )
    assert [one.why for one in said] == [None] * len(TIMES)
    after = rough.corner_errors_m(better)
    assert after.mean() <= 0.5 * gsd_m
    assert after.max() <= 2.0 * gsd_m
    assert all(one.inliers > 50 and one.residual_px is not None and one.residual_px < 1 for one in said)


def test_neighbours_agree_better_after_refinement(rough: Case) -> None:
    """Without a map the strip as a whole stays where telemetry has it, but its frames fit each other."""
    photos = rough.survey.photographs
    better, said = refine.refine(photos, rough.survey.ground, RefinedBy(neighbours=True, sigmas=(2.0, math.radians(1))))
    refined = [one.why is None for one in said]
    assert sum(refined) >= len(TIMES) - 1
    steps = [np.diff([one.eye.centre for one in some], axis=0) for some in (photos, better)]
    truth = np.diff([t.pose.position_ned_m for t in rough.flown.truths if t.pose is not None], axis=0)
    apart = [np.abs(np.linalg.norm(step, axis=1) - np.linalg.norm(truth, axis=1)).mean() for step in steps]
    assert apart[1] < 0.7 * apart[0]


def test_control_points_place_a_frame(rough: Case, tmp_path: Path) -> None:
    truth, one = rough.flown.truths[1], rough.survey.photographs[1]
    assert truth.depth_m is not None
    rows, columns = (side - 1 for side in truth.depth_m.shape)
    lines = ["name,frame,column,row,latitude,longitude,altitude"]
    for number, (row, column) in enumerate(
        [(0, 0), (0, columns), (rows, 0), (rows, columns), (rows // 2, columns // 2)]
    ):
        north, east, height = flown.true_ground(truth, row, column)
        latitude, longitude = rough.flown.to_geodetic(north, east)
        altitude = float(height) + rough.flown.path.home_altitude_msl_m
        pixel = f"{truth.grid[1, 1] * column},{truth.grid[0, 0] * row}"
        lines.append(f"p{number},{one.name}.dng,{pixel},{float(latitude):.10f},{float(longitude):.10f},{altitude}")
    (tmp_path / "gcp.csv").write_text("\n".join(lines))
    points = references.read_control_points(tmp_path / "gcp.csv", rough.survey.projection)
    better, said = refine.refine(
        rough.survey.photographs, rough.survey.ground, RefinedBy(control=points, sigmas=(2.0, math.radians(1)))
    )
    gsd_m = one.eye.gsd_m(rough.flown.path.home_altitude_msl_m)
    assert said[1].why is None
    assert rough.corner_errors_m(better)[1].max() < 2 * gsd_m
    assert said[0].why is not None
    assert said[0].why.code is Code.POSE_NO_OVERLAP
    assert better[0] is rough.survey.photographs[0]


def test_a_flight_tells_its_lens_with_control_points_and_not_without(exact: Case, tmp_path: Path) -> None:
    """The lens is taken to be 1 mm and 0.3 mm off; the simulated one is 50 mm from the sensor's middle."""
    wrong, photos = Lens(50.0, 51.0, (0.3, -0.3)), []
    for one in exact.survey.photographs:
        matrix = one.eye.matrix.copy()
        matrix[:2, 2] += matrix[:2, :2] @ [-0.3 / 50, 0.3 / 50]
        matrix[:2, :2] *= 51 / 50
        photos.append(replace(one, eye=replace(one.eye, matrix=matrix), lens=wrong))
    points = control(exact.flown, tmp_path / "points.csv")
    found = self_calibration.find(
        photos, exact.survey.ground, control=references.read_control_points(points, exact.survey.projection)
    )
    y, x = found.lens.principal_point_mm
    off = np.array([found.lens.v_mm - 50, x, y, *found.lens.distortion[:4]])
    assert (np.abs(off) < 4 * found.solution.sigmas).all()
    assert found.solution.sigmas[0] < 0.15
    assert found.solution.sigma_px < 0.2
    assert found.control == 4 * len(TIMES)
    better = self_calibration.with_lens(photos, found)
    assert exact.corner_errors_m(better).max() < 0.25 * exact.corner_errors_m(photos).max()
    with pytest.raises(DappledError, match=r"doesn't tell the lens' distance .* control points"):
        self_calibration.find(photos[:3], exact.survey.ground)


def test_a_base_map_of_something_else_is_refused_frame_by_frame(exact: Case, tmp_path: Path) -> None:
    with rasterio.open(exact.folder / "base.tif") as read:
        profile = {**read.profile, "count": 1}
    noise = np.random.default_rng(4).integers(0, 255, (1, profile["height"], profile["width"]), dtype=np.uint8)
    with rasterio.open(tmp_path / "noise.tif", "w", **profile) as target:
        target.write(noise)
    base = BaseMap(tmp_path / "noise.tif", exact.survey.projection, exact.survey.gsd_m)
    better, said = refine.refine(exact.survey.photographs[:2], exact.survey.ground, RefinedBy(base=base))
    few = {Code.POSE_FEW_POINTS, Code.POSE_POINTS_DISAGREE, Code.POSE_UNMATCHED}
    assert all(one.why is not None and one.why.code in few for one in said)
    assert all(a is b for a, b in zip(better, exact.survey.photographs, strict=False))


def test_hyperstereo_finds_the_terrain_that_flat_ground_does_not_have(exact: Case) -> None:
    coarse = replace(exact.survey, photographs=exact.survey.photographs[:4], gsd_m=0.04)
    flat = replace(coarse, ground=Flat(exact.flown.path.home_altitude_msl_m))
    made = terrain.of(flat, lambda *_: None).surface
    truth = load_ground(exact.folder / "relief.tif", flat.projection, made.grid.bounds)
    error = made.height_m - truth.heights(*made.grid.places(flat.projection))
    known = made.known & np.isfinite(error)
    assert known.mean() > 0.15  # of the map's box: what two frames of the turning strip share
    level = truth.heights(*made.grid.places(flat.projection))[known]
    assert np.median(np.abs(error[known])) < 0.02
    assert np.quantile(np.abs(error[known]), 0.68) < 0.2 * float(np.std(level))
    within = np.mean(np.abs(error[known]) < made.sigma_m[known])
    assert 0.5 < within < 0.9
    assert made.level_sigma_m > 0.05  # 2 cm of position over a baseline of 2.4 m at 20 m
    differed = terrain.of(replace(coarse, gsd_m=0.08), lambda *_: None, highest_m=207.0)
    assert differed.difference_m is not None
    assert np.nanmedian(np.abs(differed.difference_m)) < 0.05


def test_frames_that_share_no_ground_have_no_heights(exact: Case) -> None:
    apart = [exact.survey.photographs[0], replace(exact.survey.photographs[1], eye=eye_at())]
    grid = map_grid.grid_of(exact.survey.photographs[:1], exact.survey.ground, exact.survey.projection, 0.1)
    with pytest.raises(hyperstereo.HyperstereoError, match="no two frames"):
        hyperstereo.surface(apart, grid, exact.survey.projection, lowest_m=200.0, highest_m=206.0)


def test_bad_control_points_and_base_maps_are_sentences(exact: Case, tmp_path: Path) -> None:
    projection = exact.survey.projection
    path = tmp_path / "gcp.csv"
    for text, said in (
        ("name,frame\n", "has no column column"),
        ("name,frame,column,row,latitude,longitude,altitude\na,0,1,2,41,x,3\n", "line 2"),
        ("name,frame,column,row,latitude,longitude,altitude\na,0,1,2,141,9,3\n", "not a place on Earth"),
    ):
        path.write_text(text)
        with pytest.raises(DappledError, match=said):
            references.read_control_points(path, projection)
    with pytest.raises(DappledError, match="can't be read"):
        references.read_control_points(tmp_path / "none.csv", projection)
    path.write_text("name,frame,column,row,latitude,longitude,altitude\na,999,1,2,41,9,3\n")
    with pytest.raises(DappledError, match="names frame 999"):
        refine.refine(
            exact.survey.photographs[:1],
            exact.survey.ground,
            RefinedBy(control=references.read_control_points(path, projection)),
        )
    with rasterio.open(exact.folder / "base.tif") as read:
        profile = {**read.profile, "transform": rasterio.Affine(1e-6, 0, 10.0, 0, -1e-6, 50.0)}
        with rasterio.open(tmp_path / "elsewhere.tif", "w", **profile) as target:
            target.write(read.read())
    with pytest.raises(BaseMapError, match="lies elsewhere on Earth"):
        georeference.refined(exact.survey, base=tmp_path / "elsewhere.tif")
    with pytest.raises(BaseMapError, match="can't be read"):
        georeference.refined(exact.survey, base=tmp_path / "none.tif")
