"""A plane sweep over all frames of a flight: a box on textured ground, seen by rays, and poses that are off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from dappled.cli import main
from dappled.cli.placing import Refining
from dappled.products.maps import terrain
from dappled.products.maps.hyperstereo import HyperstereoError, Surface
from dappled.products.survey import flight_sweep
from tests.products.survey import seen

PLACES = [(0.6 * k - 1.5, 0.9 * (k % 3) - 0.9) for k in range(6)]
BOX_M = 2.5
EAST, NORTH = seen.eyes([(0.0, 0.0)])[0].centre[:2]


def quiet(*_: object) -> None:
    pass


def box(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((np.abs(east - EAST) < 1.6) & (np.abs(north - NORTH) < 1.3))


def heights(found: Surface, inner: float, outer: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Heights on the box (up to `inner` of its size) and on the ground (from `outer` on) where enough frames look."""
    x, y = found.grid.axes()
    away = np.maximum(np.abs(x[None, :] - EAST) / 1.6, np.abs(y[:, None] - NORTH) / 1.3)
    return found.height_m[away < inner], found.height_m[(away > outer) & (found.sigma_m < 0.7)]


def test_a_box_stands_out_of_the_ground() -> None:
    flight = seen.flown(PLACES, [(BOX_M, box, 300.0)])
    found = flight_sweep.surface(flight, quiet, between=(-2.0, 5.0))
    top, ground = heights(found, 0.6, 2.0)
    assert np.isfinite(top).mean() > 0.9
    assert ground.size > 1000
    assert np.nanmedian(np.abs(top - BOX_M)) < 0.08
    assert np.median(np.abs(ground)) < 0.08
    assert np.quantile(np.abs(ground), 0.95) < 0.4
    assert np.nanmax(found.score) <= 1.001
    assert terrain.over(flight, found).difference_m is None


def test_sigma_holds_what_poses_make() -> None:
    """Each pose off by its own σ: heights are off by more than a match's error, and σ says by how much."""
    rng = np.random.default_rng(3)
    true = seen.flown(PLACES)
    ratios = []
    for _ in range(3):
        moved = []
        for one in true.photographs:
            change = np.concatenate([rng.normal(0, 0.03, 3), np.zeros(3)])
            moved.append(replace(one, eye=one.eye.moved(change), position_sigma_m=0.03, attitude_sigma_rad=0.0))
        found = flight_sweep.surface(replace(true, photographs=tuple(moved)), quiet, between=(-2.0, 2.0))
        known = np.isfinite(found.height_m)
        assert known.mean() > 0.2
        ratios.append(float(np.median(np.abs(found.height_m[known]) / found.sigma_m[known])))
    assert 0.2 < np.mean(ratios) < 1.6
    sure = flight_sweep.surface(
        replace(true, photographs=tuple(replace(one, position_sigma_m=1e-4, attitude_sigma_rad=0.0)
                                        for one in true.photographs)), quiet, between=(-2.0, 2.0)
    )  # fmt: skip
    assert np.nanmedian(sure.sigma_m) < 0.5 * np.nanmedian(found.sigma_m)


def test_ground_without_texture_is_unknown() -> None:
    flight = seen.flown(PLACES[:3])
    bare = tuple(replace(one, image=np.full_like(one.image, 0.4)) for one in flight.photographs)
    found = flight_sweep.surface(replace(flight, photographs=bare), quiet, between=(-2.0, 2.0))
    assert not found.known.any()


def test_frames_without_a_baseline_are_refused() -> None:
    flight = seen.flown([(0.0, 0.0), (500.0, 0.0)], gsd_m=1.0)
    with pytest.raises(HyperstereoError, match="no two frames of the flight show the same ground from two places"):
        flight_sweep.surface(flight, quiet, between=(-2.0, 2.0))


def test_a_flight_is_swept_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of the ground by rays stand for a flight's."""
    flight = seen.flown(PLACES)
    monkeypatch.setattr(Refining, "placed", lambda *_, **__: flight)
    out, flown = tmp_path / "swept.tif", seen.folder(tmp_path)
    assert main(["depth", "--flight", flown, "--together", "--cell", "0.2", "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with rasterio.open(out) as read:
        height, sigma = read.read()
    known = np.isfinite(height)
    assert known.mean() == pytest.approx(report["known"])
    assert known.mean() > 0.2
    assert np.median(np.abs(height[known])) < np.median(sigma[known])
