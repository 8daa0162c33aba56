"""Pictures with position: what exiftool, exiv2, Pillow and tifffile read in them is the simulator's truth."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from dappled.cli import main
from dappled.decode import srgb
from dappled.decode.geometry import camera_pose
from dappled.products.batch import batch
from dappled.products.geotags import geotags
from dappled.products.handover import photo_files
from dappled.products.maps.georeference import Options
from dappled.products.mounting import Mounting
from tests.products.flown import Flown

GPS = 0x8825
EXIF = 0x8769


@pytest.fixture(scope="module")
def photos(short_flight: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("photos")
    placed, _ = geotags.read(short_flight.folder, geotags.PlacedBy(Mounting()))
    by_index = {one.frame.index: one for one in placed}
    jobs = batch.plan(short_flight.folder, short_flight.recipe, Options(), ["photos"], output, placed=by_index)
    assert [batch.make(job).error for job in jobs] == [None, None]
    folder = output / short_flight.folder.name / "photos"
    photo_files.write_lists(folder, placed)
    return folder


def degrees(parts: Any, sign: str) -> float:
    d, m, s = (float(part) for part in parts)
    return (d + m / 60 + s / 3600) * (-1 if sign in "SW" else 1)


@pytest.mark.slow
def test_each_frame_is_a_tiff_and_a_jpeg_and_geo_txt_names_them(photos: Path, short_flight: Flown) -> None:
    for form, suffix in (("tiff", ".tif"), ("jpeg", ".jpg")):
        names = [f"00000{n}{suffix}" for n in range(2)]
        assert sorted(path.name for path in (photos / form).iterdir()) == [*names, "geo.txt"]
        lines = (photos / form / "geo.txt").read_text().splitlines()
        assert [line.split()[0] for line in lines] == ["EPSG:4326", *names]
        for line, truth in zip(lines[1:], short_flight.truths, strict=True):
            assert truth.pose is not None
            x, y, z, yaw, pitch, roll = (float(word) for word in line.split()[1:7])
            assert (x, y) == pytest.approx((truth.pose.longitude_deg, truth.pose.latitude_deg), abs=1e-9)
            assert z == pytest.approx(truth.pose.altitude_msl_m, abs=1e-3)
            told = camera_pose.angles(camera_pose.matrix_of(truth.pose.attitude))
            assert (yaw, pitch, roll) == pytest.approx((told.yaw_deg, told.pitch_deg, told.roll_deg), abs=1e-3)


@pytest.mark.slow
def test_photos_are_the_picture_at_full_size_and_its_exif(photos: Path, short_flight: Flown) -> None:
    truth = short_flight.truths[1]
    assert truth.pose is not None
    sixteen = tifffile.imread(photos / "tiff" / "000001.tif")
    with Image.open(photos / "jpeg" / "000001.jpg") as picture:
        eight = np.asarray(picture)
        exif = picture.getexif()
        gps, inner = exif.get_ifd(GPS), exif.get_ifd(EXIF)
        xmp = picture.info["xmp"]
    assert sixteen.dtype == np.uint16
    assert eight.shape == sixteen.shape == (1388, 1844)  # the sensor's own pixels
    assert (inner[0xA002], inner[0xA003]) == (1844, 1388)
    assert abs(sixteen / 257.0 - eight).mean() < 2.0
    assert degrees(gps[2], gps[1]) == pytest.approx(truth.pose.latitude_deg, abs=1e-9)
    assert degrees(gps[4], gps[3]) == pytest.approx(truth.pose.longitude_deg, abs=1e-9)
    assert float(gps[6]) == pytest.approx(truth.pose.altitude_msl_m, abs=1e-3)
    assert (float(inner[0x829A]), float(inner[0x829D]), inner[0x8827]) == (0.001, 14.8, 100)
    assert float(inner[0x920A]) == 50.0
    assert float(inner[0xA20E]) == 1000.0  # px a centimetre
    width_mm = eight.shape[1] / (float(inner[0xA20E]) / 10)
    assert width_mm == pytest.approx(0.01 * 1844)
    assert inner[0xA405] == round(36 * 50 / width_mm)
    assert inner[0x9003] == "2026:11:21 10:15:04"
    assert b"drone-dji:GimbalPitchDegree" in xmp
    with tifffile.TiffFile(photos / "tiff" / "000001.tif") as file:
        tags = file.pages[0].tags  # type: ignore[union-attr]
        assert b"drone-dji:GimbalPitchDegree" in bytes(tags[700].value)
        assert tags[EXIF].value["FNumber"] == (1480, 100) or float(np.divide(*tags[EXIF].value["FNumber"])) == 14.8


@pytest.mark.slow
def test_no_carrier_of_the_mask_is_left_in_a_photo(photos: Path) -> None:
    """Of the second frame the calibration tells the shadow nearly right, and the frame itself better: over the former
    the carriers stand 100 000 times above the noise."""
    shown = srgb.decoded(tifffile.imread(photos / "tiff" / "000001.tif")[400:912, 600:1112] / 65535)
    windowed = (shown - shown.mean()) * np.outer(*[np.hanning(512)] * 2)
    power = np.fft.fftshift(np.abs(np.fft.fft2(windowed)) ** 2)
    noise = np.median(power[:56, :56])
    for orders in ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)):
        row, column = (256 + round(512 * 0.1535 * order) for order in orders)
        assert power[row - 3 : row + 4, column - 3 : column + 4].max() < 500 * noise


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("exiftool") is None, reason="Debian's libimage-exiftool-perl is not here")
def test_exiftool_reads_exif_and_xmp(photos: Path, short_flight: Flown) -> None:
    for path in (photos / "tiff" / "000001.tif", photos / "jpeg" / "000001.jpg"):
        asked = ["exiftool", "-j", "-n", "-G", "-a", "-Validate", "-Warning", "-all:all", "-Composite:all", str(path)]
        said = subprocess.run(asked, check=True, capture_output=True).stdout
        (found,) = json.loads(said)
        truth = short_flight.truths[1].pose
        assert truth is not None
        looks = camera_pose.angles(camera_pose.matrix_of(truth.attitude) @ camera_pose.NADIR @ camera_pose.FORWARD.T)
        assert found["Composite:GPSLatitude"] == pytest.approx(truth.latitude_deg, abs=1e-9)
        assert found["Composite:GPSLongitude"] == pytest.approx(truth.longitude_deg, abs=1e-9)
        assert found["EXIF:FocalLength"] == 50
        assert found["XMP:GimbalPitchDegree"] == pytest.approx(looks.pitch_deg, abs=1e-3)
        assert found["XMP:ImageIndex"] == 1
        if path.suffix == ".jpg":  # TIFFs lack two tags that exiftool wants of cameras
            assert found["ExifTool:Validate"] == "0 0 0"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("exiv2") is None, reason="Debian's exiv2 is not here")
def test_exiv2_reads_exif_and_xmp(photos: Path) -> None:
    for path in (photos / "tiff" / "000001.tif", photos / "jpeg" / "000001.jpg"):
        done = subprocess.run(["exiv2", "-PEXkt", path], check=True, capture_output=True, text=True)  # noqa: S607
        assert done.stderr == ""
        words = dict(line.split(None, 1) for line in done.stdout.splitlines())
        assert words["Exif.Photo.FNumber"].strip() == "F15"
        assert "Exif.GPSInfo.GPSLatitude" in words
        assert words["Xmp.exif.GPSMapDatum"].strip() == "WGS-84"


def test_what_a_pixel_covers_is_told_where_pictures_are_promised(short_flight: Flown) -> None:
    placed, _ = geotags.read(short_flight.folder, geotags.PlacedBy(Mounting()))
    heights = [-truth.pose.position_ned_m[2] for truth in short_flight.truths if truth.pose is not None]
    cm = 100 * float(np.median(heights)) * 0.01 / 50  # of 10 µm behind 50 mm
    assert photo_files.ground_words(placed).startswith(f"pictures: {cm:.2g} cm of ground per pixel from ")
    assert "is unknown" in photo_files.ground_words([])


def test_marks_are_of_one_flight(short_flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "another").mkdir()
    two = [str(short_flight.folder), str(tmp_path / "another")]
    assert main(["batch", *two, "-o", str(tmp_path / "out"), "--as", "photos", "--pos", str(tmp_path)]) == 2
    assert f"--pos {tmp_path} holds the marks of one flight" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
