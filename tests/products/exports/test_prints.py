from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.errors import DappledError
from dappled.products.exports import prints


def test_tones_and_colours_keep_order_and_show_the_unknown() -> None:
    ramp = np.linspace(0, 2, 300, dtype=np.float32).reshape(10, 30)
    ramp[0, 0] = np.nan
    eight = prints.toned(ramp, 1.0)
    assert eight[0, 0] == 0
    assert eight[-1, -1] == 255
    assert np.all(np.diff(eight.ravel()[1:].astype(int)) >= 0)
    colours = prints.coloured(ramp, 0.0, 2.0)
    assert tuple(colours[0, 0]) == prints.HATCH
    assert tuple(colours[-1, -1]) == (253, 231, 37)
    with_scale = prints.with_scale(ramp.repeat(10, axis=1), 0, 2, "m")
    assert with_scale.shape[0] > 10
    assert with_scale.shape[1] == 300


def test_a_mosaic_holds_every_picture() -> None:
    pictures = [np.full((20, 30), 40 * k, np.uint8) for k in range(1, 5)]
    sheet = prints.mosaic(pictures, ["a", "b", "c", "d"])
    for k in range(1, 5):
        assert (sheet == 40 * k).all(axis=2).sum() >= 600
    with pytest.raises(DappledError, match="no picture"):
        prints.mosaic([])


def test_pictures_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    prints.save(tmp_path / "a.png", np.zeros((4, 5), np.uint8))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (5, 4)
    with pytest.raises(DappledError, match="must end in"):
        prints.save(tmp_path / "a.gif", np.zeros((4, 5), np.uint8))
    with pytest.raises(DappledError, match="can't be written"):
        prints.save(tmp_path / "gone" / "a.png", np.zeros((4, 5), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert prints.white_of([np.full((3, 3), np.nan)]) == 1.0


def test_the_unknown_is_hatched_in_what_is_no_colour_of_the_scale() -> None:
    values = np.linspace(0, 1, 40 * 60).reshape(40, 60)
    known = prints.coloured(values, 0.0, 1.0)
    values[10:30, 20:50] = np.nan
    colours = prints.coloured(values, 0.0, 1.0)
    hole = colours[10:30, 20:50].reshape(-1, 3)
    assert {tuple(colour) for colour in hole.tolist()} == {prints.UNKNOWN, prints.HATCH}
    assert 0.1 < np.mean((hole == prints.HATCH).all(axis=1)) < 0.3
    for grey in (prints.UNKNOWN, prints.HATCH):
        assert not (known == grey).all(axis=2).any()
    assert (colours[:10] == known[:10]).all()


def ink(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Columns in which something dark is written."""
    return np.asarray((picture.max(axis=2) < 140).any(axis=0))


def test_words_keep_apart_on_small_light_fields() -> None:
    """Views of Raytrix and demo size: captions need more room than the pictures."""
    small = [np.full((30, 40), 255, np.uint8)] * 4
    captions = ["alpha = 1.022 (+0.317 px/view)"] * 4
    sheet = prints.mosaic(small, captions)
    written = np.flatnonzero(ink(sheet[30:]))
    assert written.min() > 0
    assert written.max() < sheet.shape[1] - 1
    assert np.diff(written).max() >= 6  # between two captions
    alone = np.flatnonzero(ink(prints.mosaic(small[:1], captions[:1])))
    assert np.ptp(written) >= 2 * np.ptp(alone)  # no caption lies over its neighbour
    for width in (8, 40, 90, 300):
        drawn = prints.with_scale(np.full((20, width), np.nan), 1.234, 5.678, "px/view")
        assert drawn.shape[1] >= width
        size = max(11, min(22, width // 28))
        labels = np.flatnonzero(ink(drawn[20 + size + 6 : 20 + 2 * size + 6]))
        assert np.diff(labels).max() > size  # the ends of the scale stand apart
