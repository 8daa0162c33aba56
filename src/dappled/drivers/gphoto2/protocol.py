"""What the camera's process needs of an open camera, and how its calls fail. No libgphoto2 here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from dappled.drivers.camera import Blob, Identity, Setting, SettingName

_MEMORY_FOLDER = "/"


class SessionError(Exception):
    """A call to the camera failed; one sentence."""


class AbsentError(SessionError):
    """No camera to open."""


class HeldError(SessionError):
    """The camera is there and can't be opened."""


class LostError(SessionError):
    """The session is unusable: close it and open another."""


class BusyError(SessionError):
    """The camera is at work; the same call may succeed later."""


class RefusedError(SessionError):
    """The camera said no to this call; the session goes on."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """Where a file lies at the camera. Files in the camera's memory have the folder "/"."""

    folder: str
    name: str

    @property
    def in_memory(self) -> bool:
        """Whether the file is in the camera's memory and not on its card."""
        return self.folder == _MEMORY_FOLDER


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file's bytes, and when the body's own clock says that it was made: seconds of a clock that may be wrong, None
    where the body doesn't say."""

    blob: Blob
    taken_s: int | None = None


@dataclass(frozen=True, slots=True)
class FileAdded:
    """The camera announced a file."""

    file: CameraFile


@dataclass(frozen=True, slots=True)
class CaptureComplete:
    """The camera has finished a capture."""


CameraNews = FileAdded | CaptureComplete


class Session(Protocol):
    """What the camera's process needs of an open camera."""

    @property
    def identity(self) -> Identity:
        """Who the camera is."""

    @property
    def keeps_files(self) -> bool:
        """Whether pictures go to a card, where they outlive the session."""

    def trigger(self) -> None:
        """Release the shutter. Raises BusyError, RefusedError, LostError."""

    def news(self) -> list[CameraNews]:
        """All that happened since the last call. Raises LostError."""

    def fetch(self, file: CameraFile) -> Fetched:
        """A file's bytes. Raises BusyError, RefusedError, LostError."""

    def taken_s(self, file: CameraFile) -> int | None:
        """When a file on the card was made, by the body's clock. Raises LostError."""

    def about(self, file: CameraFile) -> tuple[int, int | None]:
        """(size in bytes, when it was made by the body's clock) of a file on the card. Raises SessionError."""

    def delete(self, file: CameraFile) -> None:
        """Delete a file at the camera. Raises RefusedError, LostError."""

    def files(self) -> frozenset[CameraFile]:
        """All files on the card, as they were when the session was opened or later. Raises LostError."""

    def settings(self) -> tuple[Setting, ...]:
        """What can be read of the camera. Raises LostError."""

    def change(self, name: SettingName, value: str) -> None:
        """Set one of them. Raises BusyError, RefusedError, LostError."""

    def close(self) -> None:
        """End the session; never raises."""
