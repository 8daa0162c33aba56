"""`dappled terrain volume` against volumes and σ that follow by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dappled.cli import main
from dappled.decode.array_types import Floats
from dappled.products.maps import cog, terrain
from dappled.products.maps.earth import Projection
from dappled.products.maps.ground import Flat
from dappled.products.maps.hyperstereo import Surface
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.terrain import TerrainModel
from tests.products.maps.test_eye import eye_at
from tests.products.maps.test_map_grid import painted, photograph, survey

pytest.importorskip("rasterio")
GRID = MapGrid("EPSG:32615", 499_900.0, 4_600_100.0, 0.5, 0.5, (400, 400))  # 200 m a side, on the central meridian
SCALE = 0.9996  # of UTM there: metres of the map for one on the ground
CELL_M2 = 0.25 / SCALE**2


def written(
    path: Path, height: Floats, sigma_m: float | None = None, tags: Mapping[str, str] | None = None,
    grid: MapGrid = GRID,
) -> str:  # fmt: skip
    bands, names = [height], ["height above sea level, m"]
    if sigma_m is not None:
        bands.append(np.where(np.isfinite(height), sigma_m, np.nan))
        names.append("sigma of a height by itself, m")
    cog.write(path, grid, np.stack(bands, axis=-1).astype(np.float32), tags or {}, tuple(names))
    return str(path)


def cone(grid: MapGrid = GRID, radius_m: float = 40.0, height_m: float = 10.0) -> Floats:
    x, y = grid.axes()
    away = np.hypot(x[None, :] - 500_000.0, y[:, None] - 4_600_000.0)
    return np.asarray(np.maximum(0.0, height_m * (1 - away / radius_m)), np.float64)


def square(path: Path, west: float, south: float, east: float, north: float) -> str:
    """A GeoJSON of a rectangle of the map."""
    corners = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    latitude, longitude = Projection(GRID.crs).to_geodetic(*corners.T)
    ring = np.stack([longitude, latitude], axis=1).tolist()
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return str(path)


def told(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["terrain", "volume", *words, "--json"]) == 0
    made: dict[str, Any] = json.loads(capsys.readouterr().out)
    return made


def test_a_cone_and_a_pit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A cone holds πr²h/3."""
    flat = written(tmp_path / "flat.tif", np.full(GRID.shape, 200.0))
    made = told(capsys, flat, written(tmp_path / "heap.tif", 200.0 + cone()))
    volume = math.pi * 40**2 * 10 / 3 / SCALE**2
    assert made["fill"]["volume_m3"] == pytest.approx(volume, rel=1e-3)
    assert made["fill"]["area_m2"] == pytest.approx(math.pi * 40**2 / SCALE**2, rel=2e-3)
    assert (made["cut"]["volume_m3"], made["cut"]["area_m2"]) == (0, 0)
    assert made["net"]["area_m2"] == pytest.approx(200 * 200 / SCALE**2)
    made = told(capsys, flat, written(tmp_path / "pit.tif", 200.0 - cone()))
    assert made["cut"]["volume_m3"] == pytest.approx(volume, rel=1e-3)
    assert made["net"]["volume_m3"] == pytest.approx(-volume, rel=1e-3)
    assert made["fill"]["cells_sigma_m3"] is made["net"]["level_sigma_m3"] is made["noise_m3"] is None


