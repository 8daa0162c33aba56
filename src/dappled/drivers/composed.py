"""A camera made of a shutter line and a place where its files are picked up: neither knows of the other.

Files that come while their shots are waited for are told apart by order and by the camera's own time (`attribution`).
Where files only come later, each shot is deferred at once, and matched (`matching`) when the place is there.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from dappled.drivers import matching
from dappled.drivers.attribution import BodyClock, Claim, attribute
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    Companion,
    Deferred,
    Event,
    Fired,
    Identity,
    Setting,
    SettingName,
    ShotFailed,
    StateChanged,
    check_change,
)
from dappled.drivers.pickup import Found, Group, Source, groups
from dappled.drivers.shutter_line import Order, ShutterLine, UsesAutopilot, pressing

_LATE = 64
_WAITING = 64
_PRESSED = "the shutter stays pressed"
_FIRST_LOOK_S = 2.0
_ENOUGH = 3
"""So many pairs, and no shot without one, say that a card nobody saw before the flight is this camera's."""


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


class ComposedCamera:
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
        self._identity, self._line, self._plan, self._clock_ns = identity, line, plan, clock_ns
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._orders: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._open: dict[int, None] = {}  # shots that have not ended
        self._started = self._stopping = False
        self._opened = False  # the line, once
        self._line_fault = "the shutter line is not open"
        self._files_fault = ""
        self._ready = threading.Event()
        self._arrived = threading.Event()  # a shot was fired: look for its file
        self._pickup = (
            None
            if source is None
            else _Pickup(source, plan, self._deliver, self._give_up, clock_ns=clock_ns, utc_ns=utc_ns)
        )
        self._looked = threading.Event()  # what lay at the source before the first shot was seen, or nothing can be
        self._fire_thread = threading.Thread(target=self._fire_all, name="shutter line", daemon=True)
        self._pick_thread = threading.Thread(target=self._pick_up, name="pickup", daemon=True)

    def use_autopilot(self, order: Order) -> None:
        """See UsesAutopilot: for lines that go there."""
        if isinstance(self._line, UsesAutopilot):
            self._line.use_autopilot(order)

    def start(self) -> None:
        """See Camera."""
        self._started = True
        self._events.put(StateChanged("starting", "", self._clock_ns()))
        self._fire_thread.start()
        if self._pickup is not None:
            self._pick_thread.start()
        else:
            self._looked.set()

    def fire(self, shot: int) -> None:
        """See Camera: the line is pressed by a thread of its own."""
        with self._lock:
            if shot in self._open:
                raise CameraError(f"shot {shot} was fired before and has not ended")
            ready = self._ready.is_set() and not self._stopping and len(self._open) < _WAITING
            if ready:
                self._open[shot] = None
                self._orders.put(shot)
                return
            line = "too many shots wait for their files" if self._ready.is_set() else self._line_fault
        reason = "the camera was stopped" if self._stopping else line
        self._events.put(ShotFailed(shot, reason, self._clock_ns()))

    def next_event(self, timeout_s: float) -> Event | None:
        """See Camera."""
        try:
            return self._events.get(timeout=timeout_s) if timeout_s > 0 else self._events.get_nowait()
        except queue.Empty:
            return None

    def release(self, arrival: Arrival | Companion) -> None:
        """See Camera: what is picked up stays where it is; sources are never written to."""

    @property
    def identity(self) -> Identity | None:
        """See Camera: known once the line was open."""
        return self._identity if self._opened else None

    def settings(self) -> tuple[Setting, ...]:
        """See Camera: nothing can be read over a wire."""
        return ()

    def change(self, name: SettingName, value: str) -> None:
        """See Camera."""
        check_change((), name, value)

    def stop(self) -> None:
        """See Camera."""
        with self._lock:
            self._stopping = True
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
        while opened and not self._stopping:
            shot = self._orders.get()
            if not self._stopping:
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
        while not self._stopping:
            problem = self._tried(self._line.open)
            if pressed and not problem:
                problem = self._tried(self._line.let_go)
            if not problem:
                self._looked.wait(_FIRST_LOOK_S)
                self._opened = True
                self._ready.set()
                self._rest()
                return True
            problem = f"{_PRESSED}: {problem}" if pressed else problem
            if problem != said:
                said = problem
                self._line_lost(problem)
            self._wait(self._plan.retry_s)
            if self._opened:
                self._tried(self._line.close)
        return False

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
        if self._pickup is not None:
            self._pickup.expect(Claim(shot, called_ns))
            self._arrived.set()
        if self._plan.follows is not None:
            self._end(shot, Deferred(shot, self._plan.follows, self._clock_ns()))
        self._wait(self._plan.hold_s)
        problem = self._tried(self._line.let_go)
        if not problem:
            self._rest()
            return True
        problem = f"{_PRESSED}: {problem}"
        self._line_lost(problem)
        self._wait(self._plan.retry_s)
        return self._open_line(problem, pressed=True)

    def _rest(self) -> None:
        """Tell the state between shots, where the line is not lost."""
        with self._lock:
            fault = self._files_fault
            state = StateChanged("faulted" if fault else "ready", fault, self._clock_ns(), self._identity)
            if self._ready.is_set():
                self._events.put(state)

    def _wait(self, seconds: float) -> None:
        """Wait, but not when stopping: the end of the orders is a -1."""
        until = time.monotonic() + seconds
        while not self._stopping and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, 0.05))

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
        assert self._pickup is not None
        while not self._stopping:
            try:
                self._pickup.look()
                fault = ""
            except Exception as error:  # noqa: BLE001  # whatever a source raises: shots must end, the next look may do
                fault = f"files can't be picked up: {error!r}"
            self._looked.set()
            if fault != self._files_fault:
                self._files_fault = fault
                self._rest()
            self._arrived.wait(self._plan.poll_s)
            self._arrived.clear()
            self._wait(self._plan.poll_s / 4)
        self._pickup.close()

    def _deliver(self, arrival: Arrival | Companion) -> None:
        if isinstance(arrival, Arrival) and arrival.shot is not None:
            self._end(arrival.shot, arrival)
        else:
            self._events.put(arrival)

    def _give_up(self, shot: int, trouble: str) -> None:
        reason = f"no file came within {self._plan.file_s:g} s of the release" + (f": {trouble}" if trouble else "")
        self._end(shot, ShotFailed(shot, reason, self._clock_ns()))


