"""A FinePix S5200's RAF, masked: from the native 45° lattice to views, by the commands' own doors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from dappled.cli import main
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.scene.synthesis import Grid
from tests.simulated.super_ccd import MaskedFinePix

MASK = "mask-2-full"
MARGINS = 30, 4  # samples of the whole file outside of the active area, above and to the left
BORDER, GREEN = 12, 1
WIDE_OPEN = 11.5


def _psnr(error: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(error[..., BORDER:-BORDER, BORDER:-BORDER] ** 2)))


@pytest.mark.long
@pytest.mark.parametrize("seed", [3])
def test_a_masked_raf_is_calibrated_and_decoded(seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    body = MaskedFinePix(seed)
    white, frame, calibration = tmp_path / "white.RAF", tmp_path / "frame.RAF", tmp_path / "calibration.toml"
    white.write_bytes(body.expose("white", 8 * WIDE_OPEN)[0])
    assert main(["calibrate", str(white), "--mask", MASK, "-o", str(calibration)]) == 0
    capsys.readouterr()
    assert main(["carriers", str(white), "--mask", MASK, "--calibration", str(calibration), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["shape"] == [2918, 3704]  # every sample where it was taken: rows and half columns
    assert told["rotation_rad"] == pytest.approx(body.installed.rotation_rad, abs=1e-4)
    true = body.lattice.carriers([(c["ky"], c["kx"]) for c in told["carriers"]])
    off = [
        np.hypot((c["measured"]["fy"] - t.fy) * 2918, (c["measured"]["fx"] - t.fx) * 3704)
        for c, t in zip(told["carriers"], true, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(off))) < 0.05

    file, views = body.expose("bench", WIDE_OPEN)
    frame.write_bytes(file)
    found = Darkroom(Recipe("auto", MASK, calibration=str(calibration), workers=2)).decode(frame).light_field
    assert found.attributes["camera"] == "fujifilm-s5200"
    assert found.attributes["mask_distance_mm"] == pytest.approx(body.installed.distance_mm, rel=1e-4)
    step = Grid.of(body.chip.shape, body.lattice).step
    y, x = np.mgrid[0 : found.views.shape[2], 0 : found.views.shape[3]].astype(np.float64)
    at = np.array([found.grid[0, 0] * y + MARGINS[0], found.grid[1, 1] * x + 2 * MARGINS[1]]) / step

    def true_views(colour: int) -> np.ndarray:
        lines = [[ndimage.map_coordinates(one[colour], at, order=3, mode="nearest") for one in line] for line in views]
        return np.array(lines)

    wanted = true_views(GREEN)
    mean = np.broadcast_to(found.views.mean(axis=(0, 1)), wanted.shape)
    assert _psnr(found.views - wanted) > 37
    assert _psnr(found.views - wanted) > _psnr(mean - wanted) + 4

    recipe = Recipe("auto", MASK, calibration=str(calibration), workers=2, colour=True)
    painted = Darkroom(recipe).decode(frame).light_field.views
    assert painted.shape == (*found.views.shape, 3)
    for colour in range(3):
        wanted = true_views(colour)
        made = painted[..., colour] * (wanted.mean() / painted[..., colour].mean())  # grey in its mean
        mean = np.broadcast_to(wanted.mean(axis=(0, 1)), wanted.shape)
        assert _psnr(made - wanted) > _psnr(mean - wanted) + 10
