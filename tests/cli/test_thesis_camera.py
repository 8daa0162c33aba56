"""The thesis' camera at the command line: a 450D behind Mask 2, by rays, as a stranger's files would be."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled.cli import main
from dappled.drivers.raw import calibration_files
from dappled.findings import Code
from dappled.mocks.scene import dng
from dappled.products.exports import light_files
from tests.decode.ray_frames import MASKS, Body, Shot

FULL = Body((2856, 4290), (0.0051948051948, 0.0051948051948), "450D, whole")
QUARTER = replace(FULL, shape=(714, 1072), scale="450D, a quarter of its sides")
PROFILE = (
    'law = "fd"\nmask_distance_mm = 1.01\n[[raw]]\nname = "a quarter"\nshape = [714, 1072]\n'
    "row_mm = [0.0051948051948, 0.0]\ncolumn_mm = [0.0, 0.0051948051948]\n"
)


def dng_of(path: Path, shot: Shot, plane: np.ndarray, *, colours: bool = False, told: bool = True) -> Path:
    """A DNG of a plane; `colours` with an RGGB pattern of a warm light, not `told` from behind a manual lens."""
    black, white = 1024, 15000
    light = plane.astype(np.float64) * 0.8
    if colours:
        light[::2, ::2] *= 0.6
        light[1::2, 1::2] *= 0.45
    raw = np.clip(black + light * (white - black), 0, white).astype(np.uint16)
    exif = dng.Exif("Canon", "Canon EOS 450D", "1", shot.focal_length_mm, shot.f_number if told else 0.0, 1e-2, 100, 0)
    path.write_bytes(dng.encode(raw, black=black, white=white, exif=exif, mono=not colours))
    return path


def _quarter(folder: Path) -> list[str]:
    (folder / "quarter.toml").write_text(PROFILE)
    return ["--camera", str(folder / "quarter.toml"), "--mask", "mask-2"]


@pytest.mark.long
def test_the_readme_s_calibrate_command_works_on_a_450d_behind_mask_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = re.findall(
        r"^dappled (calibrate white-f22\.cr2 --mask .*?)\s*(?:#.*)?$", Path("README.md").read_text(), re.M
    )
    shot = Shot(MASKS["mask-2"], FULL, 50.0, 22.0, turn_deg=0.7, finer=1)
    dng_of(tmp_path / "white-f22.dng", shot, shot.frame(), colours=True)
    words = line.replace("white-f22.cr2", str(tmp_path / "white-f22.dng")).split()
    words[words.index("-o") + 1] = str(tmp_path / "calibration.toml")
    assert main(words) == 0, capsys.readouterr().err
    found = calibration_files.load(tmp_path / "calibration.toml")
    orders = np.array([(1, 1), (1, -1), (2, 2), (2, -2)])
    off = orders @ (found.fits[0].lattice.matrix() - shot.lattice) * FULL.shape
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.1
    assert found.law == "geometric"
    assert found.verdict is not None
    assert (found.verdict.code, found.verdict.facts["law"]) == (Code.LAW_ONLY, "geometric")


def test_calibrate_tells_which_orders_it_did_not_see(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Behind Mask 2, told that it were Mask 3: the second harmonic is averaged out, the fourth isn't there."""
    shot = Shot(MASKS["mask-2"], QUARTER, 50.0, 22.0, turn_deg=0.7, seed=2)
    frame = str(dng_of(tmp_path / "white.dng", shot, shot.frame()))
    words = _quarter(tmp_path)
    words[words.index("mask-2")] = "mask-3"
    assert main(["calibrate", frame, *words, "-o", str(tmp_path / "c.toml")]) == 0
    told = capsys.readouterr().out
    assert re.search(r"^transfer \(1,-1\) 0\.2\d+ \(1,1\) 0\.2\d+ \(2,-2\) unknown \(2,2\) unknown$", told, re.M)
    assert "not seen: (4,-4) (4,4) (8,-8) (8,8); a mask without them has the same carriers at f/22" in told


