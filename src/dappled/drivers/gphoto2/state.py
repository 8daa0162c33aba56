"""What the loop of the camera's process remembers."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from dappled.drivers.attribution import BodyClock, Claim
from dappled.drivers.camera import BodyState, Setting
from dappled.drivers.gphoto2.messages import LATE
from dappled.drivers.gphoto2.pairs import Pairs
from dappled.drivers.gphoto2.protocol import (
    CameraFile,
    Session,
)


@dataclass(slots=True)
class AtCamera:
    """The shot that is at the camera."""

    shot: int
    since_ns: int
    fired_ns: int | None = None
    complete_ns: int | None = None
    retry_ns: int = 0
    looked_ns: int | None = None


@dataclass(slots=True)
class Books:
    """All that the loop remembers. `late`: shots that were given up after they had been fired. `known`: the files on
    the card that are no news; None while the card was never seen."""

    session: Session | None = None
    serial: str | None = None
    state: tuple[BodyState, str] | None = None
    open_at_ns: int = 0
    waiting: deque[int] = field(default_factory=deque)
    flight: AtCamera | None = None
    to_fetch: deque[CameraFile] = field(default_factory=deque)
    tries: dict[CameraFile, int] = field(default_factory=dict)
    known: frozenset[CameraFile] | None = None
    late: deque[Claim] = field(default_factory=lambda: deque(maxlen=LATE))
    clock: BodyClock = field(default_factory=BodyClock)
    pairs: Pairs = field(default_factory=Pairs)
    settings: tuple[Setting, ...] = ()
    settings_due_ns: int | None = None
