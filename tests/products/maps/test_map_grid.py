"""Maps: cells where they belong, values where they were seen, tiles and globes."""

from __future__ import annotations

import io
import itertools
import json
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from dappled.config.profiles import Lens
from dappled.products.maps import cog, kmz, map_files, map_grid
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.eye import Eye, through
from dappled.products.maps.georeference import Survey
from dappled.products.maps.ground import Flat, Ground
from dappled.products.maps.kmz import Overlay
from dappled.products.maps.map_grid import MapError, MapGrid
from dappled.products.maps.photographs import Photograph
from dappled.products.whole_files import write_json
from tests import globe
from tests.products.maps.test_eye import GRID, SHAPE, eye_at
from tests.products.maps.test_ground import hill

KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}


def painted(eye: Eye, ground: Ground, colour: bool = False) -> NDArray[np.float32]:
    """What the eye sees of ground whose brightness is a plane wave of 3 m on the map."""
    rows, columns = eye.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    met = ground.meet(eye, pixels)
    value = wave(met[:, 0], met[:, 1]).reshape(rows, columns).astype(np.float32)
    return np.stack([value, 0.5 * value, 0.25 * value], axis=-1) if colour else value


def wave(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(0.4 + 0.2 * np.sin(2 * np.pi * (east % 3.0) / 3.0) * np.cos(2 * np.pi * (north % 3.0) / 3.0))


def photograph(eye: Eye, image: NDArray[np.float32], name: str = "000007") -> Photograph:
    return Photograph(name, 1_795_256_103_000_000_000, image, eye, 0.05, 0.001, GRID)


def survey(*photos: Photograph, ground: Ground | None = None, gsd_m: float = 0.1, crs: str = "EPSG:32615") -> Survey:
    return Survey("20261121T101503Z-0a1b2c3d", photos, Projection(crs), ground or Flat(0.0), gsd_m, float("inf"), ())


def draw(
    image: NDArray[np.float32], eye: Eye, grid: MapGrid, ground: Ground, projection: Projection
) -> NDArray[np.float32]:
    """(rows, columns, c): one view on the map, as `pieces` draws it, but alone."""
    smooth = map_grid.smoothed(image, eye, grid, ground)
    return map_grid.sample(smooth, map_grid.seen_at(eye, grid, ground, projection))


@pytest.mark.parametrize(("ground", "colour"), [(Flat(0.0), False), (hill(), True)], ids=["flat", "hill"])
def test_every_cell_shows_the_ground_that_lies_there(ground: Ground, colour: bool) -> None:
    eye = eye_at(height_m=100.0)
    made = survey(photograph(eye, painted(eye, ground, colour)), ground=ground)
    grid = map_grid.grid_of(made.photographs, ground, made.projection, 0.1)
    drawn = draw(made.photographs[0].image, eye, grid, ground, made.projection)
    east, north = grid.places(made.projection)
    known = np.isfinite(drawn[..., 0])
    assert 0.3 < known.mean() < 0.9
    assert (
        np.abs(drawn[..., 0] - wave(east, north))[known].max() < 0.03
    )  # cubic, and half a pixel beyond the last one at the rim
    inside = map_grid.seen_at(eye, grid, ground, made.projection)
    assert np.array_equal(np.isfinite(inside[..., 0]), known)


def test_a_part_of_a_coarse_map_is_the_same_where_a_part_of_the_picture_is_smoothed() -> None:
    eye, ground, projection = eye_at(height_m=100.0), Flat(0.0), Projection("EPSG:32615")
    noise = np.random.default_rng(3).random((*eye.shape, 3), dtype=np.float32)
    whole = map_grid.grid_of([photograph(eye, noise)], ground, projection, 3 * eye.gsd_m(0.0))
    smooth = map_grid.smoothed(noise, eye, whole, ground)
    shown = 0
    for top, left in itertools.product(*(range(0, side, 32) for side in whole.shape)):
        grid = whole.part(slice(top, top + 32), slice(left, left + 32))
        at = map_grid.seen_at(eye, grid, ground, projection)
        part = map_grid.sample(map_grid.smoothed(noise, eye, grid, ground, at), at)
        np.testing.assert_array_equal(part, map_grid.sample(smooth, at))
        shown += np.isfinite(part[..., 0]).sum()
    assert shown > 0.3 * math.prod(whole.shape)


def test_a_map_in_degrees_shows_the_same() -> None:
    eye, ground = eye_at(60.0, 24.05, height_m=100.0), Flat(0.0)
    made = survey(photograph(eye, painted(eye, ground)), crs=utm(60.0, 24.05))
    grid = map_grid.grid_of(made.photographs, ground, made.projection, 0.1, degrees=True)
    east, north = grid.places(made.projection)
    x, y = grid.axes()
    exact = made.projection.to_map(np.repeat(y[:, None], len(x), 1), np.tile(x, (len(y), 1)))
    assert np.abs(np.stack([east, north]) - np.stack(exact)).max() < 1e-4
    drawn = draw(made.photographs[0].image, eye, grid, ground, made.projection)[..., 0]
    known = np.isfinite(drawn)
    assert (
        np.abs(drawn - wave(east, north))[known].max() < 0.03
    )  # cubic, and half a pixel beyond the last one at the rim


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.01, 5.0))
def test_a_part_of_a_grid_has_the_same_cells(rows: int, columns: int, step: float) -> None:
    grid = MapGrid("EPSG:32615", 1000.0, 2000.0, step, step, (50, 60))
    part = grid.part(slice(rows, rows + 5), slice(columns, columns + 7))
    assert part.axes()[0] == pytest.approx(grid.axes()[0][columns : columns + 7])
    assert part.axes()[1] == pytest.approx(grid.axes()[1][rows : rows + 5])


