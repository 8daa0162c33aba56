"""`dappled calibrate --kit` on frames by rays (`ray_frames`), which shares no arithmetic with dappled."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main
from dappled.cli.calibrate.frames import fit_views
from dappled.cli.calibrate.kit import MaskResult, _agree, _lines
from dappled.decode.calibration.law_choice import CALIBRATION, LawFit
from dappled.drivers.raw import calibration_files
from dappled.findings import Code, Finding, finding
from tests.cli.test_thesis_camera import dng_of
from tests.decode.ray_frames import CANON, Body, Film, Shot, Stop

BODY = Body((356, 536), CANON.pitch_mm, "450D, an eighth of its sides")
PROFILE = (
    'law = "fd"\nmask_distance_mm = 1.01\nfocal_length_mm = [28.0, 85.0]\nf_number = [4.0, 32.0]\n'
    '[[raw]]\nname = "an eighth"\nshape = [356, 536]\n'
    f"row_mm = [{CANON.pitch_mm[0]}, 0.0]\ncolumn_mm = [0.0, {CANON.pitch_mm[1]}]\n"
)
LENGTHS, STOPS = (28.0, 85.0), (16.0, 32.0)
DISTANCE_MM, SCALE = 0.95, 1.015

Told = Callable[..., tuple[int, dict[str, Any], str]]


def _shot(name: str, length: float, stop: float, *, scale: float = SCALE, seed: int = 0) -> Shot:
    film = Film(11.38, 2, name, scale=scale)  # type: ignore[arg-type]  # full or diagonal
    return Shot(
        film, BODY, length, stop, distance_mm=DISTANCE_MM, turn_deg=1.1, stop=Stop("polygon", 6), seed=seed, finer=2
    )


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A kit as it was shot: 2 focal lengths at 2 stops, both masks printed 1.5 % too fine, and a bare frame."""
    folder = tmp_path_factory.mktemp("shot")
    for name in ("full", "diagonal"):
        (folder / name).mkdir()
        for length in LENGTHS:
            for stop in STOPS:
                shot = _shot(name, length, stop)
                dng_of(folder / name / f"{length:g}mm-f{stop:g}.dng", shot, shot.frame())
    (folder / "bare").mkdir()
    shot = _shot("full", 28.0, 32.0)
    dng_of(folder / "bare" / "28mm-f32.dng", shot, shot.without_film())
    return folder


@pytest.fixture
def kit(tmp_path: Path, frames: Path) -> Path:
    """The folder of the kit, its frames in place."""
    folder = tmp_path / "kit"
    shutil.copytree(frames, folder)
    (tmp_path / "eighth.toml").write_text(PROFILE)
    (folder / "kit.toml").write_text(
        f'camera = "{tmp_path / "eighth.toml"}"\nfocal_lengths_mm = {list(LENGTHS)}\nf_numbers = {list(STOPS)}\n'
    )
    for name in ("full", "diagonal"):
        (folder / f"{name}.toml").write_text(f'p = 2\nfrequency_per_mm = 11.38\npattern = "{name}"\n')
    return folder


@pytest.fixture
def told(kit: Path, capsys: pytest.CaptureFixture[str]) -> Told:
    """Run the command on the kit: exit code, JSON, what it says on stderr."""

    def run(*words: str) -> tuple[int, dict[str, Any], str]:
        capsys.readouterr()
        code = main(["calibrate", "--kit", str(kit), "--json", *words])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else {}, err

    return run


def _only(kit: Path, *names: str) -> None:
    for path in kit.glob("*/*.dng"):
        if path.relative_to(kit).as_posix() not in names:
            path.unlink()


