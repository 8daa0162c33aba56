"""What goes down the street: one shot's story, who is told of it, and the book that it is written in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from dappled.daemon.navigation import ExposureTime
from dappled.daemon.pipeline.decode_process import DecodedFrame
from dappled.decode.geometry import Pose
from dappled.drivers.camera import Blob, Fired, SettingsChanged, StateChanged
from dappled.flight import Frame, Result, Shot, Tag


class FlightWriter(Protocol):
    """What the street writes down, or, in a replay, compares. Raises FlightError where it can't."""

    def frame(self, index: int) -> Frame | None:
        """A frame that is safe."""

    def tag(self, index: int) -> Tag | None:
        """The tag of a frame, once known."""

    def fired(self, event: Fired) -> None:
        """The trigger call was made."""

    def failed(self, index: int, reason: str) -> None:
        """A shot will bring no frame."""

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe; when this returns it is."""

    def follows(self, index: int, reason: str) -> None:
        """A shot was fired, and its file stays at the camera for now."""

    def companion(self, index: int, name: str, blob: Blob) -> None:
        """Make a file safe that stands beside a frame."""

    def path(self, frame: Frame) -> str:
        """Where the frame's file stands."""

    def tagged(self, tag: Tag) -> None:
        """A frame's tag is known."""

    def decoded(self, result: Result) -> None:
        """A frame's slices are known."""

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        """Something happened."""


# (image index, exposure as expected) → exposure as known better, and its pose; waits, bounded
PoseSource = Callable[[int, ExposureTime], tuple[ExposureTime, Pose]]


@dataclass(slots=True)
class PendingShot:
    """One shot on its way down the street, for those who watch: filled in as it goes. Times in milliseconds.

    `over`: its watchers were told that it is finished. `follows` says, for a shot whose file stays at the camera, how
    it will come; `where` is then when and where it was exposed, as far as that is known without the file.
    """

    shot: Shot
    fired: Fired | None = None
    frame: Frame | None = None
    tag: Tag | None = None
    decoded: DecodedFrame | None = None
    problem: str = ""
    doubt: str = ""
    follows: str = ""
    where: tuple[ExposureTime, Pose] | None = None
    ms: dict[str, float] = field(default_factory=dict)
    over: bool = False

    @property
    def open(self) -> bool:
        """Whether its file is waited for."""
        return self.frame is None and not self.follows


@dataclass(frozen=True, slots=True)
class Observer:
    """Who is told what: `settled` when a shot is safe (True) or failed, `tagged` when its tag is known or there will be
    none, `finished` once, when nothing more is expected of it, `camera` at every change of the camera's state,
    `settings` at every change of its settings."""

    settled: Callable[[int, bool], None] = lambda index, ok: None
    tagged: Callable[[PendingShot], None] = lambda pending: None
    finished: Callable[[PendingShot], None] = lambda pending: None
    camera: Callable[[StateChanged], None] = lambda change: None
    settings: Callable[[SettingsChanged], None] = lambda change: None


@dataclass(frozen=True, slots=True)
class Names:
    """What headers and tags call things. `camera` "auto" takes the model that the frame names."""

    camera: str
    mask: str
    law: str
