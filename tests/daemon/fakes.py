"""A camera, a decoder and a flight for tests of the pipeline: small, and true to the protocols."""

from __future__ import annotations

import mmap
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from dappled.clock import RecordedClock, SystemClock
from dappled.config.settings import PoseSettings
from dappled.daemon.navigation import BodyLatency, ExposureTime
from dappled.daemon.pipeline.capture import Observer, PendingShot, PendingShots, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodedFrame, DecodeProcessError
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.daemon.pipeline.picture_facts import PictureFacts
from dappled.daemon.pipeline.pipeline import Decoding, Pipeline
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter
from dappled.daemon.pipeline.verdicts import Judge
from dappled.daemon.stream.publisher import Stream
from dappled.decode.geometry import Pose, Vector3
from dappled.drivers.camera import (
    Arrival,
    Blob,
    CameraError,
    CameraEvent,
    Companion,
    Fired,
    Identity,
    Setting,
    SettingName,
    ShotFailed,
    StateChanged,
    check_change,
)
from dappled.drivers.raw.recipe import LawDecision
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import Shot, recording


def no_pose(utc_ns: int = 0) -> Pose:
    return Pose.unknown(utc_ns, 0)


Script = Callable[[int], list[CameraEvent | Exception]]


def fired(shot: int) -> Fired:
    now = time.monotonic_ns()
    return Fired(shot, now, now + 1000)


def arrival(shot: int | None, data: bytes = b"", name: str = "IMG_0001.DNG") -> Arrival:
    return Arrival(shot, name, Blob.of(data or b"frame %d" % (shot or 0)), time.monotonic_ns())


def failed(shot: int, reason: str = "the mirror is stuck") -> ShotFailed:
    return ShotFailed(shot, reason, time.monotonic_ns())


def good(shot: int) -> list[CameraEvent | Exception]:
    return [fired(shot), arrival(shot)]


class FakeCamera:
    """A driver that plays a script for each shot. An exception in it is raised by `next_event`; one that stands first
    and is a CameraError by `fire`."""

    def __init__(self, script: Script = good) -> None:
        self.script = script
        self.fired: list[int] = []
        self.released: list[int | None] = []
        self.stopped = False
        self._events: queue.SimpleQueue[CameraEvent | Exception] = queue.SimpleQueue()

    def start(self) -> None:
        self._events.put(StateChanged("ready", "", time.monotonic_ns()))

    def fire(self, shot: int) -> None:
        self.fired.append(shot)
        events = self.script(shot)
        if events and isinstance(events[0], CameraError):
            for event in events[1:]:
                self._events.put(event)
            raise events[0]
        for event in events:
            self._events.put(event)

    def say(self, event: CameraEvent) -> None:
        self._events.put(event)

    def next_event(self, timeout_s: float) -> CameraEvent | None:
        try:
            event = self._events.get(timeout=timeout_s) if timeout_s > 0 else self._events.get_nowait()
        except queue.Empty:
            return None
        if isinstance(event, Exception):
            raise event
        return event

    def release(self, arrival: Arrival | Companion) -> None:
        self.released.append(arrival.shot)

    @property
    def identity(self) -> Identity | None:
        return None

    def settings(self) -> tuple[Setting, ...]:
        return ()

    def change(self, name: SettingName, value: str) -> None:
        check_change((), name, value)

    def stop(self) -> None:
        self.stopped = True


class FakeDecoder:
    """Every frame decodes to the same few bytes, unless `problem` says otherwise."""

    def __init__(self) -> None:
        self.problem = ""
        self.gate = threading.Event()
        self.gate.set()
        self.seen: list[str] = []
        self.doubts: tuple[Finding, ...] = ()
        self.decision: LawDecision | None = None
        self.picture: PictureFacts | None = None

    def decode(
        self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int, look: bool = False
    ) -> DecodedFrame:
        self.seen.append(path)
        assert self.gate.wait(60)
        if self.problem:
            raise DecodeProcessError(self.problem)
        body = mmap.mmap(-1, 16)
        arrays = [{"name": "slices", "dtype": "<c8", "shape": [1, 1, 2], "unit": "1"}]
        unit = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        decision, self.decision = self.decision, None
        made = DecodedFrame(body, "0" * 64, arrays, [[0.0] * 4], "calibrated", 1, 1, "geometric", unit, b"", (0, 0))
        return replace(made, doubts=self.doubts, decision=decision, picture=self.picture)


