"""Print what a daemon or a replay does: a line for each frame, changes of the camera, each problem once.

On a terminal these are lines; where the log goes to the journal, records with fields: `journalctl -u dappled
DAPPLED_FRAME=42`.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from dappled import codec
from dappled.clock import Clock, SystemClock
from dappled.daemon.health.record import line as status_line
from dappled.daemon.health.standing import NewFindings, unasked
from dappled.daemon.health.systemd import JournalHandler
from dappled.daemon.pipeline.capture import Observer, PendingShot
from dappled.daemon.stream import wire
from dappled.drivers.camera import StateChanged
from dappled.errors import counted
from dappled.findings import text, told
from dappled.shown import say
from dappled.workers import Loop, Worker

if TYPE_CHECKING:
    from dappled.daemon.service import Service

log = logging.getLogger("dappled.run")
_PROBLEMS_EVERY_NS = 10**9
SILENCE_S = 2.0


class Say(Protocol):
    """Prints a line; `fields` are the fields of the journal's record."""

    def __call__(self, text: str, level: int = ..., **fields: object) -> None: ...


@contextmanager
def waiting_for(what: str, silence_s: float = SILENCE_S) -> Iterator[None]:
    """Context that prints "waiting for WHAT" on standard error if it takes longer than `silence_s`."""
    over = threading.Event()

    def wait() -> None:
        if not over.wait(silence_s):
            say(f"waiting for {what}", error=True)

    loop = Loop("waiting", wait, over)
    loop.start()
    try:
        yield
    finally:
        loop.stop(1.0)


def remark(text: str, level: int = logging.INFO, **fields: object) -> None:
    """Print a line on standard error, or in the journal."""
    if _journalled():
        log.log(level, "%s", text, extra={"dappled": fields})
    else:
        say(text, error=True)


@dataclass(frozen=True, slots=True)
class _Line:
    """The line of a frame, as it was when the shot ended."""

    text: str
    level: int
    fields: Mapping[str, object]


class FrameLines:
    """Prints a line for each frame: on standard output, or in the journal unless `as_json`.

    It prints in a separate thread, so that a blocked terminal does not delay anything else.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        self._as_json = as_json
        self._lines: Worker[_Line] = Worker("print", self._print, capacity=1000, policy="drop oldest")
        self._lines.start()

    def finished(self, one: PendingShot) -> None:
        """Print the line of a shot that has ended."""
        fields: dict[str, Any] = {"frame": one.shot.index, "state": "safe" if one.frame else "failed"}
        if one.problem:
            fields["problem"] = str(text(one.problem))
        level = logging.WARNING if one.problem else logging.INFO
        self._lines.put(_Line(json.dumps(frame_values(one)) if self._as_json else frame_line(one), level, fields))

    def close(self) -> None:
        """Print the waiting lines, for a second at most."""
        self._lines.stop(1.0)

    def _print(self, line: _Line) -> None:
        if _journalled() and not self._as_json:
            remark(line.text, line.level, **line.fields)
            return
        try:
            say(line.text)
        except OSError:  # the reader is gone; the record goes on
            sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for the rest of the process


class CameraRemarks:
    """Prints the camera's state when it changes, except that it is busy."""

    def __init__(self, say: Say = remark) -> None:
        self.state = "starting"
        self._say = say

    def changed(self, change: StateChanged) -> None:
        """Take a change of state."""
        if change.state in ("busy", self.state):
            return
        self.state = change.state
        level = logging.INFO if change.state in ("starting", "ready") else logging.WARNING
        self._say(
            f"camera {change.state}" + (f": {change.reason}" if change.reason else ""), level, camera=change.state
        )


class Tally:
    """Counts the shots that have ended, over all flights of the process. Any thread may `add`."""

    def __init__(self) -> None:
        self.count = self.safe = self.decoded = self.good = 0
        self._lock = threading.Lock()

    def add(self, one: PendingShot) -> None:
        """Count a shot that has ended."""
        with self._lock:
            self.count += 1
            self.safe += one.frame is not None
            self.decoded += one.decoded is not None
            self.good += not one.problem

    def summary(self) -> str:
        """The counts as a line."""
        bad = self.count - self.good
        shots, frames = counted(self.count, "shot"), counted(self.safe, "frame")
        return f"{shots}: {frames} safe, {self.decoded} decoded, {bad} with a problem"


