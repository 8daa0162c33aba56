"""Replay a recorded camera: each shot brings the recorded file again, byte for byte."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dappled.clock import Clock, SystemClock
from dappled.drivers.camera import Arrival, Blob, Fired, Identity, PlainCamera, ShotFailed, StateChanged


@dataclass(frozen=True, slots=True)
class RecordedShot:
    """One recorded shot: its file and the camera's name for it, or the reason why there is no file.

    The fired times bracket the recorded trigger call. They and the file's arrival are None where none was recorded.
    `facts` came with the file (see `Arrival`).
    """

    shot: int
    path: Path | None
    camera_name: str
    fired_monotonic_ns: tuple[int, int] | None
    arrived_monotonic_ns: int | None = None
    reason: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)


class ReplayCamera(PlainCamera):
    """The driver (`drivers.camera.Camera`). Files are only opened for reading."""

    def __init__(self, shots: Iterable[RecordedShot], identity: Identity, clock: Clock | None = None) -> None:
        """`clock` stamps what the recording has no stamp for; in a replay it is the recording's own clock."""
        super().__init__()
        self._shots = {recorded.shot: recorded for recorded in shots}
        self.identity, self._clock = identity, clock or SystemClock()
        self._playing = False

    def start(self) -> None:
        self._playing = True
        self.report(StateChanged("ready", "", self._clock.monotonic_ns(), self.identity))

    def fire(self, shot: int) -> None:
        """Report the recorded events of this shot at once."""
        now_ns = self._clock.monotonic_ns()
        if not self._playing:
            self.report(ShotFailed(shot, "the recording is not playing", now_ns))
            return
        recorded = self._shots.get(shot)
        if recorded is None:
            self.report(ShotFailed(shot, f"shot {shot} is not in the recording", now_ns))
            return
        if recorded.fired_monotonic_ns is not None:
            self.report(Fired(shot, *recorded.fired_monotonic_ns))
        if recorded.path is None:
            self.report(ShotFailed(shot, recorded.reason, now_ns))
            return
        try:
            fd = os.open(recorded.path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            self.report(ShotFailed(shot, f"{recorded.path} can't be read: {error.strerror}", now_ns))
            return
        arrived_ns = recorded.arrived_monotonic_ns or now_ns
        blob = Blob(fd, os.fstat(fd).st_size)
        self.report(Arrival(shot, recorded.camera_name, blob, arrived_ns, recorded.facts))

    def stop(self) -> None:
        self._playing = False
