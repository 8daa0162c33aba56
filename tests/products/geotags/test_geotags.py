"""Geotags of a flight: what is written, what isn't touched, and the camera's pose against known geometry."""

from __future__ import annotations

import hashlib
import html
import io
import json
import math
import re
import shutil
import struct
import subprocess
import xml.etree.ElementTree as ET
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import rawpy
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dappled import codec
from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.decode.geometry import Gnss, Pose, camera_pose, from_euler
from dappled.decode.geometry.camera_pose import FORWARD, NADIR, Angles
from dappled.drivers.raw.raw_file import read_exif
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import recording
from dappled.flight.checks.flight_check import check
from dappled.products.geotags import exif_gps, geotags, sidecars
from dappled.products.geotags.exif_gps import ExifError
from dappled.products.maps.earth import Geoid
from dappled.products.mounting import Mounting
from tests.daemon.replay.two_vehicles import Extra, camera_of_2, nothing_more, records
from tests.flight.makers import deliver, pose, request, tag
from tests.needs import without

START_NS = 1_795_256_103_000_000_000


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Three frames: one with a pose, one without a position, one without a tag."""
    begun = recording.begin(tmp_path / "flights", RecordedClock(START_NS))
    for index in range(3):
        request(begun, index)
        frame = deliver(begun, index, b"raw %d" % index)
        nowhere = replace(pose(), source="none", latitude_rad=None, longitude_rad=None, altitude_msl_m=None)
        if index < 2:
            begun.ledger.add_tag(replace(tag(frame), pose=pose() if index == 0 else nowhere))
    begun.close()
    return begun.folder.path


def attributes(path: Path) -> dict[str, str]:
    (description,) = ET.parse(path).iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description")  # noqa: S314  ours
    return dict(description.attrib)


def test_everything_is_written_and_nothing_recorded_is_touched(flight: Path) -> None:
    kept = [*sorted((flight / "frames").iterdir()), flight / "flight.sqlite", flight / "shots.jsonl"]
    before = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in kept}
    written = geotags.write(flight, geotags.PlacedBy(Mounting()))
    assert {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in before} == before
    assert check(flight).problems == ()
    assert (written.placed, written.without_position, written.without_tag) == (
        1,
        ("frames/000001.cr2",),
        ("frames/000002.cr2",),
    )
    names = sorted(str(path.relative_to(flight)) for path in written.files)
    assert names == [
        "frames/000000.cr2.xmp",
        "frames/000001.cr2.xmp",
        "geotags/geo.txt",
        "geotags/pix4d.csv",
        "geotags/track.geojson",
    ]
    first, *rest = (flight / "geotags" / "geo.txt").read_text().splitlines()
    assert first == "EPSG:4326"
    (line,) = [row.split() for row in rest]
    assert line[0] == "000000.cr2"
    assert float(line[1]) == pytest.approx(math.degrees(-1.5977), abs=1e-8)
    assert float(line[2]) == pytest.approx(math.degrees(0.7266), abs=1e-8)
    assert len(line) == 7  # the sigma is not known, and so is not 0
    (row,) = (flight / "geotags" / "pix4d.csv").read_text().splitlines()
    assert row.split(",")[0] == "000000.cr2"
    assert row.endswith(",,")
    features = json.loads((flight / "geotags" / "track.geojson").read_text())["features"]
    assert [feature["geometry"]["type"] for feature in features] == ["Point"]


def test_a_sidecar_says_what_is_known_and_only_that(flight: Path) -> None:
    geotags.write(flight, geotags.PlacedBy(Mounting()))
    known = attributes(flight / "frames" / "000000.cr2.xmp")
    assert known["{http://ns.adobe.com/exif/1.0/}GPSLatitude"].endswith("N")
    assert known["{http://ns.adobe.com/exif/1.0/}GPSLongitude"].endswith("W")
    degrees, minutes = known["{http://ns.adobe.com/exif/1.0/}GPSLongitude"][:-1].split(",")
    assert int(degrees) + float(minutes) / 60 == pytest.approx(math.degrees(1.5977), abs=1e-8)
    assert "{http://pix4d.com/camera/1.0/}GPSXYAccuracy" not in known
    assert {"{http://pix4d.com/camera/1.0/}Yaw", "{http://www.dji.com/drone-dji/1.0/}GimbalPitchDegree"} <= set(known)
    unknown = attributes(flight / "frames" / "000001.cr2.xmp")
    assert not any("GPSL" in name or "pix4d" in name for name in unknown)


def test_somebody_elses_sidecar_stays(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs = flight / "frames" / "000000.cr2.xmp"
    theirs.write_text("<x:xmpmeta>darktable</x:xmpmeta>")
    assert main(["geotag", str(flight)]) == 1
    assert "another program" in capsys.readouterr().err
    assert "darktable" in theirs.read_text()
    assert main(["geotag", str(flight), "--force"]) == 0
    assert "darktable" not in theirs.read_text()
    assert main(["geotag", str(flight)]) == 0  # its own are replaced


def test_the_other_convention_and_another_folder(flight: Path, tmp_path: Path) -> None:
    written = geotags.write(flight, geotags.PlacedBy(Mounting()), output=tmp_path / "out", replace_extension=True)
    assert sorted(path.name for path in written.files) == [
        "000000.xmp",
        "000001.xmp",
        "geo.txt",
        "pix4d.csv",
        "track.geojson",
    ]
    assert not list((flight / "frames").glob("*.xmp"))


KNOWN = Gnss(6, 22, 0.6, 1.1, 0.014, 0.021, 0.05, 12.0)


def rtk(**changed: Any) -> Pose:
    return replace(pose(), position_sigma_m=0.02, vertical_sigma_m=0.03, gnss=KNOWN, **changed)


def one_frame(root: Path, frame: bytes, name: str, where: Pose, *, utc_known: bool = True) -> Path:
    begun = recording.begin(root / "flights", RecordedClock(START_NS), utc_known=utc_known)
    request(begun, 0)
    begun.ledger.add_tag(replace(tag(deliver(begun, 0, frame, name)), pose=where, utc_ns=START_NS + 123_456_789))
    if not utc_known:
        begun.learn_utc(86_400 * 10**9, 1, "test")
    begun.close()
    return begun.folder.path


def test_accuracies_and_the_receivers_word_are_in_every_form(tmp_path: Path) -> None:
    flight = one_frame(tmp_path, b"raw", "IMG.CR2", rtk())
    geotags.write(flight, geotags.PlacedBy(Mounting(), Geoid(offset_m=-33.5)))
    said = attributes(flight / "frames" / "000000.cr2.xmp")
    assert said["{http://www.dji.com/drone-dji/1.0/}RtkFlag"] == "50"
    assert said["{http://www.dji.com/drone-dji/1.0/}RtkStdHgt"] == "0.0300"
    assert said["{http://pix4d.com/camera/1.0/}GPSZAccuracy"] == "0.030"
    assert said["{http://ns.adobe.com/exif/1.0/}GPSSatellites"] == "22"
    assert said["{urn:dappled:sidecar:1}EllipsoidalHeightM"] == "181.600"
    (line,) = (flight / "geotags" / "geo.txt").read_text().splitlines()[1:]
    assert line.split()[3] == "215.100"
    assert line.split()[-2:] == ["0.020", "0.030"]
    (row,) = (flight / "geotags" / "pix4d.csv").read_text().splitlines()
    assert row.endswith(",0.020,0.030")
    (point,) = json.loads((flight / "geotags" / "track.geojson").read_text())["features"]
    assert point["geometry"]["coordinates"][2] == pytest.approx(181.6)
    assert point["properties"]["gnss"]["fix_type"] == 6


def flown_by_two(root: Path, extra: Extra = nothing_more, doubt: Finding | None = None, kind: str = "doubt") -> Path:
    """A frame 5 s after the start of two vehicles' telemetry, tagged where the first one was."""
    begun = recording.begin(root / "flights", RecordedClock(START_NS))
    for stamp_us, raw in records(START_NS // 1000, extra=extra):
        begun.telemetry.append(stamp_us, raw)
    request(begun, 0)
    made = replace(tag(deliver(begun, 0, b"raw")), utc_ns=START_NS + 5 * 10**9)
    begun.ledger.add_tag(replace(made, pose=replace(pose(), latitude_rad=math.radians(10.0))))
    if doubt:
        begun.ledger.add_event(kind, doubt, 0)
    begun.close()
    return begun.folder.path


def test_a_doubt_that_came_after_the_tag_is_in_the_sidecar_and_decides_the_exit_code(tmp_path: Path) -> None:
    doubt = finding(Code.FRAME_RIVAL_PICTURE, Subject("frame", 0), picture="IMG_0007.CR2")
    flight = flown_by_two(tmp_path, doubt=doubt, kind="later doubt")
    assert main(["geotag", str(flight), "--vehicle", "1"]) == 1
    (sidecar,) = (flight / "frames").glob("*.xmp")
    (told,) = re.findall(r"dappled:Doubts='([^']*)'", sidecar.read_text())
    assert json.loads(html.unescape(told)) == [codec.plain(doubt)]
    assert main(["geotag", str(flight), "--vehicle", "1", "--anyway"]) == 0


def tagged_north(flight: Path) -> float:
    line = (flight / "geotags" / "geo.txt").read_text().splitlines()[1]
    return float(line.split()[2])


def test_the_vehicle_is_chosen_where_the_flight_never_knew_whose_the_camera_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = flown_by_two(tmp_path)
    assert main(["geotag", str(flight)]) == 1
    assert "vehicles 1 and 2" in capsys.readouterr().err
    assert main(["geotag", str(flight), "--anyway"]) == 0
    for vehicle in (2, 1):
        assert main(["geotag", str(flight), "--vehicle", str(vehicle)]) == 0
        assert tagged_north(flight) == pytest.approx(10.0 * vehicle)
    assert main(["geotag", str(flight), "--vehicle", "9"]) == 2
    assert "it holds vehicles 1 and 2" in capsys.readouterr().err


def test_a_vehicle_can_t_be_chosen_without_its_telemetry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = flown_by_two(tmp_path)
    (flight / "telemetry.tlog").unlink()
    assert main(["geotag", str(flight), "--vehicle", "2"]) == 2
    assert "no positions of vehicle 2: leave out --vehicle" in capsys.readouterr().err
    assert not (flight / "geotags").exists()
    assert main(["geotag", str(flight)]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--mark-lever-arm", "0", "0", "1"], "goes with --pos"),
        (["--mount", *"110010001"], "is not a rotation"),
        (["--vehicle", "7"], "no positions of vehicle 7"),
    ],
)
def test_a_wrong_call_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    flight = flown_by_two(tmp_path)
    assert main(["geotag", str(flight), *words]) == 2
    told = capsys.readouterr().err
    assert said in told.splitlines()[-1]
    assert "usage: dappled geotag" in told
    assert not (flight / "geotags").exists()


