"""The body against the plan: what is set, what a hand must turn, what is unknown, and frames that drift."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest

from dappled.config.settings import PlannedBody
from dappled.daemon.body_plan import BodyPlan, BodyReport, BodyTemperature
from dappled.drivers.camera import CameraError, Setting, SettingName, SettingsChanged, StateChanged, check_change
from dappled.findings import Code, Finding, Level, above_note, text, told
from dappled.flight import Tag, TimeSource
from tests.daemon.fakes import no_pose

AS_PLANNED = (
    Setting("exposure_mode", "Manual", ("P", "AV", "Manual")),
    Setting("focus_mode", "Manual"),
    Setting("drive_mode", "Single", ("Single", "Continuous", "Timer 10 sec")),
    Setting("image_format", "RAW", ("L", "L + RAW", "RAW")),
    Setting("auto_power_off", "0", ("0",)),
    Setting("mirror_lockup", "off"),
    Setting("capture_target", "Memory card", ("Internal RAM", "Memory card")),
    Setting("iso", "100", ("Auto", "100", "400")),
    Setting("free_shots", "250"),
)


class Body:
    """A body with settings; those in `refused` stay as they are."""

    def __init__(self, *refused: SettingName, **changed: str) -> None:
        self.refused = refused
        self.now = tuple(replace(one, value=changed.get(one.name, one.value)) for one in AS_PLANNED)
        self.asked: list[tuple[str, str]] = []

    def settings(self) -> tuple[Setting, ...]:
        return self.now

    def change(self, name: SettingName, value: str) -> None:
        check_change(self.now, name, value)
        self.asked.append((name, value))
        if name not in self.refused:
            self.turn(**{name: value})

    def turn(self, **changed: str) -> None:
        self.now = tuple(replace(one, value=changed.get(one.name, one.value)) for one in self.now)


def said(found: Finding | None) -> str:
    return "" if found is None else str(text(found))


class Rig:
    def __init__(self, body: Body, planned: PlannedBody | None = None) -> None:
        self.body = body
        self.plan = BodyPlan(planned or PlannedBody(), "card", body)
        self.plan.take(StateChanged("ready", "", 0))
        self.read()

    def report(self) -> BodyReport:
        found = self.plan.report()
        assert found is not None
        return found

    def read(self, refused: str = "") -> None:
        """The driver reads the settings, and again after those that it was asked to change."""
        for _ in range(2):
            self.plan.settings_changed(SettingsChanged(self.body.now, 0, refused))

    def check(self) -> list[str]:
        """What stands between the body and go."""
        return [str(told(one)) for one in above_note(self.report().findings())]


def test_a_setting_that_was_wrong_is_not_over_because_the_camera_was_unplugged() -> None:
    """A pilot read "over: ISO" when the cable had come off."""
    rig = Rig(Body("iso", iso="400"), PlannedBody(iso="100"))
    (wrong,) = rig.report().wrong
    assert (wrong.subject.which, rig.plan.unseen()) == ("ISO", ())
    for state in ("absent", "starting"):
        rig.plan.take(StateChanged(state, "", 0))
        assert rig.plan.unseen() == (wrong,)
    rig.plan.take(StateChanged("ready", "", 0))
    assert rig.plan.unseen() == (wrong,)  # its settings are not read yet
    rig.body.now = AS_PLANNED
    rig.read()
    assert (rig.plan.unseen(), rig.report().wrong) == ((), ())


def tag(index: int, **values: float | None) -> Tag:
    given = {"focal_length_mm": 35.0, "f_number": 5.6, "exposure_s": 1 / 1000, "iso": 100.0} | values
    lens = given["focal_length_mm"], given["f_number"], given["exposure_s"], given["iso"]
    return Tag(index, 0, 0, TimeSource.TRIGGER_CALL, *lens, "", "", "", no_pose())


@pytest.mark.parametrize("word", ["Low", "25%", "0 %", " 10% ", "EMPTY", "critical"])
def test_a_battery_that_will_not_last_is_told_and_is_a_caution_before_flight(word: str) -> None:
    rig = Rig(Body())
    rig.body.now = (*AS_PLANNED, Setting("battery", word))
    rig.read()
    assert rig.check() == [f"the camera's battery is nearly empty: {word.strip()}: change it"]


def test_how_warm_the_body_is_is_told_and_is_a_caution_where_it_is_hot() -> None:
    rig = Rig(Body())
    rig.body.now = AS_PLANNED
    rig.read()
    assert rig.report().values()["temperature_c"] is None
    rig.plan.take(BodyTemperature(24.0))
    assert rig.report().values()["temperature_c"] == 24.0
    assert rig.check() == []
    rig.plan.take(BodyTemperature(50.0))
    assert [one.code for one in rig.report().findings()] == [Code.BODY_HOT]
    rig.plan.camera_changed(StateChanged("absent", "unplugged", 0))
    rig.plan.take(StateChanged("ready", "", 0))
    assert rig.report().temperature_c is None  # it may be another body


@pytest.mark.parametrize(
    ("word", "percent"),
    [("100%", 100), ("50%", 50), ("26%", 26), ("999%", None), ("Unknown value 0x0007", None), ("", None)],
)
def test_a_good_one_and_one_that_says_nothing_clear_are_not(word: str, percent: int | None) -> None:
    rig = Rig(Body())
    rig.body.now = (*AS_PLANNED, Setting("battery", word))
    rig.read()
    assert rig.report().values()["battery_percent"] == percent
    assert rig.check() == []


def test_a_body_as_planned_is_left_alone() -> None:
    rig = Rig(Body())
    assert rig.check() == []
    assert not rig.body.asked


def test_what_can_be_set_is_set_once_and_the_rest_is_no_go() -> None:
    """A dial can't be turned over USB; what was set by hand in flight is not set back."""
    rig = Rig(Body("exposure_mode", exposure_mode="AV", drive_mode="Continuous", image_format="L", auto_power_off="30"))
    asked = [("exposure_mode", "Manual"), ("drive_mode", "Single"), ("image_format", "RAW"), ("auto_power_off", "0")]
    assert sorted(rig.body.asked) == sorted(asked)
    assert rig.check() == ["camera's exposure mode: it is AV, not manual as planned: turn the mode dial"]
    assert [one.level for one in rig.report().findings()] == [Level.STOP]
    rig.body.turn(exposure_mode="Manual")
    rig.read()
    assert rig.check() == []
    rig.body.turn(drive_mode="Timer 10 sec")
    rig.read()
    assert rig.check() != []
    assert len(rig.body.asked) == 4  # told, and not turned back
    rig.plan.camera_changed(StateChanged("absent", "unplugged", 0))
    assert rig.plan.report() is None
    rig.plan.camera_changed(StateChanged("ready", "", 0))
    assert not rig.report().read
    rig.read()
    assert rig.check() == []  # opened again, it is set again


