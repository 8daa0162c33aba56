"""The contract of every camera driver: `Camera`, its events, and base classes and helpers to write a driver with.

A driver never blocks: `fire` returns at once, and everything that happens afterwards is reported as events, in order,
each with the monotonic time at which the driver saw it. A driver keeps no record of shots; each event carries the
image index of its shot.

A camera is composed of four small protocols: a trigger (how it is fired), arrivals (how events and files come),
settings (what can be read and set) and an identity (which body it is).
"""

from __future__ import annotations

import mmap
import os
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from dappled.clock import Clock, SystemClock
from dappled.errors import DappledError
from dappled.findings import Finding

BodyState = Literal["absent", "starting", "ready", "busy", "faulted"]


class CameraError(DappledError):
    """A camera can't be opened or used; one sentence that says what to do."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What the camera says it is. `serial` is empty where a body has none."""

    make: str
    model: str
    serial: str
    port: str


@dataclass(frozen=True, slots=True)
class Blob:
    """A file's bytes behind a descriptor (a memfd or an open file), which can pass between processes without a copy.

    `sha256` (hex) where they were hashed as they came; else None. With it, a file that has no name yet (O_TMPFILE) and
    stands on the flight's own disk is not copied: the recorder gives it its name. Nobody may write to it any more.
    """

    fd: int
    size: int
    sha256: str | None = None

    @classmethod
    def of(cls, data: bytes | memoryview, name: str = "dappled") -> Blob:
        """Copy bytes into a memfd."""
        fd = os.memfd_create(name, os.MFD_CLOEXEC)
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]
        return cls(fd, len(data))

    def map(self) -> mmap.mmap:
        """Map the bytes, read only and shared. Raises ValueError for an empty blob."""
        return mmap.mmap(self.fd, self.size, prot=mmap.PROT_READ)

    def close(self) -> None:
        """Close the descriptor; maps made from it stay valid."""
        os.close(self.fd)


@dataclass(frozen=True, slots=True)
class StateChanged:
    """The camera is in another state; `reason` is a sentence where the state is absent or faulted."""

    state: BodyState
    reason: str
    monotonic_ns: int
    identity: Identity | None = None


@dataclass(frozen=True, slots=True)
class Fired:
    """The trigger call for a shot returned without error. The exposure began between the two times, or later by the
    latency of the body."""

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
    notes; where they include a "doubt", the JSON of a finding, that says why `shot` may be the wrong one.
    """

    shot: int | None
    name: str
    blob: Blob
    monotonic_ns: int
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Companion:
    """Another file of a shot that already had its Arrival: the JPEG beside a raw file. The receiver closes the blob."""

    shot: int
    name: str
    blob: Blob
    monotonic_ns: int
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Deferred:
    """A shot was fired, and its file stays on the camera for now. `reason` is a sentence that says how it will come.
    An Arrival of the shot may follow, in this flight or by `dappled flight pickup`."""

    shot: int
    reason: str
    monotonic_ns: int


SettingName = Literal[
    "focal_length",
    "aperture",
    "shutter_speed",
    "iso",
    "image_format",
    "capture_target",
    "battery",
    "free_shots",
    "exposure_mode",
    "focus_mode",
    "drive_mode",
    "white_balance",
    "auto_power_off",
    "mirror_lockup",
]


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of a camera, in the camera's own words ("5.6", "1/500", "RAW + Large Fine JPEG", "50%").

    `choices` are the values that it accepts; empty where it can only be read.
    """

    name: SettingName
    value: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ExposureNumber:
    """A setting that is a number: what people call it, its unit, and the relative difference up to which two are the
    same: less than a third of a stop, and more than files round by."""

    title: str
    unit: str
    same: float

    def is_same(self, value: float, target: float) -> bool:
        """Whether two are equal, but for rounding."""
        return abs(value - target) <= self.same * target

    def words(self, value: float) -> str:
        """With title and unit."""
        short = f"1/{1 / value:.0f}" if self.unit == "s" and 0 < value < 0.4 else f"{value:g}"
        return f"{self.title} {short} {self.unit}".rstrip()


EXPOSURES: Mapping[SettingName, ExposureNumber] = {
    "iso": ExposureNumber("ISO", "", 0.12),
    "shutter_speed": ExposureNumber("shutter speed", "s", 0.12),
    "aperture": ExposureNumber("aperture", "", 0.06),
    "focal_length": ExposureNumber("focal length", "mm", 0.01),
}


ExposurePlan = Mapping[SettingName, tuple[str, float]]  # what is planned, as it is written, and as a number


class Exposed(Protocol):
    """A frame, by its file."""

    @property
    def iso(self) -> float | None: ...

    @property
    def exposure_s(self) -> float | None: ...

    @property
    def f_number(self) -> float | None: ...

    @property
    def focal_length_mm(self) -> float | None: ...


def taken_with(frame: Exposed) -> dict[SettingName, float | None]:
    """The numbers of a frame's exposure; None for unknown."""
    return {
        "iso": frame.iso,
        "shutter_speed": frame.exposure_s,
        "aperture": frame.f_number,
        "focal_length": frame.focal_length_mm,
    }


def off_plan(frame: Exposed, plan: ExposurePlan) -> tuple[str, ...]:
    """What a frame was taken with instead of the planned exposure and focal length, in words; nothing of what the plan
    leaves open."""
    said, values = [], taken_with(frame)
    for name, (wanted, target) in plan.items():
        one, value = EXPOSURES[name], values[name]
        if value is None or not one.is_same(value, target):
            taken = f"{one.title} unknown" if value is None else one.words(value)
            said.append(f"{taken}, not {wanted} as planned")
    return tuple(said)


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """All settings of the camera that can be read, as they are now. `refused` is a sentence where a change was
    requested and the camera refused it."""

    settings: tuple[Setting, ...]
    monotonic_ns: int
    refused: str = ""