def test_the_vehicle_that_reports_a_camera_is_taken_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = flown_by_two(tmp_path, camera_of_2)
    assert main(["geotag", str(flight)]) == 0
    assert "vehicle 2 counts, by its camera" in capsys.readouterr().err
    assert tagged_north(flight) == pytest.approx(20.0)


def test_a_frame_in_doubt_decides_the_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = flown_by_two(tmp_path, camera_of_2, finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 0), rival=7))
    assert main(["geotag", str(flight), "--json"]) == 1
    shown = capsys.readouterr()
    assert [one["code"] for one in json.loads(shown.out)["doubts"]] == ["frame.rival_shots"]
    assert "in doubt: frame frames/000000.cr2: it may be of shot 7 as well" in shown.err
    assert (flight / "geotags" / "geo.txt").exists()
    assert main(["geotag", str(flight), "--anyway"]) == 0


def test_geo_txt_has_both_accuracies_or_none(tmp_path: Path) -> None:
    flight = one_frame(tmp_path, b"raw", "IMG.CR2", replace(rtk(), vertical_sigma_m=None))
    geotags.write(flight, geotags.PlacedBy(Mounting()))
    (line,) = (flight / "geotags" / "geo.txt").read_text().splitlines()[1:]
    assert len(line.split()) == 7  # of eight words OpenDroneMap would read seven too


