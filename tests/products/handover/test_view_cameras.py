"""Cameras of views, and the models written of them: what can't be written, and what stays when a disk is full."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled import durable
from dappled.decode.geometry import camera_pose
from dappled.errors import DappledError
from dappled.findings import Code, Subject, finding, told
from dappled.flight import Frame, Tag, TimeSource
from dappled.mocks.autopilot.path import FlightPath
from dappled.products.handover import colmap, forms, nerfstudio, stac, view_cameras, view_files
from dappled.products.handover.view_cameras import FrameCameras, ViewCamera
from dappled.products.maps.eye import Eye
from dappled.products.maps.photographs import Photograph, Station
from tests.products.flown import as_recorded

VIEWS = tuple(
    ViewCamera(f"v{v}u{u}", (800.0, 750.0), (160.0, 120.5), (u * 1e-3 - 1e-3, v * 1e-3 - 1e-3, 0.0))
    for v in range(3)
    for u in range(3)
)
FRAME = FrameCameras(
    "000000", 10**18, 41.6, -91.5, 200.0, None, 0.02, None, 0.001, tuple(np.eye(3).ravel().tolist()), (240, 320),
    (-0.1, 0.01, 1e-4, -2e-4, 0.003), VIEWS,
)  # fmt: skip


def photograph(matrix: list[list[float]], distortion: tuple[float, ...] = (0.0,) * 5) -> tuple[Photograph, Station]:
    path = FlightPath(5)
    pose = as_recorded(path.pose(1.0))
    frame = Frame(0, "frames/000000.dng", "a.dng", 1, "00", 0)
    tag = Tag(0, pose.utc_ns, 10_000, TimeSource.HOT_SHOE, 50.0, 14.8, 0.001, 100, "c", "m", "00", pose)
    camera = camera_pose.of(pose)
    assert camera is not None
    assert pose.attitude is not None
    station = Station(frame, tag, camera, camera_pose.matrix_of(pose.attitude) @ camera_pose.NADIR)
    k1, k2, p1, p2, k3 = distortion
    eye = Eye(np.array(matrix), (k1, k2, p1, p2, k3), np.eye(3), np.zeros(3), 1.0, (240, 320))
    views = np.zeros((2, 240, 320), np.float32)
    apertures = np.array([[-1e-3, 0.0], [1e-3, 2e-3]])
    return Photograph("000000", 0, views[0], eye, 0.02, 0.001, np.eye(3)[:2], views, apertures), station


def test_a_turned_picture_is_a_turned_camera() -> None:
    """The picture's rows run across the sensor's: the same points are at the same pixels."""
    c, s = math.cos(0.3), math.sin(0.3)
    matrix = [[800 * c, -800 * s, 150.0], [750 * s, 750 * c, 110.0], [0.0, 0.0, 1.0]]
    one, station = photograph(matrix, (-0.2, 0.05, 1e-3, -2e-3, 0.01))
    made = view_cameras.of_photograph(one, ["v0u0", "v0u1"], station, 25.0, None)
    to_ned = np.array(made.camera_to_ned).reshape(3, 3)
    points = np.array([[1.0, 2.0, 20.0], [-3.0, 1.0, 22.0], [0.5, -2.5, 18.0]])  # in the sensor's axes
    turned = points @ station.camera_to_ned.T @ to_ned
    k1, k2, p1, p2, k3 = made.distortion
    for view, (y, x) in zip(made.views, one.apertures_m if one.apertures_m is not None else [], strict=True):
        seen = turned - view.centre_m
        (fx, fy), (cx, cy) = view.focal_px, (value - 0.5 for value in view.principal_px)
        lens = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        straight = Eye(lens, (k1, k2, p1, p2, k3), np.eye(3), np.zeros(3), 1.0, made.shape)
        away = points - [-x, -y, 0.0]
        shifted = replace(one.eye, matrix=one.eye.matrix.copy())
        shifted.matrix[:2, 2] -= shifted.matrix[:2, :2] @ np.array([x, y]) / 25.0
        assert straight.pixels(seen) == pytest.approx(shifted.pixels(away), abs=1e-9)


@pytest.mark.parametrize("matrix", [[[800, 80, 1], [0, 750, 1], [0, 0, 1]], [[-800, 0, 1], [0, 750, 1], [0, 0, 1]]])
def test_skewed_and_mirrored_views_are_refused(matrix: list[list[float]]) -> None:
    one, station = photograph(matrix)
    with pytest.raises(DappledError, match=r"frames/000000.dng are skewed or mirrored"):
        view_cameras.of_photograph(one, ["v0u0", "v0u1"], station, 25.0, None)


def test_a_frame_without_views_is_refused(tmp_path: Path) -> None:
    one, station = photograph([[800, 0, 1], [0, 750, 1], [0, 0, 1]])
    with pytest.raises(DappledError, match="has no views, only slices"):
        view_files.write_frame(tmp_path, replace(one, views=None), (1, 2), station, focus_m=math.inf, utc_ns=None)
    assert not list(tmp_path.iterdir())


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    view_files.write_record(tmp_path, FRAME)
    assert view_files.read_frames(tmp_path, ["000000"]) == [FRAME]


@pytest.mark.parametrize(
    "change",
    [
        {"views": []},
        {"shape": [1]},
        {"camera_to_ned": [1.0]},
        {"colour": 3},
        {"latitude_deg": None},
        {"altitude_m": "x"},
        {"aperture_m": math.inf},
        None,
    ],
)
def test_a_damaged_record_is_one_sentence(tmp_path: Path, change: dict[str, object] | None) -> None:
    path = view_files.write_record(tmp_path, FRAME)
    path.write_text("[]" if change is None else json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DappledError, match=r"000000.json is no record of a frame's cameras: remove it"):
        view_files.read_frames(tmp_path, ["000000"])
    with pytest.raises(DappledError, match=r"000001.json can't be read"):
        view_files.read_frames(tmp_path, ["000001"])


def test_frames_of_two_focal_lengths_are_two_rigs(tmp_path: Path) -> None:
    zoomed = tuple(replace(view, focal_px=(900.0, 850.0)) for view in VIEWS[:4])
    frames = [FRAME, replace(FRAME, name="000001", views=zoomed), replace(FRAME, name="000002", latitude_deg=41.601)]
    made = {path.name: rows(path) for path in colmap.write_model(tmp_path, frames)}
    assert [row[:2] for row in made["rigs.txt"]] == [["1", "9"], ["2", "4"]]
    assert [row[1] for row in made["frames.txt"]] == ["1", "2", "1"]
    assert [row[4] for row in made["cameras.txt"]] == ["800.0"] * 9 + ["900.0"] * 4
    images = {row[9]: (int(row[8]), [float(word) for word in row[5:8]]) for row in made["images.txt"]}
    assert len(images) == 22
    assert (images["v0u1/000001.jpg"][0], images["v0u1/000002.jpg"][0]) == (11, 2)
    assert images["v1u1/000000.jpg"][1] == pytest.approx([0, 0, 0], abs=1e-9)
    north = -images["v1u1/000002.jpg"][1][0]  # these cameras' rows run along north
    assert north == pytest.approx(111.07, abs=0.02)  # a thousandth of a degree of latitude


def test_frames_of_one_stop_are_one_rig(tmp_path: Path) -> None:
    """Each shows its aperture with an error of its own; another stop is another rig, and so is an unknown one."""

    def shot(name: str, wide: float, sigma_m: float | None) -> FrameCameras:
        views = tuple(replace(v, centre_m=(wide * v.centre_m[0], wide * v.centre_m[1], 0.0)) for v in VIEWS)
        own = replace(FRAME, name=name, views=views, aperture_m=wide * 3e-3, aperture_sigma_m=sigma_m)
        return replace(
            own, aperture_from="carriers", doubts=(finding(Code.APERTURE_UNEXPLAINED, Subject("frame"), told=wide),)
        )

    shots = [
        shot("000000", 1.0, 1e-5),
        shot("000001", 1.01, 2e-5),
        shot("000002", 1.2, 1e-5),
        shot("000003", 1.0, None),
    ]
    made = {path.name: rows(path) for path in colmap.write_model(tmp_path, shots)}
    assert [row[1] for row in made["frames.txt"]] == ["1", "1", "2", "3"]
    apart = [float(row[11]) for row in made["rigs.txt"]]  # of the first view from the middle one, to the right
    assert apart == pytest.approx([1.002e-3, 1.2e-3, 1e-3])
    said = json.loads((tmp_path / "sparse/0/origin.json").read_text())["views"]
    assert said[0] == "views stand as far apart as the frames show, in 4 of 4 frames: to ±0.7% (1 standard deviation)"
    assert said[1].startswith("the lens was taken as focused at infinity")
    assert said[2:] == [f"in doubt: {told(finding(Code.APERTURE_UNEXPLAINED, Subject('frame', '000000'), told=1.0))}"]
    assert (tmp_path / "sparse/0/priors.csv").read_text().splitlines()[4].endswith(",0.003,,carriers,infinity")


@pytest.mark.parametrize(
    ("distortion", "model"),
    [((0.0,) * 5, "PINHOLE"), ((0.1, 0.0, 0.0, 0.2, 0.0), "OPENCV"), ((0.1, 0.0, 0.0, 0.0, 0.3), "FULL_OPENCV")],
)
def test_a_camera_is_of_the_simplest_model(tmp_path: Path, distortion: tuple[float, ...], model: str) -> None:
    colmap.write_model(tmp_path, [replace(FRAME, distortion=distortion)])
    first = rows(tmp_path / "sparse/0/cameras.txt")[0]
    counts = {"PINHOLE": 4, "OPENCV": 8, "FULL_OPENCV": 12}
    assert (first[1], len(first)) == (model, 4 + counts[model])


def rows(path: Path) -> list[list[str]]:
    """The words of a model's file, without comments and empty lines."""
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def item(folder: Path, _: object) -> list[Path]:
    """A collection of one item."""
    (folder / "000000").mkdir(exist_ok=True)
    said = {"bbox": [1, 2, 3, 4], "properties": {"datetime": "2026-11-21T10:15:04.046628Z"}}
    (folder / "000000" / "000000.json").write_text(json.dumps(said))
    return stac.write_collection(folder, "flight", ["000000"])


@pytest.mark.parametrize("write", [colmap.write_model, nerfstudio.write_transforms, item])
@pytest.mark.parametrize("there", [True, False])
def test_a_full_disk_leaves_what_was_there(
    tmp_path: Path,
    write: Callable[[Path, list[FrameCameras]], list[Path]],
    there: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = write(tmp_path, [FRAME])
    before = {path: path.read_bytes() for path in made}
    if not there:
        for path in made:
            path.unlink()
    put, written = durable.write_file, list[Path]()

    def full(path: Path, data: bytes, mode: int = 0o644) -> None:
        written.append(path)
        if len(written) == len(made) // 2 + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        put(path, data, mode)

    monkeypatch.setattr(durable, "write_file", full)
    with pytest.raises(OSError, match="No space"):
        write(tmp_path, [replace(FRAME, name="000007", latitude_deg=41.7)])
    assert {path: path.read_bytes() for path in made if path.exists()} == (before if there else {})


def test_an_item_of_somebody_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DappledError, match=r"000000.json is no item of this batch"):
        forms.finish("stac", tmp_path, "flight", ["000000"])
