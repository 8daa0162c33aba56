"""Bad frames and wrong words at the decoder's door: a sentence each, and a batch that goes on."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled.cli import main
from dappled.mocks.scene.dng import Exif, encode
from dappled.mocks.scene.lens import Installation
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.products.exports import light_files
from tests.simulated.profiles import profile

MASK = "reference-5x5"


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stopped-down frame of the boards on a quarter of the sensor, and a profile that knows it."""
    folder = tmp_path_factory.mktemp("frames")
    camera = reference_camera(6, scale=0.25, scene="bench")  # its mask sits where the aperture is the ideal one
    (folder / "stopped.dng").write_bytes(camera.expose(0.0, 0, f_number=59.2).file)
    (folder / "open.dng").write_bytes(camera.expose(0.0, 1).file)
    (folder / "quarter.toml").write_text(profile(694, 922))
    return folder / "stopped.dng"


def _told(capsys: pytest.CaptureFixture[str], folder: Path, *words: str, mask: str = MASK) -> tuple[int, str, str]:
    code = main(["decode", *words, "--camera", str(folder / "quarter.toml"), "--mask", mask])
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


@pytest.mark.slow
def test_a_frame_says_what_was_seen(stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = _told(capsys, stopped.parent, str(stopped), "-o", str(tmp_path / "a.npz"))
    assert code == 0
    assert "24 of 24 carriers seen, measured" in out


def test_a_wrong_mask_and_a_frame_that_shows_no_carriers_are_told(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("frequency_per_mm = 9.3\np = 2\n")
    words = [str(stopped), "-o", str(tmp_path / "wrong.npz")]
    code, _, err = _told(capsys, stopped.parent, *words, mask=str(wrong))
    assert code == 1
    assert "should stand out at f/59.2 and no lattice of this mask does" in err
    assert _told(capsys, stopped.parent, *words, "--anyway", mask=str(wrong))[0] == 0


def test_a_frame_near_the_ideal_aperture_still_shows_where_its_lattice_is(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(stopped.with_name("open.dng")), "-o", str(tmp_path / "open.npz")]
    code, out, _ = _told(capsys, stopped.parent, *words)
    assert code == 0
    assert re.search(
        r"carriers seen, measured, by the law geometric \(odds against chance: geometric 10\^\d\d : 1", out
    )
    rows = light_files.load(tmp_path / "open.npz").carriers
    off = rows[:, :2] @ reference_camera(6, scale=0.25, scene="bench").lattice.matrix() - rows[:, 2:]
    assert np.abs(off * (694, 922)).max() < 0.1


@pytest.mark.long
def test_a_wrong_focal_length_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = reference_camera(2, scale=0.25, scene="bench", law="fd")
    camera = replace(camera, installation=Installation(0.01, (0.001, 0.002), 1.03))
    path = tmp_path / "fd.dng"
    path.write_bytes(camera.expose(0.0, 0, f_number=92.0).file)
    pitch = camera.sensor.pitch_mm
    (tmp_path / "quarter.toml").write_text(
        'law = "fd"\nmask_distance_mm = 1.01\n[[raw]]\nname = "a quarter"\nshape = [694, 922]\n'
        f"row_mm = [{pitch}, 0.0]\ncolumn_mm = [0.0, {pitch}]\n"
    )
    for length, expected, words in (("13", 0, "measured"), ("20", 1, "check mask, camera, focal length and f-number")):
        wanted = [str(path), "--focal-length", length, "-o", str(tmp_path / f"{length}.npz")]
        code, out, err = _told(capsys, tmp_path, *wanted, mask="mask-2-full")
        assert code == expected
        assert words in out + err


@pytest.mark.long
def test_carriers_are_found_and_cut_as_far_off_as_exif_rounds_the_focal_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """EXIF says 13 mm and means 13.4: under the fd law the outermost carriers stand 30 thousandths farther in."""
    for length in (12.55, 13.4):
        camera = reference_camera(2, scale=0.25, scene="bench", law="fd")
        optics = replace(camera.optics, focal_length_mm=length)
        camera = replace(camera, optics=optics, installation=Installation(0.01, (0.001, 0.002), 1.01))
        raw = camera.expose(0.0, 0, f_number=92.0).raw
        exif = Exif("dappled", "Simulated Masked Camera", "1", 13.0, 92.0, 1e-3, 100, 0)
        path = tmp_path / f"{length}.dng"
        path.write_bytes(encode(raw, black=camera.sensor.black, white=camera.sensor.white, exif=exif))
        pitch = camera.sensor.pitch_mm
        (tmp_path / "quarter.toml").write_text(
            'law = "fd"\nmask_distance_mm = 1.01\n[[raw]]\nname = "a quarter"\nshape = [694, 922]\n'
            f"row_mm = [{pitch}, 0.0]\ncolumn_mm = [0.0, {pitch}]\n"
        )
        for words in ([], ["--focal-length", "13"]):  # given by hand it counts as known to 0.05 mm
            given = [str(path), *words, "-o", str(tmp_path / f"{length}{len(words)}.npz")]
            code, out, err = _told(capsys, tmp_path, *given, mask="mask-2-full")
            assert (code, err) == (0, "")
            assert "24 of 24 carriers seen, measured" in out


def test_missing_exif_asks_for_the_focal_length(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = np.random.default_rng(0).random((694, 922)).astype(np.float32)
    np.save(tmp_path / "plain.npy", frame)
    code, _, err = _told(capsys, stopped.parent, str(tmp_path / "plain.npy"), "-o", str(tmp_path / "a.npz"))
    assert code == 1
    assert "plain.npy" in err
    assert "--focal-length" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("which", ["--white", "--dark"])
def test_a_white_or_dark_frame_of_another_size_is_refused(
    which: str, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "other.npy", np.random.default_rng(0).random((600, 922)).astype(np.float32))
    words = [str(stopped), which, str(tmp_path / "other.npy"), "-o", str(tmp_path / "a.npz")]
    code, _, err = _told(capsys, stopped.parent, *words)
    assert code == 1
    assert "600×922" in err
    assert "694×922" in err


@pytest.mark.slow
def test_a_batch_goes_on_past_bad_frames_and_says_so(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, black = tmp_path / "bad.dng", tmp_path / "black.npy"
    bad.write_bytes(stopped.read_bytes()[:5000])
    np.save(black, np.zeros((694, 922), dtype=np.uint16))
    folder = tmp_path / "decoded"
    code, out, err = _told(capsys, stopped.parent, str(bad), str(black), str(stopped), "-o", str(folder))
    assert code == 1
    assert [path.stem for path in folder.iterdir()] == ["stopped"]
    assert "stopped" in out
    lines = err.strip().splitlines()
    assert "bad.dng" in lines[0]
    assert "black.npy" in lines[1]
    assert lines[2] == "2 of 3 frames could not be decoded"


def test_two_frames_of_one_name_are_not_written_over_each_other(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "b" / stopped.name
    other.parent.mkdir()
    other.write_bytes(stopped.read_bytes())
    code, _, err = _told(capsys, stopped.parent, str(stopped), str(other), "-o", str(tmp_path / "out"))
    assert code == 2
    assert f"{stopped} and {other} would both be written as" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_bands_fall_off_softly_where_that_is_asked_for(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = {}
    for taper in ("0", "1"):
        out = tmp_path / f"{taper}.npz"
        code, _, err = _told(capsys, stopped.parent, str(stopped), "--taper", taper, "-o", str(out))
        assert code == 0, err
        made[taper] = light_files.load(out).slices
    rough = {taper: float(np.abs(np.diff(slices[0].real)).mean()) for taper, slices in made.items()}
    assert rough["1"] < 0.95 * rough["0"]
    words = ["--taper", "0.5", "-o", str(tmp_path / "x.npz")]
    code, _, err = _told(capsys, stopped.parent, str(stopped), *words, mask="lenslet")
    assert code == 1
    assert "printed mask" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "suffix"), [pytest.param("decode", "zarr", marks=pytest.mark.long), ("picture", "dng")]
)
def test_two_workers_make_what_one_makes(
    verb: str, suffix: str, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same bytes, the same lines in the same order; a torn frame among them is told."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("a", "d", "e"):
        (folder / f"{name}.dng").write_bytes(stopped.read_bytes())
    (folder / "b.dng").write_bytes(stopped.with_name("open.dng").read_bytes())
    (folder / "c.dng").write_bytes(stopped.read_bytes()[:5000])
    made, said = [], []
    for workers in ("1", "2"):
        output = tmp_path / workers
        given = ["--camera", str(stopped.parent / "quarter.toml"), "--mask", MASK, "-o", str(output)]
        assert main([verb, str(folder), *given, "--workers", workers]) == 1
        files = sorted(one for one in output.rglob("*") if one.is_file())
        made.append({str(one.relative_to(output)): one.read_bytes() for one in files})
        said.append([text.replace(str(output), "OUT") for text in capsys.readouterr()])
    assert {Path(name).parts[0] for name in made[0]} == {f"{name}.{suffix}" for name in "abde"}
    assert made[0] == made[1]
    assert said[0] == said[1]
    assert "c.dng" in said[1][1]