def test_a_vast_map_is_refused() -> None:
    with pytest.raises(MapError, match="larger --gsd"):
        map_grid.around(np.array([[0.0, 0.0], [1e6, 1e6]]), "EPSG:32615", 0.1, 0.1)


def test_views_laid_over_each_other_on_the_ground_are_sharp_where_their_mean_is_not() -> None:
    """A camera with a wide aperture, 100 m above tilted sight lines: refocused on the ground plane itself."""
    eye, ground = eye_at(tilt_deg=(10, 20, 45), lens=Lens(50.0, 50.0)), Flat(0.0)
    apertures = np.array([(y, x) for y in (-0.6, 0, 0.6) for x in (-0.6, 0, 0.6)])
    views = np.stack([painted(through(eye, (y, x)), ground) for y, x in apertures])
    mean = photograph(eye, views.mean(axis=0))
    refocused = replace(mean, views=views, apertures_m=apertures)
    grid = map_grid.grid_of([mean], ground, Projection("EPSG:32615"), 0.1)
    east, north = grid.places(Projection("EPSG:32615"))
    worst = []
    for one in (mean, refocused):
        drawn = np.full(grid.shape, np.nan)
        for rows, columns, values in map_grid.pieces([one], grid, ground, Projection("EPSG:32615")):
            drawn[rows, columns] = values[..., 0]
        drawn = drawn[30:-30, 30:-30]
        worst.append(float(np.nanquantile(np.abs(drawn - wave(east, north)[30:-30, 30:-30]), 0.99)))
    assert worst[1] < 0.02
    assert worst[0] > 4 * worst[1]


def test_a_mosaic_is_seamless_where_frames_agree() -> None:
    ground = Flat(0.0)
    first = eye_at(height_m=100.0)
    second = first.moved(np.array([12.0, 5.0, 3.0, 0.02, -0.01, 0.3]))
    photos = [photograph(eye, painted(eye, ground), name) for eye, name in ((first, "1"), (second, "2"))]
    projection = Projection("EPSG:32615")
    grid = map_grid.grid_of(photos, ground, projection, 0.1)
    east, north = grid.places(projection)
    drawn = np.full(grid.shape, np.nan)
    for rows, columns, values in map_grid.pieces(photos, grid, ground, projection):
        drawn[rows, columns] = values[..., 0]
    known = np.isfinite(drawn)
    single = [np.isfinite(draw(p.image, p.eye, grid, ground, projection)[..., 0]) for p in photos]
    assert np.array_equal(known, single[0] | single[1])
    assert (
        np.abs(drawn - wave(east, north))[known].max() < 0.03
    )  # cubic, and half a pixel beyond the last one at the rim


