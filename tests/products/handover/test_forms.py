"""COLMAP, nerfstudio, STAC and MCAP: what their own libraries read is the simulator's truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image

from dappled.decode.geometry import camera_pose
from dappled.findings import Code
from dappled.products.batch import batch
from dappled.products.exports import light_files
from dappled.products.handover import forms, view_files
from dappled.products.maps.earth import Projection
from dappled.products.maps.georeference import Options
from tests.products.flown import START_NS, Flown
from tests.products.handover.handed import NAMES, UNDULATION_M, close, true_world

pytestmark = pytest.mark.slow  # they share a fixture of 15 s: a flight in all forms


def test_nerfstudio_s_transforms_are_the_poses(handed: Path, short_flight: Flown) -> None:
    """By the convention of its documentation: camera to world, axes right, up, backward."""
    said = json.loads((handed / "nerfstudio" / "transforms.json").read_text())
    assert len(said["frames"]) == 50
    for one in said["frames"]:
        path = handed / "nerfstudio" / one["file_path"]
        view, number = path.parent.name, int(path.stem)
        turn, centre = true_world(short_flight)[number]
        y, x = short_flight.truths[number].aperture_points_mm[int(view[1]), int(view[3])] / 1e3
        pose = np.array(one["transform_matrix"])
        close(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]), pose[:3, 3], (turn, centre + turn @ [-x, -y, 0.0]))
        assert one["fl_x"] / one["w"] == pytest.approx(50.0 / 18.44, rel=0.01)
        with Image.open(path) as picture:
            assert picture.size == (one["w"], one["h"])


@pytest.mark.parametrize("form", ["colmap", "nerfstudio"])
def test_a_frame_is_one_camera_with_the_sensors_own_pixels(short_flight: Flown, tmp_path: Path, form: str) -> None:
    """Unless views are asked for: no light field is decoded, and the camera is that of the sensor."""
    (job,) = batch.plan(short_flight.folder, short_flight.recipe, Options(frames=frozenset({0})), [form], tmp_path)
    assert batch.make(job).error is None
    folder = tmp_path / short_flight.folder.name / form
    forms.finish(form, folder, short_flight.folder.name, NAMES[:1])
    with Image.open(folder / "images" / "picture" / f"{NAMES[0]}.jpg") as picture:
        assert picture.size == (1844, 1388)
    if form == "colmap":
        (line,) = (one for one in (folder / "sparse/0/cameras.txt").read_text().splitlines() if one[0] != "#")
        size, lens = line.split()[2:4], [float(word) for word in line.split()[4:]]
    else:
        (one,) = json.loads((folder / "transforms.json").read_text())["frames"]
        size, lens = [str(one["w"]), str(one["h"])], [one[key] for key in ("fl_x", "fl_y", "cx", "cy")]
    assert size == ["1844", "1388"]
    assert lens == pytest.approx([5000, 5000, 922, 694], abs=1e-6)  # 50 mm, 10 µm; from the first pixel's corner


@pytest.mark.long
@pytest.mark.parametrize("fitted", [True, False])
def test_views_stand_as_the_frame_shows(short_flight: Flown, tmp_path: Path, fitted: bool) -> None:
    """The f-number is told a fifth wrong. The carriers show it, if the calibration knows the mask's distance."""
    told = tmp_path / "calibration.toml"
    words = Path(short_flight.recipe.calibration).read_text()
    told.write_text(words.replace("distance_fitted = false", f"distance_fitted = {str(fitted).lower()}"))
    recipe = replace(short_flight.recipe, calibration=str(told))
    options = Options(f_number=12.0, view="ground", frames=frozenset({0}))
    (job,) = batch.plan(short_flight.folder, recipe, options, ["colmap"], tmp_path)
    assert batch.make(job).error is None
    (made,) = view_files.read_frames(tmp_path / short_flight.folder.name / "colmap", NAMES[:1])
    true = short_flight.truths[0].aperture_points_mm / 1e3
    apart = np.linalg.norm(true[0, 0] - true[4, 4])
    seen = float(np.linalg.norm(np.subtract(made.views[0].centre_m, made.views[24].centre_m)))
    assert made.aperture_m is not None
    assert made.aperture_sigma_m is not None
    if fitted:
        assert seen == pytest.approx(apart, rel=0.02)  # the stated distance is 1 % off
        assert made.aperture_sigma_m < 0.01 * made.aperture_m
        assert Code.APERTURE_DISAGREES in {one.code for one in made.doubts}
    else:  # in truth it is 1 / 1.23 of what is told
        assert seen == pytest.approx(14.8 / 12.0 * apart, rel=0.02)
        assert made.aperture_sigma_m == pytest.approx((1 - 12.0 / 14.8) * made.aperture_m, rel=0.2)


