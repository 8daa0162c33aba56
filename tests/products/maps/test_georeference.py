"""`dappled georeference` from a flight on disk to files, and what it says of frames that can't be mapped."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from dappled import codec, findings
from dappled.cli import main
from dappled.cli.rendering import TerminalOutput
from dappled.clock import RecordedClock
from dappled.config.profiles import CameraProfile
from dappled.decode.geometry import camera_pose, from_euler
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.picture import shadow_fit
from dappled.decode.picture.blocks import MosaicPlane
from dappled.drivers.raw import picture_maker
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.picture_maker import MadePicture, PictureMaker
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, Subject, finding, text
from dappled.flight import Result, Tag, TimeSource, recording
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene.masked_camera import Truth, reference_camera
from dappled.mocks.simulation import CAMERA, MASK
from dappled.products.maps import difference, georeference, photographs
from dappled.products.maps.earth import Projection
from dappled.products.maps.georeference import Options, Survey
from dappled.products.maps.ground import Flat
from dappled.products.maps.photographs import Photograph, PhotographError, Station
from dappled.products.mounting import Mounting
from tests import globe
from tests.flight.makers import deliver, pose, request
from tests.products import flown
from tests.products.flown import Flown
from tests.products.maps.test_eye import eye_at
from tests.products.maps.test_map_grid import painted, photograph, survey

PROJECTION = Projection("EPSG:32615")


def words(flight: Flown, output: Path, *more: str) -> list[str]:
    recipe = flight.recipe
    given = ["--camera", recipe.camera, "--mask", recipe.mask, "--calibration", recipe.calibration]
    return ["georeference", str(flight.folder), "-o", str(output), *given, *more]


@pytest.mark.slow
def test_maps_of_pictures_in_doubt_say_so(
    short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each kind of doubt once, with the first frame: in the report of a map, and where a flight is refocused."""
    picture = PictureMaker.picture

    def doubted(*given: Any, **named: Any) -> MadePicture:
        made = picture(*given, **named)
        return replace(made, findings=(finding(Code.PICTURE_CLIPPED, FRAME, share=0.03),))

    monkeypatch.setattr(PictureMaker, "picture", doubted)
    told = f"in doubt: {findings.told(finding(Code.PICTURE_CLIPPED, Subject('frame', '000000'), share=0.03))}"
    assert main(words(short_flight, tmp_path / "maps", "--as", "cog")) == 1
    assert capsys.readouterr().err.splitlines().count(told) == 1
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    assert [(one["code"], one["subject"]["which"]) for one in report["doubts"]] == [("picture.clipped", "000000")]
    recipe = ["--camera", short_flight.recipe.camera, "--mask", short_flight.recipe.mask]
    flight = ["--flight", str(short_flight.folder), "--calibration", short_flight.recipe.calibration, *recipe]
    assert main(["refocus", *flight, "--height", "0", "-o", str(tmp_path / "a.tif")]) == 1
    assert capsys.readouterr().err.splitlines().count(told) == 1


