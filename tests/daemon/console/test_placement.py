"""The background of the map and its world file; frames that have no place on it; KML as a globe reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from dappled.daemon.console import placement
from dappled.daemon.console.placement import oriented_frame
from dappled.daemon.console.studio import Studio
from dappled.decode.geometry import camera_pose
from dappled.decode.geometry.footprint import RectifiedFrame
from dappled.errors import DappledError
from tests import globe

NS = {"k": "http://www.opengis.net/kml/2.2"}
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
    with pytest.raises(DappledError, match=words):
        placement.load_background(picture)


def test_a_file_that_is_no_picture(tmp_path: Path, picture: Path) -> None:
    picture.write_bytes(b"no picture")
    with pytest.raises(DappledError, match="can't be used"):
        placement.load_background(picture)
    with pytest.raises(DappledError, match="a PNG or a JPEG"):
        placement.load_background(tmp_path / "map.tif")
    (tmp_path / "alone.jpg").write_bytes(b"")
    with pytest.raises(DappledError, match=r"no world file alone\.jgw"):
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


def test_a_body_with_sensors_of_several_sizes_has_no_footprint_before_its_frame_s_shape_is_known() -> None:
    studio = Studio(None, MOUNT)
    header = {"camera": "reference-36mm", "pose": POSE, "focal_length_mm": 50.0}
    assert studio.corners(header) is None
    small, large = (studio.corners({**header, "frame_shape": shape}) for shape in ([1388, 1844], [2776, 3688]))
    assert small is not None
    assert large is not None
    assert np.ptp(large, axis=0) == pytest.approx(2 * np.ptp(small, axis=0), rel=0.01)
    assert studio.corners({**header, "camera": "canon-eos-450d"}) is not None


def parsed(document: bytes) -> ET.Element:
    globe.check(document)
    return ET.fromstring(document)  # noqa: S314  # our own


def test_a_link_asks_again_and_again() -> None:
    link = parsed(placement.network_link_kml("http://h/kml/latest.kml?token=a&b")).find(".//k:NetworkLink/k:Link", NS)
    assert link is not None
    assert link.findtext("k:href", "", NS) == "http://h/kml/latest.kml?token=a&b"
    assert (link.findtext("k:refreshMode", "", NS), link.findtext("k:refreshInterval", "", NS)) == ("onInterval", "2")


def test_the_latest_frame_lies_in_its_box() -> None:
    frame = RectifiedFrame(np.zeros((2, 2, 4), dtype=np.uint8), 1.5, 1.25, 10.5, -10.25)
    root = parsed(placement.latest_kml("frame 7", "http://h/kml/7.png", frame, [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]))
    box = root.find(".//k:GroundOverlay/k:LatLonBox", NS)
    assert box is not None
    sides = [float(box.findtext(f"k:{side}", "", NS)) for side in ("north", "south", "east", "west")]
    assert sides == [1.5, 1.25, 10.5, -10.25]
    assert root.findtext(".//k:Icon/k:href", "", NS) == "http://h/kml/7.png"
    assert root.findtext(".//k:coordinates", "", NS).split() == [
        "1.00000000,2.00000000,3.00",
        "4.00000000,5.00000000,6.00",
    ]


def test_before_the_first_frame_there_is_an_empty_document() -> None:
    root = parsed(placement.latest_kml("frame None", "", None, []))
    assert root.find("k:Document", NS) is not None
    assert root.find(".//k:GroundOverlay", NS) is None
