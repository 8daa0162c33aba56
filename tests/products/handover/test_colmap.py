"""COLMAP's own library reads rig, poses and priors, and triangulates points from them: all is the simulator's truth.

pycolmap (134 MB) is in the peers' environment: `make peers`.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dappled.decode.array_types import Floats
from dappled.products.exports import light_files
from tests.products.flown import Flown
from tests.products.handover.handed import NAMES, close, true_world
from tests.system.peers.mavproxy import PYTHON

pytestmark = [
    pytest.mark.long,
    pytest.mark.peers,
    pytest.mark.skipif(not PYTHON.exists(), reason="pycolmap is not set up: run `make peers`"),
]
READER = Path(__file__).parents[2] / "system" / "peers" / "colmap_reader.py"
EXAMPLE = Path(__file__).parents[3] / "examples" / "colmap" / "triangulate.py"
VIEWS = ("v0u0", "v0u4", "v2u2", "v4u0", "v4u4")
SIGMA_PX = 0.1  # of a feature's place


@pytest.fixture(scope="module")
def said(handed: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What pycolmap makes of the flight."""
    folder, scratch = handed / "colmap", tmp_path_factory.mktemp("colmap")
    names = [f"v2u2/{name}.jpg" for name in NAMES]
    pairs = [[(one + 0.5).tolist() for one in pair] for pair in matches(*(folder / "images" / name for name in names))]
    orders = {
        "model": str(folder / "sparse" / "0"), "images": str(folder / "images"), "names": names,
        "database": str(scratch / "database.db"), "pairs": {"names": names, "points": pairs},
    }  # fmt: skip
    (scratch / "orders.json").write_text(json.dumps(orders))
    files = READER, scratch / "orders.json", scratch / "said.json"
    subprocess.run([str(PYTHON), "-W", "ignore", *map(str, files)], check=True, timeout=60)
    made: dict[str, Any] = json.loads((scratch / "said.json").read_text())
    return {**made, "pairs": pairs}


def matches(first: Path, second: Path) -> Iterator[tuple[Floats, Floats]]:
    """Places (x, y) of SIFT features that look alike in both pictures, the first pixel's centre at 0."""
    cv2 = pytest.importorskip("cv2", reason="opencv is part of the extra ground")
    sift = cv2.SIFT_create(2000)
    (here, a), (there, b) = (sift.detectAndCompute(cv2.imread(str(path), 0), None) for path in (first, second))
    for best, other in cv2.BFMatcher().knnMatch(a, b, k=2):
        if best.distance < 0.7 * other.distance:
            yield np.array(here[best.queryIdx].pt), np.array(there[best.trainIdx].pt)


def ground_of(flown: Flown, pixel: Floats) -> Floats:
    """The true ground point (east, north, up from the first frame) under a place (row, column) of its true views."""
    truth = flown.truths[0]
    assert truth.depth_m is not None
    (r, c), (a, b) = pixel.astype(int), pixel % 1
    depth = float(np.array([1 - a, a]) @ truth.depth_m[r : r + 2, c : c + 2] @ np.array([1 - b, b]))
    y, x = (0.01 / 50.0) * (truth.grid[:, :2] @ pixel - (np.array([1388, 1844]) - 1) / 2)
    turn, centre = true_world(flown)[0]
    return np.asarray(centre + turn @ np.array([x, y, 1.0]) * depth)


def test_the_rig_and_its_poses(said: dict[str, Any], handed: Path, short_flight: Flown) -> None:
    assert said["counts"] == [1, 25, 2, 50]
    for name, image in said["images"].items():
        view, frame = name.split("/")
        truth = short_flight.truths[int(frame[:6])]
        turn, centre = true_world(short_flight)[int(frame[:6])]
        y, x = truth.aperture_points_mm[int(view[1]), int(view[3])] / 1e3  # looks from the other side of the lens
        close(np.array(image["turn"]), np.array(image["centre"]), (turn, centre + turn @ [-x, -y, 0.0]))
        with Image.open(handed / "colmap" / "images" / name) as picture:
            assert list(picture.size) == image["size"]
            assert picture.getexif()[0x0110] == "reference-36mm"