@pytest.mark.parametrize("names", [("000000",), pytest.param(("000000", "000001"), marks=pytest.mark.slow)])
def test_a_flight_becomes_maps(
    names: tuple[str, ...],
    short_flight: Flown,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    several = len(names) > 1
    steps: list[tuple[str, int, int]] = []
    monkeypatch.setattr(TerminalOutput, "show", lambda _, *step: steps.append(step))
    before = sorted(path for path in short_flight.folder.rglob("*"))
    more = ["--each", "--as", "kmz", "cog", "footprints", "--gsd", "0.05"]
    more += ["--refine", "neighbours"] if several else ["--frames", "0"]
    assert main(words(short_flight, tmp_path, *more)) == 0
    said = capsys.readouterr().out
    assert f"{len(names)} frame{'s' if several else ''} on EPSG:32615" in said
    more_stretches = ("find features", "match neighbours") if several else ()
    stretches = "measure the mask's shadow", "develop", *more_stretches, "draw maps"
    assert tuple(dict.fromkeys(what for what, _, _ in steps)) == stretches  # no stretch of the work is silent
    assert {(what, 0, total) for what, _, total in steps} <= set(steps)
    assert [done for what, done, _ in steps if what == "develop"] == list(range(len(names) + 1))
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")) == [
        "footprints.geojson",
        *(f"frames/{name}.{form}" for name in names for form in ("kmz", "tif")),
        "mosaic.kmz",
        "mosaic.tif",
        "report.json",
    ]
    for kmz in ("mosaic.kmz", *(f"frames/{name}.kmz" for name in names)):
        globe.check_archive(tmp_path / kmz)
    report = json.loads((tmp_path / "report.json").read_text())
    assert [frame["name"] for frame in report["frames"]] == list(names)
    if several:
        assert [frame["refined"] for frame in report["frames"]] == [True, True]
        assert all(frame["shift_m"] < 0.1 for frame in report["frames"])
    with rasterio.open(tmp_path / "mosaic.tif") as read:
        truth = short_flight.truths[0].pose
        assert truth is not None
        east, north = Projection("EPSG:32615").to_map(truth.latitude_deg, truth.longitude_deg)
        assert read.bounds.left < east < read.bounds.right
        assert read.bounds.bottom < north < read.bounds.top
        assert read.count == 4
        assert (read.read(4) > 0).mean() > 0.4
    assert sorted(path for path in short_flight.folder.rglob("*")) == before  # the recording is as it was


@pytest.mark.long
def test_neighbouring_frames_have_one_colour(short_flight: Flown, tmp_path: Path) -> None:
    assert main(words(short_flight, tmp_path, "--each", "--as", "cog")) == 0
    pictures = []
    for name in ("000000", "000001"):
        with rasterio.open(tmp_path / "frames" / f"{name}.tif") as read:
            window = read.window(*common(tmp_path))
            pictures.append(read.read(window=window).astype(float))
    rows, columns = (min(a, b) for a, b in zip(pictures[0].shape[1:], pictures[1].shape[1:], strict=True))
    a, b = (picture[:, :rows, :columns] for picture in pictures)
    both = (a[3] > 0) & (b[3] > 0)
    assert both.sum() > 1000
    for band in range(3):
        assert a[band][both].mean() == pytest.approx(b[band][both].mean(), abs=4)
    assert a[0][both].mean() - a[2][both].mean() > 5  # earth and grass are no greys


def common(folder: Path) -> tuple[float, float, float, float]:
    boxes = []
    for name in ("000000", "000001"):
        with rasterio.open(folder / "frames" / f"{name}.tif") as read:
            boxes.append(read.bounds)
    a, b = boxes
    return max(a.left, b.left), max(a.bottom, b.bottom), min(a.right, b.right), min(a.top, b.top)


