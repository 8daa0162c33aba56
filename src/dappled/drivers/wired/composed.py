"""A camera made of a shutter line and a place where its files are picked up: neither knows of the other.

Where files only come later, each shot is deferred at once; whose file is whose is `file_watch`'s business.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from dappled.drivers.attribution import Claim
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    Companion,
    Deferred,
    Fired,
    Identity,
    PlainCamera,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.wired.file_watch import FileWatch
from dappled.drivers.wired.shutter_line import Order, ShutterLine, UsesAutopilot, pressing
from dappled.drivers.wired.sources import Source

_WAITING = 64
_PRESSED = "the shutter stays pressed"
_FIRST_LOOK_S = 2.0


@dataclass(frozen=True, slots=True)
class Plan:
    """How a composed camera behaves. `follows`: None where files come in flight, within `file_s`; else the sentence how
    they will come later. `hold_s`: how long the shutter is pressed. `poll_s`: between looks at the source. `retry_s`:
    between attempts to open the line. `pair_s`: how long a JPEG waits for the raw file beside it."""

    file_s: float = 30.0
    follows: str | None = None
    hold_s: float = 0.2
    poll_s: float = 0.2
    retry_s: float = 1.0
    pair_s: float = 1.0


class ComposedCamera(PlainCamera):
    """The driver (`drivers.camera.Camera`). `source` None: nothing is picked up in flight."""

    def __init__(
        self,
        identity: Identity,
        line: ShutterLine,
        source: Source | None,
        plan: Plan,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        *,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        super().__init__()
        self._identity, self._line, self._plan, self._clock_ns = identity, line, plan, clock_ns
        self._orders: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._open: dict[int, None] = {}  # shots that have not ended
        self._stopping = threading.Event()
        self._opened = False  # the line, once
        self._line_fault = "the shutter line is not open"
        self._files_fault = ""
        self._ready = threading.Event()
        self._arrived = threading.Event()  # a shot was fired: look for its file
        self._watch = None if source is None else self._watching(source, utc_ns)
        self._looked = threading.Event()  # what lay at the source before the first shot was seen, or nothing can be
        self._fire_thread = threading.Thread(target=self._fire_all, name="shutter line", daemon=True)
        self._pick_thread = threading.Thread(target=self._pick_up, name="pickup", daemon=True)

    def _watching(self, source: Source, utc_ns: Callable[[], int]) -> FileWatch:
        plan = self._plan
        return FileWatch(
            source,
            self._deliver,
            self._give_up,
            in_flight=plan.follows is None,
            file_s=plan.file_s,
            pair_s=plan.pair_s,
            clock_ns=self._clock_ns,
            utc_ns=utc_ns,
        )

    def use_autopilot(self, order: Order) -> None:
        """See UsesAutopilot: for lines that go there."""
        if isinstance(self._line, UsesAutopilot):
            self._line.use_autopilot(order)

    def start(self) -> None:
        """See Camera."""
        self._events.put(StateChanged("starting", "", self._clock_ns()))
        self._fire_thread.start()
        if self._watch is not None:
            self._pick_thread.start()
        else:
            self._looked.set()

    def fire(self, shot: int) -> None:
        """See Camera: the line is pressed by a thread of its own."""
        with self._lock:
            if shot in self._open:
                raise CameraError(f"shot {shot} was fired before and has not ended")
            ready = self._ready.is_set() and not self._stopping.is_set() and len(self._open) < _WAITING
            if ready:
                self._open[shot] = None
                self._orders.put(shot)
                return
            line = "too many shots wait for their files" if self._ready.is_set() else self._line_fault
        reason = "the camera was stopped" if self._stopping.is_set() else line
        self._events.put(ShotFailed(shot, reason, self._clock_ns()))

    @property
    def identity(self) -> Identity | None:
        """See Camera: known once the line was open."""
        return self._identity if self._opened else None

    def stop(self) -> None:
        """See Camera."""
        with self._lock:
            self._stopping.set()
        self._orders.put(-1)
        self._arrived.set()
        self._looked.set()
        for thread in (self._fire_thread, self._pick_thread):
            if thread.is_alive():
                thread.join(0.8)
        with self._lock:
            left, self._open = list(self._open), {}
        for shot in left:
            self._events.put(ShotFailed(shot, "the camera was stopped", self._clock_ns()))

    # the shutter

    def _fire_all(self) -> None:
        opened = self._open_line()
        while opened and not self._stopping.is_set():
            shot = self._orders.get()
            if not self._stopping.is_set():
                opened = self._fire_one(shot)
        if self._opened:
            self._tried(self._line.close)

    def _tried(self, call: Callable[[], None]) -> str:
        """Why a call of the line failed; empty where it did not. A line of anybody's making may raise anything."""
        try:
            call()
        except CameraError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001  # as the docstring says: the thread must outlive it
            return f"the shutter line broke: {error!r}"
        return ""

    def _open_line(self, fault: str = "", *, pressed: bool = False) -> bool:
        """Until it is open, and, where it was `pressed`, let go. False when stopping."""
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
            self._stopping.wait(self._plan.retry_s)
            if self._opened:
                self._tried(self._line.close)
        return False

    def _await_first_look(self) -> None:
        """Files that come in flight are told from older ones by that look alone. Where they come later, a source that
        takes its time must not keep us from shooting."""
        in_flight = self._plan.follows is None
        while not self._looked.wait(_FIRST_LOOK_S) and in_flight:
            continue  # a source answers at some time, and `stop` ends this too

    def _line_lost(self, problem: str) -> None:
        """Say so. Shots that wait must not be fired when it is found again: their moment is over."""
        with self._lock:
            self._ready.clear()
            self._line_fault = problem
            self._events.put(StateChanged("faulted", problem, self._clock_ns()))
        while True:
            try:
                shot = self._orders.get_nowait()
            except queue.Empty:
                return
            self._end(shot, ShotFailed(shot, problem, self._clock_ns()))

    def _fire_one(self, shot: int) -> bool:
        """False when stopping."""
        self._events.put(StateChanged("busy", "", self._clock_ns(), self._identity))
        times: list[tuple[int, int]] = []
        problem = self._tried(lambda: times.append(pressing(self._line, self._clock_ns)))
        if problem:
            self._end(shot, ShotFailed(shot, problem, self._clock_ns()))
            self._tried(self._line.close)
            return self._open_line()
        called_ns, returned_ns = times[0]
        self._events.put(Fired(shot, called_ns, returned_ns))
        if self._watch is not None:
            self._watch.expect(Claim(shot, called_ns))
            self._arrived.set()
        if self._plan.follows is not None:
            self._end(shot, Deferred(shot, self._plan.follows, self._clock_ns()))
        self._stopping.wait(self._plan.hold_s)
        problem = self._tried(self._line.let_go)
        if not problem:
            self._rest()
            return True
        problem = f"{_PRESSED}: {problem}"
        self._line_lost(problem)
        self._stopping.wait(self._plan.retry_s)
        return self._open_line(problem, pressed=True)

    def _rest(self) -> None:
        """Tell the state between shots, where the line is not lost."""
        with self._lock:
            fault = self._files_fault
            state = StateChanged("faulted" if fault else "ready", fault, self._clock_ns(), self._identity)
            if self._ready.is_set():
                self._events.put(state)

    def _end(self, shot: int, event: ShotFailed | Deferred | Arrival) -> bool:
        """Tell a shot's end; False where it had ended before."""
        with self._lock:
            was = shot in self._open
            self._open.pop(shot, None)
        if was or isinstance(event, Arrival):
            self._events.put(event)
        return was

    # the files

    def _pick_up(self) -> None:
        assert self._watch is not None
        while not self._stopping.is_set():
            try:
                self._watch.look()
                fault = ""
            except Exception as error:  # noqa: BLE001  # whatever a source raises: shots must end, the next look may do
                fault = f"files can't be picked up: {error!r}"
            self._looked.set()
            if fault != self._files_fault:
                self._files_fault = fault
                self._rest()
            self._arrived.wait(self._plan.poll_s)
            self._arrived.clear()
            self._stopping.wait(self._plan.poll_s / 4)
        self._watch.close()

    def _deliver(self, arrival: Arrival | Companion) -> None:
        if isinstance(arrival, Arrival) and arrival.shot is not None:
            self._end(arrival.shot, arrival)
        else:
            self._events.put(arrival)

    def _give_up(self, shot: int, trouble: str) -> None:
        reason = f"no file came within {self._plan.file_s:g} s of the release" + (f": {trouble}" if trouble else "")
        self._end(shot, ShotFailed(shot, reason, self._clock_ns()))