def test_points_triangulated_from_the_rig_are_on_the_true_ground(
    said: dict[str, Any], handed: Path, short_flight: Flown
) -> None:
    """Matched features of both frames, by COLMAP's own triangulation."""
    grid = light_files.load(handed / "mcap" / "slices" / "000000.npz").grid
    misses, squares = [], []
    for one, (here, _) in zip(said["points"], said["pairs"], strict=True):
        if one["miss_px"] > 0.5:
            continue  # another place that looks alike
        sensor = grid @ [here[1] - 0.5, here[0] - 0.5, 1.0]
        true = ground_of(short_flight, np.linalg.inv(short_flight.truths[0].grid[:, :2]) @ sensor)
        miss, slopes = np.array(one["at"]) - true, np.array(one["slopes"])
        misses.append(miss)
        squares.append(miss @ slopes.T @ slopes @ miss / SIGMA_PX**2)
    assert len(misses) > 50
    assert np.mean(np.array(squares) < 14.16) >= 0.95  # 3 σ of three numbers: 99.7 % of χ²
    assert np.abs(np.median(misses, axis=0)).max() < 0.03


def test_the_example_s_points_are_on_the_true_ground(handed: Path, short_flight: Flown, tmp_path: Path) -> None:
    """By COLMAP's whole way: its database, features, matches, and triangulation with the poses and cameras given.

    Views of one frame share its noise: all that show a point together count as one observation.
    """
    for part in ("sparse", "images"):
        (tmp_path / part).symlink_to(handed / "colmap" / part)
    words = [str(EXAMPLE), str(tmp_path), *VIEWS]
    done = subprocess.run(
        [str(PYTHON), "-W", "ignore", *words], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert " points, 0." in done.stdout
    orders = {
        "model": str(tmp_path / "sparse/0"),
        "triangulated": str(tmp_path / "triangulated"),
        "first": "v2u2/000000.jpg",
    }
    (tmp_path / "orders.json").write_text(json.dumps(orders))
    files = READER, tmp_path / "orders.json", tmp_path / "said.json"
    subprocess.run([str(PYTHON), "-W", "ignore", *map(str, files)], check=True, timeout=60)
    tracks = json.loads((tmp_path / "said.json").read_text())["tracks"]
    grid = light_files.load(handed / "mcap" / "slices" / "000000.npz").grid
    misses, squares = [], []
    for one in tracks:
        if (
            one["images"] > len(VIEWS) and one["error_px"] < 0.3
        ):  # of both frames, and not another place that looks alike
            sensor = grid @ [one["place"][1] - 0.5, one["place"][0] - 0.5, 1.0]
            true = ground_of(short_flight, np.linalg.inv(short_flight.truths[0].grid[:, :2]) @ sensor)
            miss, slopes = np.array(one["at"]) - true, np.array(one["slopes"])
            misses.append(miss)
            squares.append(miss @ slopes.T @ slopes @ miss / SIGMA_PX**2 / len(VIEWS))
    assert len(misses) > 50
    assert np.mean(np.array(squares) < 14.16) >= 0.95, np.percentile(squares, [50, 80, 90, 95, 98]).tolist()
    assert np.abs(np.median(misses, axis=0)).max() < 0.03


def test_priors_come_with_the_pictures(said: dict[str, Any], handed: Path, short_flight: Flown) -> None:
    for prior, truth in zip(said["priors"], short_flight.truths, strict=True):
        assert truth.pose is not None
        assert prior[:2] == pytest.approx([truth.pose.latitude_deg, truth.pose.longitude_deg], abs=1e-8)
        assert prior[2] == pytest.approx(truth.pose.altitude_msl_m, abs=1e-3)
    lines = (handed / "colmap" / "sparse" / "0" / "priors.csv").read_text().splitlines()
    for line, (_, centre) in zip(lines[1:], true_world(short_flight), strict=True):
        words = line.split(",")
        assert [float(word) for word in words[1:4]] == pytest.approx(centre.tolist(), abs=1e-3)
        assert words[4:7] == ["0.02", "", "0.001"]