@pytest.mark.slow
def test_terrain_and_difference(short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--as", "terrain", "difference", "--against", str(short_flight.folder), "--gsd", "0.05"]
    assert main(words(short_flight, tmp_path, *more)) == 0
    capsys.readouterr()
    points = laspy.read(tmp_path / "terrain.las")
    assert len(points.points) > 500
    crs = points.header.parse_crs()
    assert crs is not None
    assert "EGM96" in crs.name
    assert list(points.point_format.extra_dimension_names) == ["sigma"]
    assert 198 < points.z.min() < points.z.max() < 216
    with rasterio.open(tmp_path / "terrain.tif") as read:
        height, sigma = read.read()
        assert read.descriptions[0] == "height above sea level, m"
        assert np.isfinite(height).sum() == len(points.points) == np.isfinite(sigma).sum()
        bounds, found = read.bounds, height[np.isfinite(height)]
    with rasterio.open(tmp_path / "ground.tif") as read:
        ground = read.read(1, window=read.window(*bounds))
        assert np.isfinite(read.read(1)).all()
        assert ground[np.isfinite(height)] == pytest.approx(found, abs=1e-3)
    with rasterio.open(tmp_path / "difference.tif") as read:
        assert np.nanmax(np.abs(read.read(1))) < 1e-4  # a flight differs from itself by nothing
    with rasterio.open(tmp_path / "height-difference.tif") as read:
        assert np.nanmax(np.abs(read.read(1))) < 1e-4


@pytest.mark.long
def test_frames_are_laid_on_heights_that_they_showed_themselves(short_flight: Flown, tmp_path: Path) -> None:
    """Where each pixel really lies the simulation knows; on flat ground what stands up leans."""
    assert main(words(short_flight, tmp_path, "--as", "terrain", "--gsd", "0.05")) == 0
    with ExitStack() as stack:
        errors = {}
        for name, chosen in (("flat", Options()), ("own", Options(terrain=tmp_path / "ground.tif"))):
            made = georeference.survey(short_flight.folder, short_flight.recipe, chosen, lambda *_: None, stack)
            assert len(made.photographs) == 2
            errors[name] = np.concatenate(
                [misplaced_m(short_flight, made, *pair)
                 for pair in zip(made.photographs, short_flight.truths, strict=True)]
            )  # fmt: skip
    assert np.isfinite(errors["own"]).all()
    assert np.median(errors["own"]) < 0.3 * np.median(errors["flat"])
    assert np.mean(errors["own"]) < 0.7 * np.mean(errors["flat"])


def misplaced_m(flight: Flown, made: Survey, one: Photograph, truth: Truth) -> NDArray[np.float64]:
    """How far from its true place the survey's ground puts each of a frame's pixels (every eighth)."""
    assert truth.depth_m is not None
    rows, columns = (range(2, side, 8) for side in truth.depth_m.shape)
    pixels = np.array(
        [(truth.grid[1, 1] * c / one.grid[1, 1], truth.grid[0, 0] * r / one.grid[0, 0]) for r in rows for c in columns]
    )
    north, east, _ = np.array([flown.true_ground(truth, r, c) for r in rows for c in columns]).T
    true = np.stack(made.projection.to_map(*flight.to_geodetic(north, east)), axis=1)
    met = made.ground.meet(one.eye, pixels)[:, :2]
    return np.asarray(np.linalg.norm(met - true, axis=1))


@pytest.fixture
def later_flight(short_flight: Flown, tmp_path: Path) -> Path:
    """The first frame alone, as frame 7 of another flight: numbers go on over flights."""
    begun = recording.begin(tmp_path / "later", RecordedClock(flown.START_NS))
    raw = sorted((short_flight.folder / "frames").iterdir())[0].read_bytes()
    request(begun, 7)
    frame = deliver(begun, 7, raw, "IMG_7.DNG")
    pose_of_it = flown.as_recorded(true_pose(short_flight))
    begun.ledger.add_tag(replace(tagged(frame.sha256, 7), pose=pose_of_it))
    begun.close()
    return begun.folder.path


@pytest.mark.long
def test_frames_and_control_points_are_the_first_flights_alone(
    short_flight: Flown, later_flight: Path, tmp_path: Path
) -> None:
    place = true_pose(short_flight)
    row = f"target,000000,921.5,693.5,{place.latitude_deg},{place.longitude_deg},203.4"
    points = tmp_path / "points.csv"
    points.write_text(f"name,frame,column,row,latitude,longitude,altitude\n{row}\n")
    more = ["--as", "difference", "--against", str(later_flight), "--frames", "0", "--gcp", str(points)]
    assert main(words(short_flight, tmp_path / "maps", *more, "--gsd", "0.1")) == 0
    assert (tmp_path / "maps" / "difference.tif").is_file()


@pytest.mark.long
def test_a_control_point_of_a_frame_that_is_left_out_is_noted(
    short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = true_pose(short_flight)
    rows = [f"p{k},{k:06d},921.5,693.5,{place.latitude_deg},{place.longitude_deg},203.4" for k in (0, 1)]
    points = tmp_path / "points.csv"
    points.write_text("\n".join(["name,frame,column,row,latitude,longitude,altitude", *rows]) + "\n")
    more = ["--as", "footprints", "--gcp", str(points), "--frames"]
    assert main(words(short_flight, tmp_path / "maps", *more, "0")) == 0
    assert "control point p1: it is left out: frame 000001 is not on the map" in capsys.readouterr().err
    points.write_text("\n".join(["name,frame,column,row,latitude,longitude,altitude", rows[1]]) + "\n")
    assert main(words(short_flight, tmp_path / "none", *more, "0")) == 1
    assert "no control point is on a frame that is mapped: the first, p1" in capsys.readouterr().err


def test_a_base_map_elsewhere_leaves_the_recorded_poses(short_flight: Flown, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere.tif"
    with rasterio.open(
        elsewhere, "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8", crs="EPSG:4326",
        transform=rasterio.Affine(1e-6, 0, 10.0, 0, -1e-6, 50.0),
    ):  # fmt: skip
        pass
    more = ["--as", "footprints", "--frames", "0", "--refine", str(elsewhere)]
    assert main(words(short_flight, tmp_path / "maps", *more)) == 1
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    (note,) = codec.read(tuple[Finding, ...], report["notes"])
    assert str(text(note)).startswith(f"not refined against a base map: the base map {elsewhere} lies elsewhere")
    assert report["frames"] == [{"name": "000000"}]
    assert report["files"] == ["footprints.geojson"]


def apart(
    parent: Path, nats: Sequence[float] = (), facts: Mapping[str, Any] | None = None, scale: float = 0.125
) -> Path:
    """A flight of two tiny frames, half a kilometre from each other, and what decoding told of their mask."""
    begun = recording.begin(parent, RecordedClock(flown.START_NS), facts)
    path = FlightPath(3)
    file = reference_camera(3, scale=scale, scene="bench").bench_frame().file
    for index in range(2):
        true = path.pose(float(index))
        there = replace(true, latitude_deg=path.home_latitude_deg + 0.005 * index)
        flown.record(begun, index, file, flown.F_NUMBER, flown.as_recorded(there))
    for index, one in enumerate(nats):
        details = {"mask_nats": one}
        begun.ledger.add_result(Result(index, "ab", 1, 13, "geometric", "calibrated", details=details))
    begun.close()
    return begun.folder.path


@pytest.fixture(scope="module")
def frames_apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be written to."""
    return apart(tmp_path_factory.mktemp("apart"))


@pytest.mark.parametrize(
    ("nats", "more", "doubt"),
    [
        ((-3.4, -16.0), [], "caution"),
        ((120.0, -3.4), [], "note"),
        ((-3.4, -16.0), ["--focal-length", "50"], None),
    ],
    ids=["gone", "there", "decoded with another"],
)
def test_maps_of_pictures_tell_what_the_flight_saw_of_its_mask(
    tmp_path: Path, nats: Sequence[float], more: list[str], doubt: str | None
) -> None:
    """A picture shows no light field; frames that were decoded with other values say nothing of these."""
    facts = {"settings": {"camera": {"profile": CAMERA}, "mask": {"profile": MASK}}}
    flight = apart(tmp_path, nats, facts, scale=0.25)
    output = tmp_path / "maps"
    ends = main(["georeference", str(flight), "-o", str(output), "--as", "footprints", "--workers", "1", *more])
    doubts = json.loads((output / "report.json").read_text())["doubts"]
    assert [one["level"] for one in doubts if one["code"] == Code.MASK_OVER_FLIGHT] == ([doubt] if doubt else [])
    assert ends == 1 or doubt != "caution"


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ("georeference FLIGHT --as terrain", "no two frames of the flight overlap by a fifth"),
        ("georeference FLIGHT --as kmz --gsd 0.025", "choose a larger --gsd for the KMZ"),
        ("georeference FLIGHT --as cog --gsd 0.0001", "choose a larger --gsd, or fewer frames"),
        ("georeference FLIGHT --solve-lens OUT/lens.toml", "neighbouring frames have 0 points in common"),
        ("georeference FLIGHT --gcp FLIGHT/flight.toml", "flight.toml"),
        ("georeference FLIGHT --terrain FLIGHT/flight.toml", "flight.toml can't be read"),
        ("refocus --flight FLIGHT --eyes anaglyph -o OUT/a.png", "no two frames share 30% of their ground"),
        ("depth --flight FLIGHT --together -o OUT/a.tif", "no two frames of the flight show the same ground"),
    ],
)
def test_what_poses_tell_is_told_before_a_frame_is_made(
    frames_apart: Path, asked: str, why: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def begun(*_: Any, **__: Any) -> None:
        made.append("a frame")
        raise DappledError("too late")

    monkeypatch.setattr(PictureMaker, "picture", begun)
    monkeypatch.setattr(Darkroom, "decode", begun)
    given = asked.replace("FLIGHT", str(frames_apart)).replace("OUT", str(frames_apart.parent)).split()
    assert main([*given, "--camera", CAMERA, "--mask", MASK]) == 1
    assert why in capsys.readouterr().err
    assert made == []


def test_heights_are_refused_before_the_frames_are_made_for_other_maps(
    frames_apart: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def listening(*_: Any, **__: Any) -> None:
        said.append(capsys.readouterr().err)
        raise DappledError("no picture")

    monkeypatch.setattr(PictureMaker, "picture", listening)
    given = ["georeference", str(frames_apart), "-o", str(frames_apart.parent / "maps")]
    assert main([*given, "--camera", CAMERA, "--mask", MASK, "--as", "footprints", "terrain"]) == 1
    assert len(said) == 2
    assert "no two frames of the flight overlap by a fifth" in said[0]


@pytest.mark.slow
def test_a_flight_s_shadow_is_measured_once_in_each_frame(
    short_flight: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is taken from all frames together."""
    measured = []

    def counted(measure: Callable[..., Any]) -> Callable[..., Any]:
        def one(mosaic: MosaicPlane, *where: Any, **reach: Any) -> Any:
            measured.append(mosaic.shape)
            return measure(mosaic, *where, **reach)

        return one

    monkeypatch.setattr(picture_maker, "told_by", counted(shadow_fit.told_by))
    monkeypatch.setattr(picture_maker, "shadow_of", counted(shadow_fit.shadow_of))
    output = tmp_path / "maps"
    main(words(short_flight, output, "--as", "cog", "--gsd", "0.1", "--workers", "1"))
    frames = json.loads((output / "report.json").read_text())["frames"]
    assert len(frames) > 1
    assert len(measured) == len(frames)


@pytest.mark.long
def test_two_workers_map_as_one_does(tmp_path: Path) -> None:
    """The same bytes; a frame that is no picture is left out and named."""
    flight = flown.fly(tmp_path, times_s=(1.0, 1.4, 1.8, 2.2))
    (flight.folder / "frames" / "000002.dng").chmod(0o644)
    (flight.folder / "frames" / "000002.dng").write_bytes(b"no picture")
    made = []
    for workers in ("1", "2"):
        output = tmp_path / workers
        main(words(flight, output, "--as", "cog", "--gsd", "0.1", "--workers", workers))
        made.append({one.name: one.read_bytes() for one in output.iterdir()})
    assert made[0] == made[1]
    assert [one["name"] for one in json.loads(made[1]["report.json"])["frames"]] == ["000000", "000001", "000003"]


@pytest.mark.long
def test_what_cant_be_compared_leaves_the_maps_and_a_report(
    short_flight: Flown, later_flight: Path, tmp_path: Path
) -> None:
    """The other flight's one frame shows no ground twice."""
    more = ["--as", "cog", "terrain", "difference", "--against", str(later_flight), "--gsd", "0.1"]
    assert main(words(short_flight, tmp_path / "maps", *more)) == 1
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    assert report["files"] == ["mosaic.tif", "terrain.tif", "terrain.las", "ground.tif", "difference.tif"]
    (note,) = codec.read(tuple[Finding, ...], report["notes"])
    assert str(text(note)).startswith(f"no difference to {later_flight}: no two frames")


@pytest.mark.long
def test_several_flights_are_each_compared_with_the_first(
    short_flight: Flown, later_flight: Path, tmp_path: Path
) -> None:
    more = ["--as", "difference", "--against", str(later_flight), str(short_flight.folder), "--gsd", "0.1"]
    assert main(words(short_flight, tmp_path / "maps", *more)) == 0
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    each = [f"difference-{one.name}.tif" for one in (later_flight, short_flight.folder)]
    assert report["files"] == [*each, "trend.tif"]
    assert report["notes"] == []
    with rasterio.open(tmp_path / "maps" / report["files"][0]) as read:
        change, sigma = read.read()
        assert read.descriptions[1] == "sigma of a change by itself, share of brightness"
    assert np.array_equal(np.isfinite(change), np.isfinite(sigma))
    assert np.nanmin(sigma) >= 0
    with rasterio.open(tmp_path / "maps" / "trend.tif") as read:
        assert read.descriptions[0] == "change a day, share of brightness"
        assert np.nanmax(read.read(5)) == 3


def test_a_change_on_the_ground_stands_out_of_another_hours_light() -> None:
    eye, ground = eye_at(height_m=100.0), Flat(0.0)
    image = painted(eye, ground)
    later = 0.7 * image + 0.05
    later[100:120, 140:160] += 0.3
    first, second = (survey(photograph(eye, one)) for one in (image, later))
    made = difference.of_pictures(first, second)
    changed = np.abs(np.nan_to_num(made.values)) > 0.2
    met = ground.meet(eye, np.array([[150.0, 110.0]]))[0]
    rows, columns = np.nonzero(changed)
    x, y = made.grid.axes()
    assert np.hypot(x[columns].mean() - met[0], y[rows].mean() - met[1]) < 0.5
    assert 0.6 < changed.sum() * 0.01 / (20 * 20 * eye.gsd_m(0.0) ** 2) < 1.6
    assert np.nanmedian(np.abs(made.values)) < 0.05
    elsewhere = survey(photograph(eye.moved(np.array([500.0, 0, 0, 0, 0, 0])), image))
    with pytest.raises(difference.DifferenceError, match="no ground in common"):
        difference.of_pictures(first, elsewhere)


@pytest.mark.long
def test_frames_that_cant_be_placed_are_named_and_the_flight_goes_on(tmp_path: Path, short_flight: Flown) -> None:
    """A frame without a tag, one without a position, one that looks at the horizon, and a good one."""
    raw = sorted((short_flight.folder / "frames").iterdir())[0].read_bytes()
    good = flown.as_recorded(true_pose(short_flight))
    level = from_euler(0.0, math.radians(85), 0.0)
    poses = [None, replace(good, latitude_rad=None), replace(good, attitude=level), replace(good, attitude=None), good]
    begun = recording.begin(tmp_path / "flights", RecordedClock(flown.START_NS))
    for index, one in enumerate(poses):
        request(begun, index)
        frame = deliver(begun, index, raw, f"IMG_{index}.DNG")
        if one is not None:
            begun.ledger.add_tag(replace(tagged(frame.sha256, index), pose=one))
    begun.close()
    broken = replace(short_flight, folder=begun.folder.path)
    assert main(words(broken, tmp_path / "maps", "--as", "footprints")) == 0
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    assert [frame["name"] for frame in report["frames"]] == ["000004"]
    why = {one.subject.which: str(text(one)) for one in codec.read(tuple[Finding, ...], report["left_out"])}
    assert "never tagged" in why["frames/000000.dng"]
    assert "no position is known" in why["frames/000001.dng"]
    assert "looks above the horizon" in why["000002"]
    assert "no attitude is known" in why["frames/000003.dng"]


def true_pose(flight: Flown) -> TruePose:
    pose_of_first = flight.truths[0].pose
    assert pose_of_first is not None
    return pose_of_first


def tagged(sha256: str, index: int) -> Tag:
    return Tag(index, 1, 1, TimeSource.HOT_SHOE, 50.0, flown.F_NUMBER, 0.001, 100, CAMERA, MASK, sha256, pose())


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--crs", "EPSG:4326"], "not a map projection in metres"),
        (["--crs", "EPSG:32633"], "does not cover"),
        (["--terrain", "none.tif"], "none.tif: no such file"),
        (["--frames", "77"], "can be put on a map"),
        (["--ground", "5000", "--frames", "0"], "can be put on a map"),
        (["--as", "difference"], "--against FLIGHT go together"),
        (["--terrain", __file__, "--terrain-heights", "ellipsoid", "--geoid", "no.gtx"], "no geoid grid no.gtx"),
        (["--refine", "a.tif", "b.tif", "--frames", "0"], "one base map"),
        pytest.param(["--view", "9,9", "--frames", "0"], "there is no view 9,9", marks=pytest.mark.slow),
        (["--mount", *"110010001"], "is not a rotation"),
        (["--between", "9", "3"], "the lower height comes first"),
    ],
)
def test_a_wrong_call_is_a_sentence(
    short_flight: Flown, tmp_path: Path, more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(short_flight, tmp_path, *more)) in (1, 2)
    *usage, sentence = capsys.readouterr().err.splitlines()
    assert said in sentence
    assert all(line.startswith("usage: dappled georeference ") for line in usage)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--focus", "0", "--view", "ground"], "'0' is not a number above 0 m, or inf"),
        (["--focus", "nan"], "'nan' is not a number above 0 m, or inf"),
        (["--frames", "zero"], "write numbers as 0,3-5"),
    ],
)
def test_a_wrong_word_is_refused_before_anything_is_decoded(
    short_flight: Flown, tmp_path: Path, more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words(short_flight, tmp_path, *more))
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_lever_arm_and_the_mount_reach_the_map(short_flight: Flown) -> None:
    frames, tags = photographs.recorded(short_flight.folder)
    turned = tuple((np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ camera_pose.NADIR).ravel())
    plain = photographs.station(frames[0], tags[0], Mounting())
    moved = photographs.station(frames[0], tags[0], Mounting((0.0, 0.0, 1.0), turned))
    assert plain.camera.altitude_msl_m - moved.camera.altitude_msl_m == pytest.approx(1.0, abs=0.02)
    assert moved.camera_to_ned.T @ plain.camera_to_ned == pytest.approx(
        camera_pose.NADIR.T @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ camera_pose.NADIR, abs=1e-9
    )


