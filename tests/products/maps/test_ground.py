"""Rays on terrain: analytic hills, files with and without a place, heights from sea level and from the ellipsoid."""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from numpy.typing import NDArray

from dappled.errors import DappledError
from dappled.products.maps import ground as grounds
from dappled.products.maps.earth import Geoid, Projection
from dappled.products.maps.ground import Flat, Raster
from dappled.products.maps.references import BaseMap
from tests.products.maps.test_eye import eye_at

PROJECTION = Projection("EPSG:32615")


def hill(step_m: float = 1.0, top_m: float = 20.0) -> Raster:
    """A cone 20 m high around the eye's foot, 60 m across."""
    east, north = eye_at().centre[:2]
    axis = np.arange(-60, 60 + step_m, step_m)
    height = np.clip(top_m * (1 - np.hypot(axis[:, None], axis[None, :]) / 30), 0, None)
    return Raster(height, east - 60, north + 60, step_m, 0.1, "hill")


def write(path: Path, raster: Raster, crs: str = "EPSG:32615", *, lift: float = 0.0) -> Path:
    rows, columns = raster.values.shape
    step = raster.step_m
    transform = rasterio.Affine(step, 0, raster.west - step / 2, 0, -step, raster.north + step / 2)
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs=crs, transform=transform
    ) as target:
        target.write((raster.values + lift).astype(np.float32), 1)
    return path


def test_rays_stop_at_the_first_ground_they_meet() -> None:
    eye, ground = eye_at(tilt_deg=(0, 12, 0)), hill()
    met = ground.meet(eye, eye.border(6))
    assert np.isfinite(met).all()
    assert met[:, 2] == pytest.approx(ground.heights(met[:, 0], met[:, 1]), abs=1e-6)
    assert eye.project(met) == pytest.approx(eye.border(6), abs=1e-5)
    before = eye.centre + (met - eye.centre) * np.linspace(0.05, 0.995, 60)[:, None, None]
    assert (before[..., 2] > ground.heights(before[..., 0], before[..., 1]) - 1e-6).all()


def test_a_flat_raster_is_flat_ground() -> None:
    eye, ground = eye_at(), hill(top_m=0.0)
    assert ground.meet(eye, eye.border(3)) == pytest.approx(Flat(0.0).meet(eye, eye.border(3)), abs=1e-6)


def test_what_lies_behind_the_hill_is_not_seen() -> None:
    eye, ground = eye_at(height_m=30.0), hill()
    east, north = eye.centre[:2]
    far = np.array([40.0, 0.0, -35.0])
    places = east + far, north + np.array([0.0, 1.0, 0.0])
    seen = ground.sees(eye, places[0], places[1], ground.heights(*places))
    assert seen.tolist() == [True, True, True]  # from the top of the cone itself one sees all around
    low = eye.moved(np.array([-50.0, 0.0, -22.0, 0, 0, 0]))
    seen = ground.sees(low, places[0], places[1], ground.heights(*places))
    assert seen.tolist() == [False, True, True]


def test_beyond_the_raster_nothing_is_known() -> None:
    eye, ground = eye_at(height_m=900.0), hill()
    assert np.isnan(ground.meet(eye, eye.corners())).all()


def test_a_file_is_read_onto_the_maps_grid(tmp_path: Path) -> None:
    raster = hill()
    east, north = eye_at().centre[:2]
    bounds = (east - 20, north - 20, east + 20, north + 20)
    made = grounds.load(write(tmp_path / "hill.tif", raster), PROJECTION, bounds)
    at = east + np.array([-13.3, 0.2, 7.7]), north + np.array([4.0, -9.5, 11.1])
    assert made.heights(*at) == pytest.approx(raster.heights(*at), abs=0.15)
    assert made.name == "hill.tif"
    lifted = write(tmp_path / "ellipsoidal.tif", raster, lift=-32.0)
    down = grounds.load(lifted, PROJECTION, bounds, geoid=Geoid(offset_m=-32.0))
    assert down.heights(*at) == pytest.approx(made.heights(*at), abs=1e-3)