def test_a_cog_is_one_to_gdal(tmp_path: Path) -> None:
    eye, ground = eye_at(height_m=100.0), Flat(0.0)
    made = survey(photograph(eye, painted(eye, ground, colour=True)), gsd_m=0.05)
    path = map_files.mosaic_cog(made, tmp_path / "mosaic.tif", gain=1.0)
    with rasterio.open(path) as read:
        assert read.crs.to_epsg() == 32615
        assert read.count == 4
        assert read.overviews(1)
        assert read.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert read.tags()["DAPPLED_GROUND"] == "flat at 0.00 m"
        met = Flat(0.0).meet(eye, np.array([[150.0, 100.0]]))[0]
        row, column = read.index(met[0], met[1])
        values = read.read()[:, row, column]
    expected = cog.display(np.array([[[*(wave(met[:1], met[1:2])[0] * np.array([1, 0.5, 0.25]))]]], np.float32), 1.0)
    assert values.astype(int) == pytest.approx(expected[0, 0].astype(int), abs=6)
    assert not list(tmp_path.glob(".maps-*"))
    again = map_files.mosaic_cog(made, tmp_path / "again.tif", gain=1.0)
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="GDAL's command line is not installed")
def test_gdals_own_command_reads_the_cog(tmp_path: Path) -> None:
    eye = eye_at(height_m=100.0)
    path = map_files.mosaic_cog(survey(photograph(eye, painted(eye, Flat(0.0)))), tmp_path / "m.tif", gain=1.0)
    said = json.loads(subprocess.run(["gdalinfo", "-json", str(path)], check=True, capture_output=True).stdout)  # noqa: S607  on PATH
    assert said["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert [band["colorInterpretation"] for band in said["bands"]] == ["Gray", "Alpha"]
    x, y = said["cornerCoordinates"]["center"]
    assert np.hypot(x - eye.centre[0], y - eye.centre[1]) < 30


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="GDAL's command line is not installed")
def test_gdals_own_command_reads_the_kmz(tmp_path: Path) -> None:
    eye = eye_at(height_m=100.0)
    path = map_files.mosaic_kmz(survey(photograph(eye, painted(eye, Flat(0.0), colour=True))), tmp_path / "m.kmz", 1.0)
    said = json.loads(subprocess.run(["gdalinfo", "-json", str(path)], check=True, capture_output=True).stdout)  # noqa: S607  on PATH
    assert [band["colorInterpretation"] for band in said["bands"]] == ["Red", "Green", "Blue", "Alpha"]
    longitude, latitude = said["cornerCoordinates"]["center"]
    assert (latitude, longitude) == pytest.approx((41.6, -91.5), abs=2e-4)


def overlays(path: Path) -> tuple[ET.Element, dict[str, NDArray[np.uint8]]]:
    globe.check_archive(path)
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        assert archive.namelist()[0] == "doc.kml"
        pictures = {
            name: np.asarray(Image.open(io.BytesIO(archive.read(name))))
            for name in archive.namelist()
            if name.endswith(".png")
        }
        return ET.fromstring(archive.read("doc.kml")), pictures  # noqa: S314  written a moment ago


def box(overlay: ET.Element) -> dict[str, float]:
    found = overlay.find("k:LatLonBox", KML)
    assert found is not None
    return {child.tag.rpartition("}")[2]: float(child.text or "") for child in found}


