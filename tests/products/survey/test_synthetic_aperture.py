"""A flight as one light field: the ground through leaves, focus by height, and the blur that poses make."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image

from dappled.cli import main
from dappled.cli.placing import Refining
from dappled.errors import DappledError
from dappled.findings import text
from dappled.products.maps.ground import Flat
from dappled.products.survey import synthetic_aperture
from dappled.products.survey.synthetic_aperture import RefocusedGround
from tests.products.survey import seen

LINE = [(0.0, 0.5 * k - 2.0) for k in range(9)]
SQUARE = [(2.5 * (k % 3) - 2.5, 1.5 * (k // 3) - 1.5) for k in range(9)]
LEAVES_M = 10.0


def quiet(*_: object) -> None:
    pass


def leaves(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Leaves of half a metre over an eighth of the sky."""
    cells = np.floor(np.array([east, north]) / 0.5).astype(np.int64)
    return np.asarray((cells[0] * 73856093 ^ cells[1] * 19349663) % 97 < 12)


def wrong(made: RefocusedGround, least: int = 7) -> NDArray[np.float64]:
    """How far the picture is from the true ground where enough frames look."""
    x, y = made.grid.axes()
    true = seen.texture(*np.meshgrid(x, y))
    return np.abs(made.picture[..., 0] - true)[made.frames >= least]


def test_the_median_of_a_flight_shows_the_ground_under_leaves() -> None:
    flight = seen.flown(SQUARE, [(LEAVES_M, leaves, -40.0)])
    one = replace(flight, photographs=flight.photographs[4:5] * 2)  # twice the same: no aperture
    median, mean, alone = (
        wrong(synthetic_aperture.refocus(made, quiet, way=way), least)
        for made, way, least in ((flight, "median", 9), (flight, "mean", 9), (one, "mean", 2))
    )
    assert np.mean(alone > 0.06) > 0.08
    assert np.mean(median > 0.06) < 0.3 * np.mean(alone > 0.06)  # what is hidden in 5 of 9
    assert np.mean(mean**2) < 0.6 * np.mean(alone**2)


def test_focus_is_where_it_was_asked_for() -> None:
    """Without leaves: the ground is sharp at 0 m and blurred 4 m above it."""
    flight = seen.flown(LINE)
    sharp = synthetic_aperture.refocus(flight, quiet)
    above = synthetic_aperture.refocus(flight, quiet, above_m=4.0)
    assert wrong(sharp).max() < 0.06
    texture = [float(np.std(made.picture[..., 0][made.frames >= 7])) for made in (sharp, above)]
    assert texture[1] < 0.75 * texture[0]
    assert sharp.aperture_m == pytest.approx(4.0, abs=0.01)
    assert sharp.distance_m == pytest.approx(seen.HEIGHT_M, abs=0.01)
    assert sharp.focused_m == pytest.approx(0.06 * 30 / 4, rel=0.01)  # so far it takes to spread over one cell


def test_frames_whose_poses_are_unsure_blur_less() -> None:
    flight = seen.flown(LINE[:3])
    bad = replace(flight.photographs[0], image=np.full_like(flight.photographs[0].image, 0.9))
    level = replace(flight, photographs=(bad, *flight.photographs[1:]))
    doubted = replace(level, photographs=(replace(bad, position_sigma_m=1.0), *flight.photographs[1:]))
    errors = [np.median(wrong(synthetic_aperture.refocus(one, quiet), 3)) for one in (level, doubted)]
    assert errors[1] < 0.05 * errors[0]


def test_the_blur_of_poses_is_told_and_doubted() -> None:
    flight = seen.flown(LINE[:3])
    made = synthetic_aperture.refocus(flight, quiet)
    assert made.pose_blur_m == pytest.approx(math.hypot(0.05, 30 * 0.001), rel=0.01)
    assert len(synthetic_aperture.told(made)) == 1
    loose = replace(flight, photographs=tuple(replace(one, position_sigma_m=0.5) for one in flight.photographs))
    _, doubt = synthetic_aperture.told(synthetic_aperture.refocus(loose, quiet))
    assert "the poses are known to 0.5 m on the ground only" in str(text(doubt))
    facts = {one.name: {"refined": True, "residual_px": 0.5} for one in flight.photographs}
    refined = synthetic_aperture.refocus(replace(loose, facts=facts), quiet)
    assert refined.pose_blur_m == pytest.approx(0.5 * flight.photographs[0].eye.gsd_m(0.0), rel=0.02)


def test_what_has_no_aperture_is_refused() -> None:
    flight = seen.flown(LINE[:2])
    with pytest.raises(DappledError, match="a flight of one frame has no aperture"):
        synthetic_aperture.refocus(replace(flight, photographs=flight.photographs[:1]), quiet)
    with pytest.raises(DappledError, match="was not taken from above a surface 35 m above ground"):
        synthetic_aperture.refocus(flight, quiet, above_m=35.0)


def test_planes_are_cut_to_common_ground() -> None:
    flight = replace(seen.flown(LINE[:3]), ground=Flat(0.0))
    found = [synthetic_aperture.refocus(flight, quiet, above_m=height) for height in (0.0, 5.0)]
    pictures = synthetic_aperture.alike(found)
    assert pictures[0].shape == pictures[1].shape
    assert pictures[0].size < found[0].picture.size


@pytest.fixture
def placed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """A flight of which the command line finds frames of the ground by rays, in place of its own."""
    flight = seen.flown(LINE[:3])
    monkeypatch.setattr(Refining, "placed", lambda *_, **__: flight)
    return seen.folder(tmp_path)


def test_a_flight_is_refocused_from_the_command_line(
    placed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["refocus", "--flight", placed, "--cell", "0.1"]
    assert main([*words, "--combine", "median", "-o", str(tmp_path / "ground.tif"), "--json"]) == 0
    (plane,) = json.loads(capsys.readouterr().out)["planes"]
    assert plane["aperture_m"] == pytest.approx(1.0, abs=0.01)
    assert plane["cell_m"] == pytest.approx(0.1)
    with rasterio.open(tmp_path / "ground.tif") as read:
        assert read.descriptions == ("grey", "frames")
        assert read.read(2).max() == 3
    assert main([*words, "--height", "0", "4", "-o", str(tmp_path / "two.png")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("0 m: 3 frames a cell over an aperture of 1 m at 30 m: in focus to ±3 m; poses blur by 0.05")
    assert (tmp_path / "two.png").is_file()


def test_two_frames_are_a_stereo_pair_from_the_command_line(
    placed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pair.png"
    assert main(["refocus", "--flight", placed, "--eyes", "anaglyph", "-o", str(out)]) == 0
    assert "m apart, 3% of the distance" in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.mode == "RGB"
    words = ["refocus", "--flight", placed, "--eyes", "anaglyph", "--height", "1", "-o", str(tmp_path / "b.png")]
    assert main(words) == 2
    assert "leave --height and --combine out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["-o", "x.png"], "name a decoded light field, or a flight with --flight"),
        (["--flight", ".", "--alpha", "1", "-o", "x.png"], "--alpha is of a light field"),
        (["--flight", ".", "--height", "0", "1", "-o", "x.tif"], "x.tif holds one height"),
        ([".", "--height", "2", "-o", "x.png"], "--height goes with --flight FLIGHT and no light field"),
    ],
)
def test_wrong_calls_get_a_sentence(more: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["refocus", *more]) == 2
    assert said in capsys.readouterr().err
