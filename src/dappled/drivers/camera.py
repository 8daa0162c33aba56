"""The door that every camera comes in by.

A driver is driven, never trusted: `fire` returns at once, and all that happens afterwards comes back as events, in
order, each with the monotonic time at which it was seen. A driver owns no shot; it carries the shot's image index
through so that the daemon can balance its books.

A camera is composed of a shutter (how it is fired), arrivals (how files come), settings (what can be read and set)
and an identity (who it is): one small protocol each.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from dappled.errors import DappledError

State = Literal["absent", "starting", "ready", "busy", "faulted"]


class CameraError(DappledError):
    """A camera can't be had or can't be used; one clear sentence with what to do."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the camera says it is. `serial` is empty where a body has none."""

    make: str
    model: str
    serial: str
    port: str


@dataclass(frozen=True, slots=True)
class Blob:
    """A file's bytes behind a descriptor (a memfd, or an open file): moved between processes without a copy."""

    fd: int
    size: int

    @classmethod
    def of(cls, data: bytes | memoryview, name: str = "dappled") -> Blob:
        """Bytes in memory as a blob of their own."""
        fd = os.memfd_create(name, os.MFD_CLOEXEC)
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]
        return cls(fd, len(data))

    def map(self) -> mmap.mmap:
        """The bytes, read only and shared. Raises ValueError for an empty blob."""
        return mmap.mmap(self.fd, self.size, prot=mmap.PROT_READ)

    def close(self) -> None:
        """Let go of the descriptor; maps made from it stay valid."""
        os.close(self.fd)


@dataclass(frozen=True, slots=True)
class StateChanged:
    """The camera is in another state; `reason` is a sentence where the state is absent or faulted."""

    state: State
    reason: str
    monotonic_ns: int
    identity: Identity | None = None


@dataclass(frozen=True, slots=True)
class Fired:
    """The trigger call for a shot was made and returned without error: the exposure began between the two times,
    or a body's latency after them."""

    shot: int
    called_monotonic_ns: int
    returned_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class ShotFailed:
    """A shot will bring no file. `reason` is a sentence."""

    shot: int
    reason: str
    monotonic_ns: int


@dataclass(frozen=True, slots=True)
class Arrival:
    """A file came from the camera. `shot` is None where the driver can't say which shot made it.

    `name` is the camera's own name for it ("IMG_0042.CR2"). The receiver closes the blob. `facts` are the driver's
    notes; where there is a "doubt" among them, its sentence says why `shot` may be the wrong one.
    """

    shot: int | None
    name: str
    blob: Blob
    monotonic_ns: int
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Companion:
    """One more file of a shot whose Arrival came before: the JPEG beside a raw file. The receiver closes the blob."""

    shot: int
    name: str
    blob: Blob
    monotonic_ns: int
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Deferred:
    """A shot was fired, and its file stays at the camera for now. `reason` is a sentence that says how it will come.
    An Arrival of the shot may follow, in this flight or by `dappled flight pickup`."""

    shot: int
    reason: str
    monotonic_ns: int


SettingName = Literal[
    "focal_length", "aperture", "shutter_speed", "iso", "image_format", "capture_target", "battery", "free_shots"
]


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of a camera, in the camera's own words ("5.6", "1/500", "RAW + Large Fine JPEG", "50%").

    `choices` are what it may be set to; empty: it can only be read.
    """

    name: SettingName
    value: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """What the camera's settings are now, all that can be read. `refused` is a sentence where a change was asked for
    and the camera would not have it."""

    settings: tuple[Setting, ...]
    monotonic_ns: int
    refused: str = ""


Event = StateChanged | Fired | ShotFailed | Deferred | Arrival | Companion | SettingsChanged


class Shutter(Protocol):
    """How a camera is fired."""

    def fire(self, shot: int) -> None:
        """Expose once for this shot; returns within milliseconds. Ends in exactly one Arrival or Deferred, after a
        Fired, or one ShotFailed; a ShotFailed may follow a Fired. Raises CameraError only for a shot that was fired
        before and has not ended."""


class Arrivals(Protocol):
    """How events and files come."""

    def next_event(self, timeout_s: float) -> Event | None:
        """The next event, or None when there was none for that long."""

    def release(self, arrival: Arrival | Companion) -> None:
        """The file is durable on disk: the camera's own copy may go."""


class CameraSettings(Protocol):
    """What can be read and set."""

    def settings(self) -> tuple[Setting, ...]:
        """As they were last read, from memory; empty while none were, and for a camera that tells nothing."""

    def change(self, name: SettingName, value: str) -> None:
        """Ask for another value, one of the setting's `choices`; returns at once. A SettingsChanged tells what became
        of it. Raises CameraError where the camera has no such setting or choice."""


class Identified(Protocol):
    """Who a camera is."""

    @property
    def identity(self) -> Identity | None:
        """The body that was opened last; None before the first."""


class Camera(Shutter, Arrivals, CameraSettings, Identified, Protocol):
    """What a driver does. All calls return within milliseconds, whatever the hardware does."""

    def start(self) -> None:
        """Begin to look for the camera and to report events."""

    def stop(self) -> None:
        """Let go of the camera within two seconds."""


def check_change(settings: tuple[Setting, ...], name: str, value: str) -> None:
    """Raises CameraError, in one sentence, unless there is such a setting that takes this value."""
    found = next((each for each in settings if each.name == name), None)
    if found is None:
        known = ", ".join(each.name for each in settings if each.choices) or "none"
        raise CameraError(f"the camera has no setting {name!r}; what can be set: {known}")
    if value not in found.choices:
        takes = f"it takes {', '.join(found.choices)}" if found.choices else "it can only be read"
        raise CameraError(f"the camera's {name} can't be set to {value!r}: {takes}")