@dataclass(frozen=True, slots=True)
class Noticed:
    """The driver found something that ends no shot: the card was changed, or a picture stays on it."""

    finding: Finding
    monotonic_ns: int


CameraEvent = StateChanged | Fired | ShotFailed | Deferred | Arrival | Companion | SettingsChanged | Noticed


class ShutterTrigger(Protocol):
    """How a camera is fired."""

    def fire(self, shot: int) -> None:
        """Expose once for this shot; returns within milliseconds.

        The shot ends in exactly one Arrival or Deferred after a Fired, or in one ShotFailed, which may also follow a
        Fired. Raises CameraError only for a shot that was fired before and has not ended.
        """


class Arrivals(Protocol):
    """How events and files come."""

    def next_event(self, timeout_s: float) -> CameraEvent | None:
        """Return the next event, or None when there was none for that long."""

    def release(self, arrival: Arrival | Companion) -> None:
        """The file is durable on disk: the driver may delete the camera's copy."""


class BodySettings(Protocol):
    """What can be read and set."""

    def settings(self) -> tuple[Setting, ...]:
        """The settings as last read, from memory; empty while none were read, and for a camera that has none."""

    def change(self, name: SettingName, value: str) -> None:
        """Request another value, one of the setting's `choices`; returns at once. A SettingsChanged reports the
        outcome. Raises CameraError where the camera has no such setting or choice."""


class Identified(Protocol):
    """Which body a camera is."""

    @property
    def identity(self) -> Identity | None:
        """The body that was opened last; None before the first."""


class Camera(ShutterTrigger, Arrivals, BodySettings, Identified, Protocol):
    """What a driver does. All calls return within milliseconds, whatever the hardware does."""

    def start(self) -> None:
        """Begin to look for the camera and to report events."""

    def stop(self) -> None:
        """Close the camera within two seconds."""


@dataclass(frozen=True, slots=True)
class LivePicture:
    """A JPEG of what the lens sees now, and when it was read."""

    jpeg: bytes
    monotonic_ns: int


@runtime_checkable
class LiveView(Protocol):
    """A camera that can show what its lens sees before it is fired. A driver may have it."""

    def look(self) -> LivePicture | None:
        """Ask for a picture, and return the newest one, at most 2 s old; None while none has come. Returns at once.

        Shots go first. The camera ends live view before a shot, and when nobody has asked for 3 s. Raises CameraError
        where the body has none, or can't show it now.
        """


@runtime_checkable
class WritesFiles(Protocol):
    """A camera that can write its files to the flight's own disk while they come. A driver may have it."""

    def receive_into(self, folder: Path) -> None:
        """Files may be made without a name (O_TMPFILE) in this folder. Called before `start`."""


class QueuedCamera:
    """Base class with the receiver's half of `Arrivals`: any thread puts events, the receiver takes them."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._patience = clock or SystemClock()
        self._reported = threading.Condition()
        self._events: deque[CameraEvent] = deque()

    def report(self, event: CameraEvent) -> None:
        """Queue an event for the receiver. Any thread may call this; it never waits."""
        with self._reported:
            self._events.append(event)
            self._reported.notify()

    def next_event(self, timeout_s: float) -> CameraEvent | None:
        """Return the next event, or None where none came in time; after `stop` it still returns those that are left."""
        with self._reported:
            if timeout_s > 0:
                self._patience.wait_for(self._reported, lambda: self._events, timeout_s)
            return self._events.popleft() if self._events else None


class PlainCamera(QueuedCamera):
    """Base class of a camera that has no readable settings and never deletes its own copies of files."""

    def release(self, arrival: Arrival | Companion) -> None:
        """Do nothing: the camera's copy stays where it is."""

    def settings(self) -> tuple[Setting, ...]:
        """No settings."""
        return ()

    def change(self, name: SettingName, value: str) -> None:
        """Refuse: there is no such setting. Raises CameraError."""
        check_change((), name, value)


def check_change(settings: tuple[Setting, ...], name: str, value: str) -> None:
    """Raise CameraError, in one sentence, unless one of the settings has this name and accepts this value."""
    found = next((each for each in settings if each.name == name), None)
    if found is None:
        known = ", ".join(each.name for each in settings if each.choices) or "none"
        raise CameraError(f"the camera has no setting {name!r}; what can be set: {known}")
    if value not in found.choices:
        takes = f"it takes {', '.join(found.choices)}" if found.choices else "it can only be read"
        raise CameraError(f"the camera's {name} can't be set to {value!r}: {takes}")


def check_options(given: Mapping[str, Any], known: Sequence[str], where: str = "camera") -> None:
    """Raise CameraError for an option that the driver does not know."""
    unknown = [name for name in given if name not in known]
    if unknown:
        raise CameraError(f"{where} has no setting {unknown[0]!r} for this driver; it accepts {', '.join(known)}")


def text_option(given: Mapping[str, Any], name: str) -> str:
    """Return an option that is text, "" where it is absent. Raises CameraError."""
    value = given.get(name) or ""
    if not isinstance(value, str):
        raise CameraError(f"camera.{name} must be text, not {value!r}")
    return value


def seconds_option(given: Mapping[str, Any], name: str, default: float) -> float:
    """Return one of `timeouts`, in seconds. Raises CameraError."""
    table = given.get("timeouts") or {}
    value = table.get(name, default) if isinstance(table, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise CameraError(f"camera.timeouts.{name} must be a number of seconds above 0, not {value!r}")
    return float(value)
