"""The door that every camera comes in by.

A driver is driven, never trusted: `fire` returns at once, and all that happens afterwards comes back as events, in
order, each with the monotonic time at which it was seen. A driver owns no shot; it carries the shot's image index
through so that the daemon can balance its books.
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


Event = StateChanged | Fired | ShotFailed | Arrival


class Camera(Protocol):
    """What a driver does. All calls return within milliseconds, whatever the hardware does."""

    def start(self) -> None:
        """Begin to look for the camera and to report events."""

    def fire(self, shot: int) -> None:
        """Expose once for this shot. Ends in exactly one Arrival, after a Fired, or one ShotFailed; a ShotFailed may
        follow a Fired. Raises CameraError only for a shot that was fired before and has not ended."""

    def next_event(self, timeout_s: float) -> Event | None:
        """The next event, or None when there was none for that long."""

    def release(self, arrival: Arrival) -> None:
        """The file is durable on disk: the camera's own copy may go."""

    def stop(self) -> None:
        """Let go of the camera within two seconds."""
