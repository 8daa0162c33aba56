"""`dappled mask`: from altitude to film, and what the bench says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dappled.cli import main
from tests.decode.thesis_tables import TABLE_11, TABLE_14_LENGTHS, TABLE_14_V


def _json(words: list[str], capsys: pytest.CaptureFixture[str], code: int = 0) -> dict[str, Any]:
    assert main([*words, "--json"]) == code
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return told


def test_table_11_and_14_by_command(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["mask", "table", "--camera", "fujifilm-s5200", "--mask"]
    rows = _json([*words, "mask-2"], capsys)["rows"]
    assert isinstance(rows, list)
    for row, (length, printed) in zip(rows, TABLE_11.items(), strict=True):
        assert row["focal_length_mm"] == length
        found = [h[key] for key in ("horizontal_px", "vertical_px") for h in row["harmonics"]]
        assert found == pytest.approx(printed[2:], abs=1)
    lengths = ["--focal-length", *map(str, TABLE_14_LENGTHS)]
    rows = _json([*words, "mask-4", *lengths], capsys)["rows"]
    assert isinstance(rows, list)
    assert [r["harmonics"][0]["vertical_px"] for r in rows] == pytest.approx(TABLE_14_V[5], abs=1)
    assert main([*words, "mask-2"]) == 0
    assert "2453*" in capsys.readouterr().out
    assert main([*words, "mask-2", "--carriers", "--focal-length", "13", "--rotation", "1"]) == 0
    assert "crossed" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["m.png", "m.tif"])
def test_make_writes_the_thesis_negative(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["mask", "make", "mask-2", "--size-mm", "2", "3", "--overwrite", "-o", str(tmp_path / name)]
    told = _json([*words, "--negative"], capsys)
    assert told["period_px"] == [10, 10]
    negative = np.asarray(Image.open(tmp_path / name)).astype(int)
    _json(words, capsys)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / name)) + negative, 255)
    assert negative.shape == (228, 341)
    spectrum = np.abs(np.fft.fft2(255 - negative[:220, :340])) / 220 / 340 / 255
    assert {(22, 34), (44, 68)} <= {(int(y), int(x)) for y, x in np.argwhere(spectrum > 0.02)}


def test_make_warns_of_mask_4_and_compensates_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "curve.csv").write_text("level,density\n0,2\n64,1.6\n128,1.1\n192,0.5\n255,0.1\n")
    out = str(tmp_path / "m.png")
    words = ["mask", "make", "mask-4", "--size-mm", "2", "3", "-o", out, "--curve", str(tmp_path / "curve.csv")]
    assert main([*words, "--drawable-only", "--bits", "16"]) == 0
    err = capsys.readouterr().err
    assert err.count("warning: harmonic") == 6
    assert "left out" in err
    assert main(["mask", "make", "--wedge", "11", "--overwrite", "-o", out]) == 0
    assert len(np.unique(np.asarray(Image.open(out)))) == 11


def test_diffraction_judges_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = tmp_path / "bench.csv"
    bench.write_text("x_mm,y_mm\n" + "".join(f"{a * k},{b * k}\n" for k in (3, 7) for a in (1, -1) for b in (1, -1)))
    for mask, code, said in (
        ("mask-1", 1, "printed 2 times as large as designed, or another mask: "),
        ("mask-2", 0, "as designed: 8 spots within 0.54 mm of where they should be\n"),
        ("mask-3", 0, "as designed: 8 spots within 0.54 mm of where they should be; 8 fainter"),
        ("reference-5x5", 1, "not this mask"),
    ):
        assert main(["mask", "diffraction", "--mask", mask, "--measured", str(bench)]) == code
        out = capsys.readouterr().out
        assert out.startswith(said)
        assert ("these are the spots of mask-2" in out) == (code == 1)
    picture = tmp_path / "wall.png"
    told = _json(["mask", "diffraction", "--mask", "mask-2", "--picture", str(picture)], capsys)
    assert isinstance(told["impulses"], list)
    assert len(told["impulses"]) == 9
    wall = np.asarray(Image.open(picture))
    assert wall[wall.shape[0] // 2, wall.shape[1] // 2] == 255
    assert np.median(wall) == 0


def test_design_from_altitude_to_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "layout.png"
    camera = ["--altitude", "40", "--camera", "fujifilm-s5200"]
    told = _json(["mask", "design", *camera, "--focal-length", "13", "--picture", str(picture)], capsys)
    assert told["works"]
    assert told["films"] == ["4k", "8k", "16k"]
    assert np.asarray(Image.open(picture)).max() > 200
    assert main(["mask", "design", "--altitude", "40", "--camera", "reference-36mm"]) == 1
    assert "27.76 of at most 24 mm" in capsys.readouterr().out
    best = _json(["mask", "design", *camera, "--mask", "mask-2"], capsys)
    assert best["slices_mm"] == pytest.approx(13.4, abs=0.05)
    assert main(["mask", "plan", *camera, "--focal-length", "13", "--speed", "8", "--mask", "mask-2"]) == 0
    out = capsys.readouterr().out
    assert "frames per minute" in out
    assert "the lens of fujifilm-s5200 only stops down to f/8" in out
    assert "no shadow can be finer than the mask" in out


def test_a_plan_says_what_one_frame_brings(capsys: pytest.CaptureFixture[str]) -> None:
    """50 mm at f/7.4: f²/(N·Z) is 3.4 µm at 100 m, a third of a pixel; no relief is told from there."""
    words = ["plan", "--camera", "reference-36mm", "--mask", "reference-5x5", "--speed", "8", "--f-number", "7.4"]
    far = _json([*words, "--altitude", "100"], capsys)
    assert far["ground_sample_m"] == pytest.approx(0.02, rel=0.01)
    assert far["view_sample_m"] == pytest.approx(0.13, rel=0.05)
    assert far["frame_depth"]["stop_px"] == pytest.approx(0.338, rel=0.01)
    assert far["frame_depth"]["relief_px"] == pytest.approx(0.00338, rel=0.01)
    assert far["frame_depth"]["sigma_m"] > 10
    assert far["picture_contrast"]["left"] == pytest.approx([0.99, 0.95, 0.89, 0.83], abs=0.03)  # by waves
    assert any(text.startswith("one frame tells no relief from 100 m") for text in far["warnings"])
    near = _json([*words, "--altitude", "2"], capsys)
    assert near["frame_depth"]["sigma_m"] == pytest.approx(far["frame_depth"]["sigma_m"] * (2 / 100) ** 2, rel=0.05)
    assert not any(text.startswith("one frame tells") for text in near["warnings"])


def test_a_plan_says_how_slow_or_with_which_overlap_the_body_keeps_up(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["plan", "--camera", "reference-36mm", "--altitude", "10", "--interval", "3", "--speed"]
    needs = "the body takes a photograph in 3 s, not in"
    assert _json([*words, "4"], capsys)["warnings"] == [f"{needs} 0.28 s: fly at 0.36 m/s or slower"]
    assert _json([*words, "0.36"], capsys)["warnings"] == []
    (warning,) = _json([*words, "1"], capsys)["warnings"]
    assert warning == f"{needs} 1.1 s: fly at 0.36 m/s or slower, or with an --overlap of 0.45 or less"
    assert _json([*words, "1", "--overlap", "0.45"], capsys)["warnings"] == []


def test_design_knows_cover_glass_and_stops(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["mask", "design", "--altitude", "10", "--camera", "fujifilm-s5200", "--law", "geometric"]
    words += ["--focal-length", "63", "--film", "16k"]
    assert main([*words, "--f-number", "3.5"]) == 1
    out = capsys.readouterr().out
    assert "views of 19 × 14 px, fewer than 16 per side" in out
    assert "buildable: 5 × 5 views of 45 × 33 px at f/8" in out
    told = _json([*words, "--f-number", "3.5", "--mask-distance", "0.109"], capsys, 1)
    assert isinstance(told["buildable"], dict)
    assert told["buildable"]["mask_distance_mm"] == pytest.approx(1.01)
    assert main([*words, "--f-number", "11"]) == 1
    assert "stops down: 11 of at most 8" in capsys.readouterr().out
    assert main([*words, "--f-number", "8"]) == 0
    capsys.readouterr()
    rows = _json(["mask", "table", "--mask", "mask-2", "--camera", "fujifilm-s5200"], capsys)
    assert "from 6 to 52 mm" in str(rows["warnings"])
    rows = _json(["mask", "table", "--mask", "mask-2", "--camera", "fujifilm-s5200", "--law", "geometric"], capsys)
    assert rows["warnings"] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["make", "-o", "x.png"], "name a mask profile"),
        (["make", "mask-2", "--film", "5k", "-o", "x.png"], "no film '5k'"),
        (["make", "mask-2", "--film", "100x100", "-o", "x.png"], "needs --density"),
        (["make", "mask-2", "--size-mm", "30", "30", "-o", "x.png"], "it has 24 mm"),
        (["make", "mask-2", "-o", "x.jpg"], "must end in .png or .tif"),
        (["table", "--mask", "mask-2", "--camera", "fujifilm-s5200", "--focal-length", "0.013"], "millimetres"),
        (["design", "--altitude", "40", "--camera", "fujifilm-s5200"], "with --focal-length"),
        (["diffraction", "--mask", "mask-2", "--measured", "nowhere.csv"], "nowhere.csv: no such file"),
    ],
)
def test_a_wrong_wish_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main(["mask", *words])
    *usage, sentence = capsys.readouterr().err.splitlines()
    assert said in sentence
    assert code == (2 if usage or "with --focal-length" in said else 1)
    assert all(line.startswith(f"usage: dappled mask {words[0]} ") for line in usage)
    assert list(tmp_path.iterdir()) == []


def test_the_table_says_how_strong_each_order_is_and_what_takes_the_rest(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["mask", "table", "--mask", "mask-3", "--camera", "canon-eos-450d", "--law", "geometric", "--visibility"]
    assert main([*words, "--focal-length", "50", "--f-number", "8", "92", "--json"]) == 0
    told = {(one["f_number"], *one["order"]): one for one in json.loads(capsys.readouterr().out)["orders"]}
    assert told[92.0, 1, 1]["least"] > 0.08
    assert told[8.0, 1, 1]["most"] < 0.15 * told[92.0, 1, 1]["most"]
    assert told[8.0, 1, 1]["cause"] == "averaged out over the stop"
    assert told[92.0, 8, 8]["cause"] == "at 91 cycles/mm, which the film cannot draw"
    assert main([*words, "--focal-length", "50"]) == 0
    assert "averaged out over the stop" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ["make", "mask-2", "--film", "300x200", "--density", "113.8", "-o"],
        ["diffraction", "--mask", "mask-2", "--picture"],
        ["design", "--altitude", "10", "--camera", "fujifilm-s5200", "--law", "geometric", "--focal-length", "63",
         "--f-number", "8", "--film", "16k", "--picture"],
    ],
    ids=["make", "diffraction", "design"],
)  # fmt: skip
def test_a_picture_that_is_there_is_not_replaced_unasked(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "negative.png"
    path.write_bytes(b"the only copy")
    assert main(["mask", *words, str(path)]) == 1
    assert "exists already: choose another name, or --overwrite replaces it" in capsys.readouterr().err
    assert path.read_bytes() == b"the only copy"
    assert main(["mask", *words, str(path), "--overwrite"]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_kit_is_printed_and_shot_by_its_list(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["mask", "kit", str(tmp_path / "kit"), "--camera", "canon-eos-450d", "--film", "4k"]
    assert main(words) == 0
    folder = tmp_path / "kit"
    assert {path.name for path in folder.iterdir()} == {
        "full.png", "full.toml", "diagonal.png", "diagonal.toml", "wedge.png", "target.png", "shots.txt", "kit.toml",
    }  # fmt: skip
    for name, carriers in (("full", {(0, 1), (1, 0), (1, 1), (2, 2)}), ("diagonal", {(1, 1), (2, 2)})):
        image = np.asarray(Image.open(folder / f"{name}.png"), dtype=float)
        assert image.shape == (2732, 4096)
        block = image[:800, :800] - image[:800, :800].mean()  # 80 periods of 10 px
        spectrum = np.abs(np.fft.fft2(block)) / block.size / image.mean()
        assert {(y, x) for y in range(3) for x in range(3) if spectrum[80 * y, 80 * x] > 0.05} >= carriers
        assert (spectrum[0, 80] > 0.02) == (name == "full")
    with Image.open(folder / "target.png") as target:
        assert target.info["dpi"][0] == pytest.approx(25.4 * 12, rel=1e-3)
        below = np.asarray(target)[-12 * 15]
    assert np.count_nonzero(below < 200) == 100 * 12  # a bar of 100 mm
    told = (folder / "shots.txt").read_text()
    assert told.count("[ ] full: ") == told.count("[ ] bare: ") + 1 == 10
    assert f"dappled calibrate --kit {folder} -o calibration.toml" in told
    assert "dappled calibrate full/* --camera canon-eos-450d --mask full.toml" in told
    assert (folder / "kit.toml").read_text().splitlines()[0] == 'camera = "canon-eos-450d"'
    capsys.readouterr()
    assert main(words) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_plan_by_a_law_that_no_shadow_obeys_says_what_views_geometry_gives(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["--altitude", "40", "--speed", "8", "--camera", "fujifilm-s5200", "--focal-length", "13"]
    assert main(["plan", *words, "--mask", "mask-2"]) == 0
    assert (
        "no shadow can be finer than the mask; the law geometric gives views of 60 × 44 px" in capsys.readouterr().out
    )
