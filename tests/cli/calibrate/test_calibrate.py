"""The command on simulated frames at several focal lengths: tables, law, files, and bad frames among good ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled import findings
from dappled.cli import main
from dappled.decode.calibration.calibration import Calibration
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.findings import Code
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera
from dappled.products.exports import light_files
from tests.simulated import profiles

MASK = "reference-5x5"
LENGTHS = (35.0, 50.0, 80.0)
SHORT = (10.0, 16.0, 24.0)  # under the fd law a long lens draws the carriers together


def _zoom(seed: int, length_mm: float, law: str = "geometric") -> MaskedCamera:
    """The reference camera's mask behind a lens of another focal length; the aperture grows with it."""
    camera = reference_camera(seed, scale=0.25, scene="white")
    optics = replace(camera.optics, focal_length_mm=length_mm, aperture_mm=length_mm / 7.4627, law=law)
    return replace(camera, optics=optics, installation=camera.installed)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("profile") / "quarter.toml"
    path.write_text(profiles.profile(694, 922))
    return path


Frames = Callable[[str], list[str]]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    folder = tmp_path_factory.mktemp("frames")

    def made(law: str) -> list[str]:
        paths = []
        for length in LENGTHS if law == "geometric" else SHORT:
            path = folder / f"{law}-{length:g}.dng"
            if not path.exists():
                path.write_bytes(_zoom(4, length, law).bench_frame().file)
            paths.append(str(path))
        return paths

    return made


