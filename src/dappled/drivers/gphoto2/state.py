"""Keep the state of a camera between two turns of its process' loop: shots, files, settings, and what belongs together.

Nothing here calls the camera. The loop reports what the camera did, and sends the events that come back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from dappled import findings
from dappled.drivers.attribution import BodyClock, Claim, FileClue, attribute
from dappled.drivers.camera import (
    Arrival,
    CameraEvent,
    Companion,
    Fired,
    Setting,
    SettingsChanged,
    ShotFailed,
)
from dappled.drivers.gphoto2.messages import LATE_LIMIT, Carryover
from dappled.drivers.gphoto2.protocol import CameraFile
from dappled.drivers.gphoto2.settings import Timeouts

_WAITING_LIMIT = 64
_BUSY_RETRY_S = 0.05
_TRIES = 3
_SETTINGS_S = 1.0
"""How long after a file the settings are read: by then the body has updated what the shot changed (battery, free
shots)."""

Stem = tuple[str, str]
Held = tuple[CameraFile, Arrival, int | None]


@dataclass(slots=True)
class CurrentShot:
    """The shot that is at the camera, and the monotonic times of what happened to it; None: not yet."""

    shot: int
    since_ns: int
    fired_ns: int | None = None
    complete_ns: int | None = None
    retry_ns: int = 0
    searched_ns: int | None = None


class CameraState:
    """The state of one camera. One thread uses it; `now_ns` is monotonic time.

    Shots wait in order, and one is at the camera at a time. A shot that was given up after it had been fired is *late*:
    its file may still come. Files are attributed to the current shot or to a late one by the body's clock.

    A raw file and a JPEG of one exposure are one frame: the raw file is the frame and the JPEG its companion, whichever
    comes first. On a card they are matched by name (IMG_0042.CR2, IMG_0042.JPG). libgphoto2 invents the names of files
    in the camera's memory (capt0000.cr2, capt0001.jpg), so these are matched by order.
    """

    def __init__(self, timeouts: Timeouts, carryover: Carryover) -> None:
        self.serial = carryover.serial
        self.current: CurrentShot | None = None
        self.settings: tuple[Setting, ...] = ()
        self._timeouts = timeouts
        self._waiting: deque[int] = deque()
        self._late = deque(carryover.late, LATE_LIMIT)
        self._clock = BodyClock(carryover.offsets_s)
        self._seen = frozenset(carryover.seen)
        self._to_fetch: deque[CameraFile] = deque()
        self._tries: dict[CameraFile, int] = {}
        self._known: frozenset[CameraFile] | None = None  # files on the card that need no fetching; None: never listed
        self._held: dict[Stem, Held] = {}  # JPEGs that wait for the raw file beside them
        self._last_frame: tuple[Stem, bool, int] | None = None  # (stem, whether it is a JPEG, shot)
        self._settings_due_ns: int | None = None

    @property
    def has_work(self) -> bool:
        """Whether a file can be fetched or a shot begun at once."""
        return bool(self._to_fetch or (self._waiting and self.current is None))

    @property
    def is_busy(self) -> bool:
        """Whether a shot is at the camera or waits for it."""
        return bool(self.current or self._waiting)

    def opened(self, serial: str, now_ns: int) -> None:
        """A session was opened. Another body than before has another card."""
        if self.serial != serial:
            self.serial, self._known = serial, None
        self._settings_due_ns = now_ns

    def lost(self, reason: str, now_ns: int, *, keeps_files: bool) -> list[CameraEvent]:
        """The session is gone. A fired shot whose file is on the card stays current; any other has failed."""
        self._to_fetch.clear()
        self._tries.clear()
        if self.current is not None and not (keeps_files and self.current.fired_ns is not None):
            return self.fail_current(reason, now_ns)
        return []

    # --- shots

    def accept(self, shot: int, now_ns: int) -> list[CameraEvent]:
        """Let a shot wait for the camera; it fails where too many wait."""
        if len(self._waiting) >= _WAITING_LIMIT:
            return [ShotFailed(shot, f"{_WAITING_LIMIT} shots already wait for the camera", now_ns)]
        self._waiting.append(shot)
        return []

    def begin_next(self, now_ns: int) -> bool:
        """Make the next waiting shot the current one. False where there is none, or one is current."""
        if self.current is not None or not self._waiting:
            return False
        self.current = CurrentShot(self._waiting.popleft(), now_ns)
        return True

    def trigger_due(self, now_ns: int) -> bool:
        """Whether the current shot is to be fired now."""
        return self.current is not None and self.current.fired_ns is None and now_ns >= self.current.retry_ns

    def fired(self, called_ns: int, returned_ns: int) -> list[CameraEvent]:
        """The trigger call for the current shot returned without error."""
        assert self.current is not None
        self.current.fired_ns = returned_ns
        return [Fired(self.current.shot, called_ns, returned_ns)]

    def trigger_lost(self, called_ns: int, reason: str, now_ns: int) -> list[CameraEvent]:
        """The link broke in the trigger call: the shot has failed, and its file may still come."""
        assert self.current is not None
        self.current.fired_ns = called_ns
        return self.fail_current(f"{reason}; the shutter may have opened nevertheless", now_ns, may_come=True)

    def trigger_busy(self, reason: str, now_ns: int) -> list[CameraEvent]:
        """The camera was too busy to fire: fire again soon, or fail the shot when it was busy for `busy_s`."""
        assert self.current is not None
        busy_s = self._timeouts.busy_s
        if now_ns - self.current.since_ns < _ns(busy_s):
            self.current.retry_ns = now_ns + _ns(_BUSY_RETRY_S)
            return []
        return self.fail_current(f"{reason}, for {busy_s:g} s: wait, or switch it off and on", now_ns)

    def completed(self, now_ns: int) -> None:
        """The camera reported that the capture is complete."""
        if self.current is not None and self.current.fired_ns is not None:
            self.current.complete_ns = now_ns

    def search_due(self, now_ns: int) -> bool:
        """Whether the current shot's file is late enough to search the card for it: once a shot."""
        current = self.current
        if current is None or current.fired_ns is None or current.searched_ns is not None or self._to_fetch:
            return False
        if current.complete_ns is not None and now_ns - current.complete_ns > _ns(self._timeouts.complete_s):
            return True
        return now_ns - current.fired_ns > _ns(self._timeouts.look_s)

    def searched(self, now_ns: int) -> None:
        """The card was searched for the current shot's file."""
        if self.current is not None:
            self.current.searched_ns = now_ns

    def fail_overdue(self, now_ns: int, *, is_open: bool) -> list[CameraEvent]:
        """Fail the current shot where its file is overdue, or where the camera has finished without one."""
        current, limit_s = self.current, self._timeouts.file_s
        if current is None:
            return []
        if now_ns - (current.fired_ns or current.since_ns) > _ns(limit_s):
            reason = f"no file came from the camera within {limit_s:g} s of the release"
            return self.fail_current(reason, now_ns, may_come=True)
        if current.complete_ns is None or current.searched_ns is None or not is_open or self._to_fetch:
            return []
        if now_ns - current.searched_ns > _ns(self._timeouts.complete_s):
            reason = "the camera finished without a file: perhaps it found no focus; look at it and its card"
            return self.fail_current(reason, now_ns)
        return []

    def fail_current(self, reason: str, now_ns: int, *, may_come: bool = False) -> list[CameraEvent]:
        """End the current shot as failed. `may_come`: its file may still come."""
        current, self.current = self.current, None
        if current is None:
            return []
        if may_come and current.fired_ns is not None:
            self._late.append(Claim(current.shot, current.fired_ns))
        return [ShotFailed(current.shot, reason, now_ns)]

    def fail_waiting(self, reason: str, now_ns: int) -> list[CameraEvent]:
        """End every shot that waits as failed."""
        failed: list[CameraEvent] = [ShotFailed(shot, reason, now_ns) for shot in self._waiting]
        self._waiting.clear()
        return failed

    # --- files

    def announced(self, file: CameraFile) -> None:
        """The camera announced a file: fetch it unless it was fetched before."""
        if file not in self._to_fetch and file not in (self._known or ()):
            self._to_fetch.append(file)

    def to_identify(self, found: frozenset[CameraFile]) -> list[CameraFile]:
        """Return the files of a card listed for the first time that a late shot of an earlier process may have made.

        These are the last ones that the earlier process did not bring; `listed` takes the times when they were made.
        """
        if self._known is not None or not self._late or not self._clock.offsets_s:
            return []
        unseen = (file for file in found if (file.folder, file.name) not in self._seen)
        return sorted(unseen, key=_place)[-LATE_LIMIT:]

    def listed(self, found: frozenset[CameraFile], taken_s: Mapping[CameraFile, int | None]) -> None:
        """The card holds `found`: fetch what is new. Of a card listed for the first time only late shots' files are."""
        if self._known is None:
            self._known = found - {file for file, made_s in taken_s.items() if self._is_late_shots(made_s)}
        self._to_fetch.extend(sorted(found - self._known - set(self._to_fetch), key=_place))

    def next_file(self) -> CameraFile | None:
        """Return the file to fetch next; it stays first until `fetched` or `not_fetched`."""
        return self._to_fetch[0] if self._to_fetch else None

    def fetched(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> list[CameraEvent]:
        """A file was fetched; `taken_s` is the body's note of when it was made."""
        self._to_fetch.popleft()
        self._tries.pop(file, None)
        if not file.in_memory:
            self._settle(file)
        self._settings_due_ns = arrival.monotonic_ns + _ns(_SETTINGS_S)
        if self._makes_pairs() and _is_jpeg(arrival.name) and self._main_shot(file) is None:
            self._held[_stem(file)] = (file, arrival, taken_s)
            return []
        return self._deliver(file, arrival, taken_s)

    def not_fetched(self, file: CameraFile, reason: str, now_ns: int) -> list[CameraEvent]:
        """A file could not be fetched: try again later, three times in all, then fail the current shot."""
        self._to_fetch.popleft()
        self._tries[file] = self._tries.get(file, 0) + 1
        if self._tries[file] < _TRIES and not file.in_memory:
            self._to_fetch.append(file)
            return []
        del self._tries[file]
        self._settle(file)
        if self.current is None or self.current.fired_ns is None:
            return []
        stays = "" if file.in_memory else f"; it stays on the card as {file.folder}/{file.name}"
        return self.fail_current(f"{reason}{stays}", now_ns)

    def deleted(self, file: CameraFile) -> None:
        """A file was deleted: the camera may use its name again."""
        if self._known is not None:
            self._known -= {file}

    def release_held(self, now_ns: int) -> list[CameraEvent]:
        """Deliver each JPEG that waited too long for a raw file as a frame of its own."""
        before_ns = now_ns - _ns(self._timeouts.complete_s)
        overdue = [stem for stem, (_, arrival, _) in self._held.items() if arrival.monotonic_ns < before_ns]
        return [event for stem in overdue for event in self._deliver(*self._held.pop(stem))]

    def _settle(self, file: CameraFile) -> None:
        if self._known is not None:
            self._known |= {file}

    def _is_late_shots(self, taken_s: int | None) -> bool:
        return taken_s is not None and any(self._clock.fits(claim, taken_s) for claim in self._late)

    def _makes_pairs(self) -> bool:
        """Whether the camera is set to raw and JPEG: "RAW + Large Fine JPEG", "NEF+Fine"."""
        return any(each.name == "image_format" and "+" in each.value for each in self.settings)

    def _main_shot(self, file: CameraFile) -> int | None:
        """Return the shot that this file is the companion of; None for a frame of its own."""
        if self._last_frame is None:
            return None
        stem, jpeg, shot = self._last_frame
        return shot if stem == _stem(file) and jpeg != _is_jpeg(file.name) else None

    def _deliver(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> list[CameraEvent]:
        main = self._main_shot(file)
        if main is not None:
            return [Companion(main, arrival.name, arrival.blob, arrival.monotonic_ns, arrival.facts)]
        frame = self._attributed(arrival, taken_s)
        self._last_frame = None if frame.shot is None else (_stem(file), _is_jpeg(file.name), frame.shot)
        held = self._held.pop(_stem(file), None)
        return [frame, *([] if held is None else self._deliver(*held))]

    def _attributed(self, arrival: Arrival, taken_s: int | None) -> Arrival:
        """Say which shot made a frame. The current shot ends with its frame."""
        fired_ns = None if self.current is None else self.current.fired_ns
        current = None if self.current is None or fired_ns is None else Claim(self.current.shot, fired_ns)
        clue = FileClue(taken_s, arrival.monotonic_ns)
        found = attribute(clue, self._late, [] if current is None else [current], self._clock)
        self._clock = found.clock
        if current is not None and found.shot == current.shot:
            self.current = None
        left = [] if found.doubt else [claim for claim in self._late if claim.shot != found.shot]
        self._late = deque(left, LATE_LIMIT)  # files come in order: after one in doubt no older one is expected
        facts = {**arrival.facts, **({"doubt": findings.text(found.doubt)} if found.doubt else {})}
        facts["body_offsets_s"] = list(self._clock.offsets_s)
        return Arrival(found.shot, arrival.name, arrival.blob, arrival.monotonic_ns, facts)

    # --- settings

    def setting_turned(self, now_ns: int) -> None:
        """The body announced that a setting was changed: read them as soon as no shot is at the camera."""
        self._settings_due_ns = now_ns

    def settings_due(self, now_ns: int) -> bool:
        """Whether the settings are to be read now, with no shot at the camera: after opening, each file, and a change
        at the body."""
        return self._settings_due_ns is not None and now_ns >= self._settings_due_ns and self.current is None

    def settings_read(self, found: tuple[Setting, ...], now_ns: int) -> list[CameraEvent]:
        """The settings were read because they were due; an event where they have changed."""
        self._settings_due_ns = None
        return [] if found == self.settings else self.settings_set(found, now_ns)

    def settings_set(self, found: tuple[Setting, ...], now_ns: int) -> list[CameraEvent]:
        """One was changed on request, and all were read."""
        self.settings = found
        return [SettingsChanged(found, now_ns)]


def _place(file: CameraFile) -> tuple[str, str]:
    return file.folder, file.name


def _is_jpeg(name: str) -> bool:
    return name.lower().endswith((".jpg", ".jpeg"))


def _stem(file: CameraFile) -> Stem:
    return file.folder, "" if file.in_memory else file.name.rpartition(".")[0]


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
