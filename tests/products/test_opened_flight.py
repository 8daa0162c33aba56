"""A recorded flight opened from Python, and a frame's points laid onto the map."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import dappled
from dappled.cli import main
from dappled.errors import DappledError
from dappled.products.exports import light_files
from dappled.products.opened import OpenedFlight, OpenError
from tests.products.flown import Flown


@pytest.fixture
def flown(short_flight: Flown) -> Flown:
    return short_flight


def test_a_flight_is_its_frames(flown: Flown) -> None:
    flight = dappled.open(flown.folder, **{k: v for k, v in asdict(flown.recipe).items() if v})
    assert isinstance(flight, OpenedFlight)
    assert len(flight) == 2
    assert repr(flight) == f"<flight {flown.folder.name}: 2 safe frames, reference-5x5>"
    assert "<td>50 mm, f/" in flight._repr_html_()
    frame = next(iter(flight))
    assert frame.index is not None
    assert flight[frame.index].path == frame.path
    assert frame.tag is not None
    assert frame.views.shape[:2] == (5, 5)
    assert frame.refocus(disparity=0.1).shape == frame.views.shape[2:4]
    depth = frame.depth("contrast", between=(-0.3, 0.5))
    assert depth.known_share() > 0.5
    picture = frame.picture()
    assert (picture.pixels.shape, picture.sigma.shape) == ((1388, 1844, 3), (1388, 1844))
    with pytest.raises(IndexError, match="has no safe frame of image index 999") as missing:
        flight[999]
    assert isinstance(missing.value, KeyError)
    assert isinstance(missing.value, DappledError)


@pytest.mark.slow
def test_a_frame_s_picture_without_colour_is_as_bright_as_its_green(flown: Flown) -> None:
    flight = dappled.open(flown.folder, **{k: v for k, v in asdict(flown.recipe).items() if v})
    assert isinstance(flight, OpenedFlight)
    frame = next(iter(flight))
    green = float(frame.picture().pixels[..., 1].mean())
    assert frame.picture(colour=False).pixels.mean() == pytest.approx(green, rel=0.1)


def test_without_a_mask_frames_cannot_be_looked_at(flown: Flown) -> None:
    flight = dappled.open(flown.folder, mask="")
    assert isinstance(flight, OpenedFlight)
    with pytest.raises(OpenError, match="without a mask"):
        next(iter(flight))


@pytest.mark.slow
def test_points_lie_on_the_ground_below(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = dappled.open(flown.folder, **{k: v for k, v in asdict(flown.recipe).items() if v})
    assert isinstance(flight, OpenedFlight)
    frame = next(iter(flight))
    light_files.save(tmp_path / "f.npz", frame.light_field.field)
    words = ["depth", str(tmp_path / "f.npz"), "--focus", "inf", "--flight", str(flown.folder), "--most-sigma", "0.5"]
    words += ["--frame", str(frame.index), "--window", "25", "--method", "contrast", "--json"]
    assert main([*words, "-o", str(tmp_path / "p.ply"), str(tmp_path / "d.npz")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["coordinates"].startswith("EPSG:326")
    header, _, body = (tmp_path / "p.ply").read_bytes().partition(b"end_header\n")
    offset = [float(x) for x in header.split(b"offset ")[1].split(b"\n")[0].split()]
    table = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3), ("sigma", "<f4")])
    heights = table["xyz"][:, 2] + offset[2]
    truth = flown.truths[0]
    assert truth.pose is not None
    assert truth.depth_m is not None
    ground = truth.pose.altitude_msl_m - float(np.median(truth.depth_m))
    # A single frame at 30 m with half the aperture knows distances to metres: the median over thousands is much better.
    assert np.median(heights) == pytest.approx(ground, abs=0.15 * float(np.median(truth.depth_m)))
