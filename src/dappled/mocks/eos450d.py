"""What a Canon EOS 450D answers, transaction by transaction: its properties, its card, its captures.

No sockets here: `mocks.ptpip` carries the transactions. Operation and event lists are those of a real body (PTP
device info published with libgphoto2); its quirks kept here are the ones that drivers meet: RemoteRelease without
RemoteReleaseOn, busy while it works on a capture, room on the computer to be announced before it shoots to memory.
"""

from __future__ import annotations

import io
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum

from PIL import Image

from dappled.mocks import ptp
from dappled.mocks.faults import Faults
from dappled.mocks.ptp import Code, Format, Op

Expose = Callable[[int, int], tuple[bytes, str]]
"""(trigger_monotonic_ns, shot_number) -> (the file's bytes, its extension without a dot)."""

MODEL = "Canon EOS 450D"
SERIAL = "0830412345"
STORAGE = 0x00020001
_HUNT_S = 0.3
CARD_BYTES = 512 << 20
"""A card for about a hundred small frames: it lies in this process' memory."""
DCIM = 0x20000000
FOLDER = 0x21900000
TO_CARD = 2
TO_MEMORY = 4

_OPERATIONS = sorted(
    set(Op) - {Op.EOS_AF_CANCEL, Op.GET_THUMB}
    | {0x100A, 0x100C, 0x100D, 0x100F, 0x9103, 0x9106, 0x910A, 0x910B, 0x910C, 0x910E, 0x9113, 0x9118}
    | {0x911E, 0x911F, 0x9120, 0x9121, 0x9125, 0x9126, 0x9153, 0x9154, 0x9155, 0x9157, 0x9158, 0x9159}
)
_EVENTS = (0x4009, 0x4004, 0x4005, 0x4003, 0x4002, 0x4007, 0xC101)


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
    Prop.CAPTURE_DESTINATION: (TO_CARD, TO_MEMORY),
}
RAW = (1, 16, 6, 0, 4)
RAW_AND_JPEG = (2, 16, 1, 0, 3, 16, 6, 0, 4)
_FORMATS = (RAW, RAW_AND_JPEG)
"""Image formats as the body writes them: how many files, then size of the entry, kind, dimensions, compression."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the body says to a request: response code, response parameters, data (None: no data phase)."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | memoryview | None = None


@dataclass(frozen=True, slots=True)
class StoredObject:
    """A folder or a file on the card, or (parent 0) a file in the body's memory."""

    handle: int
    parent: int
    name: str
    code: int
    data: bytes
    unix_s: int

    @property
    def taken(self) -> str:
        """The date as PTP writes it."""
        return time.strftime("%Y%m%dT%H%M%S", time.gmtime(self.unix_s))


@dataclass(slots=True)
class _State:
    objects: dict[int, StoredObject]
    values: dict[int, bytes]
    events: deque[bytes] = field(default_factory=deque)
    session: bool = False
    remote: bool = False
    working: bool = False
    releases: int = 0


