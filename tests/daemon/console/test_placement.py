"""The background of the map and its world file; frames that have no place on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dappled.daemon.console import placement
from dappled.daemon.console.placement import BackgroundError, oriented_frame
from dappled.decode.geometry import camera_pose

POSE: dict[str, Any] = {
    "latitude_deg": 0.0,
    "longitude_deg": 10.0,
    "height_above_home_m": 100.0,
    "attitude": [1.0, 0.0, 0.0, 0.0],
}
MOUNT = tuple(camera_pose.NADIR.ravel().tolist())
WORLD = "0.001\n0\n0\n-0.002\n10.0005\n49.999\n"


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "field.png"
    Image.new("L", (100, 50)).save(path)
    (tmp_path / "field.pgw").write_text(WORLD)
    return path


def test_bounds_are_the_picture_s_edges(picture: Path) -> None:
    bounds = placement.load_background(picture).bounds()
    assert bounds == pytest.approx({"north": 50.0, "south": 49.9, "east": 10.1, "west": 10.0})


def test_any_world_file_s_name_will_do(picture: Path) -> None:
    picture.with_suffix(".pgw").rename(picture.with_suffix(".wld"))
    assert placement.load_background(picture).north == pytest.approx(50.0)


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
        placement.load_background(picture)


def test_a_file_that_is_no_picture(tmp_path: Path, picture: Path) -> None:
    picture.write_bytes(b"no picture")
    with pytest.raises(BackgroundError, match="can't be used"):
        placement.load_background(picture)
    with pytest.raises(BackgroundError, match="a PNG or a JPEG"):
        placement.load_background(tmp_path / "map.tif")
    (tmp_path / "alone.jpg").write_bytes(b"")
    with pytest.raises(BackgroundError, match=r"no world file alone\.jgw"):
        placement.load_background(tmp_path / "alone.jpg")


def test_a_frame_is_oriented_by_its_pose_and_the_mount() -> None:
    frame = oriented_frame(POSE, (20.0, 40.0), 50.0, MOUNT)
    assert frame is not None
    assert (frame.height_m, frame.latitude_deg, frame.longitude_deg) == (100.0, 0.0, 10.0)
    np.testing.assert_allclose(frame.rotation, camera_pose.NADIR)


@pytest.mark.parametrize(
    "missing", [{"latitude_deg": None}, {"attitude": None}, {"height_above_home_m": None}, {"height_above_home_m": 0.2}]
)
def test_what_is_unknown_has_no_footprint(missing: dict[str, Any]) -> None:
    assert oriented_frame(POSE | missing, (20.0, 40.0), 50.0, MOUNT) is None
    assert oriented_frame(POSE, None, 50.0, MOUNT) is None
    assert oriented_frame(POSE, (20.0, 40.0), None, MOUNT) is None
