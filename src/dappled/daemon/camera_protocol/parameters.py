"""Serve the camera's settings as MAVLink parameters (PARAM_EXT, messages 320 to 324), and describe them in XML.

The XML is the camera definition file, which QGroundControl and MAVSDK read.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape  # that of xml.sax loads urllib, SSL and e-mail
from typing import Protocol

from dappled.drivers.camera import BodySettings, CameraError, SettingName
from dappled.drivers.mavlink import MavlinkMessage, mavlink

TYPE = mavlink.MAV_PARAM_EXT_TYPE_UINT32
WAIT_NS = 5 * 10**9
DEFINITION_PATH = "camera.xml"
_ACCEPTED = mavlink.PARAM_ACK_ACCEPTED
_FAILED = mavlink.PARAM_ACK_FAILED
_UNSUPPORTED = mavlink.PARAM_ACK_VALUE_UNSUPPORTED
_IN_PROGRESS = mavlink.PARAM_ACK_IN_PROGRESS
_WORDS_FROM = 2**30
# The names that QGroundControl gives a place of their own in its camera panel, where it has one.
_BODY: dict[SettingName, tuple[str, str]] = {
    "iso": ("CAM_ISO", "ISO"),
    "aperture": ("CAM_APERTURE", "Aperture"),
    "shutter_speed": ("CAM_SHUTTERSPD", "Shutter speed"),
    "image_format": ("CAM_FORMAT", "Image format"),
    "focal_length": ("CAM_FOCALLEN", "Focal length"),
    "battery": ("CAM_BATTERY", "Battery"),
}
_DECODED_BY: tuple[SettingName, ...] = ("image_format", "focal_length")
_SETTINGS = {name: setting for setting, (name, _) in _BODY.items()}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One setting: PARAM_EXT name (at most 16 letters), title, value and choices as text. No choices: read-only."""

    name: str
    title: str
    value: str
    choices: tuple[str, ...] = ()


class OwnParameters(Protocol):
    """Settings of dappled itself: `DecodingParameter`, `RecipeParameters`."""

    def parameters(self) -> Sequence[Parameter]:
        """Each as it is now."""

    def set(self, name: str, value: str) -> None:
        """Take one of the choices of one of them; it has it at once. Raises CameraError."""


class Parameters:
    """All settings of a camera, as known in memory: the body's and those of dappled itself."""

    def __init__(self, body: BodySettings, own: Sequence[OwnParameters] = (), *, unsigned: bool = False) -> None:
        """`unsigned`: strangers may set everything (`mavlink.unsigned_parameters`)."""
        self._body, self._own, self._unsigned = body, own, unsigned

    def closed_to_strangers(self, name: str) -> bool:
        """Whether it ends a flight, or changes how its frames can be decoded: not over an unsigned link that others
        reach."""
        own = any(one.name == name for several in self._own for one in several.parameters())
        return not self._unsigned and (own or _SETTINGS.get(name) in _DECODED_BY)

    def all(self) -> tuple[Parameter, ...]:
        """The body's first."""
        body = [
            Parameter(*_BODY[each.name], each.value, each.choices)
            for each in self._body.settings()
            if each.name in _BODY
        ]
        return (*body, *(one for several in self._own for one in several.parameters()))

    def find(self, name: str) -> Parameter | None:
        """A setting by its name."""
        return next((one for one in self.all() if one.name == name), None)

    def change(self, name: str, value: str) -> bool:
        """Ask for another value and return at once. True: it is set; False: the body was asked, and will report it.

        Raises CameraError, in one sentence, where it can't be set.
        """
        parameter = self.find(name)
        if parameter is None:
            raise CameraError(f"there is no setting {name}")
        if value not in parameter.choices:
            takes = f"it takes {', '.join(parameter.choices)}" if parameter.choices else "it can't be changed in flight"
            raise CameraError(f"{name} can't be {value}: {takes}")
        for several in self._own:
            if any(one.name == name for one in several.parameters()):
                several.set(name, value)
                return True
        self._body.change(_SETTINGS[name], value)
        return False