@pytest.mark.slow
def test_tables_law_and_pair_of_files(
    frames: Frames, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", *frames("geometric"), "--camera", str(profile), "--mask", MASK]
    assert main([*words, "-o", str(tmp_path / "c.toml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    installed = _zoom(4, 50.0).installed
    assert told["law"] == "geometric"
    geometric = next(law for law in told["laws"] if law["law"] == "geometric")
    assert geometric["explains"]
    assert geometric["mask_distance_mm"] == pytest.approx(installed.distance_mm, rel=5e-3)
    assert abs(geometric["pupil_mm"]) < 0.5
    assert [one["focal_length_mm"] for one in told["focal_lengths"]] == list(LENGTHS)
    for one in told["focal_lengths"]:
        assert one["rotation_rad"] == pytest.approx(installed.rotation_rad, abs=1e-4)
        assert len(one["carriers"]) == 25
        for carrier in one["carriers"]:
            offset = np.subtract(carrier["measured"], carrier["expected"])
            assert carrier["offset"] == pytest.approx(offset.tolist(), abs=1e-9)
            assert carrier["distance"] == pytest.approx(float(np.hypot(*offset)), abs=1e-9)
    assert calibration_files.load(tmp_path / "c.npz") == calibration_files.load(tmp_path / "c.toml")
    assert main([*words, "-o", str(tmp_path / "c.toml"), "--overwrite"]) == 0
    text = capsys.readouterr().out
    assert "expected" in text
    assert "distance" in text
    assert "geometric explains these frames" in text


@pytest.mark.long
def test_a_frame_in_between_is_predicted_to_a_fraction_of_a_bin_and_searched_no_farther_than_its_exif_is_rounded(
    frames: Frames, profile: Path, tmp_path: Path
) -> None:
    main(["calibrate", *frames("geometric"), "--camera", str(profile), "--mask", MASK, "-o", str(tmp_path / "c.toml")])
    found: Calibration = calibration_files.load(tmp_path / "c.toml")
    between = _zoom(4, 62.0)
    off = (found.lattice_at(62.0).matrix() - between.lattice.matrix()) * between.sensor.shape
    assert np.abs(off).max() < 0.05
    decoder = Darkroom(Recipe(str(profile), MASK, calibration=str(tmp_path / "c.npz"))).mask_decoder((694, 922), "")
    predicted = decoder.predict(62.0)
    coarse = replace(decoder, focal_sigma_mm=0.5)
    near, far = (one.radii(predicted, 62.0) for one in (decoder, coarse))
    assert max(near) < 1.6  # a bin and a half, and what a tenth of a millimetre makes of a geometric lattice
    assert max(far) < 2.0
    assert all(b >= a for a, b in zip(near, far, strict=True))


@pytest.mark.long
def test_frames_of_the_other_law_choose_it_and_refuse_the_one_that_is_asked_for(
    frames: Frames, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", *frames("fd"), "--camera", str(profile), "--mask", MASK, "-o", str(tmp_path / "c.toml")]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["law"] == "fd"
    assert (told["verdict"]["code"], told["verdict"]["facts"]["law"]) == ("law.explains", "fd")
    for written in tmp_path.glob("c.*"):
        written.unlink()
    assert main([*words, "--law", "geometric"]) == 1
    told = capsys.readouterr().err
    assert "the law geometric was asked for, and does not explain these frames: fd explains these frames" in told
    assert "leave out --law" in told
    assert not (tmp_path / "c.toml").exists()
    assert main([*words, "--law", "geometric", "--anyway"]) == 0
    made = calibration_files.load(tmp_path / "c.toml")
    assert made.law == "geometric"
    assert [one.code for one in made.doubts] == [Code.LAW_ASKED]


def test_a_batch_goes_on_past_bad_frames_and_says_so(
    frames: Frames, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, nameless, other = tmp_path / "bad.dng", tmp_path / "nameless.npy", tmp_path / "other.dng"
    bad.write_bytes(b"II*\0 not a raw")
    np.save(nameless, np.random.default_rng(0).random((694, 922)).astype(np.float32))
    other.write_bytes(reference_camera(4, scale=0.2, scene="white").bench_frame().file)
    words = ["calibrate", str(bad), *frames("geometric")[:2], str(nameless), str(other)]
    assert main([*words, "--camera", str(profile), "--mask", MASK, "-o", str(tmp_path / "c.toml")]) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 4
    assert "bad.dng" in told[0]
    assert "nameless.npy" in told[1]
    assert "--focal-length" in told[1]
    assert "describes frames of" in told[2]
    assert told[3] == "3 of 5 frames could not be used"
    assert len(calibration_files.load(tmp_path / "c.toml").fits) == 2


@pytest.mark.slow
def test_a_wrong_mask_is_told_in_a_sentence(
    frames: Frames, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("frequency_per_mm = 9.3\np = 2\n")
    words = [*frames("geometric")[:1], "--camera", str(profile), "--mask", str(wrong), "-o", str(tmp_path / "c.toml")]
    assert main(["calibrate", *words]) == 1
    told = capsys.readouterr().err.strip()
    assert "mask" in told
    assert "\n" not in told
    assert not (tmp_path / "c.toml").exists()
    assert main(["calibrate", *words, "--anyway"]) == 0
    assert "in doubt: calibration: neither law explains" in capsys.readouterr().err
    assert [one.code for one in calibration_files.load(tmp_path / "c.toml").doubts] == [Code.LAW_NEITHER]
    frame = [*words[:-2], "--calibration", str(tmp_path / "c.toml"), "-o", str(tmp_path / "f.npz")]
    assert main(["decode", *frame]) == 1
    (doubt,) = light_files.load(tmp_path / "f.npz").doubts
    assert doubt.code is Code.LAW_NEITHER
    assert f"in doubt: {findings.told(doubt)}\n" in capsys.readouterr().err


def test_a_dark_frame_is_taken_off_and_one_of_another_size_is_refused(
    frames: Frames, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dark = np.full((694, 922), 1024, dtype=np.uint16)
    dark[::7, ::5] += 300  # warm pixels
    dark[100, 200] = 15000  # and one that glows
    np.save(tmp_path / "dark.npy", dark)
    words = ["calibrate", *frames("geometric")[:1], "--camera", str(profile), "--mask", MASK]
    assert main([*words, "--dark", str(tmp_path / "dark.npy"), "-o", str(tmp_path / "c.toml")]) == 0
    np.save(tmp_path / "dark.npy", dark[:600])
    capsys.readouterr()
    assert main([*words, "--dark", str(tmp_path / "dark.npy"), "-o", str(tmp_path / "c.toml"), "--overwrite"]) == 1
    told = capsys.readouterr().err
    assert "dark frame" in told
    assert "600×922" in told
