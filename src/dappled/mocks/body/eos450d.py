"""A simulated Canon EOS 450D, transaction by transaction: identity, session, captures, properties and events.

`ptpip` has the sockets and `eos_card` the card. Operation and event lists are those of a real body (PTP device info
published with libgphoto2). Of its quirks, those that drivers meet are simulated: RemoteRelease without RemoteReleaseOn,
busy during a capture, and no shot to memory before the computer has announced room.
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from functools import partial
from typing import TypeAlias

from PIL import Image

from dappled.clock import Clock
from dappled.encoded_pictures import file_of
from dappled.mocks.body import ptp
from dappled.mocks.body.eos_card import CARD_BYTES, FOLDER, STORAGE, Card, StoredObject
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptp import EosEvent, Format, Handler, Op, PtpRequest, PtpResponse, ResponseCode
from dappled.workers import Loop

Expose: TypeAlias = Callable[[int, int], tuple[bytes, str]]
"""(trigger_monotonic_ns, shot_number) -> (the file's bytes, its extension without a dot)."""

MODEL = "Canon EOS 450D"
SERIAL = "0830412345"
_HUNT_S = 0.3

_OPERATIONS = sorted(
    set(Op) - {Op.EOS_AF_CANCEL, Op.GET_THUMB}
    | {0x100A, 0x100C, 0x100D, 0x100F, 0x9103, 0x9106, 0x910A, 0x910B, 0x910C, 0x910E, 0x9113, 0x9118}
    | {0x911E, 0x911F, 0x9120, 0x9121, 0x9125, 0x9126, 0x9154, 0x9155, 0x9157, 0x9158, 0x9159}
)
_EVENTS = (0x4009, 0x4004, 0x4005, 0x4003, 0x4002, 0x4007, 0xC101)


class Eos450d:
    """The body's insides. `answer` may be called from any thread; captures are rendered in a thread of their own."""

    def __init__(
        self,
        expose: Expose,
        faults: BodyFaults,
        clock: Clock,
        properties: Properties | None = None,
        *,
        card_bytes: int = CARD_BYTES,
    ) -> None:
        self._expose = expose
        self._faults = faults
        self._clock = clock
        self._lock = threading.Lock()  # held around all that follows
        self._session = self._working = False
        self._releases = self._looks = self._numbered = self._wrong_s = 0
        self._card = Card(card_bytes, faults, clock.utc_ns() // 10**9)
        self._properties = properties or Properties()
        self._handlers: dict[int, Handler] = {
            Op.GET_DEVICE_INFO: self._device_info,
            Op.OPEN_SESSION: self._open,
            Op.CLOSE_SESSION: self._close,
            Op.GET_DEVICE_PROP_DESC: self._prop_desc,
            Op.EOS_GET_DEVICE_INFO_EX: self._eos_device_info,
            Op.EOS_REMOTE_RELEASE: self._release,
            Op.EOS_GET_VIEWFINDER_DATA: self._viewfinder,
            Op.EOS_SET_REMOTE_MODE: self._nothing,
            Op.EOS_SET_UI_LOCK: self._nothing,
            Op.EOS_RESET_UI_LOCK: self._nothing,
            Op.EOS_KEEP_DEVICE_ON: self._nothing,
            **self._card.handlers,
            **self._properties.handlers,
        }

    @property
    def releases(self) -> int:
        """How many exposures were begun."""
        with self._lock:
            return self._releases

    @property
    def names(self) -> list[str]:
        """The files on the card, in order."""
        with self._lock:
            return self._card.names

    def contact(self) -> bool:
        """Close the contact of the remote socket: an exposure, with or without a link. False if there is none."""
        with self._lock:
            return self._release(PtpRequest(Op.EOS_REMOTE_RELEASE, 0, ()), b"").code == ResponseCode.OK

    def change_card(self) -> None:
        """A hand changes the card for an empty one, on which names begin with 0001."""
        with self._lock:
            self._card.change()
            self._numbered = self._releases

    def turn(self, what: str, value: int) -> None:
        """A hand turns something at the body, or something in it runs low; it announces that. Its clock is turned by
        seconds, in silence. Raises ValueError."""
        with self._lock:
            if what == "clock":
                self._wrong_s += value
            else:
                self._properties.turn(what, value)

    def disconnected(self) -> None:
        """The link is gone, and the session with it. The card and a running capture stay."""
        with self._lock:
            self._session = False
            self._properties.forget_events()

    def answer(self, request: PtpRequest, data: bytes) -> PtpResponse:
        """The body's answer to one transaction; `data` is what came with it."""
        handler = self._handlers.get(request.code)
        if handler is None:
            return PtpResponse(ResponseCode.OPERATION_NOT_SUPPORTED)
        with self._lock:
            if not self._session and request.code not in (Op.GET_DEVICE_INFO, Op.OPEN_SESSION):
                return PtpResponse(ResponseCode.SESSION_NOT_OPEN)
            return handler(request, data)

    # --- identity and session

    def _device_info(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(
            data=ptp.device_info(
                model=MODEL,
                version="3-1.0.4",
                serial=self._properties.serial.rjust(32, "0"),
                operations=_OPERATIONS,
                events=_EVENTS,
                properties=(0xD402, 0xD407, 0xD406),
                formats=(Format.FOLDER, Format.JPEG, Format.RAW),
            )
        )

    def _eos_device_info(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(data=ptp.eos_device_info(tuple(EosEvent), tuple(Prop)))

    def _prop_desc(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        prop = request.parameter(0)
        texts = {0xD402: MODEL, 0xD406: "Unknown Initiator"}
        if prop in texts:
            value = ptp.string(texts[prop])
            return PtpResponse(data=struct.pack("<HHB", prop, 0xFFFF, 0) + value + value + b"\0")
        if prop == 0xD407:
            return PtpResponse(data=struct.pack("<HHBIIB", prop, 6, 0, 1, 1, 0))
        return PtpResponse(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)

    def _open(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        if self._session:
            return PtpResponse(ResponseCode.SESSION_ALREADY_OPEN)
        self._session = True
        return PtpResponse()

    def _close(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        self._session = False
        return PtpResponse()

    def _nothing(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse()

    # --- captures

    def _release(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        triggered_ns = self._clock.monotonic_ns()
        if self._working or self._faults.lasts("busy"):
            return PtpResponse(ResponseCode.DEVICE_BUSY)
        if self._faults.take("error"):
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        to_memory = self._properties.to_memory
        full = not to_memory and (self._card.full or self._faults.lasts("full"))
        if full or not self._properties.shots_left:
            # A real body says OK and parameter 7, which libgphoto2 reads over USB only: its PTP/IP drops parameters.
            return PtpResponse(ResponseCode.STORE_FULL)
        self._working = True
        self._releases += 1
        self._properties.announce(ptp.eos_status(1))
        work = (triggered_ns, self._releases, to_memory)
        capture = self._hunt if self._faults.take("no-focus") else self._capture
        Loop("capture", partial(capture, *work)).start()
        return PtpResponse(parameters=(0,))

    def _viewfinder(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        if not self._properties.shows_viewfinder:
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        if self._working:
            return PtpResponse(ResponseCode.DEVICE_BUSY)
        self._looks += 1
        picture = chart(self._looks)
        return PtpResponse(data=struct.pack("<II", 8 + len(picture), _VIEWFINDER_JPEG) + picture)

    def _hunt(self, _triggered_ns: int, _number: int, _to_memory: bool) -> None:
        """Simulate an autofocus that fails: no picture is taken."""
        time.sleep(_HUNT_S)
        self._done()

    def _capture(self, triggered_ns: int, number: int, to_memory: bool) -> None:
        try:
            opened_s = self._clock.utc_ns() // 10**9
            data, extension = self._expose(triggered_ns, number)
            with self._lock:
                self._store(data, extension, number, to_memory, opened_s + self._wrong_s)
        finally:
            self._done()

    def _done(self) -> None:
        with self._lock:
            self._working = False
            self._properties.announce(ptp.eos_status(0))

    def _store(self, data: bytes, extension: str, number: int, to_memory: bool, taken_s: int) -> None:
        stem = f"IMG_{max(number - self._numbered, 1) % 10000:04d}"
        handle, parent = (2 * number, 0) if to_memory else (FOLDER + 2 * number, FOLDER)
        code = Format.JPEG if extension.lower() in ("jpg", "jpeg") else Format.RAW
        made = [StoredObject(handle, parent, f"{stem}.{extension.upper()}", code, data, taken_s)]
        if self._properties.pairs:
            made.append(StoredObject(handle + 1, parent, f"{stem}.JPG", Format.JPEG, thumbnail(number), taken_s))
        self._card.keep(made)
        if not self._faults.take("no-event"):
            self._properties.announce(*(_announced(each, to_memory) for each in made))


def _announced(made: StoredObject, to_memory: bool) -> bytes:
    size = len(made.data)
    if to_memory:
        return ptp.eos_object_transfer(handle=made.handle, code=made.code, size=size, name=made.name)
    return ptp.eos_object_added(
        handle=made.handle, storage=STORAGE, code=made.code, size=size, parent=FOLDER, name=made.name
    )


def thumbnail(number: int) -> bytes:
    """The JPEG beside the raw file of the shot with this number: a small grey picture, its own for each."""
    return file_of(Image.new("L", (64, 48), number % 256), "JPEG", comment=f"shot {number}")


def chart(number: int) -> bytes:
    """The viewfinder's JPEG: bars from dark to clipped, fine lines, and a mark that moves from look to look."""
    picture = Image.new("L", (480, 320))
    for bar in range(8):
        picture.paste(min(36 * bar + 20, 255), (60 * bar, 0, 60 * bar + 60, 160))
    for line in range(0, 480, 4):
        picture.paste(200, (line, 160, line + 2, 320))
    left = 8 * number % 460
    picture.paste(255, (left, 230, left + 20, 250))
    return file_of(picture, "JPEG", quality=85)


_VIEWFINDER_JPEG = 1  # type of a block of the viewfinder's data; length and type go before the bytes
_TO_COMPUTER = 2
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
    WHITE_BALANCE = 0xD109
    BATTERY = 0xD111
    AUTO_POWER_OFF = 0xD114
    OWNER = 0xD115
    MODEL_ID = 0xD116
    AVAILABLE_SHOTS = 0xD11B
    CAPTURE_DESTINATION = 0xD11C
    IMAGE_FORMAT = 0xD120
    CUSTOM_FUNCTIONS = 0xD1A0
    SERIAL_NUMBER = 0xD1AF
    EVF_OUTPUT = 0xD1B0


_CHOICES = {
    Prop.APERTURE: (0x15, 0x18, 0x1D, 0x20, 0x25, 0x28, 0x2D, 0x30, 0x38, 0x40, 0x48, 0x50, 0x58),
    Prop.SHUTTER_SPEED: (0x68, 0x70, 0x78, 0x80, 0x88, 0x90),
    Prop.ISO: (0x48, 0x50, 0x58, 0x60, 0x68),
    Prop.DRIVE_MODE: (0, 1, 0x10),
    Prop.WHITE_BALANCE: (0, 1, 2, 3, 4, 5, 6),
    Prop.CAPTURE_DESTINATION: (_TO_CARD, _TO_MEMORY),
}
_BY_HAND = (Prop.AUTO_EXPOSURE_MODE, Prop.FOCUS_MODE, Prop.BATTERY, Prop.CUSTOM_FUNCTIONS)
"""What the mode dial, the switch at the lens, the cells and the menu decide: the computer can't set it."""

_DIALS = {
    "dial": Prop.AUTO_EXPOSURE_MODE,
    "focus": Prop.FOCUS_MODE,
    "drive": Prop.DRIVE_MODE,
    "battery": Prop.BATTERY,
    "room": Prop.AVAILABLE_SHOTS,
    "power-off": Prop.AUTO_POWER_OFF,
    "iso": Prop.ISO,
    "mirror": Prop.CUSTOM_FUNCTIONS,
}
"""What `Eos450d.turn` turns. dial: 0 P, 1 Tv, 2 Av, 3 M. focus: 0 one shot, 3 manual. drive: 0 single, 1 continuous,
0x10 timer. battery: 0 low, 1 half, 2 full. power-off: seconds, 0 never. mirror: 1 lock-up."""

_MIRROR_LOCKUP = 0x60F
_RAW = (1, 16, 6, 0, 4)
_RAW_AND_JPEG = (2, 16, 1, 0, 3, 16, 6, 0, 4)
_FORMATS = (_RAW, _RAW_AND_JPEG)
"""Image formats as the body writes them: how many files, then size of the entry, kind, dimensions, compression."""


class Properties:
    """The values of the properties, and the events not fetched yet. The caller holds the body's lock."""

    def __init__(
        self,
        serial: str = SERIAL,
        *,
        pairs: bool = False,
        f_number: float | None = None,
        exposure_s: float | None = None,
    ) -> None:
        """What the body says it is set to, to the next third of a stop: f-number (None: f/2.8), exposure time in
        seconds (None: 1/250 s)."""
        self.serial = serial
        self._events: deque[bytes] = deque()
        self._values: dict[int, bytes] = {
            Prop.APERTURE: _u32(0x20 if f_number is None else _aperture(f_number)),
            Prop.SHUTTER_SPEED: _u32(0x78 if exposure_s is None else _shutter_speed(exposure_s)),
            Prop.ISO: _u32(0x48),
            Prop.AUTO_EXPOSURE_MODE: _u32(3),
            Prop.DRIVE_MODE: _u32(0),
            Prop.FOCUS_MODE: _u32(3),
            Prop.WHITE_BALANCE: _u32(0),
            Prop.BATTERY: _u32(2),
            Prop.AUTO_POWER_OFF: _u32(0),
            Prop.OWNER: b"dappled\0",
            Prop.MODEL_ID: _u32(0x80000176),
            Prop.AVAILABLE_SHOTS: _u32(100),
            Prop.CAPTURE_DESTINATION: _u32(_TO_CARD),
            Prop.IMAGE_FORMAT: _words(_RAW_AND_JPEG if pairs else _RAW),
            Prop.CUSTOM_FUNCTIONS: _custom_functions(mirror_lockup=0),
            Prop.SERIAL_NUMBER: serial.encode() + b"\0",
            Prop.EVF_OUTPUT: _u32(0),
        }

    @property
    def to_memory(self) -> bool:
        """Whether captures go to the body's memory, not to its card."""
        return self._values[Prop.CAPTURE_DESTINATION][:4] == _u32(_TO_MEMORY)

    @property
    def shows_viewfinder(self) -> bool:
        """Whether the viewfinder's picture goes to the computer."""
        return bool(struct.unpack_from("<I", self._values[Prop.EVF_OUTPUT])[0] & _TO_COMPUTER)

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
        """Drop what has been announced so far."""
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

    def _event_mode(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        if request.parameter(0):
            self.forget_events()
            self.announce(*(ptp.eos_property(prop, value) for prop, value in self._values.items()))
            self.announce(*(ptp.eos_choices(prop, len(values), values) for prop, values in _CHOICES.items()))
            flat = [word for each in _FORMATS for word in each]
            self.announce(ptp.eos_choices(Prop.IMAGE_FORMAT, len(_FORMATS), flat))
        return PtpResponse()

    def _get_event(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        records = tuple(self._events)
        self.forget_events()
        return PtpResponse(data=ptp.eos_events(records))

    def _request(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        prop = request.parameter(0)
        if prop not in self._values:
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        self.announce(ptp.eos_property(prop, self._values[prop]))
        return PtpResponse()

    def _set(self, _request: PtpRequest, data: bytes) -> PtpResponse:
        if len(data) < 12:
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        _size, prop = struct.unpack_from("<II", data)
        if prop not in self._values:
            return PtpResponse(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)
        value = data[8:]
        if prop in _BY_HAND:
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        if prop in _CHOICES and struct.unpack_from("<I", value)[0] not in _CHOICES[Prop(prop)]:
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        if prop == Prop.IMAGE_FORMAT and value not in map(_words, _FORMATS):
            return PtpResponse(ResponseCode.GENERAL_ERROR)
        self._put(prop, value)
        if prop == Prop.CAPTURE_DESTINATION:
            self._put(Prop.AVAILABLE_SHOTS, _u32(0 if self.to_memory else 100))
        return PtpResponse()

    def _room(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        self._put(Prop.AVAILABLE_SHOTS, _u32(min(request.parameter(0) // 4096, 9999)))
        return PtpResponse()

    def turn(self, what: str, value: int) -> None:
        """A hand turns a dial, or something runs low: see `_DIALS`. Raises ValueError for what the body hasn't."""
        prop = _DIALS.get(what)
        if prop is None:
            raise ValueError(f"the body has no {what!r} to turn; it has {', '.join(_DIALS)}")
        self._put(prop, _custom_functions(mirror_lockup=value) if what == "mirror" else _u32(value))

    def _put(self, prop: int, value: bytes) -> None:
        self._values[prop] = value
        self.announce(ptp.eos_property(prop, value))


def _custom_functions(*, mirror_lockup: int) -> bytes:
    """The custom functions as a 450D writes them: size, groups; of each its number, size, count, and (function, values,
    value). As users have read them from the body (indilib/indi-3rdparty, issue 804); but four bytes follow, without
    which libgphoto2 2.5.34 says "bad length"."""
    groups = (
        (1, (0x101, 0), (0x10F, 0)),
        (2, (0x201, 0), (0x202, 0), (0x203, 0), (0x204, 0)),
        (3, (0x50E, 0), (0x511, 0), (_MIRROR_LOCKUP, mirror_lockup)),
        (4, (0x701, 0), (0x704, 0), (0x811, 0), (0x80F, 0)),
    )
    words = [
        word
        for number, *functions in groups
        for word in (number, 8 + 12 * len(functions), len(functions), *(w for f, v in functions for w in (f, 1, v)))
    ]
    return _words((4 * (len(words) + 2), len(groups), *words, 0))


def _aperture(f_number: float) -> int:
    """The code of the third of a stop next to an f-number, f/2.8 (0x20) to f/32 (0x58)."""
    return min(max(_thirds(8 + 16 * math.log2(f_number)), 0x20), 0x58)


def _shutter_speed(exposure_s: float) -> int:
    """The code of the third of a stop next to an exposure time, 30 s (0x10) to 1/4000 s (0x98)."""
    return min(max(_thirds(0x38 - 8 * math.log2(exposure_s)), 0x10), 0x98)


def _thirds(eighths: float) -> int:
    """Eighths of a stop to the next third of a stop: the codes of a stop end on 0, 3 and 5."""
    stop, part = divmod(round(3 * eighths / 8), 3)
    return 8 * stop + (0, 3, 5)[part]


def _words(values: Iterable[int]) -> bytes:
    words = tuple(values)
    return struct.pack(f"<{len(words)}I", *words)


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)