@pytest.mark.slow
def test_law_distance_and_a_wrong_print_scale_are_told_with_their_errors(
    kit: Path, told: Told, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, values, err = told("-o", str(tmp_path / "c.toml"))
    assert (code, values["doubts"], err) == (0, [], "")
    assert values["agree"] is True
    assert values["bare_clean"] == 1
    for one in values["masks"].values():
        assert one["law"] == "geometric"
        assert abs(one["mask_distance_mm"] - DISTANCE_MM) < 2 * one["mask_distance_sigma_mm"] < 0.2
        assert abs(one["print_scale"] - SCALE) < 2 * one["print_scale_sigma"] < 0.008
    frame = str(kit / "full" / "28mm-f16.dng")
    words = [frame, "--camera", str(tmp_path / "eighth.toml"), "--mask", str(kit / "full.toml")]
    assert main(["decode", *words, "--calibration", str(tmp_path / "c.toml"), "-o", str(tmp_path / "f.npz")]) == 0
    capsys.readouterr()
    assert main(["calibrate", "--kit", str(kit)]) == 0
    text = capsys.readouterr().out
    assert "diagonal: 4 frames used\n  law geometric, mask 0.9" in text
    assert "the masks agree" in text


def test_one_focal_length_at_one_stop_cannot_tell(kit: Path, told: Told) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng", "bare/28mm-f32.dng")
    code, values, err = told()
    assert code == 1
    assert "mask full: cannot tell the mask's distance from the print's scale" in err
    assert "mask full: 3 of 4 shots are missing, of these: 28 mm at f/16, 85 mm at f/16, 85 mm at f/32" in err
    assert values["masks"]["full"]["mask_distance_sigma_mm"] is None


def test_what_lies_in_the_wrong_place_or_cannot_be_read_is_named(kit: Path, told: Told, tmp_path: Path) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng")
    (kit / "full/28mm-f32.dng").rename(kit / "bare/film-in-place.dng")
    (kit / "full/broken.dng").write_bytes(b"II*\0 not a raw")
    code, values, err = told("-o", str(tmp_path / "c.toml"))
    assert code == 1
    assert "film-in-place.dng: it shows the mask's carriers without a mask" in err
    assert "broken.dng" in err
    assert values["masks"]["full"]["law"] is None
    assert values["agree"] is None
    assert not (tmp_path / "c.toml").exists()


def test_exchanged_masks_are_seen(kit: Path, told: Told) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng")
    (kit / "full/28mm-f32.dng").rename(kit / "full.dng")
    (kit / "diagonal/28mm-f32.dng").rename(kit / "full/28mm-f32.dng")
    (kit / "full.dng").rename(kit / "diagonal/28mm-f32.dng")
    code, _, err = told()
    assert code == 1
    assert "the orders (0, 1) and (1, 0) stand out, which this diagonal mask doesn't make" in err
    assert "another mask" in err
    assert "bare frames: no frame without a mask" in err


@pytest.mark.long
def test_prints_of_two_sizes_disagree(kit: Path, told: Told, tmp_path: Path) -> None:
    for stop in STOPS:
        shot = _shot("diagonal", 28.0, stop, scale=1.03)
        dng_of(kit / "diagonal" / f"28mm-f{stop:g}.dng", shot, shot.frame())
    _only(kit, *(f"{name}/28mm-f{stop:g}.dng" for name in ("full", "diagonal") for stop in STOPS))
    code, values, err = told()
    assert code == 1
    assert values["agree"] is False
    assert "the masks disagree: prints of 1.0" in err
    assert told("--anyway", "-o", str(tmp_path / "c.toml"))[0] == 0
    assert Code.KIT_PRINTS_DISAGREE in {one.code for one in calibration_files.load(tmp_path / "c.toml").doubts}


def test_wrong_calls_and_folders_are_refused_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "--kit", str(tmp_path)]) == 1
    assert "is no test kit, it has no kit.toml" in capsys.readouterr().err
    (tmp_path / "kit.toml").write_text('camera = "canon-eos-450d"\nf_numbers = []\n')
    assert main(["calibrate", "--kit", str(tmp_path)]) == 1
    assert "doesn't name camera, focal_lengths_mm and f_numbers" in capsys.readouterr().err
    assert main(["calibrate", "--kit", str(tmp_path), "frame.dng"]) == 2
    assert main(["calibrate", "--mask", "mask-2"]) == 2
    assert "name the frames, and the calibration to write with -o" in capsys.readouterr().err


def _asks(kit: Path, lengths: list[float], stops: list[float]) -> None:
    camera = (kit / "kit.toml").read_text().splitlines()[0]
    (kit / "kit.toml").write_text(f"{camera}\nfocal_lengths_mm = {lengths}\nf_numbers = {stops}\n")


def _blank(path: Path, stop: float) -> None:
    """A frame at 28 mm in which no carrier can be seen: as with a mask before a stop as wide as this."""
    shot = _shot("full", 28.0, stop)
    dng_of(path, shot, shot.without_film())


@pytest.mark.parametrize("words", [(), ("--anyway",)])
def test_a_mask_of_which_no_frame_shows_anything_is_in_doubt_and_writes_nothing(
    kit: Path, told: Told, tmp_path: Path, words: tuple[str, ...]
) -> None:
    _only(kit, "diagonal/28mm-f32.dng", "bare/28mm-f32.dng")
    _asks(kit, [28.0], [4.0])
    for name in ("full", "diagonal"):
        _blank(kit / name / "wide.dng", 4.0)
    code, values, err = told("-o", str(tmp_path / "c.toml"), *words)
    assert code == 1
    assert values["masks"]["full"]["frames_unseen"] == 1
    assert "mask full: no frame shows carriers" in err
    assert "nothing written: no frame of the full mask shows its carriers" in err
    assert not (tmp_path / "c.toml").exists()


