"""`dappled terrain contours` of a plane and a cone, whose lines are known."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dappled.cli import main
from dappled.decode.array_types import Floats
from dappled.products.maps.earth import Projection
from dappled.products.maps.map_grid import MapGrid
from tests.products.maps.test_volumes import GRID, cone, written

pytest.importorskip("contourpy")


def drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], raster: str, *words: str
) -> tuple[dict[str, Any], list[tuple[float, Floats]]]:
    """(what was told, the lines with their heights, (n, 2) on the map)."""
    output = tmp_path / "contours.geojson"
    assert main(["terrain", "contours", raster, "-o", str(output), "--overwrite", "--json", *words]) == 0
    projection = Projection(GRID.crs)
    told, lines = json.loads(capsys.readouterr().out), list[tuple[float, Floats]]()
    for one in json.loads(output.read_text())["features"]:
        height = one["properties"]["height_m"]
        assert one["geometry"]["type"] == "LineString"
        assert one["properties"]["major"] == (round(height / told["interval_m"]) % 5 == 0)
        longitude, latitude = np.array(one["geometry"]["coordinates"]).T
        lines.append((height, np.stack(projection.to_map(latitude, longitude), axis=1)))
    return told, lines


def plane() -> Floats:
    x, _ = GRID.axes()
    return np.array(np.broadcast_to(200.0 + 0.1 * (x - GRID.west), GRID.shape))


def test_a_plane_has_straight_lines_evenly_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told, lines = drawn(tmp_path, capsys, written(tmp_path / "a.tif", plane()), "--interval", "2")
    assert sorted(height for height, _ in lines) == [202.0, 204.0, 206.0, 208.0, 210.0, 212.0, 214.0, 216.0, 218.0]
    for height, line in lines:
        assert line[:, 0] == pytest.approx(np.full(len(line), GRID.west + 10 * (height - 200)), abs=5e-3)
        assert np.ptp(line[:, 1]) == pytest.approx(199.5, abs=5e-3)  # from the first cell's centre to the last one's
    assert told["lines"] == 9
    assert told["length_m"] == pytest.approx(9 * 199.5)


def test_a_cone_has_circles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, lines = drawn(tmp_path, capsys, written(tmp_path / "a.tif", 200.5 + cone()), "--interval", "2.5")
    assert [height for height, _ in lines] == [202.5, 205.0, 207.5, 210.0]
    for height, line in lines:
        radius = 40 * (1 - (height - 200.5) / 10)
        away = np.hypot(line[:, 0] - 500_000.0, line[:, 1] - 4_600_000.0)
        assert away == pytest.approx(np.full(len(line), radius), abs=0.06)
        assert line[0] == pytest.approx(line[-1])


def test_lines_end_where_heights_are_unknown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    height = plane()
    height[190:210] = np.nan
    told, lines = drawn(tmp_path, capsys, written(tmp_path / "a.tif", height), "--interval", "2")
    assert len(lines) == 2 * 9
    for _, line in lines:
        rows = (GRID.north - line[:, 1]) / GRID.step_y
        assert (rows < 190).all() or (rows > 210).all()
    assert told["known"] == pytest.approx(0.95)


def test_lines_are_not_nearer_than_the_heights_are_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """20 m of relief in about twenty lines; with σ of 1.1 m 2.2 m apart or more, which is 5 m."""
    told, _ = drawn(tmp_path, capsys, written(tmp_path / "a.tif", plane(), 0.01))
    assert told["interval_m"] == 1.0
    told, lines = drawn(tmp_path, capsys, written(tmp_path / "b.tif", plane(), 1.1))
    assert told["interval_m"] == 5.0
    assert told["sigma_m"] == pytest.approx(1.1)
    assert len(lines) == 3


def test_lines_across_180_degrees_are_cut_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    east, north = (float(one) for one in Projection("EPSG:32760").to_map(-17.0, 180.0))
    grid = MapGrid("EPSG:32760", east - 100, north + 100, 0.5, 0.5, GRID.shape)
    _, y = grid.axes()
    height = np.array(np.broadcast_to(200.0 + 0.1 * (grid.north - y)[:, None], grid.shape))
    output = tmp_path / "contours.geojson"
    raster = written(tmp_path / "a.tif", height, grid=grid)
    assert main(["terrain", "contours", raster, "--interval", "5", "-o", str(output)]) == 0
    capsys.readouterr()
    lines = [one["geometry"] for one in json.loads(output.read_text())["features"]]
    assert len(lines) == 3
    for line in lines:
        assert line["type"] == "MultiLineString"
        pieces = sorted((np.array(one) for one in line["coordinates"]), key=lambda piece: piece[0, 0])
        assert len(pieces) == 2
        assert pieces[0][:, 0].min() == -180
        assert pieces[1][:, 0].max() == 180
        assert all(np.ptp(piece[:, 0]) < 0.01 for piece in pieces)


def test_smoothing_leaves_a_plane_and_takes_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noisy = plane() + np.random.default_rng(48).normal(0, 0.1, GRID.shape)
    noisy[:, 100:] = np.nan
    raster = written(tmp_path / "a.tif", noisy)
    assert drawn(tmp_path, capsys, raster, "--interval", "2")[0]["lines"] > 12
    told, lines = drawn(tmp_path, capsys, raster, "--interval", "2", "--smooth", "2")
    assert told["lines"] == 2
    for height, line in lines:
        inner = np.abs(line[:, 1] - 4_600_000.0) < 90
        assert line[inner, 0] == pytest.approx(np.full(inner.sum(), GRID.west + 10 * (height - 200)), abs=0.5)


def test_what_cant_be_drawn_is_a_sentence_and_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raster = written(tmp_path / "a.tif", plane())
    for words, said in (
        ([raster, "-o", "contours.shp"], "written as .geojson"),
        ([raster, "--interval", "1e-3", "-o", str(tmp_path / "c.geojson")], "give a larger interval"),
        ([str(tmp_path), "-o", str(tmp_path / "c.geojson")], "has no maps/terrain.tif"),
    ):
        assert main(["terrain", "contours", *words]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "c.geojson").exists()
    assert math.isfinite(float(drawn(tmp_path, capsys, raster)[0]["length_m"]))
