"""Geotags of a flight: what is written, what isn't touched, and the camera's pose against known geometry."""

from __future__ import annotations

import hashlib
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.cli import main
from dappled.errors import DappledError
from dappled.flight import recording
from dappled.flight.check import check
from dappled.flight.records import Pose
from dappled.mocks.path import from_euler
from dappled.products import camera_pose, geotags, sidecars
from dappled.products.camera_pose import FORWARD, NADIR, Angles
from tests.flight.makers import deliver, pose, tag, wish

START_NS = 1_795_256_103_000_000_000


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Three frames: one with a pose, one without a position, one without a tag."""
    begun = recording.begin(tmp_path / "flights", lambda: START_NS)
    for index in range(3):
        wish(begun, index)
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
    written = geotags.write(flight)
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
    geotags.write(flight)
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
    written = geotags.write(flight, output=tmp_path / "out", replace_extension=True)
    assert sorted(path.name for path in written.files) == [
        "000000.xmp",
        "000001.xmp",
        "geo.txt",
        "pix4d.csv",
        "track.geojson",
    ]
    assert not list((flight / "frames").glob("*.xmp"))


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


@given(st.floats(-89, 89), st.floats(-180, 180), st.floats(-400, 9000))
def test_ecef_and_back(latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    found = camera_pose.from_ecef(camera_pose.to_ecef(latitude, longitude, height_m))
    assert found[0] == pytest.approx(latitude, abs=1e-14)
    assert math.remainder(found[1] - longitude, 2 * math.pi) == pytest.approx(0, abs=1e-14)
    assert found[2] == pytest.approx(height_m, abs=1e-7)


def test_ecef_of_a_known_place() -> None:
    """NIMA TR 8350.2's constants: the pole and the equator."""
    assert camera_pose.to_ecef(math.pi / 2, 0, 0)[2] == pytest.approx(6356752.3142, abs=1e-4)
    assert camera_pose.to_ecef(0, 0, 10)[0] == pytest.approx(6378147.0)


def test_a_mount_is_a_rotation() -> None:
    assert camera_pose.mount(tuple(NADIR.ravel())) == pytest.approx(NADIR)
    for bad in ((1.0,) * 9, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0), (1.0, 0.0)):
        with pytest.raises(DappledError, match="no rotation"):
            camera_pose.mount(bad)


@given(st.floats(-180, 180))
def test_minutes_never_reach_sixty(degrees: float) -> None:
    whole, minutes = sidecars._minutes(degrees, "EW")[:-1].split(",")
    assert 0 <= float(minutes) < 60
    assert int(whole) + float(minutes) / 60 == pytest.approx(abs(degrees), abs=2e-9)