def test_a_camera_on_a_gimbal_looks_where_the_gimbal_does(short_flight: Flown) -> None:
    frames, tags = photographs.recorded(short_flight.folder)
    aside = from_euler(0.1, 0.2, 0.3)
    hung = replace(tags[0], pose=replace(tags[0].pose, gimbal_attitude=aside))
    found = photographs.station(frames[0], hung, Mounting(on_gimbal=True))
    assert found.camera_to_ned == pytest.approx(camera_pose.matrix_of(aside) @ camera_pose.NADIR)
    with pytest.raises(PhotographError, match="no attitude of the gimbal"):
        photographs.station(frames[0], tags[0], Mounting(on_gimbal=True))


@pytest.fixture(scope="module")
def decoded(short_flight: Flown) -> tuple[Station, LightField, CameraProfile]:
    """The first frame of the flight."""
    (frame, *_), tags = photographs.recorded(short_flight.folder)
    darkroom = Darkroom(short_flight.recipe)
    made = darkroom.decode(short_flight.folder / frame.name, joint_views=False)
    station = photographs.station(frame, tags[frame.index], Mounting())
    return station, made.light_field, darkroom.camera(made.raw.model or "")


def test_a_lens_that_is_focused_near_stands_farther_from_the_sensor(
    decoded: tuple[Station, LightField, CameraProfile],
) -> None:
    station, field, profile = decoded
    far, near = (
        photographs.eye_of(station, field, profile, PROJECTION, focus_m=focus_m) for focus_m in (math.inf, 5.0)
    )
    assert near.matrix[0, 0] / far.matrix[0, 0] == pytest.approx(1 / (1 - 0.05 / 5.0))
    assert near.gsd_m(0.0) / far.gsd_m(0.0) == pytest.approx(1 - 0.05 / 5.0, rel=1e-4)  # it is tilted a little
    with pytest.raises(PhotographError, match=r"a lens of 50 mm can't be focused at 0\.05 m"):
        photographs.eye_of(station, field, profile, PROJECTION, focus_m=0.05)


