"""A camera that is a recording: each shot brings again the file that it brought, byte for byte."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dappled.drivers.camera import Arrival, Blob, Fired, Identity, PlainCamera, ShotFailed, StateChanged


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recorded shot: its file and the camera's name for it, or the reason why there is none.

    The fired times bracket the recorded trigger call; None where it was never seen, as is the file's arrival. `facts`
    are those that came with the file (see `Arrival`).
    """

    shot: int
    path: Path | None
    camera_name: str
    fired_monotonic_ns: tuple[int, int] | None
    arrived_monotonic_ns: int | None = None
    reason: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)


class ReplayCamera(PlainCamera):
    """A Camera (see `drivers.camera`) that plays recorded shots. Files are only ever opened for reading."""

    def __init__(
        self,
        shots: Iterable[Recorded],
        identity: Identity,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`monotonic_ns` stamps what the recording has no stamp for: the recording's own clock, in a replay."""
        super().__init__()
        self._shots = {recorded.shot: recorded for recorded in shots}
        self._identity, self._now_ns = identity, monotonic_ns
        self._playing = False

    def start(self) -> None:
        """See Camera."""
        self._playing = True
        self._events.put(StateChanged("ready", "", self._now_ns(), self._identity))

    def fire(self, shot: int) -> None:
        """See Camera: the recorded events of this shot follow at once."""
        now_ns = self._now_ns()
        if not self._playing:
            self._events.put(ShotFailed(shot, "the recording is not playing", now_ns))
            return
        recorded = self._shots.get(shot)
        if recorded is None:
            self._events.put(ShotFailed(shot, f"shot {shot} is not in the recording", now_ns))
            return
        if recorded.fired_monotonic_ns is not None:
            self._events.put(Fired(shot, *recorded.fired_monotonic_ns))
        if recorded.path is None:
            self._events.put(ShotFailed(shot, recorded.reason, now_ns))
            return
        try:
            fd = os.open(recorded.path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            self._events.put(ShotFailed(shot, f"{recorded.path} can't be read: {error.strerror}", now_ns))
            return
        arrived_ns = recorded.arrived_monotonic_ns or now_ns
        blob = Blob(fd, os.fstat(fd).st_size)
        self._events.put(Arrival(shot, recorded.camera_name, blob, arrived_ns, recorded.facts))

    @property
    def identity(self) -> Identity:
        """See Camera."""
        return self._identity

    def stop(self) -> None:
        """See Camera."""
        self._playing = False