def test_the_law_that_the_frame_obeys_is_used_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=1.0, scene="texture", seed=2)
    frame = str(dng_of(tmp_path / "f.dng", shot, shot.frame()))
    words = [frame, *_quarter(tmp_path)]
    assert main(["decode", *words, "-o", str(tmp_path / "f.npz")]) == 0
    assert "by the law geometric (odds against chance: fd shows nothing; geometric 10^" in capsys.readouterr().out
    made = light_files.load(tmp_path / "f.npz")
    assert made.attributes["law"] == "geometric"
    assert made.attributes["carriers_from"] == "measured"
    assert made.attributes["doubts"] == []
    at = {(int(ky), int(kx)): (fy, fx) for ky, kx, fy, fx in made.carriers}
    assert np.abs((np.array(at[1, 1]) - (1, 1) @ shot.lattice) * QUARTER.shape).max() < 0.1
    assert main(["carriers", *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["law"] == "geometric"
    assert {one["law"]: one["odds_nats"] is not None for one in told["laws"]} == {"fd": False, "geometric": True}


def test_a_frame_that_must_show_carriers_and_does_not_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, scene="white")
    words = [str(dng_of(tmp_path / "bare.dng", shot, shot.without_film())), *_quarter(tmp_path)]
    assert main(["decode", *words, "-o", str(tmp_path / "f.npz")]) == 1
    told = capsys.readouterr().err
    assert "should stand out at f/22" in told
    assert "--anyway" in told
    assert "\n" not in told.strip()
    assert not (tmp_path / "f.npz").exists()
    assert main(["carriers", *words]) == 1
    assert main(["calibrate", *words, "-o", str(tmp_path / "c.toml")]) == 1
    assert not (tmp_path / "c.toml").exists()
    capsys.readouterr()
    assert main(["decode", *words, "--anyway", "-o", str(tmp_path / "f.npz")]) == 0
    assert "should stand out at f/22" in capsys.readouterr().out
    (doubt,) = light_files.load(tmp_path / "f.npz").doubts
    assert doubt.code is Code.CARRIERS_UNSEEN


def test_where_no_carrier_can_be_seen_that_is_no_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 1.8, scene="texture", exponent=1.1, snr=30.0)
    words = [str(dng_of(tmp_path / "open.dng", shot, shot.frame())), *_quarter(tmp_path)]
    assert main(["decode", *words, "-o", str(tmp_path / "f.npz")]) == 0
    assert "not observable at this aperture" in capsys.readouterr().out
    assert light_files.load(tmp_path / "f.npz").attributes["carriers_found"] is None
    assert main(["carriers", *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["observable"] is False
    assert told["reason"]["code"] == "carriers.unobservable"


TEXTURED = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=1.0, scene="texture", seed=2, finer=2)


@pytest.fixture(scope="module")
def textured() -> np.ndarray:
    return TEXTURED.frame()


def test_behind_a_lens_that_tells_no_f_number_the_carriers_are_found_or_nothing_is_claimed(
    textured: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = str(dng_of(tmp_path / "manual.dng", TEXTURED, textured, told=False))
    assert main(["decode", frame, *_quarter(tmp_path), "-o", str(tmp_path / "f.npz")]) == 0
    made = light_files.load(tmp_path / "f.npz")
    assert (made.attributes["law"], made.attributes["f_number"], made.attributes["doubts"]) == ("geometric", None, [])
    at = {(int(ky), int(kx)): (fy, fx) for ky, kx, fy, fx in made.carriers}
    assert np.abs((np.array(at[1, 1]) - (1, 1) @ TEXTURED.lattice) * QUARTER.shape).max() < 0.1
    bare = str(dng_of(tmp_path / "bare.dng", TEXTURED, TEXTURED.without_film(), told=False))
    assert main(["decode", bare, *_quarter(tmp_path), "-o", str(tmp_path / "b.npz")]) == 1
    made = light_files.load(tmp_path / "b.npz")
    assert made.attributes["carriers_found"] is None
    assert [one.code for one in made.doubts] == [Code.CARRIERS_UNCONFIRMED]
    capsys.readouterr()
    assert main(["carriers", bare, *_quarter(tmp_path)]) == 1
    assert "the f-number is unknown" in capsys.readouterr().err


@pytest.mark.parametrize("law", ["fd", "geometric"])
def test_a_law_that_is_asked_for_is_checked_all_the_same(
    law: str, textured: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*_quarter(tmp_path), "--law", law]
    if law == "geometric":
        frame = dng_of(tmp_path / "bare.dng", TEXTURED, TEXTURED.without_film())
    else:
        frame = dng_of(tmp_path / "other-law.dng", TEXTURED, textured)
    assert main(["decode", str(frame), *words, "-o", str(tmp_path / "f.npz")]) == 1
    told = capsys.readouterr().err
    assert ("should stand out at f/22" if law == "geometric" else "but where geometric has") in told
    assert main(["carriers", str(frame), *words]) == 1


def test_one_peak_of_the_scene_does_not_hide_that_a_calibration_is_wrong(
    textured: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = _quarter(tmp_path)
    frame = dng_of(tmp_path / "f.dng", TEXTURED, textured)
    assert main(["calibrate", str(frame), *words, "-o", str(tmp_path / "c.toml")]) == 0
    rows, columns = np.indices(QUARTER.shape)
    fy, fx = np.array([1, 1]) @ TEXTURED.lattice
    peak = 1 + 0.1 * np.cos(2 * np.pi * (fy * rows + fx * columns))
    bare = dng_of(tmp_path / "bare.dng", TEXTURED, TEXTURED.without_film() * peak)
    capsys.readouterr()
    made = [*words, "--calibration", str(tmp_path / "c.toml"), "-o", str(tmp_path / "b.npz")]
    assert main(["decode", str(bare), *made]) == 1
    assert "should stand out at f/22 where the calibration has them, and" in capsys.readouterr().err


def test_a_full_mask_is_no_diagonal_one_of_its_period(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = replace(TEXTURED, film=MASKS["mask-2-full"])
    frame = dng_of(tmp_path / "full.dng", shot, shot.frame())
    assert main(["decode", str(frame), *_quarter(tmp_path), "-o", str(tmp_path / "f.npz")]) == 1
    assert "a full mask of its period" in capsys.readouterr().err
    geometric = tmp_path / "geometric.toml"
    geometric.write_text(PROFILE.replace('"fd"', '"geometric"'))
    words = [str(frame), "--camera", str(geometric), "--mask", "mask-2", "-o", str(tmp_path / "g.npz")]
    assert main(["decode", *words]) == 1


def test_the_advice_where_no_carrier_can_be_seen_is_what_the_lens_can_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = replace(TEXTURED, f_number=4.0)
    frame = dng_of(tmp_path / "open.dng", shot, shot.without_film())
    camera, words = _quarter(tmp_path)[1], ["--mask", "mask-2"]
    Path(camera).write_text("f_number = [1.8, 8.0]\n" + PROFILE)
    assert main(["calibrate", str(frame), "--camera", camera, *words, "-o", str(tmp_path / "c.toml")]) == 1
    told = capsys.readouterr().err
    assert "the lens ends at f/8, where no carrier can be counted on" in told
    assert "f/34" not in told
