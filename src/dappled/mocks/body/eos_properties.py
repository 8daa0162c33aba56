"""The properties of a Canon EOS 450D, and the events by which it tells of them and of its captures."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Mapping
from enum import IntEnum

from dappled.mocks.body import ptp_data
from dappled.mocks.body.ptp import Answer, Code, Handler, Op, Request

_TO_CARD = 2
_TO_MEMORY = 4


class Prop(IntEnum):
    """EOS property codes."""

    APERTURE = 0xD101
    SHUTTER_SPEED = 0xD102
    ISO = 0xD103
    AUTO_EXPOSURE_MODE = 0xD105
    DRIVE_MODE = 0xD106
    FOCUS_MODE = 0xD108
    BATTERY = 0xD111
    OWNER = 0xD115
    MODEL_ID = 0xD116
    AVAILABLE_SHOTS = 0xD11B
    CAPTURE_DESTINATION = 0xD11C
    IMAGE_FORMAT = 0xD120
    SERIAL_NUMBER = 0xD1AF
    EVF_OUTPUT = 0xD1B0


_CHOICES = {
    Prop.APERTURE: (0x15, 0x18, 0x1D, 0x20, 0x25, 0x28, 0x2D, 0x30),
    Prop.SHUTTER_SPEED: (0x68, 0x70, 0x78, 0x80, 0x88, 0x90),
    Prop.ISO: (0x48, 0x50, 0x58, 0x60, 0x68),
    Prop.DRIVE_MODE: (0, 1, 0x10),
    Prop.CAPTURE_DESTINATION: (_TO_CARD, _TO_MEMORY),
}
_RAW = (1, 16, 6, 0, 4)
_RAW_AND_JPEG = (2, 16, 1, 0, 3, 16, 6, 0, 4)
_FORMATS = (_RAW, _RAW_AND_JPEG)
"""Image formats as the body writes them: how many files, then size of the entry, kind, dimensions, compression."""


class Properties:
    """What each property is, and the events that nobody has fetched yet. Whoever calls holds the body's lock."""

    def __init__(self, serial: str, *, pairs: bool) -> None:
        self._events: deque[bytes] = deque()
        self._values: dict[int, bytes] = {
            Prop.APERTURE: _u32(0x20),
            Prop.SHUTTER_SPEED: _u32(0x78),
            Prop.ISO: _u32(0x48),
            Prop.AUTO_EXPOSURE_MODE: _u32(3),
            Prop.DRIVE_MODE: _u32(0),
            Prop.FOCUS_MODE: _u32(3),
            Prop.BATTERY: _u32(2),
            Prop.OWNER: b"dappled\0",
            Prop.MODEL_ID: _u32(0x80000176),
            Prop.AVAILABLE_SHOTS: _u32(100),
            Prop.CAPTURE_DESTINATION: _u32(_TO_CARD),
            Prop.IMAGE_FORMAT: _words(_RAW_AND_JPEG if pairs else _RAW),
            Prop.SERIAL_NUMBER: serial.encode() + b"\0",
            Prop.EVF_OUTPUT: _u32(0),
        }

    @property
    def to_memory(self) -> bool:
        """Whether captures go to the body's memory, not to its card."""
        return self._values[Prop.CAPTURE_DESTINATION][:4] == _u32(_TO_MEMORY)

    @property
    def pairs(self) -> bool:
        """Whether each raw file has a JPEG beside it."""
        return self._values[Prop.IMAGE_FORMAT] == _words(_RAW_AND_JPEG)

    @property
    def shots_left(self) -> bool:
        """Whether the body believes that there is room; for captures to memory the computer says so."""
        return self._values[Prop.AVAILABLE_SHOTS][:4] != _u32(0)

    def announce(self, *records: bytes) -> None:
        """Events for the initiator's next question."""
        self._events.extend(records)

    def forget_events(self) -> None:
        """Nobody will ask for what has been announced so far."""
        self._events.clear()

    @property
    def handlers(self) -> Mapping[int, Handler]:
        """The operations that are about properties and events."""
        return {
            Op.EOS_SET_EVENT_MODE: self._event_mode,
            Op.EOS_GET_EVENT: self._get_event,
            Op.EOS_REQUEST_DEVICE_PROP_VALUE: self._request,
            Op.EOS_SET_DEVICE_PROP_VALUE_EX: self._set,
            Op.EOS_PC_HDD_CAPACITY: self._room,
        }

    def _event_mode(self, request: Request, _data: bytes) -> Answer:
        if request.parameter(0):
            self.forget_events()
            self.announce(*(ptp_data.eos_property(prop, value) for prop, value in self._values.items()))
            self.announce(*(ptp_data.eos_choices(prop, len(values), values) for prop, values in _CHOICES.items()))
            flat = [word for each in _FORMATS for word in each]
            self.announce(ptp_data.eos_choices(Prop.IMAGE_FORMAT, len(_FORMATS), flat))
        return Answer()

    def _get_event(self, _request: Request, _data: bytes) -> Answer:
        records = tuple(self._events)
        self.forget_events()
        return Answer(data=ptp_data.eos_events(records))

    def _request(self, request: Request, _data: bytes) -> Answer:
        prop = request.parameter(0)
        if prop not in self._values:
            return Answer(Code.GENERAL_ERROR)
        self.announce(ptp_data.eos_property(prop, self._values[prop]))
        return Answer()

    def _set(self, _request: Request, data: bytes) -> Answer:
        if len(data) < 12:
            return Answer(Code.GENERAL_ERROR)
        _size, prop = struct.unpack_from("<II", data)
        if prop not in self._values:
            return Answer(Code.DEVICE_PROP_NOT_SUPPORTED)
        value = data[8:]
        if prop in _CHOICES and struct.unpack_from("<I", value)[0] not in _CHOICES[Prop(prop)]:
            return Answer(Code.GENERAL_ERROR)
        if prop == Prop.IMAGE_FORMAT and value not in map(_words, _FORMATS):
            return Answer(Code.GENERAL_ERROR)
        self._put(prop, value)
        if prop == Prop.CAPTURE_DESTINATION:
            self._put(Prop.AVAILABLE_SHOTS, _u32(0 if self.to_memory else 100))
        return Answer()

    def _room(self, request: Request, _data: bytes) -> Answer:
        self._put(Prop.AVAILABLE_SHOTS, _u32(min(request.parameter(0) // 4096, 9999)))
        return Answer()

    def _put(self, prop: int, value: bytes) -> None:
        self._values[prop] = value
        self.announce(ptp_data.eos_property(prop, value))


def _words(values: Iterable[int]) -> bytes:
    words = tuple(values)
    return struct.pack(f"<{len(words)}I", *words)


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)
