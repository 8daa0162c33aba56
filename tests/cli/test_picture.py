"""`dappled picture`: files that photograph programs open, doubts, and exit codes."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import rawpy
import tifffile
from PIL import Image

from dappled.cli import main
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.products.geotags import exif_gps
from tests.simulated.profiles import profile


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Bayer frame of the boards on a quarter of the sensor, with a position, and a profile that knows it."""
    folder = tmp_path_factory.mktemp("frames")
    data = reference_camera(6, scale=0.25, scene="bench").expose(0.0, 0, f_number=22.0).file
    (folder / "frame.dng").write_bytes(exif_gps.tagged(data, exif_gps.Place(-33.5, 151.25, 120.0)))
    (folder / "quarter.toml").write_text(profile(694, 922))
    return folder / "frame.dng"


def _call(frame: Path, output: Path, *more: str, mask: str = "reference-5x5") -> int:
    camera = str(frame.with_name("quarter.toml"))
    return main(["picture", str(frame), "--camera", camera, "--mask", mask, "-o", str(output), *more])


def _carrier(plane: np.ndarray) -> float:
    """The strongest of the mask's carriers along rows over the mean, in the green of a mosaic (0.1535 cycles/px)."""
    green = plane[0::2, 1::2].astype(np.float64)
    windowed = (green - green.mean()) * np.outer(np.hanning(green.shape[0]), np.hanning(green.shape[1]))
    power = np.abs(np.fft.fft2(windowed))
    row = round(2 * 0.1535 * green.shape[0])
    return float(power[row - 3 : row + 4, :4].max() / green.sum() * 4)


def test_a_dng_is_a_photograph_of_the_same_camera_without_the_shadow(frame: Path, tmp_path: Path) -> None:
    made = tmp_path / "made.dng"
    assert _call(frame, made, "--sigma") == 0
    with rawpy.imread(str(frame)) as before, rawpy.imread(str(made)) as after:
        assert after.raw_image_visible.shape == before.raw_image_visible.shape
        assert np.array_equal(np.asarray(after.raw_pattern), np.asarray(before.raw_pattern))
        shares = [
            (one.raw_image_visible.astype(np.float64) - black) / (white - black)
            for one, black, white in (
                (before, before.black_level_per_channel[0], before.white_level),
                (after, after.black_level_per_channel[0], after.white_level),
            )
        ]
        assert after.other.focal_length == 50
        assert after.other.aperture == pytest.approx(22)
        assert after.postprocess(use_camera_wb=True).shape == (694, 922, 3)
    assert shares[1].mean() == pytest.approx(shares[0].mean(), rel=0.02)
    assert _carrier(shares[0]) > 0.1
    assert _carrier(shares[1]) < 0.004
    exif = Image.Exif()
    exif.load_from_fp(io.BytesIO(made.read_bytes()))
    gps = exif.get_ifd(0x8825)
    assert gps[1] == "S"
    assert [float(part) for part in gps[4]] == [151, 15, 0]
    sigma = tifffile.imread(tmp_path / "made.sigma.tif")
    assert sigma.shape == (694, 922)
    assert 0 < np.nanmedian(sigma) < 0.05


@pytest.mark.parametrize("suffix", ["tif", "jpg", "png"])
def test_other_pictures_are_developed_with_exif(frame: Path, tmp_path: Path, suffix: str) -> None:
    made = tmp_path / f"made.{suffix}"
    assert _call(frame, made) == 0
    assert not list(tmp_path.glob("*.sigma.tif"))
    with Image.open(made) if suffix != "tif" else Image.open(io.BytesIO(made.read_bytes())) as image:
        assert image.size == (922, 694)
        assert float(image.getexif().get_ifd(0x8769)[0x920A]) == 50
        assert image.getexif().get_ifd(0x8825)[3] == "E"


def test_a_picture_that_is_there_stays(frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "made.png"
    made.write_bytes(b"mine")
    assert _call(frame, made) == 1
    assert "exists already" in capsys.readouterr().err
    assert made.read_bytes() == b"mine"


def test_a_mask_whose_shadow_is_not_there_is_a_doubt(
    frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("frequency_per_mm = 9.3\np = 2\n")
    assert _call(frame, tmp_path / "a.dng", "--json", "--law", "geometric", mask=str(wrong)) == 1
    out, err = capsys.readouterr()
    assert "no shadow of the mask is seen" in err
    (found,) = json.loads(out)["findings"]
    assert (found["code"], found["level"]) == ("picture.shadow_unseen", "caution")


@pytest.mark.slow
def test_a_jpeg_is_taken_with_a_doubt(frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with rawpy.imread(str(frame)) as raw:
        rgb = raw.postprocess(use_camera_wb=True, no_auto_bright=True, user_flip=0)
    shot = frame.with_name("shot.jpg")
    Image.fromarray(rgb).save(shot, quality=95)
    words = ["--focal-length", "50", "--f-number", "22"]
    assert _call(shot, tmp_path / "a.dng", *words) == 1
    assert "its tones were taken to follow sRGB's curve" in capsys.readouterr().err
    with rawpy.imread(str(tmp_path / "a.dng")) as after:
        assert after.raw_image_visible.shape[:2] == (694, 922)
    assert _call(shot, tmp_path / "b.tif", *words, "--anyway") == 0


@pytest.mark.slow
def test_frames_of_one_lens_and_stop_have_one_shadow_and_another_s_is_told(frame: Path, tmp_path: Path) -> None:
    camera, frames = reference_camera(6, scale=0.25, scene="terrain"), []
    for number, f_number in enumerate((22.0, 22.0, 22.0, 14.0)):  # a stop that hung once
        frames.append(frame.with_name(f"{number}.dng"))
        frames[-1].write_bytes(camera.expose(20.0 * number, number, f_number=f_number).file)
    words = ["--camera", str(frame.with_name("quarter.toml")), "--mask", "reference-5x5", "--f-number", "22", "--json"]
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["picture", *map(str, frames), "-o", str(tmp_path / "made"), *words]) == 0
    *sound, strange = map(json.loads, out.getvalue().splitlines()[:4])
    assert [(one["shadow_from"], one["shadow_alike"]) for one in (*sound, strange)] == [("flight", 2)] * 3 + [
        ("frame", 0)
    ]
    assert not any(one["findings"] for one in sound if "differs" in str(one["findings"]))
    (found,) = (one for one in strange["findings"] if one["code"] == "picture.shadow_differs")
    assert found["facts"] == {"unlike": 3, "others": 3}


def test_lenslets_and_two_frames_into_one_file_are_refused(
    frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _call(frame, tmp_path / "a.dng", mask="lenslet") == 1
    assert "not behind lenslets" in capsys.readouterr().err
    twice = [str(frame), str(frame)]
    assert main(["picture", *twice, "--mask", "reference-5x5", "-o", str(tmp_path / "a.dng")]) == 2
    assert "name a folder" in capsys.readouterr().err
