"""Compare the camera's body with the plan: set what can be set, say what a hand must turn, report drift."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dappled import codec
from dappled.config.settings import PlannedBody
from dappled.drivers.camera import (
    EXPOSURES,
    BodySettings,
    CameraError,
    ExposurePlan,
    Setting,
    SettingName,
    SettingsChanged,
    StateChanged,
    off_plan,
    taken_with,
)
from dappled.findings import Code, Finding, Level, Subject, Value, finding
from dappled.flight import Tag

log = logging.getLogger(__name__)
CARD_FRAMES = 20  # fewer than that, and the pilot is told
HOT_C = 50.0  # inside a body; Canon's may be used in air of up to 40 °C
LOW_PERCENT = 25
_LOW_WORDS = ("low", "empty", "exhausted", "critical")
_OFF = ("off", "0", "disable", "disabled", "never", "none")
_WORDS: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("exposure_mode", "manual"): ("manual", "m"),
    ("focus_mode", "manual"): ("manual", "manual focus", "mf", "m"),
    ("drive_mode", "single"): ("single", "single shot", "single frame", "single silent"),
    ("auto_power_off", "off"): _OFF,
    ("mirror_lockup", "off"): _OFF,
}
"""What bodies call a planned value. Any other one is compared as it is written."""
_TITLES: Mapping[SettingName, str] = {
    "exposure_mode": "exposure mode",
    "focus_mode": "focus mode",
    "drive_mode": "drive mode",
    "white_balance": "white balance",
    "image_format": "image format",
    "auto_power_off": "automatic power-off",
    "mirror_lockup": "mirror lock-up",
    "capture_target": "place of new pictures",
    "iso": "ISO",
    "shutter_speed": "shutter speed",
    "aperture": "aperture",
    "focal_length": "focal length",
}
_BY_HAND: Mapping[SettingName, str] = {
    "exposure_mode": "turn the mode dial",
    "focus_mode": "turn the switch at the lens",
    "mirror_lockup": "set it in the body's menu (custom functions)",
    "focal_length": "turn the zoom ring",
}


@dataclass(frozen=True, slots=True)
class BodyTemperature:
    """How warm a body was inside when it took a frame, by the frame's file."""

    degrees_c: float


BodyNews = StateChanged | SettingsChanged | Tag | BodyTemperature


@dataclass(frozen=True, slots=True)
class BodyReport:
    """How the body stands to the plan. `wrong` settings are not as planned; `unknown` are the titles of planned
    settings that the body doesn't report. `drift` says what the last frames were taken with instead; `card_frames` is
    the room on its card, None where it reports none or stores elsewhere. `battery` is its word for what its battery
    holds, "" where it says nothing, `battery_percent` that as a number, where it is one; `temperature_c` is that of the
    last frame's file. `read`: its settings were read; `checked`: they are compared.
    """

    read: bool
    checked: bool
    wrong: tuple[Finding, ...]
    unknown: tuple[str, ...]
    drift: Finding | None
    card_frames: int | None
    battery: str
    battery_percent: int | None
    battery_low: bool
    temperature_c: float | None

    def findings(self) -> Iterator[Finding]:
        """What is not as it should be."""
        about, settings = Subject("camera"), ", ".join(self.unknown)
        yield from self.wrong
        if self.drift is not None:
            yield self.drift
        yield from self.of_card()
        if self.battery_low:
            yield finding(Code.BODY_BATTERY_LOW, about, battery=self.battery)
        if self.temperature_c is not None and self.temperature_c >= HOT_C:
            yield finding(Code.BODY_HOT, about, degrees_c=self.temperature_c)
        if not self.checked:
            yield finding(Code.BODY_UNCHECKED, about)
        elif settings:
            yield finding(Code.BODY_UNREPORTED if self.read else Code.BODY_UNREAD, about, settings=settings)

    def of_card(self) -> Iterator[Finding]:
        """What is wrong with the room on its card."""
        if self.card_frames == 0:
            yield finding(Code.BODY_CARD_FULL, Subject("camera"))
        elif self.card_frames is not None and self.card_frames <= CARD_FRAMES:
            yield finding(Code.BODY_CARD_FILLING, Subject("camera"), frames=self.card_frames)

    def values(self) -> dict[str, Any]:
        """As the health record has it."""
        return {name: one for name, one in codec.plain(self).items() if name not in ("wrong", "drift")}


