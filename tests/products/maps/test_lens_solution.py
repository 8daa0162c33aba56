"""A lens is found from sightings whose truth is known, within the sigmas that are said."""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled.config.profiles import Lens
from dappled.decode.array_types import Floats
from dappled.products.maps import lens_solution
from dappled.products.maps.eye import Eye
from dappled.products.maps.lens_solution import Sightings
from tests.products.maps.test_eye import SHAPE, eye_at
from tests.system.peers.mavproxy import PYTHON

READER = Path(__file__).parents[2] / "system" / "peers" / "colmap_lens.py"

GIVEN = Lens(50.0, 50.0)
TRUE = Lens(50.0, 50.6, (0.12, -0.09), (-0.35, 0.9, 0.002, -0.001, 0.0))
LENS_SIGMAS = np.array([2.5, 1.0, 1.0, 0.6, 18.0, 0.04, 0.04])
POSE_SIGMAS = np.array([0.03, 0.03, 0.03, 0.02, 0.02, 0.02])


def values(lens: Lens) -> Floats:
    y, x = lens.principal_point_mm
    return np.array([lens.v_mm, x, y, *lens.distortion[:4]])


def flown(seed: int, *, pixel_sigma: float = 0.3) -> tuple[list[Eye], list[Eye], Sightings]:
    """(the eyes as telemetry has them, the true eyes, what they see) of two lines in both directions and at two heights
    over rough ground, with eight measured places."""
    rng = np.random.default_rng(seed)
    true, told = [], []
    for n in range(12):
        height_m, yaw = (100.0, 130.0)[n % 2], (30.0, 210.0)[n // 6]
        tilt = (float(rng.normal(0, 5)), float(rng.normal(0, 5)), yaw + float(rng.normal(0, 5)))
        shift = np.array([5.0 * (n % 6) - 12.0, 4.0 * (n // 6), 0.0, 0, 0, 0])
        true.append(eye_at(height_m=height_m, tilt_deg=tilt, lens=TRUE).moved(shift))
        plain = eye_at(height_m=height_m, tilt_deg=tilt, lens=GIVEN).moved(shift)
        told.append(plain.moved(POSE_SIGMAS * rng.standard_normal(6)))
    east, north = (true[0].centre[k] + rng.uniform(-25, 25, 400) for k in (0, 1))
    places = np.stack([east, north, rng.uniform(0, 12, 400)], axis=1)
    frames, points, pixels = [], [], []
    for n, eye in enumerate(true):
        at = eye.project(places)
        inside = ((at > 0) & (at < (SHAPE[1], SHAPE[0]))).all(axis=1)
        for k in np.flatnonzero(inside):
            frames.append(n)
            points.append(k)
            pixels.append(at[k] + pixel_sigma * rng.standard_normal(2))
    known = np.full(400, np.inf)
    known[:8] = 0.02
    guess = places + np.where(np.isfinite(known), 0.02, 2.0)[:, None] * rng.standard_normal((400, 3))
    return told, true, Sightings(np.array(frames), np.array(points), np.array(pixels), guess, known)


def solved(seed: int, **kinds: float) -> lens_solution.LensSolution:
    told, _, seen = flown(seed, **kinds)
    return lens_solution.solve(told, GIVEN, seen, sigmas=np.tile(POSE_SIGMAS, (len(told), 1)), lens_sigmas=LENS_SIGMAS)


def test_the_lens_is_found_within_its_sigmas() -> None:
    ratios = []
    for seed in range(4):
        found = solved(seed)
        ratios.append((values(found.lens) - values(TRUE)) / found.sigmas)
        assert found.sigma_px == pytest.approx(0.3, rel=0.05)
        assert found.before_px > 1.15 * found.sigma_px
        assert found.sigmas[0] < 0.1
        assert (found.sigmas[1:3] < 0.25).all()
        assert (found.sigmas < 0.3 * LENS_SIGMAS).all()
    assert 0.6 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.5


def test_wrong_sightings_are_found_out() -> None:
    told, _, seen = flown(1)
    pixels = seen.pixels.copy()
    pixels[::20] += 15.0
    found = lens_solution.solve(
        told, GIVEN, replace(seen, pixels=pixels), sigmas=np.tile(POSE_SIGMAS, (12, 1)), lens_sigmas=LENS_SIGMAS
    )
    assert np.mean(found.inliers[::20]) < 0.05  # a point of two sightings can't tell which is wrong
    assert np.mean(found.inliers) > 0.94
    assert (np.abs(values(found.lens) - values(TRUE)) < 4 * found.sigmas).all()


def test_the_moved_eyes_see_what_was_seen() -> None:
    told, true, seen = flown(2)
    found = lens_solution.solve(told, GIVEN, seen, sigmas=np.tile(POSE_SIGMAS, (12, 1)), lens_sigmas=LENS_SIGMAS)
    off = [math.dist(a.centre, b.centre) for a, b in zip(found.eyes, true, strict=True)]
    assert max(off) < 0.15
    for n, eye in enumerate(found.eyes):
        mine = seen.frames == n
        away = np.hypot(*(eye.project(found.places[seen.points[mine]]) - seen.pixels[mine]).T)
        assert np.median(away) < 0.45


def test_flat_ground_seen_from_one_height_does_not_tell_the_distance() -> None:
    """And the sigma says so."""
    eyes = [eye_at(tilt_deg=(0, 0, 30.0), lens=GIVEN).moved(np.array([5.0 * n, 0, 0, 0, 0, 0])) for n in range(5)]
    rng = np.random.default_rng(0)
    places = np.stack([*(eyes[2].centre[k] + rng.uniform(-25, 25, 300) for k in (0, 1)), np.zeros(300)], axis=1)
    at = np.stack([eye.project(places) for eye in eyes])
    inside = ((at > 0) & (at < (SHAPE[1], SHAPE[0]))).all(axis=2)
    frames, points = np.nonzero(inside)
    pixels = at[inside] + 0.3 * rng.standard_normal((len(frames), 2))
    seen = Sightings(frames, points, pixels, places, np.full(300, np.inf))
    loose = np.tile([1.0, 1.0, 1.0, 0.02, 0.02, 0.02], (5, 1))
    found = lens_solution.solve(eyes, GIVEN, seen, sigmas=loose, lens_sigmas=LENS_SIGMAS)
    assert found.sigmas[0] > 0.5 * LENS_SIGMAS[0]


@pytest.mark.long
@pytest.mark.peers
@pytest.mark.skipif(not PYTHON.exists(), reason="pycolmap is not set up: run `make peers`")
def test_colmap_finds_the_same_lens_from_the_same_sightings(tmp_path: Path) -> None:
    """Without telemetry or measured places, which COLMAP's adjustment doesn't use."""
    told, _, seen = flown(5)
    often = np.bincount(seen.points, minlength=400)[seen.points] > 1
    seen = replace(
        seen, frames=seen.frames[often], points=seen.points[often], pixels=seen.pixels[often],
        place_sigmas_m=np.full(400, np.inf),
    )  # fmt: skip
    loose = np.tile([10.0, 10.0, 10.0, 0.2, 0.2, 0.2], (len(told), 1))
    found = lens_solution.solve(told, GIVEN, seen, sigmas=loose, lens_sigmas=10 * LENS_SIGMAS)
    base = told[0].centre  # the world of COLMAP: ground metres from there
    scale = np.array([told[0].scale, told[0].scale, 1.0])
    (fx, _, cx), (_, fy, cy) = told[0].matrix[:2]
    orders = {
        "size": SHAPE[::-1], "params": [fx, fy, cx + 0.5, cy + 0.5, 0.0, 0.0, 0.0, 0.0],
        "poses": [{"turn": eye.rotation.tolist(), "centre": ((eye.centre - base) / scale).tolist()} for eye in told],
        "places": ((seen.places - base) / scale).tolist(), "frames": seen.frames.tolist(),
        "points": seen.points.tolist(), "pixels": (seen.pixels + 0.5).tolist(),
    }  # fmt: skip
    (tmp_path / "orders.json").write_text(json.dumps(orders))
    files = tmp_path / "orders.json", tmp_path / "said.json"
    subprocess.run([str(PYTHON), "-W", "ignore", str(READER), *map(str, files)], check=True, timeout=60)
    fx, fy, cx, cy, *bent = json.loads(files[1].read_text())["params"]
    px_mm = GIVEN.v_mm / told[0].matrix[0, 0]  # of a view
    (_, _, x), (_, _, y) = told[0].matrix[:2]
    theirs = [(fx + fy) / 2 * px_mm, (cx - 0.5 - x) * px_mm, (cy - 0.5 - y) * px_mm, *bent]
    assert (np.abs(np.array(theirs) - values(found.lens)) < 0.5 * found.sigmas).all()
    assert (np.abs(np.array(theirs) - values(TRUE)) < 4 * found.sigmas).all()