class Eos450d:
    """The body's insides. `answer` may be called from any thread; captures are rendered in a thread of their own."""

    def __init__(
        self,
        expose: Expose,
        faults: Faults,
        *,
        serial: str = SERIAL,
        card_bytes: int = CARD_BYTES,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        wall_s: Callable[[], float] = time.time,
        pairs: bool = False,
    ) -> None:
        self._expose = expose
        self._faults = faults
        self._serial = serial
        self._card_bytes = card_bytes
        self._frame_bytes = 0  # of the largest so far: room for one more like it is asked for
        self._clock_ns = clock_ns
        self._wall_s = wall_s
        self._lock = threading.Lock()
        now = int(wall_s())
        folders = (
            StoredObject(DCIM, 0, "DCIM", Format.FOLDER, b"", now),
            StoredObject(FOLDER, DCIM, "100CANON", Format.FOLDER, b"", now),
        )
        self._state = _State(
            objects={each.handle: each for each in folders},
            values={
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
                Prop.CAPTURE_DESTINATION: _u32(TO_CARD),
                Prop.IMAGE_FORMAT: _words(RAW_AND_JPEG if pairs else RAW),
                Prop.SERIAL_NUMBER: serial.encode() + b"\0",
                Prop.EVF_OUTPUT: _u32(0),
            },
        )

    @property
    def releases(self) -> int:
        """How many exposures were begun."""
        with self._lock:
            return self._state.releases

    @property
    def names(self) -> list[str]:
        """The files on the card, in order."""
        with self._lock:
            return [each.name for each in self._state.objects.values() if each.parent == FOLDER]

    def disconnected(self) -> None:
        """The link is gone: the session with it; the card, and what the body works on, stay."""
        with self._lock:
            self._state.session = self._state.remote = False
            self._state.events.clear()

    def answer(self, request: ptp.Request, data: bytes) -> Answer:
        """The body's answer to one transaction; `data` is what came with it."""
        try:
            handler = _HANDLERS[request.code]
        except KeyError:
            return Answer(Code.OPERATION_NOT_SUPPORTED)
        with self._lock:
            if not self._state.session and request.code not in (Op.GET_DEVICE_INFO, Op.OPEN_SESSION):
                return Answer(Code.SESSION_NOT_OPEN)
            return handler(self, request, data)

    # --- session and identity

    def _device_info(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer(
            data=ptp.device_info(
                model=MODEL,
                version="3-1.0.4",
                serial=self._serial.rjust(32, "0"),
                operations=_OPERATIONS,
                events=_EVENTS,
                properties=(0xD402, 0xD407, 0xD406),
                formats=(Format.FOLDER, Format.JPEG, Format.RAW),
            )
        )

    def _open(self, _request: ptp.Request, _data: bytes) -> Answer:
        if self._state.session:
            return Answer(Code.SESSION_ALREADY_OPEN)
        self._state.session = True
        return Answer()

    def _close(self, _request: ptp.Request, _data: bytes) -> Answer:
        self._state.session = False
        return Answer()

    def _nothing(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer()

    def _eos_device_info(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer(data=ptp.eos_device_info(tuple(ptp.EosEvent), tuple(Prop)))

    def _prop_desc(self, request: ptp.Request, _data: bytes) -> Answer:
        prop = request.parameter(0)
        texts = {0xD402: MODEL, 0xD406: "Unknown Initiator"}
        if prop in texts:
            value = ptp.string(texts[prop])
            return Answer(data=struct.pack("<HHB", prop, 0xFFFF, 0) + value + value + b"\0")
        if prop == 0xD407:
            return Answer(data=struct.pack("<HHBIIB", prop, 6, 0, 1, 1, 0))
        return Answer(Code.DEVICE_PROP_NOT_SUPPORTED)

    # --- properties and events

    def _event_mode(self, request: ptp.Request, _data: bytes) -> Answer:
        if request.parameter(0):
            self._state.events.clear()
            for prop, value in self._state.values.items():
                self._state.events.append(ptp.eos_property(prop, value))
            for prop, values in _CHOICES.items():
                self._state.events.append(ptp.eos_choices(prop, len(values), values))
            flat = [word for each in _FORMATS for word in each]
            self._state.events.append(ptp.eos_choices(Prop.IMAGE_FORMAT, len(_FORMATS), flat))
        return Answer()

    def _remote_mode(self, request: ptp.Request, _data: bytes) -> Answer:
        self._state.remote = bool(request.parameter(0))
        return Answer()

    def _get_event(self, _request: ptp.Request, _data: bytes) -> Answer:
        records = tuple(self._state.events)
        self._state.events.clear()
        return Answer(data=ptp.eos_events(records))

    def _request_prop(self, request: ptp.Request, _data: bytes) -> Answer:
        prop = request.parameter(0)
        if prop not in self._state.values:
            return Answer(Code.GENERAL_ERROR)
        self._state.events.append(ptp.eos_property(prop, self._state.values[prop]))
        return Answer()

    def _set_prop(self, _request: ptp.Request, data: bytes) -> Answer:
        if len(data) < 12:
            return Answer(Code.GENERAL_ERROR)
        _size, prop = struct.unpack_from("<II", data)
        if prop not in self._state.values:
            return Answer(Code.DEVICE_PROP_NOT_SUPPORTED)
        value = data[8:]
        if prop in _CHOICES and struct.unpack_from("<I", value)[0] not in _CHOICES[Prop(prop)]:
            return Answer(Code.GENERAL_ERROR)
        if prop == Prop.IMAGE_FORMAT and value not in map(_words, _FORMATS):
            return Answer(Code.GENERAL_ERROR)
        self._put(prop, value)
        if prop == Prop.CAPTURE_DESTINATION:
            self._put(Prop.AVAILABLE_SHOTS, _u32(0 if value[:4] == _u32(TO_MEMORY) else 100))
        return Answer()

    def _room(self, request: ptp.Request, _data: bytes) -> Answer:
        self._put(Prop.AVAILABLE_SHOTS, _u32(min(request.parameter(0) // 4096, 9999)))
        return Answer()

    def _put(self, prop: int, value: bytes) -> None:
        self._state.values[prop] = value
        self._state.events.append(ptp.eos_property(prop, value))

    # --- the card

    def _storage_ids(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer(data=ptp.array32((STORAGE,)))

    def _storage_info(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer(data=ptp.storage_info(self._card_bytes, self._free()))

    def _free(self) -> int:
        used = sum(len(each.data) for each in self._state.objects.values())
        return max(self._card_bytes - used, 0)

    def _children(self, parent: int) -> list[StoredObject]:
        folder = 0 if parent == ptp.ROOT else parent
        return [each for each in self._state.objects.values() if each.parent == folder and each.handle >= DCIM]

    def _handles(self, request: ptp.Request, _data: bytes) -> Answer:
        parent = request.parameter(2)
        return Answer(data=ptp.array32(each.handle for each in self._found(parent)))

    def _count(self, request: ptp.Request, _data: bytes) -> Answer:
        return Answer(parameters=(len(self._found(request.parameter(2))),))

    def _found(self, parent: int) -> list[StoredObject]:
        return list(self._state.objects.values()) if parent == 0 else self._children(parent)

    def _object_info(self, request: ptp.Request, _data: bytes) -> Answer:
        found = self._state.objects.get(request.parameter(0))
        if found is None:
            return Answer(Code.INVALID_OBJECT_HANDLE)
        return Answer(
            data=ptp.object_info(
                storage=STORAGE,
                code=found.code,
                size=len(found.data),
                parent=found.parent,
                name=found.name,
                taken=found.taken,
            )
        )

    def _folder(self, request: ptp.Request, _data: bytes) -> Answer:
        rows = self._children(request.parameter(1))
        return Answer(
            data=ptp.eos_folder(
                (each.handle, STORAGE, each.code, len(each.data), each.parent, each.name, each.unix_s) for each in rows
            )
        )

    def _whole(self, request: ptp.Request, _data: bytes) -> Answer:
        found = self._state.objects.get(request.parameter(0))
        if found is None:
            return Answer(Code.INVALID_OBJECT_HANDLE)
        return Answer(data=self._sent(memoryview(found.data), 0, len(found.data)))

    def _part(self, request: ptp.Request, _data: bytes) -> Answer:
        found = self._state.objects.get(request.parameter(0))
        if found is None:
            return Answer(Code.INVALID_OBJECT_HANDLE)
        piece = self._sent(memoryview(found.data), request.parameter(1), request.parameter(2))
        return Answer(parameters=(len(piece),), data=piece)

    def _sent(self, data: memoryview, offset: int, count: int) -> memoryview:
        end = min(offset + count, len(data))
        if end == len(data) and self._faults.take("short"):
            end = max(end - 1024, offset)
        return data[offset:end]

    def _delete(self, request: ptp.Request, _data: bytes) -> Answer:
        found = self._state.objects.pop(request.parameter(0), None)
        return Answer(Code.INVALID_OBJECT_HANDLE) if found is None else Answer()

    def _no_thumb(self, _request: ptp.Request, _data: bytes) -> Answer:
        return Answer(Code.NO_THUMBNAIL_PRESENT)

    def _transferred(self, request: ptp.Request, _data: bytes) -> Answer:
        found = self._state.objects.get(request.parameter(0))
        if found is not None and found.handle < DCIM:
            del self._state.objects[found.handle]
        return Answer()

    # --- captures

    def _release(self, _request: ptp.Request, _data: bytes) -> Answer:
        triggered_ns = self._clock_ns()
        if self._state.working or self._faults.lasts("busy"):
            return Answer(Code.DEVICE_BUSY)
        if self._faults.take("error"):
            return Answer(Code.GENERAL_ERROR)
        to_memory = self._state.values[Prop.CAPTURE_DESTINATION][:4] == _u32(TO_MEMORY)
        full = not to_memory and (self._free() < max(self._frame_bytes, 1) or self._faults.lasts("full"))
        if full or self._state.values[Prop.AVAILABLE_SHOTS][:4] == _u32(0):
            # A real body says OK and parameter 7, which libgphoto2 reads over USB only: its PTP/IP drops parameters.
            return Answer(Code.STORE_FULL)
        self._state.working = True
        self._state.releases += 1
        self._state.events.append(ptp.eos_status(1))
        work = (triggered_ns, self._state.releases, to_memory)
        capture = self._hunt if self._faults.take("no-focus") else self._capture
        threading.Thread(target=capture, args=work, name="capture", daemon=True).start()
        return Answer(parameters=(0,))

    def _hunt(self, _triggered_ns: int, _number: int, _to_memory: bool) -> None:
        """The autofocus finds nothing, and no picture is taken."""
        time.sleep(_HUNT_S)
        with self._lock:
            self._state.working = False
            self._state.events.append(ptp.eos_status(0))

    def _capture(self, triggered_ns: int, number: int, to_memory: bool) -> None:
        try:
            data, extension = self._expose(triggered_ns, number)
            with self._lock:
                self._store(data, extension, number, to_memory)
        finally:
            with self._lock:
                self._state.working = False
                self._state.events.append(ptp.eos_status(0))

    def _store(self, data: bytes, extension: str, number: int, to_memory: bool) -> None:
        stem = f"IMG_{number % 10000:04d}"
        handle = 2 * number if to_memory else FOLDER + 2 * number
        code = Format.JPEG if extension.lower() in ("jpg", "jpeg") else Format.RAW
        made = [StoredObject(handle, 0, f"{stem}.{extension.upper()}", code, data, int(self._wall_s()))]
        if self._state.values[Prop.IMAGE_FORMAT] == _words(RAW_AND_JPEG):
            made.append(StoredObject(handle + 1, 0, f"{stem}.JPG", Format.JPEG, thumbnail(number), int(self._wall_s())))
        for each in made:
            kept = each if to_memory else replace(each, parent=FOLDER)
            self._state.objects[kept.handle] = kept
        self._frame_bytes = max(self._frame_bytes, sum(len(each.data) for each in made))
        if not self._faults.take("no-event"):
            self._state.events.extend(_announced(each, to_memory) for each in made)


def _announced(made: StoredObject, to_memory: bool) -> bytes:
    size = len(made.data)
    if to_memory:
        return ptp.eos_object_transfer(handle=made.handle, code=made.code, size=size, name=made.name)
    return ptp.eos_object_added(
        handle=made.handle, storage=STORAGE, code=made.code, size=size, parent=FOLDER, name=made.name
    )


def thumbnail(number: int) -> bytes:
    """The JPEG beside the raw file of the shot with this number: a small grey picture, its own for each."""
    file = io.BytesIO()
    Image.new("L", (64, 48), number % 256).save(file, "JPEG", comment=f"shot {number}")
    return file.getvalue()


def _words(values: Iterable[int]) -> bytes:
    words = tuple(values)
    return struct.pack(f"<{len(words)}I", *words)


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)


_HANDLERS: dict[int, Callable[[Eos450d, ptp.Request, bytes], Answer]] = {
    Op.GET_DEVICE_INFO: Eos450d._device_info,
    Op.OPEN_SESSION: Eos450d._open,
    Op.CLOSE_SESSION: Eos450d._close,
    Op.GET_STORAGE_IDS: Eos450d._storage_ids,
    Op.GET_STORAGE_INFO: Eos450d._storage_info,
    Op.GET_NUM_OBJECTS: Eos450d._count,
    Op.GET_OBJECT_HANDLES: Eos450d._handles,
    Op.GET_OBJECT_INFO: Eos450d._object_info,
    Op.GET_OBJECT: Eos450d._whole,
    Op.GET_THUMB: Eos450d._no_thumb,
    Op.DELETE_OBJECT: Eos450d._delete,
    Op.GET_DEVICE_PROP_DESC: Eos450d._prop_desc,
    Op.GET_PARTIAL_OBJECT: Eos450d._part,
    Op.EOS_GET_STORAGE_IDS: Eos450d._storage_ids,
    Op.EOS_GET_STORAGE_INFO: Eos450d._storage_info,
    Op.EOS_GET_OBJECT: Eos450d._whole,
    Op.EOS_DELETE_OBJECT: Eos450d._delete,
    Op.EOS_GET_PARTIAL_OBJECT: Eos450d._part,
    Op.EOS_GET_DEVICE_INFO_EX: Eos450d._eos_device_info,
    Op.EOS_GET_OBJECT_INFO_EX: Eos450d._folder,
    Op.EOS_REMOTE_RELEASE: Eos450d._release,
    Op.EOS_SET_DEVICE_PROP_VALUE_EX: Eos450d._set_prop,
    Op.EOS_SET_REMOTE_MODE: Eos450d._remote_mode,
    Op.EOS_SET_EVENT_MODE: Eos450d._event_mode,
    Op.EOS_GET_EVENT: Eos450d._get_event,
    Op.EOS_TRANSFER_COMPLETE: Eos450d._transferred,
    Op.EOS_PC_HDD_CAPACITY: Eos450d._room,
    Op.EOS_SET_UI_LOCK: Eos450d._nothing,
    Op.EOS_RESET_UI_LOCK: Eos450d._nothing,
    Op.EOS_KEEP_DEVICE_ON: Eos450d._nothing,
    Op.EOS_REQUEST_DEVICE_PROP_VALUE: Eos450d._request_prop,
}