def test_dted_is_terrain(tmp_path: Path) -> None:
    """A DTED level 0 cell written by GDAL: posts every 30 arc seconds, whole metres above sea level."""
    north, west = 42.0, -92.0
    post = 1 / 120
    rows = columns = 121
    height = np.tile(np.arange(columns, dtype=np.int16), (rows, 1))  # a metre a post, to the east
    transform = rasterio.Affine(post, 0, west - post / 2, 0, -post, north + post / 2)
    plain, cell = tmp_path / "plain.tif", tmp_path / "n41.dt0"
    with rasterio.open(
        plain, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="int16", crs="EPSG:4326",
        transform=transform,
    ) as target:  # fmt: skip
        target.write(height, 1)
    rasterio.shutil.copy(plain, cell, driver="DTED")
    east, y = (float(v) for v in PROJECTION.to_map(41.6, -91.5))
    ground = grounds.load(cell, PROJECTION, (east - 500, y - 500, east + 500, y + 500))
    assert float(ground.heights(np.array(east), np.array(y))) == pytest.approx(60.0, abs=0.5)


def write_degrees(path: Path, west: float, north: float, step_deg: float, values: NDArray[np.float32]) -> Path:
    rows, columns = values.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs="EPSG:4326",
        transform=rasterio.Affine(step_deg, 0, west, 0, -step_deg, north),
    ) as target:  # fmt: skip
        target.write(values, 1)
    return path


def test_a_raster_of_the_whole_world_is_terrain(tmp_path: Path) -> None:
    world = write_degrees(tmp_path / "world.tif", -180, 90, 0.5, np.full((360, 720), 12.0, dtype=np.float32))
    east, north = eye_at().centre[:2]
    made = grounds.load(world, PROJECTION, (east - 20, north - 20, east + 20, north + 20))
    assert float(made.heights(np.array(east), np.array(north))) == pytest.approx(12.0)
    assert 30_000 < made.step_m < 60_000  # half a degree of longitude, there


@pytest.mark.parametrize("west", [-180.0, 0.0, 170.0])
def test_terrain_goes_on_over_the_antimeridian(tmp_path: Path, west: float) -> None:
    """From a raster that ends there, and from two that don't."""
    columns = 40 if west == 170 else 720
    longitude = west + 0.5 * (np.arange(columns) + 0.5)
    values = np.where(longitude % 360 < 180, 10.0, 20.0).astype(np.float32)
    world = write_degrees(tmp_path / "world.tif", west, 90, 0.5, np.tile(values, (360, 1)))
    projection = Projection("EPSG:32701")
    east, north = (float(v) for v in projection.to_map(-17.0, 180.0))
    made = grounds.load(world, projection, (east - 90e3, north - 9e3, east + 90e3, north + 9e3))
    met = made.heights(np.array([east - 85e3, east + 85e3]), np.full(2, north))
    assert met == pytest.approx([10.0, 20.0], abs=0.01)
    picture = BaseMap(world, projection, 1000.0)
    box = np.array([[east - 90e3, north - 9e3], [east + 90e3, north + 9e3]])
    picture.check(box)
    window = picture.window(box, 0.0)
    assert window is not None
    drawn, _ = window
    assert np.isfinite(drawn).all()
    assert drawn[:, 0] == pytest.approx(10.0, abs=0.01)
    assert drawn[:, -1] == pytest.approx(20.0, abs=0.01)


def test_bad_terrain_is_a_sentence(tmp_path: Path) -> None:
    east, north = eye_at().centre[:2]
    bounds = (east - 20, north - 20, east + 20, north + 20)
    with pytest.raises(DappledError, match="can't be read"):
        grounds.load(tmp_path / "none.tif", PROJECTION, bounds)
    elsewhere = write(tmp_path / "elsewhere.tif", hill(), "EPSG:32633")
    with pytest.raises(DappledError, match=r"elsewhere\.tif lies elsewhere"):
        grounds.load(elsewhere, PROJECTION, bounds)
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(tmp_path / "nowhere.tif", "w", driver="GTiff", width=4, height=4, count=1, dtype="float32"),
    ):
        pass
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        pytest.raises(DappledError, match="has no coordinates"),
    ):
        grounds.load(tmp_path / "nowhere.tif", PROJECTION, bounds)


def test_a_raster_that_names_a_server_asks_it_nothing(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0)
        address = f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/a.tif"
        (tmp_path / "terrain.tif").write_text(
            '<VRTDataset rasterXSize="4" rasterYSize="4"><SRS>EPSG:32615</SRS><GeoTransform>0,1,0,0,0,-1</GeoTransform>'
            f'<VRTRasterBand dataType="Byte" band="1"><SimpleSource><SourceFilename>{address}</SourceFilename>'
            "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
        )
        with pytest.raises(DappledError, match=r"terrain\.tif can't be read"):
            grounds.load(tmp_path / "terrain.tif", Projection("EPSG:32615"), (0.0, -4.0, 4.0, 0.0))
        with pytest.raises(BlockingIOError):
            server.accept()