class _Pickup:
    """Watches a source. What lay there before the first shot is older than the flight. One thread looks."""

    def __init__(
        self,
        source: Source,
        plan: Plan,
        deliver: Callable[[Arrival | Companion], None],
        give_up: Callable[[int, str], None],
        *,
        clock_ns: Callable[[], int],
        utc_ns: Callable[[], int],
    ) -> None:
        self._source, self._plan = source, plan
        self._tell, self._give_up_shot, self._clock_ns, self._utc_ns = deliver, give_up, clock_ns, utc_ns
        self._lock = threading.Lock()
        self._claims: list[Claim] = []
        self._late: list[Claim] = []
        self._clock = BodyClock()
        self._done: set[str] | None = None
        self._old: frozenset[str] | None = None  # what lay there before the first shot, as long as it does
        self._before: dict[str, int] = {}
        self._dates: dict[Found, float | None] = {}
        self._weighed: tuple[list[Claim], list[Group]] | None = None  # what was matched last: again brings no more
        self._trouble = ""  # why nothing could be listed, at the last look
        self._first_seen: dict[str, int] = {}
        self._stems: dict[str, int] = {}  # delivered frames by stem: for companions that come after

    def expect(self, claim: Claim) -> None:
        """A shot was fired; its file may come."""
        with self._lock:
            self._claims.append(claim)

    def look(self) -> None:
        """Deliver what is new and whole; give up what was waited for too long, whatever the source does."""
        try:
            self._look()
        finally:
            self._bound()

    def _look(self) -> None:
        self._trouble = ""
        try:
            found = self._source.list()
        except CameraError as error:
            self._trouble = str(error)
            found = []
            self._old = self._old or None  # an empty card that went can't be told from another one
        else:
            names = frozenset(one.name for one in found)
            if self._done is None and not self._claims:
                self._done, self._old = set(names), names
            if self._old is not None and not self._old <= names:
                self._old = None  # another card
            self._take(found)
        self._before = {one.name: one.size for one in found}

    def close(self) -> None:
        """Let go of the source."""
        self._source.close()

    def _take(self, found: list[Found]) -> None:
        done = self._done = self._done or set()
        fresh = [one for one in found if one.name not in done]
        whole = [one for one in fresh if one.size > 0 and self._before.get(one.name) == one.size]
        if self._plan.follows is None:
            for group in groups(whole):
                if self._complete(group):
                    self._hand_over(group)
        elif whole and len(whole) == len(fresh):  # nothing is still being written: now order and count mean something
            self._match(groups(whole))

    def _complete(self, group: Group) -> bool:
        """Whether no raw file is to be expected beside it any more."""
        now_ns = self._clock_ns()
        first_ns = self._first_seen.setdefault(group.main.stem, now_ns)
        waited = now_ns - first_ns >= self._plan.pair_s * 1e9
        return group.main.raw or group.main.stem in self._stems or waited

    def _hand_over(self, group: Group) -> None:
        """A file that comes in flight: whose is it?"""
        main = group.main
        if main.stem in self._stems:
            self._accompany(self._stems[main.stem], (main, *group.companions))
            return
        try:
            taken_s = self._source.taken_s(main)
        except CameraError:
            return  # the next look may find it again
        with self._lock:
            current = self._claims[0] if self._claims else None
        shown = None if taken_s is None else int(taken_s)
        verdict = attribute(self._late, current, shown, self._clock)
        if current is not None and verdict.shot == current.shot and shown is not None and not self._late:
            self._clock = self._clock.learnt(current, shown)
        facts = {"doubt": verdict.doubt} if verdict.doubt else {}
        if self._bring(verdict.shot, group, facts):
            self._late = [] if verdict.doubt else [one for one in self._late if one.shot != verdict.shot]

    def _match(self, fresh: list[Group]) -> None:
        """A card with all that was taken since: only pairs that are sure are taken now.

        Where nobody saw what lay on it before the flight, what is there may be of any day and any camera: then all
        shots must have found their files, and enough of them. The rest is left to `dappled flight pickup`.
        """
        with self._lock:
            claims = list(self._claims)
        if not claims or self._weighed == (claims, fresh):
            return
        try:
            for group in fresh:
                if group.main not in self._dates:
                    self._dates[group.main] = self._source.taken_s(group.main)
        except CameraError:
            return  # the card is gone again
        dated = [matching.DatedFile(group.main.name, self._dates[group.main]) for group in fresh]
        to_utc_ns = self._utc_ns() - self._clock_ns()
        shots = [matching.FiredShot(claim.shot, (claim.fired_ns + to_utc_ns) / 1e9) for claim in claims]
        by_name = {group.main.name: group for group in fresh}
        matched = matching.match(shots, dated)
        sure = self._old is not None or (not matched.shots and len(matched.pairs) >= _ENOUGH)
        brought = [self._bring(shot, by_name[name], {}) for shot, name in matched.pairs] if sure else []
        if all(brought):
            self._weighed = claims, fresh

    def _bring(self, shot: int | None, group: Group, facts: dict[str, str]) -> bool:
        try:
            blob = self._source.open(group.main)
        except CameraError:
            return False  # the next look may find it again
        assert self._done is not None
        self._done.add(group.main.name)
        with self._lock:
            self._claims = [claim for claim in self._claims if claim.shot != shot]
        self._tell(Arrival(shot, group.main.base, blob, self._clock_ns(), {"name": group.main.name, **facts}))
        if shot is not None:
            self._stems[group.main.stem] = shot
            self._accompany(shot, group.companions)
        return True

    def _accompany(self, shot: int, files: tuple[Found, ...]) -> None:
        assert self._done is not None
        for one in files:
            try:
                blob = self._source.open(one)
            except CameraError:
                continue
            self._done.add(one.name)
            self._tell(Companion(shot, one.base, blob, self._clock_ns(), {"name": one.name}))

    def _bound(self) -> None:
        if self._plan.follows is not None:
            return
        limit_ns = self._clock_ns() - round(self._plan.file_s * 1e9)
        with self._lock:
            overdue = [claim for claim in self._claims if claim.fired_ns < limit_ns]
            self._claims = [claim for claim in self._claims if claim.fired_ns >= limit_ns]
        for claim in overdue:
            self._late = [*self._late, claim][-_LATE:]
            self._give_up_shot(claim.shot, self._trouble)
