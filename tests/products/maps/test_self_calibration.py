"""A flight tells the lens that took it, and says what it doesn't tell."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from dappled.cli import main
from dappled.config import profiles
from dappled.config.profiles import Lens
from dappled.errors import DappledError
from dappled.mocks.simulation import CAMERA, MASK
from dappled.products.maps import self_calibration
from dappled.products.maps.ground import Flat
from dappled.products.maps.photographs import Photograph
from tests.products import flown
from tests.products.flown import Flown
from tests.products.maps.test_eye import GRID, SHAPE, eye_at

LENS = Lens(50.0, 50.0)


def photographs(count: int, lenses: tuple[Lens, ...] = (LENS,)) -> list[Photograph]:
    image = np.zeros(SHAPE, dtype=np.float32)
    one = Photograph("000000", 0, image, eye_at(), 0.02, 0.001, GRID)
    return [replace(one, name=f"{n:06d}", lens=lenses[n % len(lenses)]) for n in range(count)]


@pytest.mark.parametrize(
    ("some", "says"),
    [
        (photographs(1), "from 2 frames or more, not 1"),
        (photographs(3), r"have 0 points in common, and a lens needs 60: fly with more overlap"),
        (photographs(4, (LENS, Lens(35.0, 35.0))), r"several focal lengths \(35, 50 mm\): choose with --frames"),
    ],
)
def test_frames_that_cannot_tell_a_lens_are_a_sentence(some: list[Photograph], says: str) -> None:
    with pytest.raises(DappledError, match=says):
        self_calibration.find(some, Flat(0.0))


def control(made: Flown, path: Path) -> Path:
    """True places that the frames' corners and middles show."""
    lines = ["name,frame,column,row,latitude,longitude,altitude"]
    for index, truth in enumerate(made.truths):
        assert truth.depth_m is not None
        rows, columns = truth.depth_m.shape
        for n, (row, column) in enumerate([(9, 9), (9, columns - 9), (rows - 9, 9), (rows - 9, columns - 9)]):
            north, east, height = flown.true_ground(truth, row, column)
            latitude, longitude = made.to_geodetic(north, east)
            pixel = f"{truth.grid[1, 1] * column},{truth.grid[0, 0] * row}"
            altitude = float(height) + made.path.home_altitude_msl_m
            place = f"{float(latitude):.10f},{float(longitude):.10f},{altitude}"
            lines.append(f"p{index}{n},{index:06d},{pixel},{place}")
    path.write_text("\n".join(lines))
    return path


@pytest.mark.long
def test_a_flight_tells_its_lens(short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The profile is 2 % and 0.3 mm wrong; the simulated lens is 50 mm from the sensor's middle, without distortion."""
    made = short_flight
    tables = profiles.tables(CAMERA, "cameras")
    wrong = {"focal_length_mm": 50.0, "v_mm": 51.0, "principal_point_mm": [0.3, -0.3], "distortion": [0.0] * 5}
    tables["lens"] = [wrong]
    (tmp_path / "wrong.toml").write_text(tomli_w.dumps(tables))
    given = {"camera": tmp_path / "wrong.toml", "mask": MASK, "calibration": made.recipe.calibration}
    asked = ["georeference", str(made.folder), "--as", "footprints", "-o", str(tmp_path / "maps"), "--grey"]
    asked += [word for name, value in given.items() for word in (f"--{name}", str(value))]
    solved = tmp_path / "solved.toml"
    points = str(control(made, tmp_path / "points.csv"))
    assert main([*asked, "--solve-lens", str(solved), "--gcp", points]) == 0
    said = capsys.readouterr().out
    assert "8 control points: they agree to 0.0" in said
    assert " mm at 50 mm, principal point " in said
    told = json.loads((tmp_path / "maps" / "report.json").read_text())["lens"]
    (lens,) = tomllib.loads(solved.read_text())["lens"]
    found, true = told["values"], dict.fromkeys(told["values"], 0.0) | {"v_mm": 50.0}
    for name, one in found.items():
        assert abs(one["value"] - true[name]) < 3.5 * one["sigma"], name
    assert found["v_mm"]["sigma"] < 0.25
    assert lens["v_mm"] == found["v_mm"]["value"]
    assert lens["principal_point_mm"] == [found["principal y_mm"]["value"], found["principal x_mm"]["value"]]
    assert told["control_points"] == 8
    assert told["scatter_px"] < 0.2
