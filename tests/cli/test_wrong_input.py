"""Frames that are not what they are said to be, at the command line: each gets a sentence, none passes in silence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.cli import main
from dappled.drivers.raw import calibration_files
from dappled.findings import Code
from dappled.products.exports import light_files
from tests.cli.test_thesis_camera import QUARTER, dng_of
from tests.cli.test_thesis_camera import _quarter as quarter
from tests.decode.ray_frames import MASKS, Shot

Grid = NDArray[np.float64]
SHOT = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=0.7, scene="texture", seed=4, finer=2)
MASK_PERIOD_PX = 1 / float(np.hypot(*SHOT.lattice[0]))  # of one step: its diagonals are √2 finer


def _wave(period_px: float, angle_deg: float) -> Grid:
    y, x = np.mgrid[0 : QUARTER.shape[0], 0 : QUARTER.shape[1]]
    angle = np.radians(angle_deg)
    return np.asarray((x * np.cos(angle) + y * np.sin(angle)) / period_px)


def _fence(scene: Grid) -> Grid:
    return np.asarray(scene * (0.4 + 0.6 * (_wave(23.7, 2) % 1 < 0.7)))


def _chain_link(scene: Grid) -> Grid:
    return np.asarray(scene * (1 - 0.7 * ((_wave(17.3, 46) % 1 < 0.15) | (_wave(17.3, -44) % 1 < 0.15))))


def _cloth(scene: Grid) -> Grid:
    return np.asarray(
        scene * (1 + 0.25 * np.sign(np.sin(2 * np.pi * _wave(7.3, 3)) * np.sin(2 * np.pi * _wave(7.9, 93))))
    )


def _halftone(scene: Grid) -> Grid:
    dots = np.cos(2 * np.pi * _wave(9.1, 45)) + np.cos(2 * np.pi * _wave(9.1, -45))
    return np.asarray(0.05 + (dots / 2 > 1 - 4 * scene))


def _halftone_near_the_mask(scene: Grid) -> Grid:
    dots = [np.cos(2 * np.pi * _wave(1.07 * MASK_PERIOD_PX / np.sqrt(2), angle)) for angle in (46, -44)]
    return np.asarray(scene * (1 + 0.3 * dots[0] + 0.3 * dots[1]))


def _screen(scene: Grid) -> Grid:
    return np.asarray(scene * (0.3 + 0.7 * (_wave(5.37, 0.8) % 1 < 0.7) * (_wave(5.37, 90.8) % 1 < 0.8)))


@pytest.fixture(scope="module")
def bare() -> Grid:
    return SHOT.without_film().astype(np.float64)


@pytest.fixture(scope="module")
def masked() -> NDArray[np.float32]:
    return SHOT.frame()


def _noisy(plane: Grid) -> NDArray[np.float32]:
    plane = np.clip(plane, 0.01, None) * 0.35 / plane.mean()
    noise = np.random.default_rng(3).normal(size=plane.shape) * np.sqrt(plane * 0.35) / 100
    return np.clip(plane + noise, 0, 1).astype(np.float32)


def _refused(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The sentences of decode, carriers and calibrate, each of which must fail and leave no file."""
    told = []
    for verb, more in (
        ("decode", ["-o", str(folder / "f.npz")]),
        ("carriers", []),
        ("calibrate", ["-o", str(folder / "c.toml")]),
    ):
        assert main([verb, *words, *more]) == 1, verb
        sentence, *more_said = capsys.readouterr().err.strip().splitlines()
        assert more_said in ([], [f"dappled {verb}: done, but in doubt: see above; --anyway accepts that"])
        told.append(sentence)
    assert not (folder / "f.npz").exists()
    assert not (folder / "c.toml").exists()
    return told