def unsigned_refusal(name: str) -> str:
    """What the pilot is told of a setting that is closed to strangers."""
    return f"{name} can't be set over an unsigned link: sign it, or set mavlink.unsigned_parameters"


@dataclass(frozen=True, slots=True)
class ParameterReply:
    """Messages for the link that asked, and text for the pilot."""

    messages: tuple[MavlinkMessage, ...]
    words: str | None = None


@dataclass(frozen=True, slots=True)
class _Asked:
    """A change that the body was asked for, and that its sender waits for."""

    value: str
    link: int
    due_ns: int


class ParameterServer:
    """Answers PARAM_EXT from memory. A change that the body needs time for is acknowledged twice: in progress, and how
    it ended."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._lock = threading.Lock()
        self._asked: dict[str, _Asked] = {}
        self._reported: dict[str, str] | None = (
            None  # each value as of the last call of `changed`; None: not called yet
        )

    def listing(self) -> ParameterReply:
        """PARAM_EXT_REQUEST_LIST (321)."""
        parameters = self._parameters.all()
        return ParameterReply(tuple(_value(one, at, len(parameters)) for at, one in enumerate(parameters)))

    def read(self, message: MavlinkMessage) -> ParameterReply:
        """PARAM_EXT_REQUEST_READ (320): by index, or by name where that is -1. No answer for an unknown one."""
        parameters = self._parameters.all()
        name, index = str(message.param_id), int(message.param_index)
        found = [
            _value(one, at, len(parameters))
            for at, one in enumerate(parameters)
            if (at == index if index >= 0 else one.name == name)
        ]
        return ParameterReply(tuple(found))

    def changed(self) -> tuple[MavlinkMessage, ...]:
        """PARAM_EXT_VALUE of each setting that differs from the last call, for all ground stations; nothing the first
        time."""
        parameters = self._parameters.all()
        now = {one.name: one.value for one in parameters}
        with self._lock:
            before, self._reported = self._reported or now, now
        return tuple(
            _value(one, at, len(parameters))
            for at, one in enumerate(parameters)
            if one.value != before.get(one.name, one.value)
        )

    def set(self, message: MavlinkMessage, link: int, now_ns: int, *, exposed: bool = False) -> ParameterReply:
        """PARAM_EXT_SET (323). Time is monotonic. `exposed`: a stranger may have sent it."""
        name = str(message.param_id)
        parameter = self._parameters.find(name)
        wanted = _number(message)
        if parameter is None or wanted is None:
            words = f"there is no setting {name}" if parameter is None else f"{name} takes whole numbers"
            now = (wanted or 0) if parameter is None else code(parameter.value)
            return ParameterReply((_ack(name, now, _UNSUPPORTED),), words)
        value = next((one for one in (*parameter.choices, parameter.value) if code(one) == wanted), None)
        if value is None:
            return ParameterReply((_ack(name, code(parameter.value), _UNSUPPORTED),), f"{name} has no choice {wanted}")
        asked = self._asked.get(name)
        if asked is not None and asked.value == value:
            return ParameterReply((_ack(name, wanted, _IN_PROGRESS),))  # a retry: the change is under way
        if asked is None and value == parameter.value:
            return ParameterReply((_ack(name, wanted, _ACCEPTED),))
        if exposed and self._parameters.closed_to_strangers(name):
            return ParameterReply((_ack(name, code(parameter.value), _FAILED),), unsigned_refusal(name))
        return self._change(parameter, value, _Asked(value, link, now_ns + WAIT_NS))

    def _change(self, parameter: Parameter, value: str, asked: _Asked) -> ParameterReply:
        with self._lock:
            self._asked[parameter.name] = asked
        result, words = _IN_PROGRESS, None
        try:
            if self._parameters.change(parameter.name, value):
                result = _ACCEPTED
        except CameraError as error:
            result, value, words = _FAILED, parameter.value, str(error)
        if result != _IN_PROGRESS:
            self._done(parameter.name, asked)
        return ParameterReply((_ack(parameter.name, code(value), result),), words)

    def settled(self, now_ns: int, refused: str | None = None) -> list[tuple[int, ParameterReply]]:
        """How changes ended that the body was asked for: (link, reply) each.

        Call when the body reports its settings (with its sentence where it `refused`), and regularly: a change that
        took longer than five seconds has failed.
        """
        replies = []
        with self._lock:
            waiting = list(self._asked.items())
        for name, asked in waiting:
            parameter = self._parameters.find(name)
            now = "" if parameter is None else parameter.value
            if now == asked.value:
                reply = ParameterReply((_ack(name, code(now), _ACCEPTED),))
            elif refused or now_ns >= asked.due_ns or parameter is None:
                why = refused or "the camera has not taken it for 5 s"
                reply = ParameterReply((_ack(name, code(now), _FAILED),), f"{name} stays {now or 'unknown'}: {why}")
            else:
                continue
            if self._done(name, asked):
                replies.append((asked.link, reply))
        return replies

    def _done(self, name: str, asked: _Asked) -> bool:
        """Whether this is still the change asked for: not replaced by another value, and not reported already."""
        with self._lock:
            ours = self._asked.get(name) is asked
            if ours:
                del self._asked[name]
        return ours


@dataclass(frozen=True, slots=True)
class Definition:
    """The file's bytes, and its version: ground stations cache it by vendor, model and version, so the version
    changes with the content (1 to 65535, made from it: the same content has the same version after a restart)."""

    version: int
    xml: bytes

    def uri(self, component_id: int) -> str:
        """Where to fetch it: over MAVLink FTP, from our component."""
        return f"mftp://[;comp={component_id}]/{DEFINITION_PATH}"


def camera_definition(vendor: str, model: str, parameters: Iterable[Parameter]) -> Definition:
    """The definition of a camera with these settings."""
    described = "".join(_described(one) for one in parameters)
    version = zlib.crc32((vendor + "\0" + model + "\0" + described).encode()) % 65535 + 1
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<mavlinkcamera>\n'
        f'  <definition version="{version}">\n'
        f"    <model>{escape(model)}</model>\n    <vendor>{escape(vendor)}</vendor>\n  </definition>\n"
        f"  <parameters>\n{described}  </parameters>\n</mavlinkcamera>\n"
    )
    return Definition(version, text.encode())


def _described(parameter: Parameter) -> str:
    """One setting: choices in the body's order; the current value as the only one where it is read-only."""
    choices = parameter.choices or (parameter.value,)
    readonly = "" if parameter.choices else ' readonly="1"'
    options = "".join(f'        <option name="{escape(one)}" value="{code(one)}"/>\n' for one in choices)
    return (
        f'    <parameter name="{parameter.name}" type="uint32" default="{code(choices[0])}"{readonly}>\n'
        f"      <description>{escape(parameter.title)}</description>\n"
        f"      <options>\n{options}      </options>\n    </parameter>\n"
    )