def test_pystac_reads_the_items(handed: Path, short_flight: Flown) -> None:
    pystac = pytest.importorskip("pystac", reason="pystac is not here")
    projection = pytest.importorskip("pystac.extensions.projection")
    collection = pystac.Collection.from_file(str(handed / "stac" / "collection.json"))
    items = list(collection.get_items())
    assert [item.id for item in items] == [f"{short_flight.folder.name}-{name}" for name in NAMES]
    for item, truth in zip(items, short_flight.truths, strict=True):
        pose = truth.pose
        assert pose is not None
        assert item.datetime.timestamp() == pytest.approx(START_NS / 1e9 + pose.t_s, abs=2e-6)
        said = projection.ProjectionExtension.ext(item)
        on_map = Projection(said.code)
        east, north = on_map.to_map(pose.latitude_deg, pose.longitude_deg)
        centre = item.properties["pers:perspective_center"]
        assert centre == pytest.approx([float(east), float(north), pose.altitude_msl_m], abs=1e-3)
        grid = on_map.at(pose.latitude_deg, pose.longitude_deg)
        true = grid.from_ned() @ camera_pose.matrix_of(pose.attitude) @ camera_pose.NADIR @ np.diag([1.0, -1.0, -1.0])
        turn = np.array(item.properties["pers:rotation_matrix"]).reshape(3, 3).T
        assert np.linalg.norm(turn - true) / math.sqrt(2) < math.radians(0.001)
        asset = item.assets["visual"]
        shown = projection.ProjectionExtension.ext(asset)
        with rasterio.open(asset.get_absolute_href()) as file:
            assert file.crs.to_string() == said.code
            assert file.shape == tuple(shown.shape)
            assert list(file.transform)[:6] == pytest.approx(shown.transform)
            assert list(file.bounds) == pytest.approx(asset.extra_fields["proj:bbox"])
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def test_the_mcap_file_holds_the_flight(handed: Path, short_flight: Flown) -> None:
    reading = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is part of the extra ros")
    path = handed / "mcap" / f"{short_flight.folder.name}.mcap"
    found: dict[str, list[Any]] = {}
    for one in reading.read_ros2_messages(str(path)):
        found.setdefault(one.channel.topic, []).append(one.ros_msg)
    assert {topic: len(each) for topic, each in found.items()} == dict.fromkeys(
        ("/camera/image/compressed", "/camera/camera_info", "/fix", "/camera/pose", "/camera/slices"), 2
    )
    for n, truth in enumerate(short_flight.truths):
        assert truth.pose is not None
        fix, pose = found["/fix"][n], found["/camera/pose"][n].pose
        place = truth.pose.latitude_deg, truth.pose.longitude_deg
        assert (fix.latitude, fix.longitude) == pytest.approx(place, abs=1e-9)
        assert fix.altitude == pytest.approx(truth.pose.altitude_msl_m + UNDULATION_M, abs=1e-3)
        assert (fix.position_covariance_type, fix.status.status) == (0, 0)
        q, at = pose.orientation, pose.position
        turn = camera_pose.matrix_of((q.w, q.x, q.y, q.z))
        close(turn, np.array([at.x, at.y, at.z]), true_world(short_flight)[n])
        slices = found["/camera/slices"][n]
        values = np.frombuffer(bytes(slices.data), "<c8").reshape(slices.count, slices.height, slices.width)
        made = light_files.load(handed / "mcap" / "slices" / f"{NAMES[n]}.npz")
        assert np.array_equal(values, made.slices)
        assert list(slices.carriers) == made.carriers.ravel().tolist()
        info, picture = found["/camera/camera_info"][n], found["/camera/image/compressed"][n]
        assert bytes(picture.data) == (handed / "mcap" / "images" / "picture" / f"{NAMES[n]}.jpg").read_bytes()
        assert info.k[0] / info.width == pytest.approx(50.0 / 18.44, rel=0.01)
        stamp = picture.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == START_NS + round(truth.pose.t_s * 1e9)