class BodyPlan:
    """The settings that a body is planned to have, and those that it has. It stands between a ground station's requests
    and the camera: what a person sets there is the plan from then on.

    A body is set once each time it is opened, never between shots: what a hand turns later is reported, not set back.
    `exposure` is what frames are compared with now, nothing where the plan isn't checked; any thread may read it.
    """

    def __init__(self, planned: PlannedBody, capture_target: str, body: BodySettings) -> None:
        self._check, self._body = planned.check, body
        self._planned = plan_of(planned, capture_target)
        self._requested: dict[SettingName, str] = {}
        self.exposure: ExposurePlan = {}
        self._replan()
        self._found: tuple[Setting, ...] = ()
        self._may_set, self._ready = True, False
        self._manual = planned.exposure_mode == "manual"
        self._last: dict[SettingName, tuple[float, int]] = {}
        self._drift: Finding | None = None
        self._left: tuple[Finding, ...] = ()  # what was found when the camera went, until another one is read
        self._temperature_c: float | None = None

    # what a ground station uses

    def settings(self) -> tuple[Setting, ...]:
        return self._body.settings()

    def change(self, name: SettingName, value: str) -> None:
        """Request another value for a person: it is the plan from now on unless the body refuses it."""
        self._body.change(name, value)
        self._requested = {**self._requested, name: value}
        self._replan()

    # what the camera reports

    def take(self, news: BodyNews) -> Finding | None:
        """Take what the camera reported, in order. Returns what is to be said of a frame that is not as planned."""
        match news:
            case StateChanged():
                self.camera_changed(news)
            case SettingsChanged():
                self.settings_changed(news)
            case Tag():
                return self.tagged(news)
            case BodyTemperature(degrees):
                self._temperature_c = degrees
        return None

    def camera_changed(self, change: StateChanged) -> None:
        """The camera has come or gone. One that has gone is compared, and set, when it is opened again."""
        before, self._ready = self.report(), change.state in ("ready", "busy")  # the settings are read before
        if before is not None and not self._ready:
            self._left = (*before.wrong, *before.of_card())
        if change.state in ("absent", "faulted"):
            self._found, self._may_set, self._temperature_c = (), True, None

    def settings_changed(self, change: SettingsChanged) -> None:
        """The settings were read. The first ones after opening are changed to the plan's where the body lets them."""
        self._found = change.settings
        if change.refused:
            now = {one.name: one.value for one in change.settings}
            self._requested = {k: v for k, v in self._requested.items() if k not in now or _is(k, v, now[k])}
            self._replan()
        if self._check == "set" and self._may_set and self._found:
            self._may_set = False
            self._set()

    def tagged(self, tag: Tag) -> Finding | None:
        """Compare a frame with the plan, and where the plan leaves an exposure open with the frame before. Returns how
        they differ."""
        if self._check == "off":
            return None
        said = [*off_plan(tag, self.exposure)]
        for name, value in taken_with(tag).items():
            if name not in self.exposure and value is not None and (was := self._changed(name, value, tag.index)):
                said.append(was)
        about: dict[str, Value] = {"frame": tag.index, "taken_with": "; ".join(said)}
        self._drift = Finding(Code.BODY_DRIFT, Subject("camera"), about, Level.CAUTION) if said else None
        return self._drift

    # what others ask

    def unseen(self) -> tuple[Finding, ...]:
        """What was not as it should be when the camera went: nothing shows that it is over, until one is read again."""
        now = self.report()
        return () if now is not None and now.read else self._left

    def report(self) -> BodyReport | None:
        """The body against the plan, now; None while no camera is ready."""
        if not self._ready:
            return None
        now = {one.name: one.value for one in self._found}
        plan = self._plan() if self._check != "off" else {}
        # A focal length that no body reports is compared by each frame's EXIF.
        unknown = tuple(_TITLES[name] for name in plan if name not in now and name != "focal_length")
        battery, percent, low = _battery(now.get("battery", ""))
        return BodyReport(
            read=bool(self._found),
            checked=self._check != "off",
            wrong=tuple(
                finding(
                    Code.BODY_SETTING_WRONG,
                    Subject("camera's", _TITLES[name]),
                    value=now[name],
                    planned=wanted,
                    remedy=_BY_HAND.get(name, "set it at the body"),
                )
                for name, wanted in plan.items()
                if name in now and not _is(name, wanted, now[name])
            ),
            unknown=unknown,
            drift=self._drift,
            card_frames=_card_frames(now),
            battery=battery,
            battery_percent=percent,
            battery_low=low,
            temperature_c=self._temperature_c,
        )

    def _replan(self) -> None:
        self.exposure = {} if self._check == "off" else exposure_of(self._plan())

    def _plan(self) -> dict[SettingName, str]:
        return self._planned | {name: value for name, value in self._requested.items() if name in _TITLES}

    def _set(self) -> None:
        """Ask the body for each planned value that it hasn't, and accepts. It reports the outcome."""
        plan = self._plan()
        for one in self._found:
            wanted = plan.get(one.name)
            if wanted is None or _is(one.name, wanted, one.value):
                continue
            choice = _choice(one, wanted)
            if choice is None:
                continue
            try:
                self._body.change(one.name, choice)
                log.info("the camera's %s is set from %s to %s", _TITLES[one.name], one.value, choice)
            except CameraError as error:
                log.warning("the camera's %s was not set: %s", _TITLES[one.name], error)

    def _changed(self, name: SettingName, value: float, index: int) -> str:
        """What an exposure was before, where the body is in manual mode and nobody has requested another."""
        if not self._manual or name not in ("iso", "shutter_speed"):
            return ""  # the verdicts compare the lens' settings
        before = self._last.get(name)
        if before is not None and index < before[1]:
            return ""  # a file that comes late
        self._last[name] = value, index
        if before is None or EXPOSURES[name].is_same(value, before[0]):
            return ""
        return f"{EXPOSURES[name].words(value)}; frame {before[1]} with {EXPOSURES[name].words(before[0])}"