@pytest.mark.parametrize(
    "pattern",
    [
        _fence,
        _halftone_near_the_mask,
        *(pytest.param(one, marks=pytest.mark.slow) for one in (_chain_link, _cloth, _halftone, _screen)),
    ],
)
def test_a_period_of_the_scene_is_no_light_field(
    pattern: Callable[[Grid], Grid], bare: Grid, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = dng_of(tmp_path / "f.dng", SHOT, _noisy(pattern(bare)))
    decode, carriers, _ = _refused([str(path), *quarter(tmp_path)], tmp_path, capsys)
    assert "pattern of the scene (fence, woven cloth, halftone print, a screen)" in decode
    assert "or another mask" in carriers or "or to another mask" in carriers


@pytest.mark.parametrize(
    ("named", "told"),
    [
        ("mask-1", "stronger peaks stand half-way between this mask's carriers: another mask, of double periods"),
        ("mask-4", "which should stand out as well: another mask"),
    ],
)
def test_another_mask_than_the_camera_s_is_told(
    named: str, told: str, masked: NDArray[np.float32], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(dng_of(tmp_path / "f.dng", SHOT, masked)), *quarter(tmp_path)[:2], "--mask", named]
    for sentence in _refused(words, tmp_path, capsys):
        assert told in sentence


def test_another_body_is_told(masked: NDArray[np.float32], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = dng_of(tmp_path / "f.dng", SHOT, masked)
    for verb in (["carriers"], ["decode", "-o", str(tmp_path / "f.npz")]):
        assert main([verb[0], str(frame), "--camera", "fujifilm-s5200", "--mask", "mask-2", *verb[1:]]) == 2
        assert "this one is 714 × 1072; choose another camera" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["jpeg", "clipped"])
def test_what_is_not_linear_is_no_calibration_and_a_doubt_of_the_light_field(
    kind: str, masked: NDArray[np.float32], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "jpeg":
        path, told, code = tmp_path / "f.jpg", "it is a JPEG: its tones are not linear", Code.FRAME_DEVELOPED
        Image.fromarray((255 * (masked / masked.max()) ** (1 / 2.2)).astype(np.uint8)).save(path, quality=85)
    else:
        path = dng_of(tmp_path / "f.dng", SHOT, np.clip(masked * 3.2, 0, 1.3))
        told, code = "of its pixels are clipped", Code.FRAME_CLIPPED
    words = [str(path), *quarter(tmp_path), "--focal-length", "85", "--f-number", "22"]
    assert main(["calibrate", *words, "-o", str(tmp_path / "c.toml")]) == 1
    assert told in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()
    assert main(["calibrate", *words, "--anyway", "-o", str(tmp_path / "c.toml")]) == 0
    assert f"in doubt: calibration frame {path.name}: " in capsys.readouterr().err
    known = calibration_files.load(tmp_path / "c.toml")
    assert known.overridden[0].code is code
    assert known.overridden[0] in known.doubts
    assert known.verdict is not None
    assert (known.verdict in known.doubts) == (known.verdict.code is Code.LAW_NEITHER)
    assert main(["decode", *words, "-o", str(tmp_path / "f.npz")]) == 1
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("in doubt: ")
    assert last == "dappled decode: done, but in doubt: see above; --anyway accepts that"
    assert code in {one.code for one in light_files.load(tmp_path / "f.npz").doubts}
    assert main(["decode", *words, "--anyway", "-o", str(tmp_path / "g.npz")]) == 0
    said = capsys.readouterr().err
    assert "in doubt: " in said
    assert "--anyway" not in said
    good = str(dng_of(tmp_path / "good.dng", SHOT, masked))
    assert main(["decode", good, *words, "-o", str(tmp_path / "both")]) == 1
    assert "done, but in doubt, 1 of 2 frames: see above" in capsys.readouterr().err


def test_the_same_frame_as_it_is_passes_without_a_doubt(masked: NDArray[np.float32], tmp_path: Path) -> None:
    words = [str(dng_of(tmp_path / "f.dng", SHOT, masked)), *quarter(tmp_path)]
    assert main(["decode", *words, "-o", str(tmp_path / "f.npz")]) == 0
    assert light_files.load(tmp_path / "f.npz").attributes["doubts"] == []
    assert main(["calibrate", *words, "-o", str(tmp_path / "c.toml")]) == 0


def test_vignetting_is_a_doubt_unless_a_white_frame_takes_it_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y, x = (np.linspace(-1, 1, side) for side in QUARTER.shape)
    masked = replace(SHOT, scene="white").frame()
    lens = 1 - 0.25 * (y[:, None] ** 2 + x**2)
    frame = dng_of(tmp_path / "f.dng", SHOT, masked * lens)
    white = dng_of(tmp_path / "w.dng", SHOT, np.full(QUARTER.shape, 0.4) * lens)
    words = ["decode", str(frame), *quarter(tmp_path), "-o", str(tmp_path / "f.npz"), "--overwrite"]
    assert main(words) == 1
    assert "in doubt: its corners have " in capsys.readouterr().err
    attributes = light_files.load(tmp_path / "f.npz").attributes
    lost, sigma = attributes["falloff"]
    assert abs(lost - 0.5) < 3 * sigma
    assert [one["code"] for one in attributes["doubts"]] == ["frame.vignetted"]
    assert main([*words, "--white", str(white)]) == 0
    assert "its corners" not in capsys.readouterr().err
    attributes = light_files.load(tmp_path / "f.npz").attributes
    assert (attributes["falloff"], attributes["doubts"]) == (None, [])
    bright = dng_of(tmp_path / "bright.dng", SHOT, np.full(QUARTER.shape, 1.3) * lens)
    assert main([*words, "--white", str(bright)]) == 1
    assert "in doubt: white frame: " in capsys.readouterr().err


def test_names_of_files_are_shown_without_what_a_terminal_obeys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [str(tmp_path / f"{name}\x1b[2J.dng") for name in "ab"]
    assert main(["decode", *frames, "--mask", "reference-5x5", "-o", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    assert "\x1b" not in shown.out + shown.err
    assert "\\x1b[2J.dng" in shown.err
