"""`dappled picture --panel` and `--panel-file`: factors of a reflectance panel, and pictures in reflectances."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from dappled.cli import main
from dappled.config import profiles
from dappled.mocks.scene import dng
from dappled.mocks.scene.ray_camera import REAL_COLOURS, RayCamera
from dappled.mocks.scene.sharp_boards import SharpBoard
from tests.simulated.profiles import profile

BLACK, WHITE = 1024, 15000
SEEN = (0.6, 0.8, 0.4)  # of a white's light at 1/100 s, f/8 and ISO 100: what red, green and blue give
PANEL = ["--panel", "40,30,120,90", "--reflectance", "0.5", "--reflectance-sigma", "0.01"]
EXPOSED = 1e-2 / 8**2  # s × ISO / 100 / N²
Caught = pytest.CaptureFixture[str]


def frame(folder: Path, name: str, scene: np.ndarray, *, exposure_s: float = 1e-2, iso: int = 100) -> Path:
    """A Bayer frame of a scene's reflectances at f/8, with a profile that knows its size."""
    light = scene * (exposure_s or 1e-2) / 1e-2 * iso / 100
    for (row, column), share in zip(
        ((0, 0), (0, 1), (1, 0), (1, 1)), (SEEN[0], SEEN[1], SEEN[1], SEEN[2]), strict=True
    ):
        light[row::2, column::2] *= share
    noise = np.random.default_rng(7).normal(0, 15, scene.shape)
    raw = np.clip(BLACK + light * (WHITE - BLACK) + noise, 0, WHITE).astype(np.uint16)
    exif = dng.Exif("Canon", "Canon EOS 450D", "1", 50.0, 8.0, exposure_s, iso, 0)
    return written(folder / name, raw, exif)


def written(path: Path, raw: np.ndarray, exif: dng.Exif) -> Path:
    path.write_bytes(dng.encode(raw, black=BLACK, white=WHITE, exif=exif, mono=False))
    path.with_name("small.toml").write_text(profile(160, 240))
    return path


def call(path: Path, output: Path, *more: str) -> int:
    camera = str(path.with_name("small.toml"))
    return main(["picture", str(path), "--camera", camera, "--mask", "reference-5x5", "-o", str(output), *more])


def told(caught: Caught) -> tuple[dict[str, Any], set[str]]:
    said = json.loads(caught.readouterr().out)
    return said, {one["code"] for one in said["findings"] if not one["code"].startswith("picture.shadow")}


def grey(level: float = 0.5) -> np.ndarray:
    return np.full((160, 240), level)


def test_a_picture_in_reflectances_is_what_was_there(tmp_path: Path, capsys: Caught) -> None:
    """The frame has half the panel's exposure: by that alone it is half as bright."""
    shot = frame(tmp_path, "shot.dng", grey())
    assert call(shot, tmp_path / "p.tif", *PANEL, "--json", "--anyway") == 0
    said, codes = told(capsys)
    assert codes == set()
    written = tomllib.loads((tmp_path / "p.panel.toml").read_text())
    assert written["colours"] == said["panel"]["colours"]
    for one, name, share, pixels in zip(written["colours"], "RGB", SEEN, (1200, 2400, 1200), strict=True):
        assert (one["name"], one["pixels"]) == (name, pixels)
        assert one["mean"] == pytest.approx(0.5 * share, rel=2e-3)
        assert one["factor"] == pytest.approx(EXPOSED / share, rel=2e-3)
        assert one["factor_sigma"] == pytest.approx(0.02 * one["factor"], rel=0.02)
    scene = grey(0.3)
    scene[:, 120:] = 0.9
    fields = frame(tmp_path, "fields.dng", scene, exposure_s=5e-3)
    panel = ["--panel-file", str(tmp_path / "p.panel.toml")]
    assert call(fields, tmp_path / "r.tif", *panel, "--json", "--anyway") == 0
    said, codes = told(capsys)
    assert codes == set()
    with tifffile.TiffFile(tmp_path / "r.tif") as file:
        assert f"reflectance x {said['steps_at_reflectance_1']}" in file.pages.first.tags[270].value
        made = file.asarray() / said["steps_at_reflectance_1"]
    assert made.shape == (160, 240, 3)
    assert made[40:120, 30:90].mean(axis=(0, 1)) == pytest.approx([0.3] * 3, rel=0.01)
    assert made[40:120, 150:210].mean(axis=(0, 1)) == pytest.approx([0.9] * 3, rel=0.01)