def test_a_kmz_is_north_up_and_lies_where_the_frame_looked(tmp_path: Path) -> None:
    eye, ground = eye_at(height_m=100.0), Flat(0.0)
    made = survey(photograph(eye, painted(eye, ground)))
    root, pictures = overlays(map_files.mosaic_kmz(made, tmp_path / "m.kmz", gain=1.0))
    (overlay,) = root.iter(f"{{{KML['k']}}}GroundOverlay")
    assert [child.tag.rpartition("}")[2] for child in overlay] == ["name", "Icon", "LatLonBox"]
    edges = box(overlay)
    assert list(edges) == ["north", "south", "east", "west"]
    assert overlay.find("k:LatLonBox/k:rotation", KML) is None
    href = overlay.findtext("k:Icon/k:href", namespaces=KML)
    assert href is not None
    picture = pictures[href]
    corners = ground.meet(eye, eye.corners())
    latitude, longitude = made.projection.to_geodetic(corners[:, 0], corners[:, 1])
    assert edges["west"] <= longitude.min() < edges["west"] + 1e-5
    assert edges["east"] - 1e-5 < longitude.max() <= edges["east"]
    assert edges["south"] <= latitude.min() < edges["south"] + 1e-5
    # a place in the picture is the place that was painted there
    met = ground.meet(eye, np.array([[150.0, 100.0]]))[0]
    lat, lon = made.projection.to_geodetic(met[0], met[1])
    row = int((edges["north"] - float(lat)) / (edges["north"] - edges["south"]) * picture.shape[0])
    column = int((float(lon) - edges["west"]) / (edges["east"] - edges["west"]) * picture.shape[1])
    expected = cog.display(wave(met[:1], met[1:2]).astype(np.float32)[:, None, None], 1.0)[0, 0]
    assert picture[row, column].astype(int) == pytest.approx(expected.astype(int), abs=8)
    assert (picture[0, 0, -1], picture[-1, -1, -1]) == (0, 0)  # transparent beside the turned frame


def test_across_the_antimeridian_there_are_two_overlays_and_a_cut_footprint(tmp_path: Path) -> None:
    eye, ground = eye_at(-17.0, 179.99999, height_m=100.0), Flat(0.0)
    made = survey(photograph(eye, painted(eye, ground)), crs="EPSG:32760")
    root, pictures = overlays(map_files.mosaic_kmz(made, tmp_path / "m.kmz", gain=1.0))
    west, east = (box(one) for one in root.iter(f"{{{KML['k']}}}GroundOverlay"))
    assert (west["east"], east["west"]) == (180.0, -180.0)
    assert 179.999 < west["west"] < 180
    assert -180 < east["east"] < -179.999
    assert len({picture.shape[0] for picture in pictures.values()}) == 1
    shape = map_files.feature(made.photographs[0], ground, made.projection, {})["geometry"]
    assert shape["type"] == "MultiPolygon"
    rings = [np.array(polygon[0]) for polygon in shape["coordinates"]]
    assert sorted(np.sign(ring[:, 0].mean()) for ring in rings) == [-1, 1]
    assert all((np.abs(ring[:, 0]) <= 180).all() for ring in rings)
    assert all((ring[0] == ring[-1]).all() for ring in rings)
    drawn = map_files.mosaic_cog(made, tmp_path / "m.tif", gain=1.0)
    with rasterio.open(drawn) as read:
        assert read.width < 1000  # one piece: the projection goes on


