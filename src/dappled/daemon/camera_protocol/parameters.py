"""The extended parameter protocol (PARAM_EXT, messages 320 to 324): the camera's settings read and set by name."""

from __future__ import annotations

import struct
import threading
from dataclasses import dataclass

from dappled.daemon.camera_protocol.camera_settings import Knob, Knobs, code
from dappled.drivers.camera import CameraError
from dappled.drivers.mavlink.links import Message, mavlink

TYPE = mavlink.MAV_PARAM_EXT_TYPE_UINT32
WAIT_NS = 5 * 10**9
_ACCEPTED = mavlink.PARAM_ACK_ACCEPTED
_FAILED = mavlink.PARAM_ACK_FAILED
_UNSUPPORTED = mavlink.PARAM_ACK_VALUE_UNSUPPORTED
_IN_PROGRESS = mavlink.PARAM_ACK_IN_PROGRESS


@dataclass(frozen=True, slots=True)
class Reply:
    """Messages for the link that asked, and words for the pilot."""

    messages: tuple[Message, ...]
    words: str | None = None


@dataclass(frozen=True, slots=True)
class _Asked:
    """A body was asked for a value, and whoever asked waits."""

    value: str
    link: int
    due_ns: int


class Parameters:
    """Answers from memory. What a body takes its time for is acknowledged twice: in progress, and how it ended."""

    def __init__(self, knobs: Knobs) -> None:
        self._knobs = knobs
        self._lock = threading.Lock()
        self._asked: dict[str, _Asked] = {}
        self._told: dict[str, str] | None = None  # what each was when that was asked last; None: never yet

    def listing(self) -> Reply:
        """PARAM_EXT_REQUEST_LIST (321)."""
        knobs = self._knobs.all()
        return Reply(tuple(_value(knob, at, len(knobs)) for at, knob in enumerate(knobs)))

    def read(self, message: Message) -> Reply:
        """PARAM_EXT_REQUEST_READ (320): by index, or by name where that is -1. Silence for one that is not there."""
        knobs = self._knobs.all()
        name, index = str(message.param_id), int(message.param_index)
        found = [
            _value(knob, at, len(knobs))
            for at, knob in enumerate(knobs)
            if (at == index if index >= 0 else knob.name == name)
        ]
        return Reply(tuple(found))

    def news(self) -> tuple[Message, ...]:
        """PARAM_EXT_VALUE of each setting that is another than when this was last asked, whoever changed it: other
        ground stations and other links show it too. Nothing the first time."""
        knobs = self._knobs.all()
        now = {knob.name: knob.value for knob in knobs}
        with self._lock:
            before, self._told = self._told or now, now
        return tuple(
            _value(knob, at, len(knobs))
            for at, knob in enumerate(knobs)
            if knob.value != before.get(knob.name, knob.value)
        )

    def set(self, message: Message, link: int, now_ns: int) -> Reply:
        """PARAM_EXT_SET (323). Time is monotonic."""
        name = str(message.param_id)
        knob = self._knobs.find(name)
        wanted = _number(message)
        if knob is None or wanted is None:
            words = f"there is no setting {name}" if knob is None else f"{name} takes whole numbers"
            now = (wanted or 0) if knob is None else code(knob.value)
            return Reply((_ack(name, now, _UNSUPPORTED),), words)
        value = next((one for one in (*knob.choices, knob.value) if code(one) == wanted), None)
        if value is None:
            return Reply((_ack(name, code(knob.value), _UNSUPPORTED),), f"{name} has no choice {wanted}")
        asked = self._asked.get(name)
        if asked is not None and asked.value == value:
            return Reply((_ack(name, wanted, _IN_PROGRESS),))  # a retry: it is on its way
        if asked is None and value == knob.value:
            return Reply((_ack(name, wanted, _ACCEPTED),))
        return self._turn(knob, value, _Asked(value, link, now_ns + WAIT_NS))

    def _turn(self, knob: Knob, value: str, asked: _Asked) -> Reply:
        with self._lock:
            self._asked[knob.name] = asked
        result, words = _IN_PROGRESS, None
        try:
            if self._knobs.turn(knob.name, value):
                result = _ACCEPTED
        except CameraError as error:
            result, value, words = _FAILED, knob.value, str(error)
        if result != _IN_PROGRESS:
            self._done(knob.name, asked)
        return Reply((_ack(knob.name, code(value), result),), words)

    def settled(self, now_ns: int, refused: str | None = None) -> list[tuple[int, Reply]]:
        """How those ended that a body was asked for: (link, reply) each. Call when the body told its settings (with
        its sentence where it `refused`), and now and then: whatever took longer than five seconds has failed."""
        replies = []
        with self._lock:
            waiting = list(self._asked.items())
        for name, asked in waiting:
            knob = self._knobs.find(name)
            now = "" if knob is None else knob.value
            if now == asked.value:
                reply = Reply((_ack(name, code(now), _ACCEPTED),))
            elif refused or now_ns >= asked.due_ns or knob is None:
                why = refused or "the camera has not taken it for 5 s"
                reply = Reply((_ack(name, code(now), _FAILED),), f"{name} stays {now or 'unknown'}: {why}")
            else:
                continue
            if self._done(name, asked):
                replies.append((asked.link, reply))
        return replies

    def _done(self, name: str, asked: _Asked) -> bool:
        """Whether this is still what was asked for: not another value meanwhile, and told by nobody else."""
        with self._lock:
            ours = self._asked.get(name) is asked
            if ours:
                del self._asked[name]
        return ours


def _value(knob: Knob, index: int, count: int) -> Message:
    return mavlink.MAVLink_param_ext_value_message(knob.name.encode(), _packed(code(knob.value)), TYPE, count, index)


def _ack(name: str, value: int, result: int) -> Message:
    return mavlink.MAVLink_param_ext_ack_message(name.encode()[:16], _packed(value), TYPE, result)


def _packed(value: int) -> bytes:
    return struct.pack("<I", value).ljust(128, b"\0")


def _number(message: Message) -> int | None:
    """The value as a number: what our type holds; None for another type."""
    if message.param_type != TYPE:
        return None
    data: bytes = message._param_value_raw  # pymavlink cuts `param_value` at the first zero byte, as if it were text
    return int(struct.unpack("<I", data[:4].ljust(4, b"\0"))[0])