def test_views_need_an_f_number(decoded: tuple[Station, LightField, CameraProfile]) -> None:
    station, field, profile = decoded
    silent = replace(field, attributes={**field.attributes, "f_number": None, "focal_length_mm": None})
    assert photographs.photograph(station, silent, profile, PROJECTION, view="ground").apertures_m == pytest.approx(
        photographs.photograph(station, field, profile, PROJECTION, view="ground").apertures_m
    )  # the tag knows both
    unknown = replace(station, tag=replace(station.tag, f_number=None))
    for view in ("ground", "0,4"):
        with pytest.raises(PhotographError, match=r"the f-number of frames/000000\.dng is unknown"):
            photographs.photograph(unknown, silent, profile, PROJECTION, view=view)
    photographs.photograph(unknown, silent, profile, PROJECTION)


@pytest.mark.slow
def test_one_view_is_seen_from_aside(short_flight: Flown, tmp_path: Path) -> None:
    more = ["--view", "0,4", "--as", "kmz", "--frames", "0", "--each", "--quad"]
    assert main(words(short_flight, tmp_path / "v", *more)) == 0
    globe.check_archive(tmp_path / "v" / "frames" / "000000.kmz")
    with zipfile.ZipFile(tmp_path / "v" / "frames" / "000000.kmz") as archive:
        assert b"LatLonQuad" in archive.read("doc.kml")