def test_frames_of_one_shot_do_not_stand_for_another(kit: Path, told: Told) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng", "bare/28mm-f32.dng")
    _asks(kit, [28.0], [4.0, 16.0, 32.0])
    _blank(kit / "full" / "wide.dng", 4.0)
    _blank(kit / "full" / "again.dng", 4.0)
    _, _, err = told()
    assert "mask full: 1 of 3 shots are missing, of these: 28 mm at f/16" in err


def test_a_bare_frame_at_a_stop_that_hides_carriers_proves_nothing(kit: Path, told: Told) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng")
    _blank(kit / "bare" / "wide.dng", 4.0)
    _, values, err = told()
    assert values["bare_clean"] == 0
    assert "bare frames: at the stop of 1 of its frames no carrier could be seen with a mask, either" in err


def test_a_bare_frame_at_a_stop_where_the_mask_was_seen_counts(kit: Path, told: Told) -> None:
    """At f/8 a stop of some shapes hides the carriers; this camera's doesn't, as its masked frame shows."""
    _only(kit)
    _asks(kit, [28.0], [8.0])
    shot = _shot("diagonal", 28.0, 8.0)
    dng_of(kit / "diagonal" / "f8.dng", shot, shot.frame())
    _blank(kit / "bare" / "f8.dng", 8.0)
    _, values, err = told()
    assert values["masks"]["diagonal"]["frames_used"] == 1
    assert values["bare_clean"] == 1
    assert "bare" not in err


def _result(law: str, distance_mm: float, sigma_mm: float | None) -> MaskResult:
    return MaskResult(1, 0, None, _fit(law, distance_mm, sigma_mm))


def _fit(law: str, distance_mm: float = 1.0, sigma_mm: float | None = None, explains: bool = True) -> LawFit:
    return LawFit(law, distance_mm, 0.0, None, None, 0.1, explains, distance_sigma_mm=sigma_mm)


@pytest.mark.parametrize(
    ("law", "sigma_mm", "told"),
    [
        ("geometric", 0.02, "mask 1.234 ± 0.020 mm before the sensor"),
        ("geometric", None, "mask 1.234 mm (stated) before the sensor"),
        ("fd", None, "mask 1.234 mm (fitted, error unknown) before the sensor"),
    ],
)
def test_a_distance_is_told_with_how_it_is_known(law: str, sigma_mm: float | None, told: str) -> None:
    assert f"  law {law}, {told}" in _lines({"full": _result(law, 1.234, sigma_mm)}, 0, None)


@pytest.mark.parametrize(
    ("law", "sigma_mm", "agree"), [("geometric", None, None), ("geometric", 0.01, False), ("fd", None, False)]
)
def test_a_stated_distance_is_not_compared_with_a_fitted_one(
    law: str, sigma_mm: float | None, agree: bool | None
) -> None:
    doubts: list[Finding] = []
    other = None if law == "fd" else 0.01
    results = {"diagonal": _result(law, 1.25, other), "full": _result(law, 1.01, sigma_mm)}
    assert _agree(results, doubts) is agree
    assert bool(doubts) is (agree is False)


def test_each_doubt_is_stored_once(kit: Path, told: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _only(kit, "full/28mm-f32.dng", "diagonal/28mm-f32.dng", "bare/28mm-f32.dng")
    _asks(kit, [28.0], [32.0])
    monkeypatch.setattr(
        "dappled.cli.calibrate.kit.fit_views",
        lambda *words, **named: replace(
            fit_views(*words, **named),
            verdict=finding(Code.LAW_NEITHER, CALIBRATION, fits="", stated_mm=1.0),
            law="fd",
            overridden=(finding(Code.FRAME_DEVELOPED, CALIBRATION, why="a JPEG"),),
        ),
    )
    monkeypatch.setattr("dappled.decode.calibration.report.law_fits", lambda *_: [_fit("geometric", explains=False)])
    assert told("--anyway", "-o", str(tmp_path / "c.toml"))[0] == 0
    codes = [one.code for one in calibration_files.load(tmp_path / "c.toml").doubts]
    assert codes.count(Code.FRAME_DEVELOPED) == codes.count(Code.LAW_NEITHER) == 2  # one of each mask