def test_a_panel_behind_the_mask_is_even_and_its_factors_hold_for_what_is_beside_it(
    tmp_path: Path, capsys: Caught
) -> None:
    """At f/22 the raw panel varies by 70 % of its mean: what a mean over it says depends on where its edges are."""
    boards = [SharpBoard(colour=(0.2,) * 3, contrast=0.0)]
    for level, left in ((0.5, -0.45), (0.1, -0.15), (0.8, 0.15)):
        boards.append(SharpBoard(0.0, (-0.4, 0.4, left, left + 0.3), (level,) * 3, contrast=0.0))
    mask = profiles.mask("reference-5x5").mask
    camera = RayCamera(
        mask, shape=(160, 240), boards=tuple(boards), f_number=22.0, print_scale=1.003, turn_rad=0.012, level=0.12,
        colour_filters=REAL_COLOURS, views=2, points_per_view=1, lens_diffraction=False,
    )  # fmt: skip
    raw = camera.expose().raw(BLACK, WHITE)
    shot = written(tmp_path / "shot.dng", raw, dng.Exif("Canon", "Canon EOS 450D", "1", 50.0, 22.0, 1e-2, 100, 0))
    panel = raw[31:129:2, 18:74:2].astype(float) - BLACK  # its greens
    assert panel.std() > 0.5 * panel.mean()
    words = ["--panel", "17,30,75,129", "--reflectance", "0.5", "--json"]
    assert call(shot, tmp_path / "p.png", *words) == 0
    said, codes = told(capsys)
    assert "picture.panel_uneven" not in codes
    assert all(one["deviation"] < 0.03 * one["mean"] for one in said["panel"]["colours"])
    assert call(shot, tmp_path / "r.tif", "--panel-file", str(tmp_path / "p.panel.toml")) == 0
    made = tifffile.imread(tmp_path / "r.tif") / 32768
    assert made[40:120, 92:140].mean(axis=(0, 1)) == pytest.approx([0.1] * 3, rel=0.01)
    assert made[40:120, 164:212].mean(axis=(0, 1)) == pytest.approx([0.8] * 3, rel=0.01)


@pytest.mark.parametrize(
    ("left", "right", "code"),
    [
        (0.5, 1.5, "picture.panel_clipped"),
        (0.005, 0.005, "picture.panel_dark"),
        (0.5, 0.6, "picture.panel_uneven"),
    ],
)
def test_a_bad_panel_is_a_doubt(tmp_path: Path, capsys: Caught, left: float, right: float, code: str) -> None:
    scene = grey(left)
    scene[:, 80:] = right
    assert call(frame(tmp_path, "shot.dng", scene), tmp_path / "p.png", *PANEL, "--json") == 1
    assert code in told(capsys)[1]


def test_an_unknown_exposure_counts_as_the_panel_s(tmp_path: Path, capsys: Caught) -> None:
    shot = frame(tmp_path, "shot.dng", grey(), exposure_s=0.0)
    assert call(shot, tmp_path / "p.png", *PANEL, "--json") == 1
    said, codes = told(capsys)
    assert codes == {"picture.exposure_unknown"}
    assert said["panel"]["colours"][1]["factor"] == pytest.approx(1 / SEEN[1], rel=2e-3)
    assert call(shot, tmp_path / "r.tif", "--panel-file", str(tmp_path / "p.panel.toml"), "--json") == 1
    assert told(capsys)[1] == {"picture.exposure_unknown"}
    assert tifffile.imread(tmp_path / "r.tif").mean() / 32768 == pytest.approx(0.5, rel=0.01)


def test_another_iso_is_reckoned_with_and_doubted(tmp_path: Path, capsys: Caught) -> None:
    assert call(frame(tmp_path, "shot.dng", grey()), tmp_path / "p.png", *PANEL, "--anyway") == 0
    capsys.readouterr()
    fields = frame(tmp_path, "fields.dng", grey(0.3), iso=200)
    assert call(fields, tmp_path / "r.tif", "--panel-file", str(tmp_path / "p.panel.toml"), "--json") == 1
    assert told(capsys)[1] == {"picture.panel_differs"}
    assert tifffile.imread(tmp_path / "r.tif").mean() / 32768 == pytest.approx(0.3, rel=0.01)


def test_calls_that_can_give_no_reflectance_are_refused(tmp_path: Path, capsys: Caught) -> None:
    shot = frame(tmp_path, "shot.dng", grey())
    assert call(shot, tmp_path / "p.png", *PANEL[:2]) == 2
    with pytest.raises(SystemExit, match="2"):
        call(shot, tmp_path / "p.png", "--panel", "1,2,3", "--reflectance", "0.5")
    assert call(shot, tmp_path / "p.png", "--panel", "200,0,300,50", "--reflectance", "0.5") == 1
    assert "the panel isn't inside its 240 × 160 px" in capsys.readouterr().err
    other = tmp_path / "small.toml"
    assert call(shot, tmp_path / "p.png", "--panel-file", str(other)) == 2
    assert call(shot, tmp_path / "p.tif", "--panel-file", str(other)) == 1
    assert "is no file of a panel" in capsys.readouterr().err
    assert not [*tmp_path.glob("p.*")]