class RunObserver(Observer):
    """Counts and prints the shots that have ended, and what becomes of the camera."""

    def __init__(self, tally: Tally, frames: FrameLines, camera: CameraRemarks) -> None:
        self._tally, self._frames, self._camera = tally, frames, camera

    def finished(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot."""
        self._tally.add(pending)
        self._frames.finished(pending)

    def camera_changed(self, change: StateChanged) -> None:
        self._camera.changed(change)


class ProblemRemarks:
    """Prints each problem once when it appears, and gives the service manager its `status` line, each second."""

    def __init__(
        self,
        daemon: Service,
        status: Callable[[str], object],
        *,
        say: Say = remark,
        clock: Clock | None = None,
    ) -> None:
        self._daemon, self._status, self._say, self._clock = daemon, status, say, clock or SystemClock()
        self._new = NewFindings()
        self._due_ns = self._clock.monotonic_ns() + _PROBLEMS_EVERY_NS

    def look(self, *, now: bool = False) -> None:
        """Read the health record if a second has passed since the last time, or if `now`."""
        now_ns = self._clock.monotonic_ns()
        if not now and now_ns < self._due_ns:
            return
        self._due_ns = now_ns + _PROBLEMS_EVERY_NS
        record = self._daemon.health()
        for one in self._new.among(unasked(record)):
            self._say(f"{one.level.word}: {told(one)}", logging.WARNING, finding=one.code.value)
        self._status(status_line(record))


def _journalled() -> bool:
    return any(isinstance(one, JournalHandler) for one in logging.getLogger().handlers)


_SHORT = {"wish to trigger": "request", "trigger call": "call", "trigger to file": "file"}


def frame_line(pending: PendingShot) -> str:
    """One line: index, source, time, position, attitude, focal length, carriers, size, milliseconds per stage."""
    cause = pending.shot.cause
    sequence = "" if cause.sequence is None else f" #{cause.sequence}"
    words = [f"{pending.shot.index:06d}", f"{cause.kind}{sequence} from {cause.source}"]
    if pending.tag:
        pose = wire.pose_face(pending.tag)
        words.append(datetime.fromtimestamp(pending.tag.utc_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3])
        if pose["latitude_deg"] is None:
            words.append("no position")
        else:
            words.append(f"{pose['latitude_deg']:.7f} {pose['longitude_deg']:.7f} {pose['altitude_msl_m']:.2f} m")
        if pose["yaw_deg"] is None:
            words.append("no attitude")
        else:
            words.append(f"roll {pose['roll_deg']:.1f} pitch {pose['pitch_deg']:.1f} yaw {pose['yaw_deg']:.1f}")
        length = pending.tag.focal_length_mm
        words.append("focal length unknown" if length is None else f"{length:g} mm")
    if pending.decoded:
        done = pending.decoded
        found = "-" if done.carriers_found is None else done.carriers_found  # not observable at this aperture
        words.append(f"{found}/{done.carriers_predicted} carriers ({done.carriers_from})")
    if pending.frame:
        words.append(f"{pending.frame.size / 1e6:.1f} MB")
    times = " ".join(f"{_SHORT.get(name, name)} {ms:.0f}" for name, ms in pending.ms.items())
    if times:
        words.append(f"ms: {times}")
    if pending.frame is None and pending.follows:
        words.append(str(text(pending.follows)))
    if pending.problem:
        words.append(f"PROBLEM: {text(pending.problem)}")
    return "  ".join(words)


def frame_values(pending: PendingShot) -> dict[str, Any]:
    """For JSON: the shot, its frame, tag, carriers and times."""
    return {
        "index": pending.shot.index,
        "cause": codec.plain(pending.shot.cause),
        "frame": codec.plain(pending.frame),
        "tag": codec.plain(pending.tag),
        "carriers_found": pending.decoded.carriers_found if pending.decoded else None,
        "carriers_predicted": pending.decoded.carriers_predicted if pending.decoded else None,
        "carriers_from": pending.decoded.carriers_from if pending.decoded else None,
        "slices_sha256": pending.decoded.sha256 if pending.decoded else None,
        "ms": {**pending.ms, "decoder": dict(pending.decoded.ms) if pending.decoded else {}},
        "follows": codec.plain(pending.follows),
        "problem": codec.plain(pending.problem),
    }
