"""A picture behind the track, and the world file beside it."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from dappled.daemon.console import background
from dappled.daemon.console.background import BackgroundError

WORLD = "0.001\n0\n0\n-0.002\n10.0005\n49.999\n"


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "field.png"
    Image.new("L", (100, 50)).save(path)
    (tmp_path / "field.pgw").write_text(WORLD)
    return path


def test_bounds_are_the_picture_s_edges(picture: Path) -> None:
    bounds = background.load(picture).bounds()
    assert bounds == pytest.approx({"north": 50.0, "south": 49.9, "east": 10.1, "west": 10.0})


def test_any_world_file_s_name_will_do(picture: Path) -> None:
    picture.with_suffix(".pgw").rename(picture.with_suffix(".wld"))
    assert background.load(picture).north == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("world", "words"),
    [
        ("0.001\n0.1\n0\n-0.002\n10\n50\n", "must be north up"),
        ("0.001\n0\n0\n0.002\n10\n50\n", "must be north up"),
        ("0.5\n0\n0\n-0.5\n500000\n5400000\n", "not in degrees"),
        ("fish", "can't be used as a map"),
        ("1\n2\n", "can't be used as a map"),
    ],
)
def test_what_is_no_map_is_refused_in_words(picture: Path, world: str, words: str) -> None:
    picture.with_suffix(".pgw").write_text(world)
    with pytest.raises(BackgroundError, match=words):
        background.load(picture)


def test_a_file_that_is_no_picture(tmp_path: Path, picture: Path) -> None:
    picture.write_bytes(b"no picture")
    with pytest.raises(BackgroundError, match="can't be used"):
        background.load(picture)
    with pytest.raises(BackgroundError, match="a PNG or a JPEG"):
        background.load(tmp_path / "map.tif")
    (tmp_path / "alone.jpg").write_bytes(b"")
    with pytest.raises(BackgroundError, match=r"no world file alone\.jgw"):
        background.load(tmp_path / "alone.jpg")
