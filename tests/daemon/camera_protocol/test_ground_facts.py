"""What a ground station is told of camera, disk and images; unknown stays unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dappled.config.settings import Settings
from dappled.daemon.camera_protocol import ground_facts
from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.drivers.camera import Identity
from dappled.flight import Cause, ImageIndex, Shot

SHOT = Shot(7, Cause("test", "console", 1), 1_000, 1_000)


def test_the_chip_of_a_profile() -> None:
    settings = Settings()
    known = ground_facts.chip(replace(settings, camera=replace(settings.camera, profile="canon-eos-450d")), "")
    assert known["columns"] > known["rows"] > 2000
    assert 21 < known["sensor_width_mm"] < 23
    assert ground_facts.chip(settings, "a model that nobody knows") == {}


def test_a_camera_that_has_not_said_who_it_is() -> None:
    unknown = ground_facts.camera(None, None, {})
    assert (unknown.vendor, unknown.model, unknown.focal_length_mm) == ("dappled", "masked camera", None)
    who = Identity("Canon Inc.", "Canon EOS 450D", "1234", "usb:001,002")
    assert ground_facts.camera(who, 18.0, {}).model == "Canon EOS 450D"


def test_a_disk_that_does_not_say(tmp_path: Path) -> None:
    told = ground_facts.storage(tmp_path)
    assert told is not None
    assert told.total >= told.available > 0
    assert ground_facts.storage(tmp_path / "gone") is None


def test_a_shot_that_failed_was_not_captured() -> None:
    captured = ground_facts.of_story(PendingShot(SHOT, problem="no file came"), lambda utc_ns: utc_ns)
    assert (captured.index, captured.ok, captured.pose) == (7, False, None)


def test_an_image_that_nobody_took(tmp_path: Path) -> None:
    (tmp_path / "flights").mkdir()
    images = ImageIndex(tmp_path / "flights")
    assert ground_facts.of_record(3, images) is None
    images.close()