def test_a_flight_that_doesnt_know_its_height_asks_for_the_ground(short_flight: Flown) -> None:
    frames, tags = photographs.recorded(short_flight.folder)
    unknown = replace(tags[0], pose=replace(tags[0].pose, height_above_home_m=None))
    station = photographs.station(frames[0], unknown, Mounting())
    assert georeference.level_of([station], Options(ground_m=12.0)) == 12.0
    with pytest.raises(DappledError, match="--ground or --terrain"):
        georeference.level_of([station], Options())
    with pytest.raises(PhotographError, match="never tagged"):
        photographs.station(frames[0], None, Mounting())


def test_maps_in_a_named_folder_are_not_replaced_unasked(
    short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "maps" / "frames" / "000000.tif"
    there.parent.mkdir(parents=True)
    there.write_bytes(b"of before")
    assert main(words(short_flight, tmp_path / "maps", "--as", "cog", "--each", "--frames", "0")) == 1
    assert "000000.tif exists already: choose another name, or --overwrite replaces it" in capsys.readouterr().err
    (tmp_path / "maps" / "footprints.geojson").write_bytes(b"of before")
    more = ["--as", "footprints", "--frames", "0"]
    assert main(words(short_flight, tmp_path / "maps", *more)) == 1
    assert "footprints.geojson exists already" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "maps").iterdir()) == ["footprints.geojson", "frames"]
    assert main(words(short_flight, tmp_path / "maps", *more, "--overwrite")) == 0
    assert (tmp_path / "maps" / "footprints.geojson").read_bytes() != b"of before"
    assert there.read_bytes() == b"of before"
