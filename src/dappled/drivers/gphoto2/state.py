"""Keep the state of a camera between two turns of its process' loop: shots, files, settings, and what belongs together.

Nothing here calls the camera. The loop reports what the camera did, and sends the events that come back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from dappled import codec, durable, picture_order
from dappled.drivers.attribution import BodyClock, Claim, FileClue, FramedShot, attribute, rivals
from dappled.drivers.camera import (
    Arrival,
    CameraEvent,
    Companion,
    Fired,
    Noticed,
    Setting,
    SettingsChanged,
    ShotFailed,
)
from dappled.drivers.gphoto2.known_card import KnownCard
from dappled.drivers.gphoto2.messages import LATE_LIMIT, Carryover
from dappled.drivers.gphoto2.protocol import CameraFile, CardContents, FileFacts
from dappled.drivers.gphoto2.settings import Timeouts
from dappled.findings import Code, Subject, finding

_WAITING_LIMIT = 64
_BUSY_RETRY_S = 0.05
_TRIES = 3
_SETTINGS_S = 1.0
"""How long after a file the settings are read: by then the body has updated what the shot changed (battery, free
shots)."""

Stem = tuple[str, str]


@dataclass(slots=True)
class CurrentShot:
    """The shot that is at the camera, and the monotonic times of what happened to it; None: not yet."""

    shot: int
    since_ns: int
    fired_ns: int | None = None
    complete_ns: int | None = None
    retry_ns: int = 0
    searched_ns: int | None = None


@dataclass(frozen=True, slots=True)
class _Announced:
    """When a file was announced or first listed, and since when that would have been seen (None: unknown)."""

    seen_ns: int
    since_ns: int | None


Held = tuple[CameraFile, Arrival, int | None, _Announced]


class CameraState:
    """The state of one camera. One thread uses it; `now_ns` is monotonic time.

    Shots wait in order, and one is at the camera at a time. A shot that was given up after it had been fired is *late*:
    its file may still come. Files are attributed to the current shot or to a late one by the body's clock.

    A raw file and a JPEG of one exposure are one frame: the raw file is the frame and the JPEG its companion, whichever
    comes first. On a card they are matched by name (IMG_0042.CR2, IMG_0042.JPG). libgphoto2 invents the names of files
    in the camera's memory (capt0000.cr2, capt0001.jpg), so these are matched by order.

    A file on a card is known by name, size and time: a card that was changed may number from 0001 again. Where a
    picture may have been missed (its number was skipped, a shot failed, the link was cut), the card is listed anew, and
    what is not known is fetched. What can't be fetched is named.
    """

    def __init__(self, timeouts: Timeouts, carryover: Carryover) -> None:
        self.serial = carryover.serial
        self.current: CurrentShot | None = None
        self.settings: tuple[Setting, ...] = ()
        self._timeouts = timeouts
        self._waiting: deque[int] = deque()
        self._late = deque(carryover.late, LATE_LIMIT)
        self._clock = BodyClock(carryover.offsets_s)
        self._card = KnownCard(carryover.seen)
        self._since_ns = carryover.since_ns  # pictures made before are known; None: unknown
        self._to_fetch: dict[CameraFile, _Announced] = {}
        self._to_compare: dict[CameraFile, None] = {}  # announced, and of a name that is known
        self._tries: dict[CameraFile, int] = {}
        self._suspects: dict[CameraFile, _Announced] = {}  # announced, and other than was listed under their names
        self.cut_off = tuple(CameraFile(*one) for one in carryover.cut_off)  # announced, and not fetched at a break
        self._missed = False  # a picture may have been missed
        self._quiet_ns = 0  # when something was last heard of a shot or a file
        self._framed: deque[FramedShot] = deque(maxlen=LATE_LIMIT)  # the last shots whose frames have come
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
            if self.serial is not None:
                self._clock, self._since_ns, self._card = BodyClock(), None, KnownCard(())
            self.serial = serial
        self._settings_due_ns = now_ns

    def lost(self, reason: str, now_ns: int, *, keeps_files: bool) -> list[CameraEvent]:
        """The session is gone. A fired shot whose file is on the card stays current; any other has failed."""
        self.cut_off = (*self.cut_off, *(file for file in (*self._to_fetch, *self._suspects) if not file.in_memory))
        open_since = [one.since_ns for one in (*self._to_fetch.values(), *self._suspects.values()) if one.since_ns]
        if self._since_ns is not None:
            self._since_ns = min([self._since_ns, *open_since])  # these are not known yet
        self._to_fetch.clear()
        self._to_compare.clear()
        self._suspects.clear()
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
            return self.fail_current(reason, now_ns, may_come=bool(self._clock.offsets_s))
        return []

    def fail_current(self, reason: str, now_ns: int, *, may_come: bool = False) -> list[CameraEvent]:
        """End the current shot as failed. `may_come`: its file may still come."""
        current, self.current = self.current, None
        if current is None:
            return []
        self._missed, self._quiet_ns = self._missed or current.fired_ns is not None, now_ns
        if may_come and current.fired_ns is not None:
            self._late.append(Claim(current.shot, current.fired_ns))
        return [ShotFailed(current.shot, reason, now_ns)]

    def fail_waiting(self, reason: str, now_ns: int) -> list[CameraEvent]:
        """End every shot that waits as failed."""
        failed: list[CameraEvent] = [ShotFailed(shot, reason, now_ns) for shot in self._waiting]
        self._waiting.clear()
        return failed

    # --- files

    def announced(self, file: CameraFile, now_ns: int) -> None:
        """The camera announced a file: fetch it; one of a known name is compared first."""
        self._quiet_ns = now_ns
        if self._card.has_name(file):
            self._to_compare[file] = None
        else:
            self._queue([file], now_ns)

    def to_compare(self) -> list[CameraFile]:
        """The files that were announced with a known name, once."""
        files = list(self._to_compare)
        self._to_compare.clear()
        return files

    def compared(self, file: CameraFile, facts: FileFacts | None, now_ns: int) -> None:
        """A file with a known name was looked at: another size or time is another picture, on another card. None: the
        library knows it no more. Then, and where a time is unknown, the card is listed before anything is fetched."""
        if facts is not None and self._card.has(file, facts) and not self._card.is_done(file):
            self._queue([file], now_ns)  # it was listed before it was announced
        elif facts is None or not self._card.is_proven(file, facts):
            self._suspects[file] = _Announced(now_ns, self._since_ns)

    def listed(self, found: CardContents, now_ns: int) -> list[CameraEvent]:
        """The card was listed: fetch what is new. On a card that is seen for the first time that is what was made since
        its predecessor, or the predecessor of this process, was listed."""
        told: list[CameraEvent] = []
        only_recent = not self._card.is_listed
        strange = [file for file, facts in found.files.items() if not self._card.has(file, facts)]
        made = {file: self._made_since(found.files[file][1]) for file in strange}
        newer = [file for file in strange if only_recent and not made[file] and self._card.is_newer(file)]
        owed = self.current is not None or bool(self._late)  # the body's clock may have been set before its file
        made |= {file: True for file in newer if made[file] is None or owed}  # where time says nothing, the count may
        old = any(self._made_since(taken_s) is False for _, taken_s in found.files.values())
        is_other = self._card.is_other(found, has_old=old and self._card.is_listed)
        if is_other:
            only_recent = True
            self._card.change()
            self._last_frame = None
            told.append(Noticed(finding(Code.CARD_CHANGED, Subject("card")), now_ns))
        suspects = [(file, one) for file, one in self._suspects.items() if file in found.files]
        self._to_fetch |= {file: one for file, one in suspects if not self._card.is_proven(file, found.files[file])}
        if is_other:
            unsure = [file for file in strange if not made[file] and file not in self._to_fetch]
            told += [_on_card(file, now_ns) for file in (unsure if len(unsure) <= LATE_LIMIT else ())]
            newer = []
            told += [_on_card(file, now_ns) for file in self.cut_off if file in found.files]
        told += [_on_card(file, now_ns) for file in newer[:LATE_LIMIT] if not made[file]]
        told += [_on_card(file, now_ns) for file in self.cut_off if file not in found.files]
        fresh = [file for file in strange if made[file] or not only_recent]
        self.cut_off = ()
        self._suspects.clear()
        self._queue(picture_order.by_name(fresh, lambda file: f"{file.folder}/{file.name}"), now_ns)
        self._card.list(found, self._to_fetch)
        self._missed, self._since_ns = False, now_ns
        return told

    def left(self, found: CardContents, now_ns: int) -> list[CameraEvent]:
        """The card was listed for the last time: name what was not brought."""
        told = self.listed(found, now_ns)
        waiting = [file for file in self._to_fetch if not file.in_memory]
        return [*told, *(_on_card(file, now_ns) for file in waiting)]

    def not_listed(self, now_ns: int) -> list[CameraEvent]:
        """The card can't be listed for the last time: pictures may stay on it, of this process or one before."""
        known = self.serial is not None
        return [Noticed(finding(Code.CARD_NOT_LISTED, Subject("card")), now_ns)] if known else []

    def list_due(self, now_ns: int, quiet_s: float) -> bool:
        """Whether a picture may have been missed, and the camera had nothing to do for so long."""
        return self._missed and not self.is_busy and not self._to_fetch and now_ns - self._quiet_ns >= _ns(quiet_s)

    @property
    def is_stale(self) -> bool:
        """Whether the library knows another card than the one that is in the camera."""
        return bool(self._suspects)

    def _made_since(self, taken_s: int | None) -> bool | None:
        """Whether a picture was made after the card had been listed last; None where that is not known."""
        if taken_s is None or self._since_ns is None or not self._clock.offsets_s:
            return None
        return self._clock.off_s(Claim(0, self._since_ns), taken_s) >= -self._clock.limit_s

    def _queue(self, files: Iterable[CameraFile], now_ns: int) -> None:
        for file in files:
            if file not in self._to_fetch:
                self._to_fetch[file] = _Announced(now_ns, self._since_ns)
                self._missed = self._card.count(file) or self._missed

    def next_file(self) -> CameraFile | None:
        """Return the file to fetch next; it stays first until `fetched` or `not_fetched`."""
        return next(iter(self._to_fetch), None)

    def fetched(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> list[CameraEvent]:
        """A file was fetched; `taken_s` is the body's note of when it was made."""
        announced = self._to_fetch.pop(file)
        self._tries.pop(file, None)
        self._quiet_ns = arrival.monotonic_ns
        self._settings_due_ns = arrival.monotonic_ns + _ns(_SETTINGS_S)
        told: list[CameraEvent] = []
        if not file.in_memory:
            facts = (arrival.blob.size, taken_s)
            sha256 = arrival.blob.sha256 or durable.hash_descriptor(arrival.blob.fd, arrival.blob.size)
            is_again = self._card.is_again(file, facts, sha256)
            self._card.settle(file, facts, sha256)
            if is_again:  # it was announced once more
                arrival.blob.close()
                return []
            if is_again is False:  # other bytes where the listing could tell no difference
                self._card.count_anew()
                self._card.count(file)
                self._last_frame = None
                told.append(Noticed(finding(Code.CARD_CHANGED, Subject("card")), arrival.monotonic_ns))
        if self._makes_pairs() and _is_jpeg(arrival.name) and self._main_shot(file) is None:
            self._held[_stem(file)] = (file, arrival, taken_s, announced)
            return told
        return [*told, *self._deliver(file, arrival, taken_s, announced)]

    def not_fetched(self, file: CameraFile, reason: str, now_ns: int) -> list[CameraEvent]:
        """A file could not be fetched: try again later, three times in all, then fail the current shot."""
        announced = self._to_fetch.pop(file)
        self._tries[file] = self._tries.get(file, 0) + 1
        if self._tries[file] < _TRIES and not file.in_memory:
            self._to_fetch[file] = announced
            return []
        del self._tries[file]
        if file.in_memory:
            return self.fail_current(reason, now_ns) if self._is_fired else []
        self._card.settle(file, None)
        told = [_on_card(file, now_ns)]
        if self._is_fired:  # the file may be a picture by hand, and the shot's own yet to come
            told += self.fail_current(
                f"{reason}; it stays on the card as {file.folder}/{file.name}", now_ns, may_come=True
            )
        return told

    def deleted(self, file: CameraFile) -> None:
        """A file was deleted: the camera may use its name again."""
        self._card.deleted(file)

    def release_held(self, now_ns: int) -> list[CameraEvent]:
        """Deliver each JPEG that waited too long for a raw file as a frame of its own."""
        before_ns = now_ns - _ns(self._timeouts.complete_s)
        overdue = [stem for stem, (_, arrival, _, _) in self._held.items() if arrival.monotonic_ns < before_ns]
        return [event for stem in overdue for event in self._deliver(*self._held.pop(stem))]

    @property
    def _is_fired(self) -> bool:
        return self.current is not None and self.current.fired_ns is not None

    def _makes_pairs(self) -> bool:
        """Whether the camera is set to raw and JPEG: "RAW + Large Fine JPEG", "NEF+Fine"."""
        return any(each.name == "image_format" and "+" in each.value for each in self.settings)

    def _main_shot(self, file: CameraFile) -> int | None:
        """Return the shot that this file is the companion of; None for a frame of its own."""
        if self._last_frame is None:
            return None
        stem, jpeg, shot = self._last_frame
        return shot if stem == _stem(file) and jpeg != _is_jpeg(file.name) else None

    def _deliver(
        self, file: CameraFile, arrival: Arrival, taken_s: int | None, announced: _Announced
    ) -> list[CameraEvent]:
        main = self._main_shot(file)
        if main is not None:
            return [Companion(main, arrival.name, arrival.blob, arrival.monotonic_ns, arrival.facts)]
        frame = self._attributed(file, arrival, taken_s, announced)
        self._last_frame = None if frame.shot is None else (_stem(file), _is_jpeg(file.name), frame.shot)
        held = self._held.pop(_stem(file), None)
        clue = FileClue(taken_s, announced.seen_ns)
        doubts = rivals(arrival.name, clue, self._framed, self._clock) if frame.shot is None else []
        told = [Noticed(doubt, arrival.monotonic_ns) for doubt in doubts]
        return [frame, *told, *([] if held is None else self._deliver(*held))]

    def _attributed(self, file: CameraFile, arrival: Arrival, taken_s: int | None, announced: _Announced) -> Arrival:
        """Say which shot made a frame. The current shot ends with its frame."""
        fired_ns = None if self.current is None else self.current.fired_ns
        current = None if self.current is None or fired_ns is None else Claim(self.current.shot, fired_ns)
        clue = FileClue(taken_s, announced.seen_ns, announced.since_ns, *self._card.neighbours(file, taken_s))
        waiting = [] if current is None else [current]
        found = attribute(clue, self._late, waiting, self._clock)
        self._clock = found.clock
        framed = (claim for claim in (*self._late, *waiting) if claim.shot == found.shot)
        self._framed.extend(FramedShot(claim, announced.seen_ns) for claim in framed)
        if current is not None and found.shot == current.shot:
            self.current = None
        left = [claim for claim in self._late if claim.shot != found.shot]
        if found.doubt is not None and found.doubt.code is not Code.FRAME_CLOCK_DISAGREES:
            left = []  # files come in order: no older one is expected
        self._late = deque(left, LATE_LIMIT)
        if found.shot is not None and found.doubt is None:
            self._card.made(file, found.shot, taken_s)
        facts = {**arrival.facts, **({"doubt": codec.plain(found.doubt)} if found.doubt else {})}
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


def _is_jpeg(name: str) -> bool:
    return name.lower().endswith((".jpg", ".jpeg"))


def _stem(file: CameraFile) -> Stem:
    return file.folder, "" if file.in_memory else file.name.rpartition(".")[0]


def _on_card(file: CameraFile, now_ns: int) -> CameraEvent:
    return Noticed(finding(Code.PICTURE_ON_CARD, Subject("picture", f"{file.folder}/{file.name}")), now_ns)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