@pytest.mark.parametrize("heading", [1, -1])
def test_the_track_is_cut_at_the_antimeridian(tmp_path: Path, heading: int) -> None:
    begun = recording.begin(tmp_path / "flights", RecordedClock(START_NS))
    for index, longitude_deg in enumerate((179.998, 179.999, -179.999, -179.997)[::heading]):
        request(begun, index)
        where = replace(pose(), longitude_rad=math.radians(longitude_deg), latitude_rad=math.radians(-17 + index / 100))
        begun.ledger.add_tag(replace(tag(deliver(begun, index, b"raw")), pose=where))
    begun.close()
    flight = begun.folder.path
    geotags.write(flight, geotags.PlacedBy(Mounting()))
    track, *points = json.loads((flight / "geotags" / "track.geojson").read_text())["features"]
    assert len(points) == 4
    assert track["geometry"]["type"] == "MultiLineString"
    west, east = track["geometry"]["coordinates"]
    assert west[-1][0] == heading * 180
    assert east[0][0] == -heading * 180
    assert west[-1][1:] == east[0][1:]
    assert west[-1][1] == pytest.approx(-16.985, abs=1e-6)


def test_times_are_put_right_where_utc_was_learnt(tmp_path: Path) -> None:
    flight = one_frame(tmp_path, b"raw", "IMG.CR2", rtk(), utc_known=False)
    geotags.write(flight, geotags.PlacedBy(Mounting()))
    said = attributes(flight / "frames" / "000000.cr2.xmp")
    assert said["{http://ns.adobe.com/exif/1.0/}GPSTimeStamp"] == "2026-11-22T10:15:03.123456Z"