def test_sigma_of_a_sum(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors of cells add in squares, those of a patch of 3 × 3 alike, an error in common adds up."""
    height = np.full(GRID.shape, 200.0)
    first = written(tmp_path / "a.tif", height, 0.03, {"DAPPLED_LEVEL_SIGMA_M": "0.3"})
    alike = {"DAPPLED_LEVEL_SIGMA_M": "0.4", "DAPPLED_CORRELATED_M": "1.5"}
    second = written(tmp_path / "b.tif", height + 1.0, 0.04, alike)
    made, cells = told(capsys, first, second), 400 * 400
    assert made["net"]["volume_m3"] == pytest.approx(cells * CELL_M2)
    own = CELL_M2 * math.sqrt(cells * 0.03**2 + 9 * cells * 0.04**2)
    assert made["net"]["cells_sigma_m3"] == pytest.approx(own, rel=1e-5)
    assert made["net"]["level_sigma_m3"] == pytest.approx(0.5 * cells * CELL_M2)
    assert made["noise_m3"] == pytest.approx(0.05 / math.sqrt(2 * math.pi) * cells * CELL_M2, rel=1e-5)
    assert made["sure_fill_m3"] == pytest.approx(cells * CELL_M2)  # each changed by 20 σ
    made = told(capsys, first, second, "--correlated", "1000")  # all err alike: σ of each times the area, and no more
    assert made["net"]["cells_sigma_m3"] == pytest.approx(0.05 * cells * CELL_M2, rel=1e-5)


def test_noise_makes_fill_and_cut_of_unchanged_ground_as_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(48).normal(0, 0.1, (2, *GRID.shape))
    made = told(capsys, *(written(tmp_path / f"{n}.tif", 200.0 + one, 0.1) for n, one in enumerate(noise)))
    assert made["fill"]["volume_m3"] == pytest.approx(made["noise_m3"], rel=0.02)
    assert made["cut"]["volume_m3"] == pytest.approx(made["noise_m3"], rel=0.02)
    assert abs(made["net"]["volume_m3"]) < 3 * made["net"]["cells_sigma_m3"]
    assert made["sure_fill_m3"] < 0.2 * made["fill"]["volume_m3"]


def test_an_area_limits_and_unknown_cells_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of the area lies beyond the raster, and a tenth of the other half has no height."""
    before, after = np.full(GRID.shape, 200.0), np.full(GRID.shape, 202.0)
    after[:40] = np.nan
    pair = written(tmp_path / "a.tif", before), written(tmp_path / "b.tif", after)
    area = square(tmp_path / "area.geojson", 500_000.1, 4_599_900.1, 500_200.1, 4_600_099.9)
    made = told(capsys, *pair, "--area", area)
    assert made["cells"] == 200 * 360
    assert made["unknown_cells"] == 200 * 40 + 200 * 400
    assert made["net"]["volume_m3"] == pytest.approx(2 * 200 * 360 * CELL_M2)
    assert told(capsys, *pair)["unknown_cells"] == 400 * 40  # without an area: what one of them knows


def test_stable_ground_takes_a_common_error_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0.7 m of an error in common: the median of unchanged ground tells it; σ of a median of n is √(π/2n) σ."""
    height = np.full(GRID.shape, 200.0)
    tags = {"DAPPLED_LEVEL_SIGMA_M": "1"}
    pair = (
        written(tmp_path / "a.tif", height, 0.06, tags), written(tmp_path / "b.tif", height + 0.7 + cone(), 0.08, tags),
    )  # fmt: skip
    road = square(tmp_path / "road.geojson", 499_900.1, 4_600_050.1, 500_099.9, 4_600_099.9)
    made = told(capsys, *pair, "--stable", road)
    assert made["levelled_m"] == pytest.approx(0.7, abs=1e-4)
    assert made["net"]["volume_m3"] == pytest.approx(math.pi * 40**2 * 10 / 3 / SCALE**2, rel=2e-3)
    assert made["level_sigma_m"] == pytest.approx(math.sqrt(math.pi / 2) * 0.1 / math.sqrt(400 * 100), rel=1e-4)
    assert main(["terrain", "volume", *pair, "--stable", road]) == 0
    said = capsys.readouterr().out
    assert "+0.7 m of change on the stable ground was taken off" in said
    assert "0 m² (0%) unknown" in said


def test_cells_of_another_size_are_interpolated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A slope of 1 in 10 is the same slope on cells of 0.8 m: no volume, where the nearest cell would be off."""

    def slope(grid: MapGrid) -> Floats:
        x, _ = grid.axes()
        return np.broadcast_to(200.0 + 0.1 * (x - GRID.west), grid.shape)

    coarse = MapGrid(GRID.crs, GRID.west - 1.0, GRID.north + 1.3, 0.8, 0.8, (300, 300))
    pair = written(tmp_path / "a.tif", slope(GRID)), written(tmp_path / "b.tif", slope(coarse), grid=coarse)
    made = told(capsys, *pair)
    assert made["unknown_cells"] == 0
    assert abs(made["fill"]["volume_m3"]) < 1e-3 * made["net"]["area_m2"]


def test_a_flight_s_terrain_brings_its_errors_along(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As `georeference --as terrain` writes it: windows of 9 × 9 cells err alike, and poses give all heights 0.5 m."""
    eye = eye_at(height_m=60.0)
    flown = survey(photograph(eye, painted(eye, Flat(0.0))))
    grid = replace(GRID, shape=(100, 100))
    height, sigma, score = (np.full(grid.shape, value, np.float32) for value in (200.0, 0.1, 1.0))
    found = TerrainModel(Surface(grid, height, sigma, score, 0.5), None)
    terrain.write_raster(flown, found, tmp_path / "maps" / "terrain.tif")
    made = told(capsys, str(tmp_path), str(tmp_path))
    assert made["net"]["cells_sigma_m3"] == pytest.approx(math.sqrt(2) * 0.1 * 9 * 100 * made["cell_m2"], rel=1e-4)
    assert made["level_sigma_m"] == pytest.approx(math.sqrt(2) * 0.5)


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        (MapGrid("EPSG:32616", 0.0, 4_600_100.0, 0.5, 0.5, (4, 4)), "lies on EPSG:32615 and"),
        (MapGrid("EPSG:32615", 600_000.0, 4_600_100.0, 0.5, 0.5, (4, 4)), "share no known height"),
        (MapGrid("EPSG:4326", -93.0, 41.0, 1e-5, 1e-5, (4, 4)), "not a map projection in metres"),
    ],
)
def test_what_cant_be_compared_is_a_sentence_and_2(
    grid: MapGrid, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = written(tmp_path / "a.tif", np.full((4, 4), 200.0), grid=MapGrid(GRID.crs, *_of(GRID), (4, 4)))
    other = written(tmp_path / "b.tif", np.full((4, 4), 200.0), grid=grid)
    assert main(["terrain", "volume", one, other]) == 2
    _usage, line = capsys.readouterr().err.splitlines()
    assert line.startswith("dappled terrain volume: ")
    assert said in line


def _of(grid: MapGrid) -> tuple[float, float, float, float]:
    return grid.west, grid.north, grid.step_x, grid.step_y


def test_what_is_no_raster_of_heights_is_a_sentence_and_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = written(tmp_path / "a.tif", np.full(GRID.shape, 200.0))
    (tmp_path / "flight").mkdir()
    (tmp_path / "text.tif").write_text("no raster")
    cog.write(tmp_path / "mosaic.tif", GRID, np.zeros((*GRID.shape, 2), np.uint8), {})
    lost = written(tmp_path / "lost.tif", np.full(GRID.shape, np.nan))
    elsewhere = square(tmp_path / "elsewhere.geojson", 510_000.0, 4_600_000.0, 510_100.0, 4_600_100.0)
    for words, said in (
        ([good, str(tmp_path / "flight")], "has no maps/terrain.tif: make it with dappled georeference"),
        ([good, str(tmp_path / "text.tif")], "can't be read"),
        ([good, str(tmp_path / "mosaic.tif")], "is a picture"),
        ([good, lost], "holds no known height"),
        ([good, good, "--area", elsewhere], "lies elsewhere than"),
        ([good, written(tmp_path / "tag.tif", cone(), 0.1, {"DAPPLED_LEVEL_SIGMA_M": "nan"})], "its tag"),
    ):
        assert main(["terrain", "volume", *words]) == 2
        _usage, line = capsys.readouterr().err.splitlines()
        assert said in line
