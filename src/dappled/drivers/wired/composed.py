"""A camera composed of a shutter line, which fires it, and a file source, where its files are picked up.

Where files come only after the flight, each shot is deferred at once. `file_watch` attributes files to shots.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from dappled.clock import Clock, TimeOfDayClock
from dappled.drivers.attribution import Claim
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    Companion,
    Deferred,
    Fired,
    Identity,
    Noticed,
    PlainCamera,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.wired.file_watch import FileWatch
from dappled.drivers.wired.shutter_line import CommandSender, HalfPressedLine, OutsideLine, ShutterLine, UsesAutopilot
from dappled.drivers.wired.sources import FileSource
from dappled.workers import Loop

_WAITING = 256  # at 5 Hz with files that come after 30 s, 150 shots wait
_PRESSED = "the shutter stays pressed"
_FIRST_LOOK_S = 2.0
_END_S = 0.8


@dataclass(frozen=True, slots=True)
class ComposedSettings:
    """How a composed camera behaves.

    `follows`: None where files come in flight, within `file_s` of the release; else a sentence that says how they come
    later. `hold_s`: how long the shutter is pressed. `poll_s`: time between looks at the source. `retry_s`: time
    between attempts to open the line. `pair_s`: how long a JPEG waits for the raw file beside it.
    """

    file_s: float = 30.0
    follows: str | None = None
    hold_s: float = 0.2
    poll_s: float = 0.2
    retry_s: float = 1.0
    pair_s: float = 1.0


class ComposedCamera(PlainCamera):
    """The driver (`drivers.camera.Camera`). Without a source no file is picked up in flight."""

    def __init__(
        self,
        identity: Identity,
        line: ShutterLine,
        source: FileSource | None,
        settings: ComposedSettings,
        clock: Clock | None = None,
    ) -> None:
        self._clock = clock or TimeOfDayClock()
        super().__init__(self._clock)
        self._identity, self._line, self._settings = identity, line, settings
        self._requested, self._asked = deque[int](), threading.Event()
        self._lock = threading.Lock()
        self._open: dict[int, None] = {}  # shots that have not ended
        self._stopping = threading.Event()
        self._opened = False  # the line, once
        self._line_fault = "the shutter line is not open"
        self._files_fault = ""
        self._ready = threading.Event()
        self._shot_fired = threading.Event()  # a shot was fired: look for its file
        self._watch: FileWatch | None = None
        if source is not None:
            self._watch = FileWatch(
                source,
                self._clock,
                in_flight=settings.follows is None,
                file_s=settings.file_s,
                pair_s=settings.pair_s,
            )
        self._looked = threading.Event()  # the files from before the first shot are known, or there is no source
        self._loops = [Loop("shutter line", self._fire_all, self._stopping, self._clock)]
        if self._watch is not None:
            self._loops.append(Loop("pickup", self._pick_up, self._stopping, self._clock))

    def use_autopilot(self, send: CommandSender) -> None:
        """Send commands by this from now on. Hand it on to a line that is fired by the autopilot."""
        if isinstance(self._line, UsesAutopilot):
            self._line.use_autopilot(send)

    def start(self) -> None:
        self.report(StateChanged("starting", "", self._clock.monotonic_ns()))
        if self._watch is None:
            self._looked.set()
        for loop in self._loops:
            loop.start()

    def fire(self, shot: int) -> None:
        """Queue the shot: a thread of its own presses the line. Raises CameraError for one that has not ended."""
        with self._lock:
            if shot in self._open:
                raise CameraError(f"shot {shot} was fired before and has not ended")
            ready = self._ready.is_set() and not self._stopping.is_set() and len(self._open) < _WAITING
            if ready:
                self._open[shot] = None
                self._requested.append(shot)
                self._asked.set()
                return
            reason = "too many shots wait for their files" if self._ready.is_set() else self._line_fault
        if self._stopping.is_set():
            reason = "the camera was stopped"
        self.report(ShotFailed(shot, reason, self._clock.monotonic_ns()))

    @property
    def identity(self) -> Identity | None:
        """The body, known once the line has been open."""
        return self._identity if self._opened else None

    def stop(self) -> None:
        with self._lock:
            self._stopping.set()
        self._asked.set()
        self._shot_fired.set()
        self._looked.set()
        for loop in self._loops:
            loop.stop(_END_S)
        with self._lock:
            left, self._open = list(self._open), {}
        for shot in left:
            self.report(ShotFailed(shot, "the camera was stopped", self._clock.monotonic_ns()))

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        return [name for loop in self._loops for name in loop.dead_threads()]

    # the shutter

    def _fire_all(self) -> None:
        opened = self._open_line()
        while opened and not self._stopping.is_set():
            self._clock.pause(self._asked, None)
            self._asked.clear()
            while self._requested and opened and not self._stopping.is_set():
                opened = self._fire_one(self._requested.popleft())
        if self._opened:
            self._tried(self._line.close)

    def _tried(self, call: Callable[[], None]) -> str:
        """Call the line and return why it failed, "" where it did not. A third party's line may raise anything."""
        try:
            call()
        except CameraError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001  # as the docstring says: the thread must survive it
            return f"the shutter line broke: {error!r}"
        return ""

    def _open_line(self, fault: str = "", *, pressed: bool = False) -> bool:
        """Try until the line is open and, where it was `pressed`, released. Returns False when stopping."""
        said = fault
        while not self._stopping.is_set():
            problem = self._tried(self._line.open)
            if pressed and not problem:
                problem = self._tried(self._line.let_go)
            if not problem:
                self._await_first_look()
                self._opened = True
                self._ready.set()
                self._rest()
                return True
            problem = f"{_PRESSED}: {problem}" if pressed else problem
            if problem != said:
                said = problem
                self._line_lost(problem)
            self._clock.pause(self._stopping, self._settings.retry_s)
            if self._opened:
                self._tried(self._line.close)
        return False

    def _await_first_look(self) -> None:
        """Wait until the source was listed once: only that look tells new files from older ones.

        Where files come later, a slow source does not hold up shooting for longer than `_FIRST_LOOK_S`.
        """
        in_flight = self._settings.follows is None
        while not self._clock.pause(self._looked, _FIRST_LOOK_S) and in_flight:
            continue  # a source answers in the end, and `stop` sets the event too

    def _line_lost(self, problem: str) -> None:
        """Report it, and fail the shots that wait: when the line is back their moment has passed."""
        with self._lock:
            self._ready.clear()
            self._line_fault = problem
            self.report(StateChanged("faulted", problem, self._clock.monotonic_ns()))
        while self._requested:
            shot = self._requested.popleft()
            self._end(shot, ShotFailed(shot, problem, self._clock.monotonic_ns()))

    def _fire_one(self, shot: int) -> bool:
        """Press, hold and release the line for a shot. Returns False when stopping."""
        self.report(StateChanged("busy", "", self._clock.monotonic_ns(), self._identity))
        problem = ""
        if isinstance(self._line, HalfPressedLine):
            problem = self._tried(self._line.prepare)
            if not problem and self._clock.pause(self._stopping, self._line.lead_s):
                self._tried(self._line.let_go)
                return False
        called_ns = self._clock.monotonic_ns()
        problem = problem or self._tried(self._line.press)
        returned_ns = self._clock.monotonic_ns()
        if problem:
            self._end(shot, ShotFailed(shot, problem, self._clock.monotonic_ns()))
            self._tried(self._line.close)
            return self._open_line()
        self.report(Fired(shot, called_ns, returned_ns))
        if self._watch is not None:
            self._watch.expect(Claim(shot, called_ns))
            self._shot_fired.set()
        if self._settings.follows is not None:
            self._end(shot, Deferred(shot, self._settings.follows, self._clock.monotonic_ns()))
        if not isinstance(self._line, OutsideLine):
            self._clock.pause(self._stopping, self._settings.hold_s)
        problem = self._tried(self._line.let_go)
        if not problem:
            self._rest()
            return True
        problem = f"{_PRESSED}: {problem}"
        self._line_lost(problem)
        self._clock.pause(self._stopping, self._settings.retry_s)
        return self._open_line(problem, pressed=True)

    def _rest(self) -> None:
        """Report the state between shots, unless the line is lost."""
        with self._lock:
            fault = self._files_fault
            state = StateChanged("faulted" if fault else "ready", fault, self._clock.monotonic_ns(), self._identity)
            if self._ready.is_set():
                self.report(state)

    def _end(self, shot: int, event: ShotFailed | Deferred | Arrival) -> bool:
        """Report the end of a shot. Returns False where it had ended before."""
        with self._lock:
            was = shot in self._open
            self._open.pop(shot, None)
        if was or isinstance(event, Arrival):
            self.report(event)
        return was

    # the files

    def _pick_up(self) -> None:
        assert self._watch is not None
        while not self._stopping.is_set():
            try:
                for event in self._watch.look():
                    self._deliver(event)
                fault = ""
            except Exception as error:  # noqa: BLE001  # a source may raise anything: shots must end, and the next look may work
                fault = f"files can't be picked up: {error!r}"
            for failed in self._watch.overdue():
                self._end(failed.shot, failed)
            self._looked.set()
            if fault != self._files_fault:
                self._files_fault = fault
                self._rest()
            self._clock.pause(self._shot_fired, self._settings.poll_s)
            self._shot_fired.clear()
            self._clock.pause(self._stopping, self._settings.poll_s / 4)
        for left in self._watch.left():
            self.report(left)
        self._watch.close()

    def _deliver(self, arrival: Arrival | Companion | Noticed) -> None:
        if isinstance(arrival, Arrival) and arrival.shot is not None:
            self._end(arrival.shot, arrival)
        else:
            self.report(arrival)