# --- EXIF in copies


def tiff(order: Literal["little", "big"] = "little", model: str = "Model") -> bytes:
    """The least TIFF: one row of eight pixels, with a model."""
    exif = Image.Exif()
    exif[0x0110] = model
    exif.endian = "<" if order == "little" else ">"
    data = io.BytesIO()
    Image.new("L", (8, 1), 77).save(data, "TIFF", exif=exif)
    return data.getvalue()


def jpeg(*, exif: bool) -> bytes:
    data, told = io.BytesIO(), Image.Exif()
    told[0x0110] = "Model"
    Image.new("L", (8, 8), 77).save(data, "JPEG", **({"exif": told} if exif else {}))
    return data.getvalue()


def raf() -> bytes:
    preview = jpeg(exif=True)
    header = bytearray(160)
    header[:15] = b"FUJIFILMCCD-RAW"
    struct.pack_into(">II", header, 84, 160, len(preview))
    return bytes(header) + preview + b"sensor data"


def png(mode: str = "I;16", *, exif: bool = False, late: bool = False) -> bytes:
    """A grey PNG of 16 bits, or another; `late` puts its EXIF behind the pixels, where it may stand too."""
    data, told = io.BytesIO(), Image.Exif()
    told[0x0110] = "Model"
    Image.new(mode, (8, 8), 77).save(data, "PNG", **({"exif": told} if exif and not late else {}))
    made = data.getvalue()
    if not late:
        return made
    chunk = b"eXIf" + told.tobytes().removeprefix(b"Exif\0\0")
    return made[:-12] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + made[-12:]


def gps(data: bytes) -> dict[int, Any]:
    """The GPS directory, as Pillow reads it."""
    if data.startswith(b"FUJIFILM"):
        offset, length = struct.unpack_from(">II", data, 84)
        data = data[offset : offset + length]
    with Image.open(io.BytesIO(data)) as image:
        told = image.getexif()
        assert told.get(0x0110, "Model") == "Model"
        return dict(told.get_ifd(0x8825))