def test_nothing_is_set_where_that_is_not_wanted() -> None:
    rig = Rig(Body(drive_mode="Continuous"), PlannedBody(check="tell"))
    assert rig.check() == ["camera's drive mode: it is Continuous, not single as planned: set it at the body"]
    assert not rig.body.asked
    rig = Rig(Body(drive_mode="Continuous"), PlannedBody(check="off"))
    assert [one.code for one in rig.report().findings()] == [Code.BODY_UNCHECKED]
    assert not rig.body.asked
    assert not rig.report().wrong


def test_what_the_body_does_not_report_is_unknown_and_not_good() -> None:
    body = Body()
    body.now = tuple(one for one in body.now if one.name not in ("mirror_lockup", "focus_mode"))
    assert Rig(body).check() == ["the camera doesn't report focus mode, mirror lock-up: look at it"]
    body.now = ()
    (unread,) = Rig(body).check()
    assert unread.startswith("the camera's settings can't be read: look at exposure mode, focus mode, drive mode")


@pytest.mark.parametrize(
    ("setting", "planned", "value", "same"),
    [
        ("shutter_speed", "1/1000", "0.001", True), ("shutter_speed", "1/60", "1/64", True),
        ("shutter_speed", "1/1000", "1/800", False), ("aperture", "5.6", "f/5.7", True),
        ("aperture", "5.6", "6.3", False), ("iso", "400", "400", True), ("iso", "400", "Auto", False),
        ("image_format", "raw", "L + RAW", True), ("image_format", "raw", "Large Fine JPEG", False),
        ("white_balance", "daylight", "Daylight", True), ("focus_mode", "manual", "One Shot", False),
        ("exposure_mode", "manual", "M", True), ("iso", "1/0", "100", False),
    ],
)  # fmt: skip
def test_each_body_has_its_own_words(setting: SettingName, planned: str, value: str, same: bool) -> None:
    body = Body()
    body.now = (*(one for one in body.now if one.name != setting), Setting(setting, value))
    rig = Rig(body, replace(PlannedBody(), **cast(Any, {setting: planned})))
    assert (not rig.report().wrong) == same


