"""Another mask or law from the next flight on: what it is flown with, and which flight follows which."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from dappled import findings
from dappled.clock import RecordedClock
from dappled.config import profiles
from dappled.config.settings import CameraSettings, DecodeSettings, MaskSettings, Settings
from dappled.daemon import flight_handover
from dappled.daemon.camera_protocol.parameters import Parameters
from dappled.daemon.flight_handover import BY_BODY, NONE, FlightHandover, RecipeParameters
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.camera import CameraError, Setting, SettingName
from dappled.errors import DappledError
from dappled.findings import Finding
from tests.daemon.fakes import FakeSink

CONFIGURED = Settings(
    camera=CameraSettings(profile="reference-36mm"),
    mask=MaskSettings("reference-5x5"),
    decode=DecodeSettings(calibration="/bench/calibration.toml", white="/bench/white.dng"),
)


class NoBody:
    def settings(self) -> tuple[Setting, ...]:
        return ()

    def change(self, name: SettingName, value: str) -> None:
        raise AssertionError(name)


class Flown:
    """A flight, and what a ground station may set in it. `events` are those that it writes."""

    def __init__(self, settings: Settings, after: FlightHandover | None, names: Names | None = None) -> None:
        self.events: list[str] = []
        clock = RecordedClock(10**18)
        self.shutter = Shutter(FakeSink(), clock, next_index=0)
        flown = names or recipes.called(settings)
        recipe = RecipeParameters(flown, after, LiveSettings(settings), self.shutter, self.later)
        self.parameters = Parameters(NoBody(), (recipe,))

    def later(self, kind: str, found: Finding) -> None:
        self.events.append(f"{kind}: {findings.text(found)}")


def test_each_shipped_mask_each_law_and_no_mask_can_be_chosen() -> None:
    after = FlightHandover(CONFIGURED)
    assert set(after.masks()) == {*profiles.shipped("masks"), NONE}
    assert set(after.laws()) == {"fd", "geometric"}
    own = replace(CONFIGURED, mask=MaskSettings("/bench/of-my-own.toml"), camera=CameraSettings(profile="auto"))
    assert "of-my-own" in FlightHandover(own).masks()
    assert BY_BODY in FlightHandover(own).laws()


def test_lenslets_have_nothing_to_choose() -> None:
    lenslets = replace(CONFIGURED, mask=MaskSettings(profiles.LENSLET))
    after = FlightHandover(lenslets)
    assert (after.masks(), after.laws()) == ((), ())
    found = Flown(lenslets, after).parameters
    with pytest.raises(CameraError, match="can't be changed"):
        found.change("LF_MASK", "mask-1")


def test_a_calibration_counts_with_its_own_mask_and_law_alone() -> None:
    after = FlightHandover(CONFIGURED)
    other = after.with_mask(CONFIGURED, "mask-3")
    assert (other.mask.profile, other.decode.calibration) == ("mask-3", "")
    assert other.decode.white == CONFIGURED.decode.white
    assert after.with_mask(other, "reference-5x5") == CONFIGURED
    law = next(one for one in after.laws() if one != recipes.called(CONFIGURED).law)
    bent = after.with_law(CONFIGURED, law)
    assert (bent.decode.law, bent.decode.calibration) == (law, "")
    assert after.with_mask(bent, "mask-3").decode.calibration == ""
    assert after.with_law(bent, recipes.called(CONFIGURED).law) == CONFIGURED
    assert after.with_mask(CONFIGURED, NONE).mask.profile == ""


def test_what_was_set_is_asked_for_and_a_second_setting_comes_on_top_of_the_first() -> None:
    after = FlightHandover(CONFIGURED)
    flown = Flown(CONFIGURED, after)
    found = flown.parameters
    assert found.change("LF_MASK", "mask-2")
    assert found.change("LF_LAW", "fd")
    assert flown.events == [
        "next flight: mask mask-2 from there on, by the ground station",
        "next flight: carrier law fd from there on, by the ground station",
    ]
    assert after.next is not None
    assert (after.next.mask.profile, after.next.decode.law) == ("mask-2", "fd")
    assert [one.value for one in found.all()] == ["mask-2", "fd"]  # what all ground stations are told


def test_what_is_refused_is_not_shown() -> None:
    after = FlightHandover(CONFIGURED)
    flown = Flown(CONFIGURED, after)
    found = flown.parameters
    assert flown.shutter.request(CaptureRequest("test", "console", 1)).accepted
    for name, word in (("LF_MASK", "mask-2"), ("LF_LAW", "fd")):
        with pytest.raises(CameraError, match="under way"):
            found.change(name, word)
    assert [one.value for one in found.all()] == list(flight_handover.words(recipes.called(CONFIGURED)))
    assert (after.next, flown.events) == (None, [])


def test_where_no_flight_can_follow_they_are_to_be_read() -> None:
    found = Flown(CONFIGURED, None, Names("auto", "", "")).parameters
    assert [(one.name, one.value, one.choices) for one in found.all()] == [
        ("LF_MASK", NONE, ()),
        ("LF_LAW", BY_BODY, ()),
    ]


def test_flights_follow_one_another_until_one_is_the_last() -> None:
    flown: list[str] = []

    def fly(settings: Settings, after: FlightHandover) -> bool:
        flown.append(settings.mask.profile)
        after.began = True
        if len(flown) < 3:
            after.next = after.with_mask(settings, f"mask-{len(flown)}")
        return True

    flight_handover.flights(CONFIGURED, fly)
    assert flown == ["reference-5x5", "mask-1", "mask-2"]


def test_nothing_follows_a_flight_that_was_told_to_end() -> None:
    flown: list[str] = []

    def fly(settings: Settings, after: FlightHandover) -> bool:
        flown.append(settings.mask.profile)
        after.next = after.with_mask(settings, "mask-1")
        return False

    flight_handover.flights(CONFIGURED, fly)
    assert flown == ["reference-5x5"]


def test_a_next_flight_that_can_not_begin_leaves_all_as_it_was(caplog: pytest.LogCaptureFixture) -> None:
    flown: list[str] = []

    def fly(settings: Settings, after: FlightHandover) -> bool:
        flown.append(settings.mask.profile)
        if settings.mask.profile == "mask-1":
            raise DappledError("not with this one")
        after.began = True
        if len(flown) == 1:
            after.next = after.with_mask(settings, "mask-1")
        return True

    with caplog.at_level(logging.WARNING):
        flight_handover.flights(CONFIGURED, fly)
    assert flown == ["reference-5x5", "mask-1", "reference-5x5"]
    assert "not with this one" in caplog.text


@pytest.mark.parametrize("began", [True, False])
def test_what_goes_wrong_in_flight_or_at_the_first_start_is_not_repeated(began: bool) -> None:
    flown: list[str] = []

    def fly(settings: Settings, after: FlightHandover) -> bool:
        flown.append(settings.mask.profile)
        after.began = began
        raise DappledError("the disk is gone")

    with pytest.raises(DappledError, match="disk is gone"):
        flight_handover.flights(CONFIGURED, fly)
    assert len(flown) == 1
