"""What the camera reports about itself, its disk, its images and distances; unknown stays unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dappled.config.settings import Settings
from dappled.daemon.camera_protocol import camera_status
from dappled.daemon.camera_protocol.camera_status import ReportedCamera, distance_message, sensor_orientation
from dappled.daemon.pipeline.capture import PendingShot
from dappled.drivers.camera import Identity
from dappled.drivers.mavlink import mavlink
from dappled.flight import Cause, ImageIndex, Shot
from tests.standing import failure

SHOT = Shot(7, Cause("test", "console", 1), 1_000, 1_000)


WHO = Identity("Canon Inc.", "Canon EOS 450D", "1234", "usb:001,002")


def test_the_sensor_of_a_profile_and_of_a_model() -> None:
    settings = Settings()
    named = ReportedCamera(replace(settings, camera=replace(settings.camera, profile="canon-eos-450d"))).facts()
    assert named.columns is not None
    assert named.rows is not None
    assert named.sensor_width_mm is not None
    assert named.columns > named.rows > 2000
    assert 21 < named.sensor_width_mm < 23
    camera = ReportedCamera(settings)
    assert camera.facts().columns is None
    assert camera.identify(WHO)
    assert camera.facts().columns == named.columns
    assert camera.identify(replace(WHO, model="a model that nobody knows"))
    assert camera.facts().columns is None


def test_a_camera_that_has_not_said_who_it_is() -> None:
    camera = ReportedCamera(Settings())
    unknown = camera.facts()
    assert (unknown.vendor, unknown.model, unknown.focal_length_mm) == ("dappled", "masked camera", None)
    assert not camera.known
    assert [camera.identify(WHO), camera.identify(WHO), camera.known] == [True, False, True]
    assert camera.facts().model == "Canon EOS 450D"


def test_a_lens_that_was_zoomed_is_seen_and_an_unknown_focal_length_changes_nothing() -> None:
    camera = ReportedCamera(Settings())
    seen = [camera.zoomed(length_mm) for length_mm in (None, 35.0, None, 35.0, 55.0)]
    assert seen == [None, None, None, None, (35.0, 55.0)]
    assert camera.facts().focal_length_mm == 55.0


def test_a_shot_that_failed_was_not_captured() -> None:
    captured = camera_status.captured_shot(PendingShot(SHOT, problem=failure("no file came")), lambda utc_ns: utc_ns)
    assert (captured.index, captured.ok, captured.pose) == (7, False, None)


def test_an_image_that_nobody_took(tmp_path: Path) -> None:
    (tmp_path / "flights").mkdir()
    images = ImageIndex(tmp_path / "flights")
    assert camera_status.captured_image(3, images) is None
    images.close()


DOWN = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FORWARD = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
ASIDE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)


@pytest.mark.parametrize(
    ("mount", "looks"),
    [
        (DOWN, mavlink.MAV_SENSOR_ROTATION_PITCH_270),
        (FORWARD, mavlink.MAV_SENSOR_ROTATION_NONE),
        (ASIDE, None),
    ],
)
def test_it_looks_where_the_camera_does(mount: tuple[float, ...], looks: int | None) -> None:
    assert sensor_orientation(mount) == looks
    told = distance_message((7.5, 0.1), 1234, mount)
    assert (told is None) == (looks is None)
    if told is not None:
        assert told.orientation == looks
        assert told.current_distance == 750
        assert told.covariance == 100
        assert told.time_boot_ms == 1234


def test_what_the_message_cannot_say() -> None:
    vague = distance_message((50.0, 4.0), 0, DOWN)
    assert vague is not None
    assert vague.covariance == 255  # unknown
    assert distance_message((0.1, 0.01), 0, DOWN) is None
    assert distance_message((900.0, 50.0), 0, DOWN) is None
    told = distance_message((655.0, 1.0), 0, DOWN)
    assert told is not None
    assert told.pack(mavlink.MAVLink(None))  # fits the fields
