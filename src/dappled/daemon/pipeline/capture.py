"""Follow each shot from its request to its safe frame: the shots under way, and the camera's events in order."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from dappled import codec, findings
from dappled.clock import Clock, SystemClock
from dappled.daemon.navigation import ExposureTime
from dappled.daemon.pipeline.decode_process import DecodedFrame
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.pipeline.verdicts import Verdict
from dappled.decode.geometry import Pose, Vector3
from dappled.drivers.camera import (
    Arrival,
    BodyState,
    Camera,
    CameraEvent,
    Companion,
    Deferred,
    Fired,
    Noticed,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)
from dappled.errors import report, sentence
from dappled.findings import FRAME, Code, Evidence, Finding, Subject, finding
from dappled.flight import Frame, Shot, Tag
from dappled.flight.records import DOUBT, LATER_DOUBT, LEFT, NOTICED
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)
_WITHOUT_CAMERA = {
    "absent": Code.CAMERA_ABSENT,
    "faulted": Code.CAMERA_FAULTED,
    "starting": Code.CAMERA_STARTING,
}
GIVEN_UP = 16  # failed shots that a late file can still belong to
FOLLOWING = 4096  # the same for shots whose file stays at the camera; `geotag` tags the frames of older ones
_LOOK_S = 0.1
_LAST_EVENTS_NS = 10**9


@dataclass(slots=True)
class PendingShot:
    """One shot on its way through the pipeline; each stage fills in what it finds. `ms` holds times in milliseconds.

    `over`: its observers know that it is finished. `entered`: its row is in the ledger. `follows` says, for a shot
    whose file stays at the camera, how it will come; `where` is then when and where it was exposed, as far as that is
    known without the file. `rates_rad_s` are the body's at mid-exposure. `body_c` is the camera's
    temperature as its file has it.
    """

    shot: Shot
    fired: Fired | None = None
    frame: Frame | None = None
    tag: Tag | None = None
    rates_rad_s: Vector3 | None = None
    body_c: float | None = None
    decoded: DecodedFrame | None = None
    verdict: Verdict | None = None
    problem: Finding | None = None
    doubt: Finding | None = None
    follows: Finding | None = None
    where: tuple[ExposureTime, Pose] | None = None
    ms: dict[str, float] = field(default_factory=dict)
    over: bool = False
    entered: bool = False

    @property
    def open(self) -> bool:
        """Whether its file is still expected."""
        return self.frame is None and not self.follows


class Observer:
    """Follows what the pipeline does. Each method does nothing here; subclasses override what they need.

    An exception from a method is logged, and the pipeline goes on.
    """

    def settled(self, index: int, ok: bool) -> None:
        """A shot is safe (`ok`) or failed."""

    def tagged(self, pending: PendingShot) -> None:
        """A shot's tag is known, or there will be none."""

    def finished(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot. Called once for each."""

    def camera_changed(self, change: StateChanged) -> None:
        """The camera's state changed."""

    def settings_changed(self, change: SettingsChanged) -> None:
        """The camera's settings changed."""


class PendingShots:
    """The shots under way at one camera, and the state of that camera. Any thread may ask, add and remove.

    A shot that failed, or whose file stays at the camera, is kept for a while after its end: its file may still come.
    `decoding`: whether safe frames are decoded in flight. `clock` measures the stages of the pipeline too.
    """

    def __init__(self, camera: Camera, clock: Clock | None = None) -> None:
        self.clock = clock or SystemClock()
        self.state: BodyState = "starting"
        self.reason = ""
        self.decoding = True
        self.camera = camera
        self._unfired: deque[ShotFailed] = deque()
        self._changed = threading.Condition()
        self._in_hand: dict[int, PendingShot] = {}
        self._given_up: dict[int, PendingShot] = {}
        self._following: dict[int, PendingShot] = {}

    def fire(self, shot: Shot) -> None:
        """Hand a noted shot to the camera. Never raises: a shot that the driver refuses has failed."""
        with self._changed:
            self._in_hand[shot.index] = PendingShot(shot)
        try:
            self.camera.fire(shot.index)
        except Exception as error:  # noqa: BLE001  # any driver's; the shot is noted and must come to an end
            reason = f"the camera driver did not take the shot: {sentence(error)}"
            self._unfired.append(ShotFailed(shot.index, reason, self.clock.monotonic_ns()))

    def unfired(self) -> ShotFailed | None:
        """The next shot that the driver refused."""
        return self._unfired.popleft() if self._unfired else None

    def in_hand(self, index: int) -> PendingShot | None:
        """A shot that has not come to its end; None for any other."""
        return self._in_hand.get(index)

    def of_file(self, index: int) -> PendingShot | None:
        """The shot that a file belongs to, also where the shot ended without the file."""
        with self._changed:
            return self._in_hand.get(index) or self._given_up.get(index) or self._following.get(index)

    def open(self) -> list[int]:
        """The shots whose files are expected."""
        with self._changed:
            return [index for index, pending in self._in_hand.items() if pending.open]

    @property
    def waits(self) -> bool:
        """Whether a shot was handed to the camera that it has not fired yet."""
        with self._changed:
            return any(pending.fired is None and pending.open for pending in self._in_hand.values())

    def untagged(self, index: int) -> bool:
        """Whether a shot is under way and not tagged yet."""
        pending = self._in_hand.get(index)
        return pending is not None and pending.tag is None

    def wait_decoded(self, timeout_s: float = 5.0) -> bool:
        """Wait until no tagged frame is to be decoded. False if that takes longer than `timeout_s`."""
        with self._changed:
            return self.clock.wait_for(
                self._changed, lambda: all(one.tag is None for one in self._in_hand.values()), timeout_s
            )

    def without_camera(self) -> Finding | None:
        """Why there is no camera to fire; None where there is one."""
        code = _WITHOUT_CAMERA.get(self.state)
        return None if code is None else finding(code, Subject("camera"), reason=self.reason)

    def add(self, pending: PendingShot) -> None:
        """Take in a shot whose file came after its end."""
        with self._changed:
            self._in_hand[pending.shot.index] = pending

    def remove(self, pending: PendingShot) -> bool:
        """A shot has come to its end; False where its observers know that already."""
        with self._changed:
            if self._in_hand.get(pending.shot.index) is pending:
                del self._in_hand[pending.shot.index]
                self._changed.notify_all()
            over, pending.over = pending.over, True
        return not over

    def keep_failed(self, pending: PendingShot) -> None:
        """Know a failed shot's file for a while longer."""
        self._keep(self._given_up, pending, GIVEN_UP)

    def keep_following(self, pending: PendingShot) -> None:
        """Know the file of a shot that stays at the camera."""
        self._keep(self._following, pending, FOLLOWING)

    def file_came(self, index: int) -> tuple[bool, bool]:
        """A file is safe: whether it was to follow, and whether its shot had failed."""
        with self._changed:
            return self._following.pop(index, None) is not None, self._given_up.pop(index, None) is not None

    def _keep(self, where: dict[int, PendingShot], pending: PendingShot, most: int) -> None:
        with self._changed:
            where[pending.shot.index] = pending
            while len(where) > most:
                del where[min(where)]


class ShotEnds:
    """End each shot once, write down what is remarkable, and call the observer."""

    def __init__(self, shots: PendingShots, writer: FlightWriter, observer: Observer) -> None:
        self.shots, self.writer, self.observer = shots, writer, observer

    def fail(self, pending: PendingShot, why: Finding) -> None:
        """A shot ends without a frame; see `GIVEN_UP`."""
        pending.problem = why
        self.shots.keep_failed(pending)
        self.tell(self.observer.settled, pending.shot.index, False)
        self.tell(self.observer.tagged, pending)
        self.finish(pending)

    def follow(self, pending: PendingShot, why: Finding) -> None:
        """A shot's file stays at the camera for now."""
        pending.follows = why
        self.shots.keep_following(pending)
        self.tell(self.observer.settled, pending.shot.index, False)

    def safe(self, pending: PendingShot, frame: Frame, name: str) -> PendingShot:
        """A shot's file is safe. Returns the shot that goes on with it.

        For a file that was to follow that is a second PendingShot, whose end is not reported again.
        """
        if pending.follows:
            pending = PendingShot(pending.shot, pending.fired, ms=pending.ms, over=True, entered=pending.entered)
            self.shots.add(pending)
        pending.frame = frame
        followed, failed = self.shots.file_came(frame.index)
        if followed:
            self.note("followed", finding(Code.FRAME_FOLLOWED, FRAME, file=name), frame.index)
        elif failed:
            pending.problem = None
            self.shots.add(pending)
        return pending

    def leave(self, pending: PendingShot, code: Code, why: Evidence) -> None:
        """A safe frame is not processed further."""
        pending.problem = finding(code, _frame(pending), why=why)
        self.note(LEFT, pending.problem, pending.shot.index)
        self.finish(pending)

    def finish(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot."""
        if self.shots.remove(pending):
            self.tell(self.observer.finished, pending)

    def note(self, kind: str, found: Finding, index: int) -> None:
        """Write an event into the record. The pipeline goes on where that fails."""
        self.tell(self.writer.event, kind, found, index)

    def tell(self, receiver: Callable[..., Any], *facts: object) -> None:
        """Call `receiver`; log its exception instead of raising it."""
        try:
            receiver(*facts)
        except Exception as error:  # noqa: BLE001  # no observer may stop the pipeline
            report(log, "pipeline", error)


def _frame(pending: PendingShot) -> Subject:
    return Subject("frame", pending.shot.index)


class NextStage(Protocol):
    """The stage of the pipeline that shots go to next."""

    def take(self, pending: PendingShot) -> None:
        """Queue a shot. Never waits: where the queue is full, the shot ends here."""


class Capture(OneThread):
    """Pull the camera's events in one thread: make each file safe, and give up each shot without one.

    `following` takes the shots that are ready to be tagged: their frame is safe, or its file stays at the camera.
    """

    def __init__(self, ends: ShotEnds, following: NextStage) -> None:
        self._camera, self._ends, self._following = ends.shots.camera, ends, following
        self._shots, self._writer, self._observer = ends.shots, ends.writer, ends.observer
        self._clock = ends.shots.clock
        self._give_up_ns = 0
        self._never = threading.Event()
        self._loop = Loop("capture", self._run, clock=self._clock)

    def start(self) -> None:
        """Start the camera, then the thread."""
        self._camera.start()
        super().start()

    def stop(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` for what is with the camera, then release it. Shots without a file have failed."""
        self._give_up_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        ended = self._loop.stop(timeout_s + 1)
        self._ends.tell(self._camera.stop)
        if ended:
            self._last_events()

    def _run(self) -> None:
        while not self._loop.stopping.is_set() or self._worth_waiting():
            self._take(_LOOK_S)

    def _worth_waiting(self) -> bool:
        return self._clock.monotonic_ns() < self._give_up_ns and bool(self._shots.open())

    def _last_events(self) -> None:
        """Take what came while the camera was released; then every shot that is still open has failed."""
        until_ns = self._clock.monotonic_ns() + _LAST_EVENTS_NS
        while self._clock.monotonic_ns() < until_ns and self._take(0.0):
            pass
        for index in self._shots.open():
            self._ends.tell(self._shot_failed, index, finding(Code.SHOT_CUT_OFF, Subject("shot", index)))

    def _take(self, timeout_s: float) -> bool:
        """Pull one event and act on it; False where none came in time."""
        try:
            event = self._shots.unfired() or self._camera.next_event(timeout_s)
        except Exception as error:  # noqa: BLE001  # any driver's; go on, slowly enough for other threads
            report(log, "the camera driver", error)
            self._clock.pause(self._never, _LOOK_S)
            return True
        if event is None:
            return False
        self._handle(event)
        return True

    def _handle(self, event: CameraEvent) -> None:
        try:
            if isinstance(event, StateChanged):
                self._state_changed(event)
            elif isinstance(event, Fired):
                self._fired(event)
            elif isinstance(event, ShotFailed):
                about = Subject("shot", event.shot)
                self._shot_failed(event.shot, finding(Code.SHOT_FAILED, about, reason=event.reason))
            elif isinstance(event, Arrival):
                self._arrived(event)
            elif isinstance(event, Companion):
                self._accompanied(event)
            elif isinstance(event, Deferred):
                self._deferred(event)
            elif isinstance(event, SettingsChanged):
                self._ends.tell(self._observer.settings_changed, event)
            elif isinstance(event, Noticed):
                self._noticed(event.finding)
        except Exception as error:  # noqa: BLE001  # one event that goes wrong must not end the capture
            report(log, "capture", error)

    def _state_changed(self, change: StateChanged) -> None:
        self._shots.state, self._shots.reason = change.state, change.reason
        if not self._loop.stopping.is_set():
            self._ends.tell(self._observer.camera_changed, change)

    def _noticed(self, found: Finding) -> None:
        log.warning("%s", findings.told(found))
        about = found.subject
        if about.kind == "frame" and isinstance(about.which, int):
            self._writer.event(LATER_DOUBT, found, about.which)
        else:
            self._writer.event(NOTICED, found)

    def _enter(self, index: int | None) -> None:
        """Write a shot's row before its first event. Raises FlightError; the next event tries again."""
        pending = None if index is None else self._shots.of_file(index)
        if pending is not None and not pending.entered:
            self._writer.requested(pending.shot)
            pending.entered = True

    def _fired(self, event: Fired) -> None:
        self._enter(event.shot)
        self._writer.fired(event)  # raises for a second time, or one after the file: the first report counts
        if pending := self._shots.in_hand(event.shot):
            pending.fired = event
            pending.ms["wish to trigger"] = (event.called_monotonic_ns - pending.shot.wished_monotonic_ns) / 1e6
            pending.ms["trigger call"] = (event.returned_monotonic_ns - event.called_monotonic_ns) / 1e6

    def _shot_failed(self, index: int, why: Finding) -> None:
        pending = self._shots.in_hand(index)
        if pending is not None and pending.frame is not None:
            self._ends.note("contradiction", why, index)
            return
        try:
            self._enter(index)
            self._writer.failed(index, why)
        finally:
            if pending is not None:
                self._ends.fail(pending, why)

    def _arrived(self, arrival: Arrival) -> None:
        began = self._clock.monotonic_ns()
        pending = None if arrival.shot is None else self._shots.of_file(arrival.shot)
        try:
            self._enter(arrival.shot)
            frame = self._writer.record(arrival.shot, arrival.name, arrival.blob)
        except Exception as error:
            # The recorder has noted it as far as the disk lets it. A second file doesn't undo the first one.
            if pending is not None and pending.frame is None and not pending.over:
                about = Subject("shot", pending.shot.index)
                self._ends.fail(pending, finding(Code.SHOT_UNRECORDED, about, reason=error))
            raise
        finally:
            arrival.blob.close()
        self._ends.tell(self._camera.release, arrival)
        if pending is None or pending.frame is not None:
            return
        pending = self._ends.safe(pending, frame, arrival.name)
        if doubt := arrival.facts.get("doubt"):
            pending.doubt = codec.read(Finding, doubt)
            self._ends.note(DOUBT, pending.doubt, frame.index)
        if pending.fired:
            pending.ms["trigger to file"] = (arrival.monotonic_ns - pending.fired.returned_monotonic_ns) / 1e6
        pending.ms["record"] = (self._clock.monotonic_ns() - began) / 1e6
        self._ends.tell(self._observer.settled, frame.index, True)
        self._following.take(pending)

    def _accompanied(self, companion: Companion) -> None:
        try:
            self._writer.companion(companion.shot, companion.name, companion.blob)
        finally:
            companion.blob.close()
        self._ends.tell(self._camera.release, companion)

    def _deferred(self, event: Deferred) -> None:
        """The end of a shot whose file comes later: where it was exposed can be reported now."""
        why = finding(Code.SHOT_FOLLOWS, Subject("shot", event.shot), reason=event.reason)
        try:
            self._enter(event.shot)
            self._writer.follows(event.shot, why)
        finally:
            pending = self._shots.in_hand(event.shot)
            if pending is not None and pending.frame is None:
                self._ends.follow(pending, why)
                self._following.take(pending)
