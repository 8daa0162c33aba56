"""The protocol of an open camera, and its errors. This module does not load libgphoto2."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

from dappled.drivers.camera import Blob, Identity, Setting, SettingName
from dappled.drivers.gphoto2.intake import Intake

_MEMORY_FOLDER = "/"
FileFacts: TypeAlias = tuple[int, int | None]
"""A file's size in bytes, and when it was made by the body's clock, in seconds; None where the body doesn't say."""


def bus_nodes(dev: Path = Path("/dev/bus/usb")) -> frozenset[tuple[str, int, int, int, int]]:
    """The device files of the USB bus, each with what tells that it was made anew or may be opened by others."""
    found = set()
    for path in dev.glob("*/*"):
        with contextlib.suppress(OSError):  # it is gone
            node = path.stat()
            found.add((str(path), node.st_ino, node.st_mode, node.st_uid, node.st_gid))
    return frozenset(found)


class SessionError(Exception):
    """A call to the camera failed; one sentence."""


class AbsentError(SessionError):
    """No camera to open."""


class NotOnBusError(AbsentError):
    """It will not be there before something changes on the USB bus."""


class LostError(SessionError):
    """The session is unusable: close it and open another."""


class BusyError(SessionError):
    """The camera is busy; the same call may succeed later."""


class RefusedError(SessionError):
    """The camera refused this call; the session goes on."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A file's place on the camera. Files in the camera's memory have the folder "/"."""

    folder: str
    name: str

    @property
    def in_memory(self) -> bool:
        """Whether the file is in the camera's memory and not on its card."""
        return self.folder == _MEMORY_FOLDER


@dataclass(frozen=True, slots=True)
class CardContents:
    """The files on a card, each with its size in bytes and when it was made by the body's clock; and what the camera
    says of the card itself (label and capacity), "" where it says nothing.

    Two files of one name are the same where size and time are equal; libgphoto2 gives no number of a file.
    """

    files: Mapping[CameraFile, FileFacts]
    card: str = ""


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file's bytes, and when it was made by the body's own clock, as `FileFacts` has it."""

    blob: Blob
    taken_s: int | None = None


@dataclass(frozen=True, slots=True)
class FileAdded:
    """The camera announced a file."""

    file: CameraFile


@dataclass(frozen=True, slots=True)
class CaptureComplete:
    """The camera has finished a capture."""


@dataclass(frozen=True, slots=True)
class SettingTurned:
    """A setting of the camera has another value than was read: a hand has turned a dial."""


CameraNews = FileAdded | CaptureComplete | SettingTurned


class Session(Protocol):
    """An open camera."""

    @property
    def identity(self) -> Identity:
        """What the camera says it is."""

    @property
    def keeps_files(self) -> bool:
        """Whether pictures go to a card, where they outlive the session."""

    def trigger(self) -> None:
        """Release the shutter. Raises BusyError, RefusedError, LostError."""

    def news(self) -> list[CameraNews]:
        """Return what happened since the last call. Raises LostError."""

    def fetch(self, file: CameraFile, intake: Intake, alive: Callable[[], None]) -> Fetched:
        """Fetch a file's bytes; `alive` is called whenever some have come. Raises BusyError, RefusedError, LostError,
        OSError where there is no room in memory either, and what `alive` raises."""

    def about(self, file: CameraFile) -> FileFacts:
        """Return size and time of a file on the card. Raises SessionError."""

    def delete(self, file: CameraFile) -> None:
        """Delete a file at the camera. Raises RefusedError, LostError."""

    def files(self) -> frozenset[CameraFile]:
        """List all files on the card, as they were when the session was opened or later. Raises LostError."""

    def contents(self) -> CardContents:
        """What is on the card, as `files` has it. Raises LostError."""

    def settings(self) -> tuple[Setting, ...]:
        """Read all settings that the camera has. Raises LostError."""

    def change(self, name: SettingName, value: str) -> None:
        """Change a setting. Raises BusyError, RefusedError, LostError."""

    def preview(self) -> Blob:
        """Read a JPEG of what the lens sees; live view is on after that. Raises BusyError, RefusedError, LostError."""

    def end_preview(self) -> None:
        """End live view. Raises LostError."""

    def close(self) -> None:
        """End the session; never raises."""