def test_what_a_person_sets_in_flight_is_the_plan_from_then_on() -> None:
    rig = Rig(Body(), PlannedBody(iso="100"))
    with pytest.raises(CameraError):
        rig.plan.change("iso", "123")
    rig.plan.change("iso", "400")
    rig.read()
    assert rig.check() == []
    assert rig.plan.tagged(tag(1, iso=400.0)) is None
    assert said(rig.plan.tagged(tag(2))) == "frame 2 was taken with ISO 100, not 400 as planned"
    rig.body.refused = ("iso",)
    rig.plan.change("iso", "Auto")
    rig.read(refused="iso was not set to Auto: busy")
    assert not any("Auto" in str(told(one)) for one in rig.report().wrong)


def test_each_frame_is_compared_with_the_plan() -> None:
    rig = Rig(Body(), PlannedBody(iso="100", shutter_speed="1/1000", aperture="5.6", focal_length_mm=35))
    assert rig.plan.tagged(tag(1)) is None
    drift = (
        "frame 2 was taken with shutter speed 1/250 s, not 1/1000 as planned; focal length 34 mm, not 35 mm as planned"
    )
    assert said(rig.plan.tagged(tag(2, exposure_s=1 / 250, focal_length_mm=34.0))) == drift
    unreported = "the camera doesn't report shutter speed, aperture: look at it"
    assert rig.check() == [f"{drift}: look at the camera's dials", unreported]
    assert said(rig.plan.tagged(tag(3, iso=None))) == "frame 3 was taken with ISO unknown, not 100 as planned"
    assert rig.plan.tagged(tag(4)) is None
    assert rig.check() == [unreported]  # the next frame as planned ends it


def test_without_a_plan_a_frame_is_compared_with_the_one_before() -> None:
    rig = Rig(Body())
    assert rig.plan.tagged(tag(1)) is None
    drift = "frame 2 was taken with ISO 200; frame 1 with ISO 100"
    assert said(rig.plan.tagged(tag(2, iso=200.0))) == drift
    assert rig.plan.tagged(tag(3, iso=200.0)) is None
    assert rig.plan.tagged(tag(0)) is None  # it came late
    automatic = Rig(Body(exposure_mode="AV"), PlannedBody(exposure_mode="AV"))
    assert automatic.plan.tagged(tag(1)) is None
    assert automatic.plan.tagged(tag(2, exposure_s=1 / 30)) is None  # the body's business in this mode


@pytest.mark.parametrize(
    ("room", "codes"), [("101", []), ("20", [Code.BODY_CARD_FILLING]), ("0", [Code.BODY_CARD_FULL])]
)
def test_a_card_that_is_nearly_full_is_told(room: str, codes: list[Code]) -> None:
    rig = Rig(Body(free_shots=room))
    assert [one.code for one in rig.report().findings()] == codes
    memory = Rig(Body(free_shots=room, capture_target="Internal RAM"), PlannedBody(check="off"))
    assert memory.report().card_frames is None  # what counts then is this computer's disk