def degrees(parts: tuple[Any, Any, Any]) -> float:
    return float(parts[0]) + float(parts[1]) / 60 + float(parts[2]) / 3600


FILES = {
    "IMG.TIF": tiff(),
    "IMG.DNG": tiff("big"),
    "IMG.JPG": jpeg(exif=True),
    "BARE.JPG": jpeg(exif=False),
    "DSCF0001.RAF": raf(),
    "BARE.PNG": png(),
    "IMG.PNG": png("RGB", exif=True),
    "LATE.PNG": png("L", exif=True, late=True),
}


@pytest.mark.parametrize("name", FILES)
def test_a_copy_has_its_place_in_exif_and_the_original_none(tmp_path: Path, name: str) -> None:
    flight = one_frame(tmp_path, FILES[name], name, rtk(latitude_rad=-0.7266))
    ((frame, copy),) = geotags.copies(flight, tmp_path / "copies", geotags.PlacedBy(Mounting()))
    assert isinstance(copy, Path)
    assert (flight / frame).read_bytes() == FILES[name]
    found = gps(copy.read_bytes())
    assert (found[1], found[3], found[5], found[0x12]) == ("S", "W", b"\0", "WGS-84")
    assert degrees(found[2]) == pytest.approx(math.degrees(0.7266), abs=1e-9)
    assert degrees(found[4]) == pytest.approx(math.degrees(1.5977), abs=1e-9)
    assert float(found[6]) == pytest.approx(215.1)
    assert [float(part) for part in found[7]] == [10, 15, 3.123456]
    assert (found[0x1D], found[8]) == ("2026:11:21", "22")
    assert (float(found[0x0B]), float(found[0x1F])) == (0.6, 0.02)
    again = exif_gps.tagged(copy.read_bytes(), exif_gps.Place(10.0, 20.0, -5.0))
    assert degrees(gps(again)[2]) == 10.0
    assert gps(again)[5] == b"\1"
    assert 7 not in gps(again)


@pytest.mark.parametrize("file", ["synthetic_450D.CR2", "synthetic_S5200.RAF"])
def test_copies_of_raws_open_as_before(shared_data: Path, file: str) -> None:
    original = (shared_data / "raw" / file).read_bytes()
    copy = exif_gps.tagged(original, exif_gps.Place(41.6, -91.5, 215.0, START_NS))
    with rawpy.imread(io.BytesIO(original)) as before, rawpy.imread(io.BytesIO(copy)) as after:
        assert np.array_equal(before.raw_image, after.raw_image)
    assert read_exif(io.BytesIO(copy)) == read_exif(io.BytesIO(original))
    if file.endswith("CR2"):
        told = Image.Exif()
        told.load_from_fp(io.BytesIO(copy))
        assert degrees(told.get_ifd(0x8825)[2]) == pytest.approx(41.6, abs=1e-9)


def exiftool(folder: Path) -> dict[str, dict[str, Any]]:
    """What ExifTool says of each file in a folder, by name."""
    if shutil.which("exiftool") is None:
        without("exiftool (Debian: libimage-exiftool-perl)")
    asked = [
        "exiftool",
        "-j",
        "-n",
        "-FileType",
        "-GPSLatitude",
        "-FileName",
        "-Model",
        "-Warning",
        "-Error",
        str(folder),
    ]
    said = subprocess.run(asked, check=True, capture_output=True).stdout
    return {one["FileName"]: one for one in json.loads(said) if one.pop("SourceFile")}


def exiv2_reads(paths: list[Path]) -> None:
    """exiv2 finds the latitude in each, without a word on stderr."""
    if shutil.which("exiv2") is None:
        without("exiv2 (Debian: exiv2)")
    for path in paths:
        done = subprocess.run(["exiv2", "-q", "-PEkt", path], check=True, capture_output=True, text=True)  # noqa: S607
        assert done.stderr == ""
        words = dict(line.split(None, 1) for line in done.stdout.splitlines() if line.strip())
        assert words["Exif.GPSInfo.GPSLatitude"].strip() == "41deg 36' 0\""


