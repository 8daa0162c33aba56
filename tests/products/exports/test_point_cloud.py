from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dappled.decode.depth.ranging import DistanceMap
from dappled.decode.geometry import Pose
from dappled.errors import DappledError
from dappled.flight import Frame, Tag, TimeSource
from dappled.products.exports import point_cloud
from dappled.products.maps import photographs
from dappled.products.mounting import Mounting
from tests.products.fields import light_field

FIELD = light_field(shape=(60, 80))
PICTURE = FIELD.views[2, 2]


def distances(metres: float = 10.0, sigma: float = 0.1) -> DistanceMap:
    made = DistanceMap(np.full((60, 80), metres, np.float32), np.full((60, 80), sigma, np.float32))
    made.distance_m[:10] = np.nan
    made.sigma_m[10:20] = 5.0
    return made


def station(altitude_m: float) -> photographs.Station:
    """Straight above a place at 41.6° N, looking down, the picture's top to the north."""
    pose = Pose(
        "interpolated", 0, None, float(np.radians(41.6)), float(np.radians(-91.5)), altitude_m, None, None,
        (1.0, 0.0, 0.0, 0.0), 0.1, 0.01, 0.0, 0,
    )  # fmt: skip
    tag = Tag(1, 0, 0, TimeSource.HOT_SHOE, 50.0, 7.4, None, None, "reference-36mm", "reference-5x5", "", pose)
    return photographs.station(Frame(1, "frames/000001.dng", "", 0, "", 0), tag, Mounting())


def test_camera_coordinates_and_what_is_withheld() -> None:
    cloud = point_cloud.of(FIELD, PICTURE, distances())
    assert cloud.withheld == 10 * 80
    assert len(cloud.points) == 40 * 80
    assert np.all(cloud.points[:, 2] == 10)
    # 0.1 mm a view's pixel before 50 mm: 2 mm a metre away, 20 mm at ten.
    first, second = cloud.points[0], cloud.points[1]
    assert second[0] - first[0] == pytest.approx(0.02, rel=1e-6)
    everything = point_cloud.of(FIELD, PICTURE, distances(), most_sigma=1.0)
    assert everything.withheld == 0


def test_on_the_map_the_ground_lies_below_the_camera() -> None:
    place = station(310.0)
    cloud = point_cloud.of(FIELD, PICTURE, distances(), station=place)
    assert cloud.crs == "EPSG:32615"
    np.testing.assert_allclose(cloud.points[:, 2], 300.0, atol=1e-6)
    assert np.ptp(cloud.points[:, 0]) == pytest.approx(79 * 0.02, rel=0.01)
    assert cloud.points[0, 1] > cloud.points[-1, 1]  # the picture's top is north


def test_a_ply_comes_back(tmp_path: Path) -> None:
    cloud = point_cloud.of(FIELD, PICTURE, distances())
    point_cloud.write(tmp_path / "a.ply", cloud)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 3200" in header
    table = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3), ("sigma", "<f4")])
    np.testing.assert_allclose(table["xyz"], cloud.points, rtol=1e-6)
    np.testing.assert_array_equal(table["rgb"], cloud.colours >> 8)
    np.testing.assert_array_equal(table["sigma"], cloud.sigma_m)


def test_a_las_comes_back(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy", reason="LAS is an extra")
    cloud = point_cloud.of(FIELD, PICTURE, distances(), station=station(310.0))
    point_cloud.write(tmp_path / "a.las", cloud)
    with laspy.open(tmp_path / "a.las") as file:
        found = file.read()
        assert file.header.parse_crs().to_epsg() == 32615
    np.testing.assert_allclose(np.stack([found.x, found.y, found.z], axis=1), cloud.points, atol=0.001)
    np.testing.assert_allclose(found["sigma_m"], cloud.sigma_m)
    np.testing.assert_array_equal(found.red, cloud.colours[:, 0])


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    cloud = point_cloud.of(FIELD, PICTURE, distances())
    with pytest.raises(DappledError, match=r"\.ply, \.las or \.laz"):
        point_cloud.write(tmp_path / "a.xyz", cloud)
    nothing = point_cloud.of(FIELD, PICTURE, distances(), most_sigma=0.001)
    with pytest.raises(DappledError, match="4000 withheld"):
        point_cloud.write(tmp_path / "a.ply", nothing)
    with pytest.raises(DappledError, match="camera and focal length"):
        point_cloud.of(light_field(camera=None), PICTURE, distances())
    assert list(tmp_path.iterdir()) == []