def test_a_large_picture_becomes_a_tree_of_tiles(tmp_path: Path) -> None:
    rows, columns = 2300, 1900
    picture = np.zeros((rows, columns, 2), np.uint8)
    picture[..., 0] = (np.arange(columns) // 100 * 10 % 256)[None, :]
    picture[..., 1] = 255
    grid = MapGrid("EPSG:4326", -91.5, 41.6, 1e-6, 1e-6, (rows, columns))
    kmz.write(tmp_path / "large.kmz", "large", [Overlay("large", picture, grid)])
    with zipfile.ZipFile(tmp_path / "large.kmz") as archive:
        names = archive.namelist()
        pages = {name: ET.fromstring(archive.read(name)) for name in names if name.endswith(".kml")}  # noqa: S314  ours
        sizes = [Image.open(io.BytesIO(archive.read(name))).size for name in names if name.endswith(".png")]
    assert max(max(size) for size in sizes) <= kmz.TILE
    assert set(globe.check_archive(tmp_path / "large.kmz")) == set(pages)
    reached, open_pages = set(), ["doc.kml"]
    leaves = []
    while open_pages:
        page = open_pages.pop()
        reached.add(page)
        folder = page.rpartition("/")[0]
        for href in pages[page].iter(f"{{{KML['k']}}}href"):
            target = f"{folder}/{href.text}" if folder else str(href.text)
            assert target in names
            if target.endswith(".kml"):
                open_pages.append(target)
        links = list(pages[page].iter(f"{{{KML['k']}}}NetworkLink"))
        leaves += [box(one) for one in pages[page].iter(f"{{{KML['k']}}}GroundOverlay") if not links]
    assert reached == set(pages)
    area = sum((one["east"] - one["west"]) * (one["north"] - one["south"]) for one in leaves)
    assert area == pytest.approx(rows * columns * 1e-12, rel=1e-4)  # the finest tiles cover everything once
    again = tmp_path / "again.kmz"
    kmz.write(again, "large", [Overlay("large", picture, grid)])
    assert again.read_bytes() == (tmp_path / "large.kmz").read_bytes()


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="GDAL's command line is not installed")
def test_gdal_reads_the_tree_of_tiles(tmp_path: Path) -> None:
    picture = np.full((1300, 1100, 2), 255, np.uint8)
    path, grid = tmp_path / "m.kmz", MapGrid("EPSG:4326", -91.5, 41.6, 1e-6, 1e-6, (1300, 1100))
    kmz.write(path, "m", [Overlay("m", picture, grid)])
    said = json.loads(subprocess.run(["gdalinfo", "-json", str(path)], check=True, capture_output=True).stdout)  # noqa: S607  on PATH
    assert said["driverShortName"] == "KMLSUPEROVERLAY"
    corners = said["cornerCoordinates"]
    assert [*corners["upperLeft"], *corners["lowerRight"]] == pytest.approx([-91.5, 41.6, -91.4989, 41.5987], abs=1e-8)
    assert min(said["size"]) >= 1024  # finer than the first page's picture


def test_a_quad_keeps_the_view_as_it_is(tmp_path: Path) -> None:
    eye, ground = eye_at(height_m=100.0), Flat(0.0)
    made = survey(photograph(eye, painted(eye, ground)))
    root, pictures = overlays(map_files.frame_kmz(made, made.photographs[0], tmp_path / "q.kmz", 1.0, quad=True))
    text = root.findtext(".//gx:LatLonQuad/k:coordinates", namespaces=KML)
    assert text is not None
    quad = np.array([[float(word) for word in pair.split(",")] for pair in text.split()])
    assert next(iter(pictures.values())).shape[:2] == SHAPE
    met = ground.meet(eye, eye.corners()[[3, 2, 1, 0]])  # lower left first, counter-clockwise
    latitude, longitude = made.projection.to_geodetic(met[:, 0], met[:, 1])
    assert quad == pytest.approx(np.stack([longitude, latitude], axis=1), abs=1e-9)


def footprint(folder: Path) -> Path:
    eye, ground = eye_at(height_m=100.0), hill()
    one = photograph(eye, painted(eye, ground))
    path = folder / "footprints.geojson"
    features = [map_files.feature(one, ground, Projection("EPSG:32615"), {"a": 1})]
    write_json(path, {"type": "FeatureCollection", "features": features})
    return path


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="GDAL's command line is not installed")
def test_footprints_are_polygons_to_others(tmp_path: Path) -> None:
    command = ["ogrinfo", "-ro", "-al", str(footprint(tmp_path))]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # on PATH
    assert "Geometry: Polygon" in said
    assert "Feature Count: 1" in said
    assert re.search(r"\(String\) = 000007\b", said)


def test_footprints_turn_counter_clockwise(tmp_path: Path) -> None:
    path = footprint(tmp_path)
    ring = np.array(json.loads(path.read_text())["features"][0]["geometry"]["coordinates"][0])
    x, y = ring[:-1, 0], ring[:-1, 1]
    assert np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0  # RFC 7946: counter-clockwise
