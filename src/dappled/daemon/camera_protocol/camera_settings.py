"""What a ground station may see and set: the body's own settings and those of the decoder, by their MAVLink names."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from dappled.drivers.camera import CameraError, Setting, SettingName

# The names that QGroundControl gives a place of their own in its camera panel, where it has one.
_BODY: dict[SettingName, tuple[str, str]] = {
    "iso": ("CAM_ISO", "ISO"),
    "aperture": ("CAM_APERTURE", "Aperture"),
    "shutter_speed": ("CAM_SHUTTERSPD", "Shutter speed"),
    "image_format": ("CAM_FORMAT", "Image format"),
    "focal_length": ("CAM_FOCALLEN", "Focal length"),
    "battery": ("CAM_BATTERY", "Battery"),
}
_SETTINGS = {name: setting for setting, (name, _) in _BODY.items()}
_WORDS_FROM = 2**30


@dataclass(frozen=True, slots=True)
class Knob:
    """One setting: PARAM_EXT name (at most 16 letters), title, value and choices in words. No choices: read only."""

    name: str
    title: str
    value: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OwnKnob:
    """A setting of dappled itself. `turn` takes effect at once; None: it belongs to the flight."""

    name: str
    title: str
    value: Callable[[], str]
    choices: tuple[str, ...] = ()
    turn: Callable[[str], None] | None = None


class Body(Protocol):
    """The part of a camera driver that is needed here; see `drivers.camera.BodySettings`."""

    def settings(self) -> tuple[Setting, ...]: ...

    def change(self, name: SettingName, value: str) -> None: ...


class Knobs:
    """All settings of a camera, as they are known in memory."""

    def __init__(self, body: Body, own: Sequence[OwnKnob] = ()) -> None:
        self._body = body
        self._own = {knob.name: knob for knob in own}

    def all(self) -> tuple[Knob, ...]:
        """The body's first."""
        body = [
            Knob(*_BODY[each.name], each.value, each.choices) for each in self._body.settings() if each.name in _BODY
        ]
        own = [
            Knob(knob.name, knob.title, knob.value(), knob.choices if knob.turn else ()) for knob in self._own.values()
        ]
        return (*body, *own)

    def find(self, name: str) -> Knob | None:
        """A setting by its name."""
        return next((knob for knob in self.all() if knob.name == name), None)

    def turn(self, name: str, value: str) -> bool:
        """Ask for another value, returning at once. True: it is so now; False: the body was asked, and will tell.

        Raises CameraError, in one sentence, where it can't be.
        """
        knob = self.find(name)
        if knob is None:
            raise CameraError(f"there is no setting {name}")
        if value not in knob.choices:
            takes = f"it takes {', '.join(knob.choices)}" if knob.choices else "it can't be changed in flight"
            raise CameraError(f"{name} can't be {value}: {takes}")
        own = self._own.get(name)
        if own is not None and own.turn is not None:
            own.turn(value)
            return True
        self._body.change(_SETTINGS[name], value)
        return False


def code(value: str) -> int:
    """A value in words as the number that stands for it on the wire: a whole number below 2³⁰ as itself ("400"),
    anything else ("1/500") as 30 bits of its CRC-32 above that. So a number means the same whatever else may be
    chosen, and fits a signed 32-bit integer, which is what MAVSDK reads."""
    if value.isascii() and value.isdigit() and int(value) < _WORDS_FROM:
        return int(value)
    return zlib.crc32(value.encode()) >> 2 | _WORDS_FROM