def exposure_of(plan: Mapping[SettingName, str]) -> ExposurePlan:
    """The numbers of a plan that a frame's EXIF is compared with."""
    numbers = {name: (plan[name], _number(plan[name])) for name in EXPOSURES if name in plan}
    return {name: (wanted, number) for name, (wanted, number) in numbers.items() if number is not None}


def plan_of(planned: PlannedBody, capture_target: str = "") -> dict[SettingName, str]:
    """The plan by the names of the driver's settings, without those that may have any value."""
    focal = f"{planned.focal_length_mm:g} mm" if planned.focal_length_mm else ""
    every: dict[SettingName, str] = {
        "exposure_mode": planned.exposure_mode,
        "focus_mode": planned.focus_mode,
        "drive_mode": planned.drive_mode,
        "white_balance": planned.white_balance,
        "image_format": planned.image_format,
        "auto_power_off": planned.auto_power_off,
        "mirror_lockup": planned.mirror_lockup,
        "capture_target": capture_target,
        "iso": planned.iso,
        "shutter_speed": planned.shutter_speed,
        "aperture": planned.aperture,
        "focal_length": focal,
    }
    return {name: value for name, value in every.items() if value}


def _is(name: SettingName, wanted: str, value: str) -> bool:
    """Whether a body's value is the one that is wanted."""
    one, other = wanted.strip().lower(), value.strip().lower()
    if name == "image_format" and one == "raw":
        return re.search(r"\b(c?raw|nef|raf|dng|arw|orf)\b", other) is not None
    if name == "capture_target" and one in ("card", "ram"):
        return one in other
    numbers = (_number(one), _number(other)) if name in EXPOSURES else (None, None)
    if numbers[0] is not None and numbers[1] is not None:
        return EXPOSURES[name].is_same(numbers[1], numbers[0])
    return other in _WORDS.get((name, one), (one,))


def _choice(setting: Setting, wanted: str) -> str | None:
    """The shortest of a setting's choices that is the wanted value ("RAW" before "L + RAW"); None without one."""
    return min((one for one in setting.choices if _is(setting.name, wanted, one)), key=len, default=None)


def _number(text: str) -> float | None:
    """A number as bodies write it: "400", "1/250", "f/5.6", "35 mm"; None for other text, such as "auto"."""
    found = re.fullmatch(r"(?:iso |f/)?(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?(?: ?(?:s|mm))?", text.strip().lower())
    if found is None:
        return None
    below = float(found[2] or 1)
    return float(found[1]) / below if below else None


def _card_frames(now: Mapping[SettingName, str]) -> int | None:
    """How many more frames the body's card takes, by its own count; None where it stores elsewhere or says nothing."""
    count = now.get("free_shots", "")
    return int(count) if count.isdecimal() and "card" in now.get("capture_target", "").lower() else None


def _battery(word: str) -> tuple[str, int | None, bool]:
    """A body's word for its battery, the percentage where it is one, and whether it is nearly empty. Each body has its
    own words."""
    word = word.strip()
    found = re.fullmatch(r"(\d{1,3})\s*%", word)
    percent = int(found[1]) if found and int(found[1]) <= 100 else None
    return word, percent, word.lower() in _LOW_WORDS if percent is None else percent <= LOW_PERCENT