OTHERS_READ = {
    "RAF": raf(),
    "TIFF": tiff(),
    "JPEG": jpeg(exif=True),
    "PNG": png("RGB", exif=True),
}


@pytest.mark.parametrize("kind", OTHERS_READ)
def test_exiftool_and_exiv2_read_the_place_whatever_the_size_of_the_file(tmp_path: Path, kind: str) -> None:
    """ExifTool takes no file for a RAF whose preview's offset has bit 15 set. Sizes beside each multiple of 0x4000, and
    between."""
    sizes = [at + step for at in range(0x4000, 0x24000, 0x4000) for step in (-160, -3, -1, 0, 1, 2, 1021)]
    for size in sizes:
        original = grown(OTHERS_READ[kind], kind, size)
        copy = exif_gps.tagged(exif_gps.tagged(original, exif_gps.Place(1.0, 2.0, 3.0)), exif_gps.Place(41.6, -91.5, 9))
        (tmp_path / f"{size:x}.{kind}").write_bytes(copy)
    found = exiftool(tmp_path)
    assert len(found) == len(sizes)
    for name, told in found.items():
        assert (told["FileType"], told["GPSLatitude"], told["Model"]) == (kind, pytest.approx(41.6), "Model"), name
        assert not {"Warning", "Error"} & told.keys(), told
    if kind != "RAF":  # exiv2 wants a real sensor's part: the body's own RAF is below
        exiv2_reads([tmp_path / f"{size:x}.{kind}" for size in sizes[::9]])


def grown(data: bytes, kind: str, size: int) -> bytes:
    """A file of this size with the same content: bytes behind all else, or before a PNG's and a JPEG's pixels."""
    missing = size - len(data)
    if kind == "PNG":  # pixels begin behind signature and IHDR
        chunk = b"teSt" + bytes(missing - 12)
        return data[:33] + struct.pack(">I", missing - 12) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    if kind == "JPEG":
        comments = b""
        while missing > 0:
            length = min(missing, 0x8000)
            length = missing if missing - length < 4 else length
            comments += struct.pack(">BBH", 0xFF, 0xFE, length - 2) + b" " * (length - 4)
            missing -= length
        return data[:2] + comments + data[2:]
    return data + bytes(missing)


@pytest.mark.parametrize("file", ["synthetic_450D.CR2", "synthetic_S5200.RAF"])
def test_others_read_copies_of_the_bodies_raws_at_any_size(tmp_path: Path, shared_data: Path, file: str) -> None:
    original = (shared_data / "raw" / file).read_bytes()
    kind = file[-3:]
    for more in (0, 1, 0x4001, 0x8000, 0xFFFE):
        copy = exif_gps.tagged(original + bytes(more), exif_gps.Place(41.6, -91.5, 215.0, START_NS))
        (tmp_path / f"{more}.{kind}").write_bytes(copy)
    for name, told in exiftool(tmp_path).items():
        assert (told["FileType"], told["GPSLatitude"]) == (kind, pytest.approx(41.6)), name
        assert not {"Warning", "Error"} & told.keys(), told
    exiv2_reads(sorted(tmp_path.iterdir()))
    with rawpy.imread(str(tmp_path / f"0.{kind}")) as first, rawpy.imread(str(tmp_path / f"32768.{kind}")) as grown_one:
        assert np.array_equal(first.raw_image, grown_one.raw_image)


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith("PNG")])
def test_a_copy_of_a_png_has_the_same_pixels_and_whole_chunks(name: str) -> None:
    """Pillow's own check reads every chunk's CRC; nothing but eXIf is new."""
    copy = exif_gps.tagged(FILES[name], exif_gps.Place(41.6, -91.5, 215.0, START_NS))
    with Image.open(io.BytesIO(copy)) as image:
        image.verify()
    with Image.open(io.BytesIO(copy)) as image, Image.open(io.BytesIO(FILES[name])) as original:
        assert image.mode == original.mode
        assert image.tobytes() == original.tobytes()
    assert [chunk for chunk in chunks(copy) if chunk[0] != b"eXIf"] == [
        chunk for chunk in chunks(FILES[name]) if chunk[0] != b"eXIf"
    ]
    assert [kind for kind, _ in chunks(copy)].count(b"eXIf") == 1
    for cut in (9, 40, len(FILES[name]) - 13):
        with pytest.raises(ExifError, match="cut short"):
            exif_gps.tagged(FILES[name][:cut], exif_gps.Place(1.0, 2.0, 3.0))


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """A PNG's (kind, content and CRC)."""
    found, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 12 + length]))
        at += 12 + length
    return found


