"""Epipolar-plane images: a point is a line whose slope is its disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dappled.cli import main
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack
from dappled.products.exports import epi


def stack() -> ViewStack:
    """A bright point at (20, 30) that moves by 2 px a view down and right."""
    views = np.zeros((5, 5, 40, 60), np.float32)
    for v in range(5):
        for u in range(5):
            views[v, u, 20 + 2 * (v - 2), 30 + 2 * (u - 2)] = 1.0
    return ViewStack(views, np.arange(-2.0, 3), np.arange(-2.0, 3))


def test_a_point_is_a_leaning_line() -> None:
    along, down = epi.along_row(stack(), 20), epi.along_column(stack(), 30)
    assert along.shape == (5, 60)
    assert down.shape == (5, 40)
    assert np.argmax(along, axis=1).tolist() == [26, 28, 30, 32, 34]
    assert np.argmax(down, axis=1).tolist() == [16, 18, 20, 22, 24]
    assert not epi.along_row(stack(), 21).any()


def test_the_drawing_holds_view_row_and_column() -> None:
    made = epi.drawn(stack(), 20, 30)
    assert made.shape == (40 + 6 + 5 * 8, 60 + 6 + 5 * 8, 3)
    assert (made[20, :60] == (220, 40, 40)).all()
    below, beside = made[46:, :60], made[:40, 66:]
    assert np.argmax(below[:, :, 0], axis=1)[::8].tolist() == [26, 28, 30, 32, 34]
    assert np.argmax(beside[:, :, 0], axis=0)[::8].tolist() == [16, 18, 20, 22, 24]
    for wrong in (-1, 40):
        with pytest.raises(DecodeError, match=f"there is no row {wrong}: the views have 40, from 0 to 39"):
            epi.drawn(stack(), wrong)


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "views"
    folder.mkdir()
    for number, view in enumerate(stack().views.reshape(25, 40, 60)):
        Image.fromarray((255 * view).astype(np.uint8)).save(folder / f"input_Cam{number:03d}.png")
    out = tmp_path / "epi.png"
    assert main(["views", str(folder), "--of", "epi", "--row", "20", "-o", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.size == (106, 86)
    assert main(["views", str(folder), "--row", "20", "-o", str(tmp_path / "b.png")]) == 2
    assert "--row and --column are of --of epi" in capsys.readouterr().err
