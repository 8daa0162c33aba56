from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dappled.products.exports import prints
from dappled.products.exports.prints import PrintError


def test_tones_and_colours_keep_order_and_show_the_unknown() -> None:
    ramp = np.linspace(0, 2, 300, dtype=np.float32).reshape(10, 30)
    ramp[0, 0] = np.nan
    eight = prints.toned(ramp, 1.0)
    assert eight[0, 0] == 0
    assert eight[-1, -1] == 255
    assert np.all(np.diff(eight.ravel()[1:].astype(int)) >= 0)
    colours = prints.coloured(ramp, 0.0, 2.0)
    assert tuple(colours[0, 0]) == (150, 150, 150)
    assert tuple(colours[-1, -1]) == (253, 231, 37)
    with_scale = prints.with_scale(ramp.repeat(10, axis=1), 0, 2, "m")
    assert with_scale.shape[0] > 10
    assert with_scale.shape[1] == 300


def test_a_mosaic_holds_every_picture() -> None:
    pictures = [np.full((20, 30), 40 * k, np.uint8) for k in range(1, 5)]
    sheet = prints.mosaic(pictures, ["a", "b", "c", "d"])
    for k in range(1, 5):
        assert (sheet == 40 * k).all(axis=2).sum() >= 600
    with pytest.raises(PrintError, match="no picture"):
        prints.mosaic([])


def test_pictures_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    prints.save(tmp_path / "a.png", np.zeros((4, 5), np.uint8))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (5, 4)
    with pytest.raises(PrintError, match="must end in"):
        prints.save(tmp_path / "a.gif", np.zeros((4, 5), np.uint8))
    with pytest.raises(PrintError, match="can't be written"):
        prints.save(tmp_path / "gone" / "a.png", np.zeros((4, 5), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert prints.white_of([np.full((3, 3), np.nan)]) == 1.0