@pytest.mark.parametrize("fill", [0, 1, 3, 700])
@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("exif", [True, False])
def test_a_jpeg_may_have_fill_bytes_before_its_markers(fill: int, header: bool, exif: bool) -> None:
    made = io.BytesIO()
    known = Image.Exif()
    known[271] = "Canon"
    Image.new("RGB", (16, 16), "red").save(made, "JPEG", **({"exif": known} if exif else {}))
    plain = made.getvalue()
    after = 4 + int.from_bytes(plain[4:6], "big")
    body = (plain[2:after] if header else b"") + b"\xff" * fill + plain[after:]
    copy = exif_gps.tagged(plain[:2] + body, exif_gps.Place(41.5, -91.5, 200.0))
    picture = Image.open(io.BytesIO(copy))
    picture.load()
    assert picture.getexif().get(271) == ("Canon" if exif else None)
    assert picture.getexif().get_ifd(0x8825)[2] == (41.0, 30.0, 0.0)
    assert copy.count(b"Exif\0\0") == 1


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_in_a_sentence_or_tagged(data: bytes) -> None:
    for start in (b"", b"II*\0\x08\0\0\0", b"MM\0*", b"\xff\xd8\xff\xe1", b"\x89PNG\r\n\x1a\n", b"FUJIFILMCCD-RAW"):
        try:
            made = exif_gps.tagged(start + data, exif_gps.Place(1.0, 2.0, 3.0))
            assert len(made) > len(data)
        except ExifError:
            continue


