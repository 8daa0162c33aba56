"""Carriers of simulated frames by the command, against where the simulator put them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from PIL import Image

from dappled.cli import main
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.scene import dng
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera
from tests.simulated.calibration import from_frame

MASK = "reference-5x5"
SNR = 50


@dataclass(frozen=True)
class Bench:
    """A camera, and a calibration of it on one stopped-down frame."""

    camera: MaskedCamera
    calibration: Path

    def frame(self, folder: Path, stops: float) -> Path:
        """A frame of the same boards at a raw signal of 50, stopped down by this factor."""
        camera = replace(self.camera, sensor=replace(self.camera.sensor, shot_noise=False, read_noise_e=0.0))
        sensor = camera.sensor
        shot = camera.expose(0.0, 0, f_number=stops * camera.optics.f_number)
        light = shot.raw.astype(np.float64) - sensor.black
        noise = np.random.default_rng(5).normal(0, light.mean() / SNR, light.shape)
        raw = np.clip(shot.raw + noise, 0, sensor.white).astype(np.uint16)
        path = folder / f"{stops}.dng"
        exif = dng.Exif("dappled", "Simulated Masked Camera", "1", 50.0, stops * 7.4, 1e-3, 100, 0)
        path.write_bytes(dng.encode(raw, black=sensor.black, white=sensor.white, exif=exif))
        return path

    def off_bins(self, carriers: list[dict[str, Any]], *, key: str | None) -> np.ndarray:
        """Distances from the true carriers in bins of the frame; `key` "measured", or None for the predicted ones."""
        orders = [(c["ky"], c["kx"]) for c in carriers]
        true = self.camera.lattice.carriers(orders)
        found = [c[key] if key else c for c in carriers]
        shape = self.camera.sensor.shape
        return np.array(
            [
                math.hypot((f["fy"] - t.fy) * shape[0], (f["fx"] - t.fx) * shape[1])
                for f, t in zip(found, true, strict=True)
            ]
        )


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("bench")
    camera = reference_camera(6, scale=0.5, scene="bench")
    (folder / "white.dng").write_bytes(camera.bench_frame().file)
    found = from_frame(Darkroom(Recipe("reference-36mm", MASK)), folder / "white.dng")
    (folder / "calibration.toml").write_text(tomli_w.dumps(found.to_dict()))
    return Bench(camera, folder / "calibration.toml")


def _asked(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["carriers", *words, "--json", "--anyway"]) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return told


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("stops", [*(pytest.param(stops, marks=pytest.mark.slow) for stops in (8, 4)), 2])
def test_stopped_down_carriers_are_measured_to_a_twentieth_of_a_bin(
    bench: Bench, stops: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = _asked(capsys, str(bench.frame(tmp_path, stops)), "--mask", MASK)
    assert told["carriers_from"] == "measured"
    assert told["rotation_rad"] == pytest.approx(bench.camera.installed.rotation_rad, abs=1e-4)
    seen = [c for c in told["carriers"] if c["measured"] and (c["ky"], c["kx"]) != (0, 0)]
    assert len(seen) >= 20
    assert _rms(bench.off_bins(seen, key="measured")) < 0.05


@pytest.mark.long
def test_a_mask_that_is_not_where_it_is_said_to_be_is_found_and_doubted(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    height, width = bench.camera.sensor.shape
    (tmp_path / "off.toml").write_text(
        'law = "geometric"\nmask_distance_mm = 0.48\n[[raw]]\nname = "half"\n'
        f"shape = [{height}, {width}]\nrow_mm = [0.0092, 0.0]\ncolumn_mm = [0.0, 0.0092]\n"
    )
    words = [str(bench.frame(tmp_path, 4)), "--mask", MASK, "--camera", str(tmp_path / "off.toml")]
    told = _asked(capsys, *words)
    assert told["carriers_from"] == "measured"
    seen = [c for c in told["carriers"] if c["measured"] and (c["ky"], c["kx"]) != (0, 0)]
    assert _rms(bench.off_bins(seen, key="measured")) < 0.05
    assert main(["carriers", *words]) == 0
    assert "they stand 8.7% farther out than predicted" in capsys.readouterr().out
    assert main(["decode", *words, "-o", str(tmp_path / "out.npz")]) == 1
    assert "they stand 8.7% farther out than predicted" in capsys.readouterr().out


@pytest.mark.parametrize("stops", [*(pytest.param(stops, marks=pytest.mark.slow) for stops in (8, 4, 1.4)), 2, 1])
def test_over_all_apertures_the_calibrated_carriers_are_right_and_it_is_said_where_they_come_from(
    bench: Bench, stops: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = bench.frame(tmp_path, stops)
    told = _asked(capsys, str(frame), "--mask", MASK, "--calibration", str(bench.calibration))
    assert _rms(bench.off_bins(told["carriers"], key=None)) < 0.05
    seen = [c for c in told["carriers"] if c["measured"] and (c["ky"], c["kx"]) != (0, 0)]
    if told["carriers_from"] == "measured":
        assert _rms(bench.off_bins(seen, key="measured")) < 0.05
    assert told["carriers_from"] == ("calibrated" if stops < 2 else told["carriers_from"])
    assert main(["carriers", str(frame), "--mask", MASK, "--calibration", str(bench.calibration)]) == 0
    assert ("a decode uses the calibration's prediction" in capsys.readouterr().out) == (
        told["carriers_from"] == "calibrated"
    )


def test_a_photograph_without_a_mask_shows_no_carriers_and_that_is_said(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    height, width = bench.camera.sensor.shape
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :]
    picture = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(height, width))) / np.maximum(np.hypot(fy, fx), 1e-3))
    values = np.clip(110 + 30 * picture / picture.std() + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
    values[300:600, ::17] //= 2  # a fence
    path = tmp_path / "photo.png"
    Image.fromarray(values).save(path)
    words = [str(path), "--mask", MASK, "--camera", "reference-36mm", "--focal-length", "50"]
    told = _asked(capsys, *words)
    assert [c for c in told["carriers"] if c["measured"] and (c["ky"], c["kx"]) != (0, 0)] == []
    assert main(["carriers", *words, "--anyway"]) == 0
    assert "no carriers in this frame" in capsys.readouterr().out
    assert main(["carriers", *words]) == 1  # where slices are cut is not confirmed
    assert "in doubt: no carriers in this frame" in capsys.readouterr().err
    assert main(["carriers", str(path), "--mask", "lenslet"]) == 1
    assert "no carriers" in capsys.readouterr().err


def test_crossed_orders_are_listed_when_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Tables 12 and 13: a mask of diagonals shows (k, 0) and (0, k), too."""
    words = ["--shape", "2776", "3688", "--camera", "fujifilm-s5200", "--mask", "mask-2", "--focal-length", "12"]
    plain, crossed = _asked(capsys, *words), _asked(capsys, *words, "--crossed")
    assert (len(plain["carriers"]), len(crossed["carriers"])) == (9, 25)
    assert all(c["main"] for c in plain["carriers"])
    between = {(c["ky"], c["kx"]): c for c in crossed["carriers"] if not c["main"]}
    assert (between[-1, 0]["row"], between[0, 1]["col"]) == pytest.approx((768.2, 2457.3), abs=0.1)


