"""Coverage: what frames saw against plain geometry, areas from three formats, and re-flown holes that close."""

from __future__ import annotations

import json
import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from PIL import Image

from dappled import codec
from dappled.cli import main
from dappled.clock import SystemClock
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.decode.geometry import Gnss, from_euler
from dappled.decode.geometry import area as areas
from dappled.decode.geometry.area import AreaError, PlannedArea
from dappled.drivers.camera import Blob
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Subject, finding
from dappled.flight import Cause, Frame, Result, Shot, Tag, TimeSource, recording
from dappled.products.maps import coverage, refly
from dappled.products.maps.coverage import Coverage, FramesSeen
from dappled.products.maps.earth import Projection
from dappled.products.maps.ground import Flat, Raster
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.photographs import Station, station
from dappled.products.mounting import Mounting
from tests.daemon.fakes import no_pose

CAMERA, FOCAL_MM, HEIGHT_M, HOME_M = "canon-eos-450d", 20.0, 60.0, 200.0
PROJECTION = Projection("EPSG:32615")
HOME = PROJECTION.to_map(41.64, -91.54)
ALONG_M, ACROSS_M = (HEIGHT_M / FOCAL_MM * side for side in (2856 * 0.0051948, 4290 * 0.0051948))


def frame(index: int, east_m: float, north_m: float, *, heading: float = 0.0, pitch: float = 0.0, roll: float = 0.0,
          speed: float = 8.0) -> Station:  # fmt: skip
    """A frame at a place (metres from home), its image's top to the heading."""
    latitude, longitude = PROJECTION.to_geodetic(HOME[0] + east_m, HOME[1] + north_m)
    pose = replace(
        no_pose(),
        source="interpolated",
        latitude_rad=math.radians(float(latitude)),
        longitude_rad=math.radians(float(longitude)),
        altitude_msl_m=HOME_M + HEIGHT_M,
        height_above_home_m=HEIGHT_M,
        attitude=from_euler(roll, pitch, heading),
        velocity_ned_m_s=(speed * math.cos(heading), speed * math.sin(heading), 0.0),
    )
    name = f"frames/{index:06d}.cr2"
    tag = Tag(index, 0, 0, TimeSource.HOT_SHOE, FOCAL_MM, 8.0, 1e-3, 100.0, CAMERA, "mask-2", "0" * 64, pose)
    return station(Frame(index, name, "x", 1, "0" * 64, 0), tag, Mounting())


def seen(stations: list[Station], ground: Flat | Raster | None = None) -> FramesSeen:
    eyes = {one.name: coverage.eye_of(one, PROJECTION) for one in stations}
    return FramesSeen("test", PROJECTION, ground or Flat(HOME_M), eyes, tuple(stations), ())


def grid(side_m: float = 400.0, step: float = 2.0) -> MapGrid:
    cells = round(side_m / step)
    return MapGrid("EPSG:32615", float(HOME[0]) - side_m / 2, float(HOME[1]) + side_m / 2, step, step, (cells, cells))


def square(half_m: float) -> PlannedArea:
    corners = [(-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)]
    latitude, longitude = PROJECTION.to_geodetic(*(HOME[axis] + np.array(corners)[:, axis] for axis in (0, 1)))
    return PlannedArea("field", ((tuple(zip(latitude.tolist(), longitude.tolist(), strict=True)),),))


def survey(rng: np.random.Generator, half_m: float, *, lost: float) -> list[Station]:
    """A survey of lines to the north over a square, a share of its frames and one whole line lost."""
    found, index = [], 0
    lines = np.arange(-half_m, half_m + ACROSS_M / 2, ACROSS_M * 0.7)
    for number, east in enumerate(lines):
        for north in np.arange(-half_m, half_m + 1, ALONG_M * 0.4):
            index += 1
            if number != len(lines) // 2 and rng.random() > lost:
                tilt = {"pitch": -0.05 + rng.normal(0, 0.03), "roll": rng.normal(0, 0.03)}
                found.append(frame(index, float(east), float(north), **tilt))
    return found