def test_the_command_makes_copies_and_says_what_it_could_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = one_frame(tmp_path, b"no image at all", "IMG.CR2", rtk())
    assert main(["geotag", str(flight), "--copies", str(tmp_path / "copies"), "--geoid", "12.5", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["copies"] == []
    assert json.loads(said.out)["geoid"] == "constant 12.5 m"
    assert "no copy of frames/000000.cr2: it is not a TIFF-like raw" in said.err
    assert main(["geotag", str(flight), "--copies", str(flight / "frames")]) == 1
    assert "into the flight itself" in capsys.readouterr().err
    assert main(["geotag", str(flight), "--geoid", str(tmp_path / "none.gtx")]) == 2
    assert "there is no geoid grid" in capsys.readouterr().err


# --- the camera's pose


def at(roll: float, pitch: float, yaw: float, *, latitude_deg: float = 41.6) -> Pose:
    attitude = from_euler(math.radians(roll), math.radians(pitch), math.radians(yaw))
    return replace(pose(), attitude=attitude, latitude_rad=math.radians(latitude_deg))


def close(found: Angles | None, yaw: float, pitch: float, roll: float) -> bool:
    assert found is not None
    turned = math.remainder(found.yaw_deg - yaw, 360)
    return max(abs(turned), abs(found.pitch_deg - pitch), abs(found.roll_deg - roll)) < 1e-6


def test_conventions_of_other_programs() -> None:
    level = camera_pose.of(at(0, 0, 0))
    assert level is not None
    assert close(level.pix4d, 0, 0, 0)  # nadir, image top north
    assert level.dji is not None
    assert level.dji.pitch_deg == pytest.approx(-90)
    ahead = camera_pose.of(at(0, 0, 30), camera_mount=FORWARD)
    assert ahead is not None
    assert close(ahead.pix4d, 30, 90, 0)
    assert close(ahead.dji, 30, 0, 0)
    tilted = camera_pose.of(at(3, -5, 200))
    assert tilted is not None
    assert close(tilted.pix4d, 200, -5, 3)
    assert close(tilted.vehicle, 200, -5, 3)


def test_a_camera_on_the_gimbal_looks_where_the_gimbal_looks() -> None:
    head = from_euler(0.0, math.radians(-60), math.radians(200))
    flown = replace(at(10, 5, 120), gimbal_attitude=head, gimbal_source="GIMBAL_DEVICE_ATTITUDE_STATUS")
    there = camera_pose.of(flown, camera_mount=FORWARD, on_gimbal=True)
    assert there is not None
    assert close(there.dji, 200, -60, 0)
    assert close(there.vehicle, 120, 5, 10)
    without = camera_pose.of(at(10, 5, 120), camera_mount=FORWARD, on_gimbal=True)
    assert without is not None
    assert without.dji is None
    assert without.vehicle is not None


@pytest.mark.parametrize("latitude_deg", [-77.0, 0.0, 41.6])
@pytest.mark.parametrize("lever", [(0.3, 0.0, 0.0), (0.1, -0.2, 0.5)])
def test_the_lever_arm_turns_with_the_vehicle(latitude_deg: float, lever: tuple[float, float, float]) -> None:
    flown = at(4, -6, 120, latitude_deg=latitude_deg)
    bare, moved = camera_pose.of(flown), camera_pose.of(flown, lever)
    assert bare is not None
    assert moved is not None
    assert flown.attitude is not None
    ned = camera_pose.matrix_of(flown.attitude) @ np.array(lever)
    places = [
        camera_pose.to_ecef(math.radians(p.latitude_deg), math.radians(p.longitude_deg), p.altitude_msl_m)
        for p in (bare, moved)
    ]
    axes = camera_pose.ned_to_ecef(math.radians(bare.latitude_deg), math.radians(bare.longitude_deg))
    assert axes.T @ (places[1] - places[0]) == pytest.approx(ned, abs=1e-6)
    assert bare.altitude_msl_m - moved.altitude_msl_m == pytest.approx(ned[2], abs=1e-6)


@given(st.floats(-89, 89), st.floats(-179.9, 180), st.floats(-400, 9000))
def test_ecef_and_back(latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    found = camera_pose.from_ecef(camera_pose.to_ecef(latitude, longitude, height_m))
    assert found[0] == pytest.approx(latitude, abs=1e-12)
    assert math.remainder(found[1] - longitude, 2 * math.pi) == pytest.approx(0, abs=1e-12)
    assert found[2] == pytest.approx(height_m, abs=1e-6)


def test_ecef_of_a_known_place() -> None:
    """NIMA TR 8350.2's constants: the pole and the equator."""
    assert camera_pose.to_ecef(math.pi / 2, 0, 0)[2] == pytest.approx(6356752.3142, abs=1e-4)
    assert camera_pose.to_ecef(0, 0, 10)[0] == pytest.approx(6378147.0)


def test_a_mount_is_a_rotation() -> None:
    assert camera_pose.mount(tuple(NADIR.ravel())) == pytest.approx(NADIR)
    for bad in ((1.0,) * 9, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0), (1.0, 0.0)):
        with pytest.raises(DappledError, match="not a rotation"):
            camera_pose.mount(bad)


@given(st.floats(-180, 180))
def test_minutes_never_reach_sixty(degrees: float) -> None:
    whole, minutes = sidecars._minutes(degrees, "EW")[:-1].split(",")
    assert 0 <= float(minutes) < 60
    assert int(whole) + float(minutes) / 60 == pytest.approx(abs(degrees), abs=2e-9)


@pytest.mark.parametrize(
    "pose", [{"lever_arm_m": ["a", 0, 0]}, {"lever_arm_m": 1}, {"mount": [[1]]}, {"on_gimbal": "yes"}, {"mount": "x"}]
)
def test_a_mounting_that_is_none_is_told(pose: dict[str, object]) -> None:
    with pytest.raises(DappledError, match=r"settings of \[pose\] are damaged"):
        Mounting.of({"settings": {"pose": pose}})