def test_peaks_at_simple_fractions_of_the_frame_are_called_suspect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At 12 mm the thesis' mask 2 puts carriers where interpolation leaves its own mark: a sixth of the columns."""
    height, width = 2776 // 2, 3688 // 2
    y, x = np.mgrid[0:height, 0:width]
    plane = 0.5 + 0.05 * np.cos(2 * np.pi * x / 6) + 0.05 * np.cos(2 * np.pi * y / 4)
    plane += np.random.default_rng(0).normal(0, 0.01, plane.shape)
    np.save(tmp_path / "frame.npy", plane.astype(np.float32))
    camera = (
        'law = "fd"\nmask_distance_mm = 1.01\n[[raw]]\nname = "half"\n'
        f"shape = [{height}, {width}]\nrow_mm = [{4.29 / height}, 0.0]\ncolumn_mm = [0.0, {5.76 / width}]\n"
    )
    (tmp_path / "half.toml").write_text(camera)
    words = [str(tmp_path / "frame.npy"), "--camera", str(tmp_path / "half.toml"), "--mask", "mask-2-full"]
    told = _asked(capsys, *words, "--focal-length", "12")
    at = {(c["ky"], c["kx"]): c["measured"] for c in told["carriers"]}
    assert at[0, 1]["suspect"]
    assert at[0, 1]["fx"] == pytest.approx(1 / 6, abs=1e-5)
    assert told["carriers_from"] == "predicted"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "told"), [("scale", "+0.30"), ("turn", "turned by -0.50")])
def test_a_mask_printed_larger_or_turned_is_decoded_where_its_weak_carriers_stand(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, told: str
) -> None:
    """Frames by a simulator that shares nothing with the project's: print and turn cost the views next to nothing."""
    frames = shared_data / "optics"
    words = ["--camera", str(frames / "eighth.toml"), "--mask", MASK, "--black", "0", "--white-level", "255"]
    words += ["--focal-length", "50"]
    known = ["--calibration", str(tmp_path / "known.toml")]
    white = ["calibrate", str(frames / "white-f62.png"), "--f-number", "62", "-o", str(tmp_path / "known.toml")]
    assert main([*white, *words]) == 0
    capsys.readouterr()
    assert main(["carriers", str(frames / f"{name}-f9.9.png"), "--f-number", "9.9", *words, *known]) == 0
    assert told in capsys.readouterr().out
    views = []
    for one in ("good", name):
        made = tmp_path / f"{one}.npz"
        decode = ["decode", str(frames / f"{one}-f9.9.png"), "--f-number", "9.9", "-o", str(made)]
        assert main([*decode, *words, *known]) == 0
        views.append(np.load(made)["views"][:, :, 6:-6, 6:-6])
    assert -10 * math.log10(float(np.mean((views[1] - views[0]) ** 2))) > 38