def test_one_frame_sees_its_footprint() -> None:
    made = coverage.cover(seen([frame(1, 0, 0)]), grid())
    assert made.frames.max() == 1
    assert made.frames.sum() * made.cell_m2 == pytest.approx(ALONG_M * ACROSS_M, rel=0.04)
    wide = np.ptp(np.nonzero(made.frames)[1]) + 1
    assert wide * 2 == pytest.approx(ACROSS_M, abs=4)  # to the east: the image's width


def test_a_tilted_frame_sees_where_its_axis_points() -> None:
    made = coverage.cover(seen([frame(1, 0, 0, pitch=math.radians(20))]), grid())
    rows, _ = np.nonzero(made.frames)
    norths, half = grid().axes()[1][rows] - HOME[1], math.atan(ALONG_M / HEIGHT_M / 2)
    edges = [math.tan(math.radians(20) + side * half) * HEIGHT_M for side in (-1, 1)]
    assert [norths.min(), norths.max()] == pytest.approx(edges, abs=2)  # nose up: it looks ahead, north


def test_frames_and_directions_are_counted_apart() -> None:
    twice = coverage.cover(seen([frame(1, 0, 0), frame(2, 0, 0)]), grid())
    assert [twice.frames.max(), twice.directions.max()] == [2, 1]
    places = [frame(n, 30 * math.sin(a), 30 * math.cos(a)) for n, a in enumerate(np.arange(4) * math.pi / 2)]
    around = coverage.cover(seen(places), grid())
    row, column = (side // 2 for side in around.frames.shape)
    assert around.directions[row, column] == around.frames[row, column] > 1


def test_what_a_hill_hides_is_not_seen() -> None:
    flat = grid()
    heights = np.full((120, 120), HOME_M)
    heights[:, 66:70] = HOME_M + 40  # a wall of 40 m east of the middle
    wall = Raster(heights, flat.west - 40, flat.north + 40, 4.0, 0.5, "wall")
    frames = [frame(1, -20, 0, roll=math.radians(-35))]
    hidden = coverage.cover(seen(frames, wall), flat).frames.sum()
    assert 0 < hidden < 0.8 * coverage.cover(seen(frames), flat).frames.sum()


def test_an_area_is_inside_by_odd_rings() -> None:
    outer, inner = square(50).rings[0], square(20).rings[0]
    area = PlannedArea("ring", ((outer, inner),))
    made = coverage.cover(seen([frame(1, 0, 0)]), grid(200, 1), area)
    assert made.planned.sum() == pytest.approx(100**2 - 40**2, rel=0.02)


def test_polygons_that_overlap_are_all_planned() -> None:
    wide, narrow = square(50).rings[0], square(20).rings[0]
    for polygons in (((wide,), (narrow,)), ((wide,), (wide,))):
        made = coverage.cover(seen([frame(1, 0, 0)]), grid(200, 1), PlannedArea("two surveys", polygons))
        assert made.planned.sum() == pytest.approx(100**2, rel=0.02)


def flown(plan: dict[str, Any], rng: np.random.Generator, first: int) -> list[Station]:
    """Fly a plan as an autopilot would: by its items alone, with wind and tilt; the nose along the line."""
    found: list[Station] = []
    at: np.ndarray[Any, Any] | None = None
    trigger = 0.0
    for item in plan["mission"]["items"]:
        if item["command"] == 206:
            trigger = item["params"][0]
        if item["command"] not in (16, 22):
            continue
        to = np.array(PROJECTION.to_map(item["params"][4], item["params"][5])) - np.array(HOME)
        if at is not None and trigger:
            way = to - at
            heading = math.atan2(way[0], way[1])
            for along in np.arange(0, np.linalg.norm(way), trigger):
                place = at + way / np.linalg.norm(way) * along + rng.normal(0, 0.5, 2)
                tilt = {"pitch": -0.06 + rng.normal(0, 0.03), "roll": rng.normal(0, 0.03)}
                found.append(frame(first + len(found), float(place[0]), float(place[1]), heading=heading, **tilt))
        at = to
    return found


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_refly_that_is_flown_closes_every_hole_and_flies_no_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    area, frames = square(80), survey(rng, 80, lost=0.4)
    survived = seen(frames)
    before = coverage.cover(survived, grid(), area)
    assert before.holes().sum() * before.cell_m2 > 500
    made = refly.plan(survived, before)
    assert made is not None
    again = flown(json.loads(json.dumps(refly.qgc_plan(made))), rng, 1000)
    after = coverage.cover(seen([*frames, *again]), grid(), area)
    assert after.holes().sum() == 0
    assert refly.plan(seen([*frames, *again]), after) is None
    alone = coverage.cover(seen(again), grid(), area)
    assert alone.holes().sum() > 0  # it is not the whole survey again


def test_holes_far_apart_are_flown_one_by_one() -> None:
    frames = survey(np.random.default_rng(1), 80, lost=0.0)
    covered = coverage.cover(seen(frames), grid(), square(80))
    holes = np.zeros_like(covered.planned)
    holes[65:68, 65:68] = holes[130:133, 130:133] = True
    only = Coverage(covered.grid, np.where(holes, 0, 9).astype(np.uint16), covered.directions, covered.planned)
    made = refly.plan(seen(frames), only)
    assert made is not None
    assert len(made.lines) == 2


def test_a_mission_is_refused_where_it_may_lead_into_the_ground() -> None:
    frames = survey(np.random.default_rng(1), 80, lost=0.4)
    covered = coverage.cover(seen(frames), grid(), square(80))
    unknown, hill = np.full((61, 61), HOME_M), np.full((61, 61), HOME_M)
    unknown[20:40, 20:40] = np.nan
    hill[22:39, 29:32] = HOME_M + 0.7 * HEIGHT_M  # a ridge on the lost line, below the flight, not by far
    for heights, said in ((unknown, "is not known everywhere on the way"), (hill, "rises to 242 m, 18 m below")):
        ground = Raster(heights, float(HOME[0]) - 300, float(HOME[1]) + 300, 10.0, 0.1, "hill.tif")
        with pytest.raises(DappledError, match=said):
            refly.plan(seen(frames, ground), covered)


def test_a_camera_that_looks_aside_gets_no_mission_for_one_that_looks_down() -> None:
    frames = [frame(n, 0, 10.0 * n, pitch=math.radians(40)) for n in range(5)]
    covered = coverage.cover(seen(frames), grid(), square(80))
    with pytest.raises(DappledError, match="40° off the vertical"):
        refly.plan(seen(frames), covered)


def test_the_mount_says_which_side_of_the_frame_lies_along_the_line() -> None:
    frames = survey(np.random.default_rng(1), 80, lost=0.4)
    covered = coverage.cover(seen(frames), grid(), square(80))
    made = refly.plan(seen(frames), covered)
    drifting = replace(frames[0].tag.pose, velocity_ned_m_s=(0.0, 0.3, 0.0))
    frames[0] = replace(frames[0], tag=replace(frames[0].tag, pose=drifting))
    assert made is not None
    assert refly.plan(seen(frames), covered) == made
    assert made.trigger_m == pytest.approx(0.2 * ALONG_M, rel=0.05)


def test_a_mission_is_as_slow_as_the_body_or_says_that_the_vehicle_is_too_fast_for_it() -> None:
    frames = survey(np.random.default_rng(1), 80, lost=0.4)
    covered = coverage.cover(seen(frames), grid(), square(80))
    usual = refly.plan(seen(frames), covered)
    assert usual is not None
    assert (usual.speed_m_s, usual.body_s) == (8.0, None)
    timed = [replace(one, tag=replace(one.tag, utc_ns=3_000_000_000 * one.frame.index)) for one in frames]
    for made in (refly.plan(seen(timed), covered), refly.plan(seen(frames), covered, body_s=3.0)):
        assert made is not None
        assert made.interval_s == pytest.approx(3.0, rel=0.01)  # a photograph every 8.9 m: 8 m/s would be one in 1.1 s
        assert made.body_s == 3.0
        assert made.interval_s >= 3.0
        (speed,) = [one for one in refly.qgc_plan(made)["mission"]["items"] if one["command"] == 178]
        assert speed["params"][1] == made.speed_m_s
    with pytest.raises(DappledError, match=r"in 3 s: one every 0\.89 m asks for 0\.29 m/s.* --overlap of 0\.96 or"):
        refly.plan(seen(timed), covered, overlap=0.98)
    with pytest.raises(DappledError, match=r"no slower than 12 m/s: give an --overlap of 0\.19 or less"):
        refly.plan(seen(timed), covered, slowest_m_s=12.0)
    with pytest.raises(DappledError, match="fly this area by hand, and higher"):
        refly.plan(seen(timed), covered, slowest_m_s=20.0)


SIMPLE = {
    "type": "object",
    "required": ["type", "autoContinue", "command", "doJumpId", "frame", "params"],
    "properties": {
        "type": {"const": "SimpleItem"},
        "autoContinue": {"type": "boolean"},
        "command": {"type": "integer"},
        "doJumpId": {"type": "integer", "minimum": 1},
        "frame": {"type": "integer"},
        "params": {"type": "array", "minItems": 7, "maxItems": 7, "items": {"type": ["number", "null"]}},
        "AMSLAltAboveTerrain": {"type": ["number", "null"]},
        "Altitude": {"type": "number"},
        "AltitudeMode": {"type": "integer"},
    },
    "additionalProperties": False,
}
PLAN = {  # from QGroundControl's developer guide, file_formats/plan.md: the required keys, and no others
    "type": "object",
    "required": ["version", "fileType", "groundStation", "mission"],
    "additionalProperties": False,
    "properties": {
        "version": {"const": 1},
        "fileType": {"const": "Plan"},
        "groundStation": {"type": "string"},
        "geoFence": {
            "type": "object",
            "required": ["circles", "polygons", "version"],
            "properties": {"version": {"const": 2}},
        },
        "rallyPoints": {"type": "object", "required": ["points", "version"], "properties": {"version": {"const": 2}}},
        "mission": {
            "type": "object",
            "required": [
                "version", "firmwareType", "globalPlanAltitudeMode", "vehicleType", "cruiseSpeed", "hoverSpeed",
                "items", "plannedHomePosition",
            ],
            "additionalProperties": False,
            "properties": {
                "version": {"const": 2},
                "firmwareType": {"type": "integer"},
                "globalPlanAltitudeMode": {"type": "integer"},
                "vehicleType": {"type": "integer"},
                "cruiseSpeed": {"type": "number"},
                "hoverSpeed": {"type": "number"},
                "items": {"type": "array", "minItems": 1, "items": SIMPLE},
                "plannedHomePosition": {
                    "type": "array", "minItems": 3, "maxItems": 3, "items": {"type": "number"},
                },
            },
        },
    },
}  # fmt: skip


def test_a_plan_is_as_qgroundcontrol_documents_it(tmp_path: Path) -> None:
    frames = survey(np.random.default_rng(0), 80, lost=0.4)
    made = refly.plan(seen(frames), coverage.cover(seen(frames), grid(), square(80)))
    assert made is not None
    refly.write(made, tmp_path / "again.plan")
    plan = json.loads((tmp_path / "again.plan").read_bytes())
    jsonschema.validate(plan, PLAN)
    items = plan["mission"]["items"]
    assert [one["doJumpId"] for one in items] == list(range(1, len(items) + 1))
    assert (items[0]["command"], items[-1]["command"]) == (22, 20)
    assert [one["params"][0] > 0 for one in items if one["command"] == 206] == [True, False] * len(made.lines)


def test_the_end_of_a_distorted_lens_is_the_end_of_what_it_sees() -> None:
    """k1 = −0.15 turns back at 1.5 times the distance: ground at 150 m would fall into the picture again."""
    bent = replace(coverage.eye_of(frame(1, 0, 0), PROJECTION), distortion=(-0.15, 0.0, 0.0, 0.0, 0.0))
    east, north = HOME[0] + np.array([[0.0, 20.0, 154.0]]), HOME[1] + np.zeros((1, 3))
    flat = FramesSeen("test", PROJECTION, Flat(HOME_M), {"1": bent}, (), ())
    assert coverage.cover(flat, grid(400, 2)).frames.sum() * 4 < 1.4 * ALONG_M * ACROSS_M
    x, _ = bent.project(np.stack([east, north, np.full_like(east, HOME_M)], axis=-1).reshape(-1, 3)).T
    assert 0 < x[2] < bent.shape[1]  # without the lens' limit it would count


KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><Polygon><outerBoundaryIs><LinearRing>
<coordinates>8.1,47.1,0 8.2,47.1,0 8.2,47.2,0 8.1,47.1,0</coordinates></LinearRing></outerBoundaryIs></Polygon>
</Placemark></Document></kml>"""
CORNERS = [[8.1, 47.1], [8.2, 47.1], [8.2, 47.2], [8.1, 47.1]]
SURVEY = {"type": "ComplexItem", "complexItemType": "survey", "polygon": [[y, x] for x, y in CORNERS]}
FILES = {
    "a.kml": KML,
    "a.geojson": json.dumps({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [CORNERS]}}),
    "a.json": json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "geometry": {"type": "MultiPolygon", "coordinates": [[CORNERS]]}}]}),
    "a.plan": json.dumps({"fileType": "Plan", "mission": {"items": [{"type": "SimpleItem"}, SURVEY]}}),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_an_area_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FILES[name], encoding="utf-8")
    assert areas.read(tmp_path / name).rings == (((47.1, 8.1), (47.1, 8.2), (47.2, 8.2)),)


def polygon(*places: tuple[float, float]) -> str:
    return json.dumps({"type": "Polygon", "coordinates": [[list(place) for place in places]]})


def test_what_of_a_plan_is_no_survey_is_named(tmp_path: Path) -> None:
    items = [{"type": "ComplexItem", "complexItemType": "CorridorScan"}, SURVEY]
    (tmp_path / "a.plan").write_text(json.dumps({"fileType": "Plan", "mission": {"items": items}}))
    assert areas.read(tmp_path / "a.plan").left == ("1 CorridorScan",)
    (tmp_path / "a.kml").write_text(KML, encoding="utf-16")
    with pytest.raises(AreaError, match="not UTF-8"):
        areas.read(tmp_path / "a.kml")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "a.geojson",
            polygon((0, 0), (1, 1), (1, 0), (0, 1)),
            "crosses itself (the sides from corner 1",
        ),
        ("a.geojson", polygon((0, 0), (1, 1)), "a polygon has 2 corners"),
        ("a.geojson", polygon((0, 0), (1, 95), (1, 0)), "is not a latitude and a longitude"),
        ("a.geojson", '{"type": "Point", "coordinates": [1, 2]}', "has no polygon"),
        ("a.geojson", "{", "a.geojson"),
        ("a.geojson", "[]", "can't be read as an area"),
        ("a.kml", "<kml>", "can't be read as an area"),
        ("a.kml", KML.replace(",", ", "), "without blanks"),
        ("a.kml", '<!DOCTYPE k [<!ENTITY a "b">]><kml/>', "declares entities"),
        ("a.plan", '{"fileType": "Plan", "mission": {"items": []}}', "no survey with a polygon"),
        ("a.plan", '{"fileType": "Cake"}', "not 'Plan'"),
        ("a.shp", "", "an area is a .geojson, a .kml or a QGroundControl .plan"),
    ],
)
def test_an_area_that_cant_be_used_is_a_sentence(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(AreaError) as error:
        areas.read(tmp_path / name)
    assert said in str(error.value)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight with a frame that was judged bad, one without a pose, one judged unknown, and four whose place is in
    doubt; and a field.geojson and crossed.geojson beside it."""
    root = tmp_path_factory.mktemp("flights")
    flight = recording.begin(root, SystemClock(), {})
    writer = LedgerWriter(flight, SystemClock())
    frames = survey(np.random.default_rng(2), 60, lost=0.3)
    doubtful: dict[str, dict[str, Any]] = {
        frames[12].name: {"source": "nearest", "age_ms": 8500.0},
        frames[13].name: {"gnss": Gnss(1, 3, None, None, None, None, None, 100.0)},
        frames[14].name: {"position_sigma_m": 50.0},
    }
    for one in frames[:16]:
        index = one.frame.index
        writer.requested(Shot(index, Cause("test", "test"), 0, 0))
        with closing(Blob.of(b"x%d" % index)) as blob:
            kept = writer.record(index, f"{index}.cr2", blob)
        pose = no_pose() if one is frames[1] else replace(one.tag.pose, **doubtful.get(one.name, {}))
        doubts = (finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 15), rival=2),) if one is frames[15] else ()
        writer.tagged(replace(one.tag, frame_sha256=kept.sha256, pose=pose, doubts=doubts))
        state = "bad" if one is frames[0] else "unknown" if one is frames[2] else "good"
        details = {
            "verdict": {
                "state": state,
                "reasons": [codec.plain(finding(Code.FRAME_DARK, FRAME, share=0.01))] * (state == "bad"),
                "facts": {},
            }
        }
        writer.decoded(Result(index, "0" * 64, 1, 1, "fd", "predicted", 1.0, details=details))
    flight.close()
    ring = [[longitude, latitude] for latitude, longitude in square(60).rings[0]]
    (root / "field.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}))
    far = [(-91.6, 41.8), (-91.6, 41.801), (-91.601, 41.8)]
    (root / "far.geojson").write_text(polygon(*far))
    (root / "crossed.geojson").write_text(polygon((0, 0), (1, 1), (1, 0), (0, 1)))
    return flight.folder.path


def test_the_command_writes_what_was_seen_and_the_mission(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["flight", "coverage", str(recorded), "--area", str(recorded.parent / "field.geojson"), "--cell", "1"]
    outputs = ["-o", str(tmp_path), "--refly", str(tmp_path / "again.plan")]
    assert main([*call, *outputs, "--json"]) == 1  # there are holes
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == 10
    assert sorted(one["code"] for one in facts["left_out"]) == [
        "frame.judged_bad",
        "frame.unplaced",
        "position.far_telemetry",
        "position.time_doubted",
        "position.too_coarse",
        "position.without_fix",
    ]
    assert facts["unjudged"] == 1
    assert facts["interval_s"] > 0
    assert facts["speed_m_s"] == 8.0
    assert 0 < facts["holes_m2"] < facts["area_m2"] == pytest.approx(120**2, rel=0.02)
    with Image.open(tmp_path / "coverage.png") as picture:
        assert picture.width == 1080
    features = json.loads((tmp_path / "coverage.geojson").read_bytes())["features"]
    sizes = {is_hole: sum(one["properties"]["area_m2"] for one in features if one["properties"]["hole"] is is_hole)
             for is_hole in (False, True)}  # fmt: skip
    assert sizes[True] == pytest.approx(facts["holes_m2"], rel=0.01)
    assert sum(sizes.values()) == pytest.approx(facts["area_m2"], rel=0.01)  # each place once
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(tmp_path / "coverage.tif") as made:
        assert made.descriptions == ("frames", "directions", "holes")
        assert made.read(3).sum() == pytest.approx(facts["holes_m2"], rel=0.01)
    assert main([*call, "--count-bad", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["frames"] == 11
    assert main([*call, "--count-doubtful", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["frames"] == 14
    assert main([*call, *outputs]) == 1
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--refly", "again.plan"], 2, "--refly needs --area"),
        (["--area", "field.geojson", "--refly", "again.kml"], 2, "opens .plan files only"),
        (["--area", "crossed.geojson"], 1, "the area crosses itself"),
        (["--area", "nowhere.kml"], 2, "nowhere.kml: no such file"),
        (["--terrain", "nowhere.tif"], 2, "nowhere.tif: no such file"),
        (["--area", "field.geojson", "--cell", "9000"], 2, "smaller than a cell"),
        (["--area", "field.geojson", "--cell", "0.001"], 1, "give a --cell of"),
        (["--area", "field.geojson", "--ground", "300"], 1, "below the ground at 300 m"),
        (["--area", "far.geojson", "--refly", "again.plan"], 1, "is it another field's"),
        (
            ["--area", "field.geojson", "--least", "3", "--overlap", "0.5", "--refly", "a.plan"],
            1,
            "--overlap of 0.67 or",
        ),
    ],
)
def test_a_wrong_call_is_a_sentence(
    recorded: Path, words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    named = [
        str(recorded.parent / word) if word.partition(".")[0].isalpha() and "." in word else word for word in words
    ]
    assert main(["flight", "coverage", str(recorded), *named]) == code
    assert said in capsys.readouterr().err