@dataclass
class Rig:
    """A pipeline with its shutter and writer, in front of a fake camera."""

    flight: recording.Recording
    camera: FakeCamera
    pipeline: Pipeline
    pending: PendingShots
    shutter: Shutter
    decoder: FakeDecoder | None
    shots: list[PendingShot] = field(default_factory=list)
    settled: list[tuple[int, bool]] = field(default_factory=list)
    tagged: list[int] = field(default_factory=list)

    def request(self, number: int) -> ShotDecision:
        return self.shutter.request(CaptureRequest("test", "console", number))

    def ended(self, index: int) -> PendingShot:
        """A shot, once it is finished."""
        until = time.monotonic() + 60
        while time.monotonic() < until:
            for pending in list(self.shots):
                if pending.shot.index == index:
                    return pending
            threading.Event().wait(0.002)
        raise AssertionError(f"shot {index} never ended")

    def events(self) -> list[str]:
        return [f"{event.kind}: {event.words}" for event in self.flight.ledger.events()]


class CallingObserver(Observer):
    """Calls what it is given."""

    def __init__(
        self,
        settled: Callable[[int, bool], object] = lambda index, ok: None,
        tagged: Callable[[PendingShot], object] = lambda pending: None,
        finished: Callable[[PendingShot], object] = lambda pending: None,
    ) -> None:
        self._settled, self._tagged, self._finished = settled, tagged, finished

    def settled(self, index: int, ok: bool) -> None:
        self._settled(index, ok)

    def tagged(self, pending: PendingShot) -> None:
        self._tagged(pending)

    def finished(self, pending: PendingShot) -> None:
        self._finished(pending)


NO_CAMERA = finding(Code.CAMERA_ABSENT, Subject("camera"), reason="none is on the bus")


class FakeSink:
    """A ShotSink that keeps what it is given: `done` in order. `problem` stands in the way of every shot."""

    def __init__(self) -> None:
        self.problem: Finding | None = None
        self.note_error: OSError | None = None
        self.done: list[tuple[str, int]] = []
        self.refusals: list[Finding] = []

    @property
    def fired(self) -> list[int]:
        return [index for act, index in self.done if act == "fire"]

    def obstacle(self) -> Finding | None:
        return self.problem

    def note(self, shot: Shot) -> None:
        if self.note_error:
            raise self.note_error
        self.done.append(("note", shot.index))

    def fire(self, shot: Shot) -> None:
        self.done.append(("fire", shot.index))

    def refused(self, why: Finding) -> None:
        self.refusals.append(why)


class Nowhere:
    """SurveyFacts of which nothing is known."""

    def pose(self) -> None:
        """Not known."""

    def height(self) -> None:
        """Not known."""

    def field(self) -> None:
        """Not known."""

    def busy(self) -> bool:
        return False


@dataclass(frozen=True)
class FlightSink:
    """A ShotSink that notes shots in a flight and hands them to a camera."""

    flight: recording.Recording
    shots: PendingShots

    def obstacle(self) -> None:
        """There is none."""

    def note(self, shot: Shot) -> None:
        self.flight.journal.note(shot)

    def fire(self, shot: Shot) -> None:
        self.shots.fire(shot)

    def refused(self, why: Finding) -> None:
        """Only the sender hears it."""


class NoPoses:
    """A PoseSource that knows no pose."""

    def pose(self, index: int, exposure: ExposureTime) -> tuple[ExposureTime, Pose]:
        return exposure, no_pose(exposure.utc_ns)

    def rates(self, pose: Pose) -> Vector3 | None:
        return None


@contextmanager
def rig(
    flights: Path,
    script: Script = good,
    *,
    decode: bool = True,
    queue_: int = 4,
    stop_s: float = 5.0,
    camera: FakeCamera | None = None,
    publisher: Stream | None = None,
) -> Iterator[Rig]:
    """A pipeline at work on a new flight in `flights`; stopped and closed at the end."""
    clock = SystemClock()
    flight = recording.begin(flights, clock, {})
    writer = LedgerWriter(flight, clock)
    camera = camera or FakeCamera(script)
    decoder = FakeDecoder() if decode else None
    made: list[Rig] = []

    def settled(index: int, ok: bool) -> None:
        made[0].settled.append((index, ok))
        made[0].shutter.settled(index, ok)

    pending_shots = PendingShots(camera)
    observer = CallingObserver(
        settled,
        lambda pending: made[0].tagged.append(pending.shot.index),
        lambda pending: made[0].shots.append(pending),  # noqa: PLW0108  # a test may take the list away
    )
    ends, judge = ShotEnds(pending_shots, writer, observer), Judge(PoseSettings().mount, on_gimbal=False)
    decoding = Decoding(ends, decoder, publisher, capacity=queue_, judge=judge)
    pipeline = Pipeline(decoding, NoPoses(), BodyLatency(60.0, 15.0), Names("test", "mask", "geometric"))
    now_ns = clock.utc_ns()  # it stands still, so that a slow machine makes no new request of a retry
    steady = RecordedClock(now_ns, now_ns - clock.monotonic_ns())
    shutter = Shutter(FlightSink(flight, pending_shots), steady, next_index=flight.next_index, capacity=1000)
    made.append(Rig(flight, camera, pipeline, pending_shots, shutter, decoder))
    pipeline.start()
    try:
        yield made[0]
    finally:
        pipeline.stop(stop_s)
        flight.close()