def code(value: str) -> int:
    """The number that stands for a value on the wire.

    A whole number below 2³⁰ ("400") stands for itself; anything else ("1/500") is 2³⁰ plus 30 bits of its CRC-32. So a
    number means the same whatever the other choices are, and fits the signed 32-bit integer that MAVSDK reads.
    """
    if value.isascii() and value.isdigit() and int(value) < _WORDS_FROM:
        return int(value)
    return zlib.crc32(value.encode()) >> 2 | _WORDS_FROM


def _value(parameter: Parameter, index: int, count: int) -> MavlinkMessage:
    return mavlink.MAVLink_param_ext_value_message(
        parameter.name.encode(), _packed(code(parameter.value)), TYPE, count, index
    )


def _ack(name: str, value: int, result: int) -> MavlinkMessage:
    return mavlink.MAVLink_param_ext_ack_message(name.encode()[:16], _packed(value), TYPE, result)


def _packed(value: int) -> bytes:
    return struct.pack("<I", value).ljust(128, b"\0")


def _number(message: MavlinkMessage) -> int | None:
    """The value as a number: None for another type than ours."""
    if message.param_type != TYPE:
        return None
    data: bytes = message._param_value_raw  # pymavlink cuts `param_value` at the first zero byte, as if it were text
    return int(struct.unpack("<I", data[:4].ljust(4, b"\0"))[0])
