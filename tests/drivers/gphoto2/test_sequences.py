"""Random sequences of shots, pictures by hand, card changes, cut links, lost and late events, restarts and steps of the
body's clock over the loop of the camera's process, in simulated time: no picture may go to another shot without a
doubt, and none may be unaccounted for.

A failing sequence is shrunk, and printed with its seed.
"""

from __future__ import annotations

import os
import random
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from dappled.clock import RecordedClock
from dappled.drivers.attribution import TOLERANCE_S, Claim
from dappled.drivers.camera import (
    Arrival,
    Blob,
    CameraEvent,
    Fired,
    Identity,
    Noticed,
    Setting,
    SettingName,
    ShotFailed,
)
from dappled.drivers.child_process import ChannelMessage, ProcessChannel
from dappled.drivers.gphoto2.intake import Intake
from dappled.drivers.gphoto2.messages import CUT_OFF, Carryover, message_event
from dappled.drivers.gphoto2.process import CameraLoop
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CameraNews,
    CaptureComplete,
    CardContents,
    Fetched,
    FileAdded,
    FileFacts,
    LostError,
    RefusedError,
)
from dappled.drivers.gphoto2.settings import GPhoto2Settings
from dappled.findings import Code

FOLDER = "/store/DCIM/100CANON"
Op = tuple[str, float]
"""What happens, and how long until the next."""

_KINDS = {
    "shot": 14,
    "no-focus": 1,
    "hand": 2,
    "hand at once": 1,  # within 0.3 s before a shot: its event is swallowed
    "lose": 1,  # the next event
    "late": 1,  # the next event comes 8 s late
    "cut": 1,
    "cut transfer": 1,
    "card": 1,
    "card with pictures": 0.5,
    "card, no cut": 0.5,
    "restart": 1,
    "step": 0.5,
}


def sequence(seed: int) -> list[Op]:
    chance = random.Random(seed)  # noqa: S311  a simulation
    kinds = chance.choices(list(_KINDS), list(_KINDS.values()), k=chance.randint(6, 16))
    return [("shot", 4.0), ("shot", 4.0), *((kind, round(chance.uniform(0.6, 9.0), 2)) for kind in kinds)]


@dataclass(eq=False)
class Picture:
    """A picture that the body made: of a shot, or by hand; when (s); and where it stands."""

    data: bytes
    shot: int | None
    made_s: float
    file: CameraFile
    taken_s: int | None
    card: Card
    listed: bool = False  # a session could have seen it


@dataclass(eq=False)
class Card:
    """A card; `number` is the last that was used."""

    files: dict[CameraFile, tuple[bytes, int | None]] = field(default_factory=dict)
    number: int = 0


class Body:
    """The body, and a session with it. Like libgphoto2, a session knows the card as it was when it was opened, and the
    files announced since, without a time where that was within 2 s; a release swallows the events that nobody has
    read."""

    keeps_files = True
    identity = Identity("Canon", "450D", "1", "usb:1,2")

    def __init__(
        self, clock: RecordedClock, chance: random.Random, *, dated: bool = True, latest_s: float = 0.2
    ) -> None:
        """`latest_s`: how long the body takes to expose, at most."""
        self.clock, self.chance, self.dated, self.latest_s = clock, chance, dated, latest_s
        self.opened_s = 0.0
        self.offset_s = chance.uniform(0, 10**6)
        self.card = Card()
        self.pictures: list[Picture] = []
        self.down_until_s = 0.0
        self.cuts_transfer = self.has_focus = False
        self.fate: str = ""
        self._coming: list[tuple[float, CameraNews, Picture | None]] = []
        self._busy_until_s = 0.0
        self._dead = True
        self._cache: dict[CameraFile, tuple[Card, FileFacts]] = {}
        self._old: dict[CameraFile, tuple[Card, FileFacts]] = {}

    @property
    def now_s(self) -> float:
        return self.clock.monotonic_ns() / 1e9

    def open(self, _settings: GPhoto2Settings, _before: str | None) -> Body:
        if self.now_s < self.down_until_s:
            raise AbsentError("pulled")
        self._dead, self._coming, self.opened_s = False, [], self.now_s
        self._cache = {file: (self.card, (len(data), taken)) for file, (data, taken) in self.card.files.items()}
        for one in self.pictures:
            one.listed = one.listed or (one.card is self.card and one.made_s <= self.now_s)
        return self

    def cut(self, seconds: float) -> None:
        self._dead, self.down_until_s, self._coming = True, self.now_s + seconds, []

    def change_card(self, older: int) -> None:
        """Change the card for one with so many pictures of a month ago, on which names begin with 0001."""
        self.card = Card(number=older)
        for number in range(1, older + 1):
            taken_s = int(self.now_s + self.offset_s) - 86400 * 30 if self.dated else None
            self.card.files[CameraFile(FOLDER, f"IMG_{number:04d}.CR2")] = (b"older%d" % number, taken_s)

    def expose(self, shot: int | None) -> None:
        """Make a picture now; it is announced half a second later, unless that is lost or late."""
        self.card.number += 1
        file = CameraFile(FOLDER, f"IMG_{self.card.number:04d}.CR2")
        made_s = self.now_s + self.chance.uniform(0.05, self.latest_s)
        data = b"%06d" % len(self.pictures) + b"." * (0 if self.dated else len(self.pictures))
        taken_s = int(made_s + self.offset_s) if self.dated else None
        self.card.files[file] = (data, taken_s)
        picture = Picture(data[:6], shot, made_s, file, taken_s, self.card)
        self.pictures.append(picture)
        fate, self.fate = self.fate, ""
        if fate != "lose" and not self._dead:
            at_s = made_s + self.chance.uniform(0.2, 0.5) + 8 * (fate == "late")
            self._coming.append((at_s, FileAdded(file), picture))
        self._coming.append((made_s + 0.6, CaptureComplete(), None))
        self._busy_until_s = self.now_s + 0.3

    def trigger(self) -> None:
        self._check()
        if self.now_s < self._busy_until_s:
            raise BusyError("busy")
        self._coming = [one for one in self._coming if one[0] > self.now_s]
        if self.has_focus:
            self.expose(self.current)
        else:
            self._coming.append((self.now_s + 0.5, CaptureComplete(), None))

    current = -1

    def swallow(self) -> None:
        """What was announced until now is not read before the next release."""
        self._coming = [one for one in self._coming if one[2] is None]

    def news(self) -> list[CameraNews]:
        self._check()
        due = [one for one in self._coming if one[0] <= self.now_s]
        self._coming = [one for one in self._coming if one[0] > self.now_s]
        for _, news, picture in due:
            if picture is not None and isinstance(news, FileAdded):
                picture.listed = True
                data, taken_s = picture.card.files[news.file]
                taken_s = None if self.now_s < self.opened_s + 2 else taken_s
                self._cache.setdefault(news.file, (picture.card, (len(data), taken_s)))
        return [news for _, news, _ in due]

    def fetch(self, file: CameraFile, _intake: Intake, alive: Callable[[], None]) -> Fetched:
        self._check()
        if self.cuts_transfer:
            self.cuts_transfer = False
            self.cut(0.2)
            raise LostError("cut")
        card, (_, taken_s) = self._cache[file]
        if card is not self.card:
            raise RefusedError("a handle of another card")
        return Fetched(Blob.of(card.files[file][0]), taken_s)

    def about(self, file: CameraFile) -> FileFacts:
        self._check()
        card, facts = self._cache[file]
        if card is not self.card:
            raise RefusedError("a handle of another card")
        return facts

    def files(self) -> frozenset[CameraFile]:
        self._check()
        return frozenset(self._cache)

    def contents(self) -> CardContents:
        self._check()
        return CardContents({file: facts for file, (_, facts) in self._cache.items()}, "SD")

    def settings(self) -> tuple[Setting, ...]:
        return ()

    def change(self, name: SettingName, value: str) -> None: ...
    def delete(self, file: CameraFile) -> None: ...
    def end_preview(self) -> None: ...
    def close(self) -> None:
        self._dead = True

    def preview(self) -> Blob:
        raise RefusedError("no live view")

    def _check(self) -> None:
        if self._dead:
            raise LostError("the link is gone")


class Pipe:
    """A channel without a socket: commands for the loop, and what it said."""

    def __init__(self) -> None:
        self.commands: deque[Mapping[str, Any]] = deque()
        self.said: list[tuple[CameraEvent, bytes]] = []
        self.cut_off: Mapping[str, Any] = {"files": ()}

    def receive(self, _timeout_s: float) -> ChannelMessage | None:
        return ChannelMessage(dict(self.commands.popleft())) if self.commands else None

    def send(self, body: Mapping[str, Any], fds: tuple[int, ...] = (), timeout_s: float = 0.0) -> None:
        del timeout_s
        if body["is"] == CUT_OFF:
            self.cut_off = dict(body)
            return
        data = b"".join(os.pread(fd, 6, 0) for fd in fds)
        self.said.append((message_event(ChannelMessage(dict(body), fds)), data))


@dataclass
class Outcome:
    """What became of a sequence. `wrong`: what may never be; the rest is counted over many."""

    wrong: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


class World:
    """A body, the loop, and the part of the driver that outlives the loop."""

    def __init__(self, seed: int) -> None:
        self.clock = RecordedClock(1_000_000_000_000)
        latest_s = 1.0 if seed % 3 == 1 else 0.2
        chance = random.Random(seed)  # noqa: S311  a simulation
        self.body = Body(self.clock, chance, dated=seed % 8 != 7, latest_s=latest_s)
        self.carryover = Carryover()
        self.events: list[tuple[float, CameraEvent, bytes]] = []
        self.pending: dict[int, int | None] = {}
        self.fired_s: dict[int, float] = {}
        self.disturbed_s: list[float] = []
        self.steps_s: list[float] = []
        self.shots = 0
        self.restarted = False
        self.framed: set[int] = set()
        self.doubted: set[int] = set()
        self._begin()

    def _begin(self) -> None:
        self.pipe = Pipe()
        channel = cast("ProcessChannel", self.pipe)
        self.loop = CameraLoop(channel, GPhoto2Settings(), self.body.open, self.clock, self.carryover)

    def run(self, ops: Iterable[Op]) -> Outcome:
        self._pass(1.0)
        for kind, gap_s in ops:
            self._do(kind)
            self._pass(gap_s)
        self._pass(30.0)
        self.pipe.commands.append({"do": "stop"})
        self.loop.run()
        self._hear()
        return self._judged()

    def _do(self, kind: str) -> None:
        body = self.body
        if kind != "shot":
            self.disturbed_s.append(body.now_s)
        match kind:
            case "shot" | "no-focus":
                self._fire(focus=kind == "shot")
            case "hand at once":
                body.expose(None)
                body.swallow()
                self.clock.advance(0.3)
                self._fire(focus=True)
            case "hand":
                body.expose(None)
            case "lose" | "late":
                body.fate = kind
            case "cut":
                body.cut(self.body.chance.uniform(0.1, 6.0))
            case "cut transfer":
                body.cuts_transfer = True
            case "restart":
                self._restart()
            case "step":
                self.steps_s.append(body.now_s)
                body.offset_s += body.chance.choice([-3600, 3600, -40, 40, 7200])
            case _:
                body.change_card(older=5 * (kind == "card with pictures"))
                if kind != "card, no cut":
                    body.cut(1.5)

    def _fire(self, *, focus: bool) -> None:
        self.body.has_focus = focus
        self.shots += 1
        self.pending[self.shots] = None
        self.pipe.commands.append({"do": "fire", "shot": self.shots})

    def _restart(self) -> None:
        self.body.close()
        self._hear()
        fired = [Claim(shot, at_ns) for shot, at_ns in self.pending.items() if at_ns is not None]
        self.carryover = self.carryover.died(fired).cut(self.pipe.cut_off)
        self.pending.clear()
        self.restarted = True
        self._begin()

    def _pass(self, seconds: float) -> None:
        until_s = self.body.now_s + seconds
        while self.body.now_s < until_s:
            busy = bool(self.pending)
            self.clock.advance(min(0.1 if busy else 0.5, until_s - self.body.now_s + 1e-6))
            for _ in range(1 + busy):
                self.body.current = next(iter(self.pending), -1)
                self.loop.step()
                self._hear()

    def _hear(self) -> None:
        for event, data in self.pipe.said:
            self.events.append((self.body.now_s, event, data))
            self.carryover = self.carryover.heard(event)
            if isinstance(event, Fired):
                self.pending[event.shot] = event.called_monotonic_ns
                self.fired_s[event.shot] = event.called_monotonic_ns / 1e9
            elif isinstance(event, ShotFailed | Arrival):
                self.pending.pop(event.shot or 0, None)
        self.pipe.said.clear()

    # --- what became of it

    def _judged(self) -> Outcome:
        found, by_data = Outcome(), {one.data: one for one in self.body.pictures}
        accounted: set[bytes] = set()
        noticed = [event.finding for _, event, _ in self.events if isinstance(event, Noticed)]
        self.doubted = {int(one.subject.which) for one in noticed if one.subject.kind == "frame"}
        for at_s, event, data in self.events:
            if isinstance(event, Noticed) and event.finding.code is Code.PICTURE_ON_CARD:
                folder, _, name = str(event.finding.subject.which).rpartition("/")
                accounted |= {one.data for one in by_data.values() if one.file == CameraFile(folder, name)}
            elif isinstance(event, Arrival):
                if data in accounted and data in by_data and by_data[data].shot is None:
                    found.counts["twice"] += 1
                accounted.add(data)
                if data not in by_data:
                    found.counts["older"] += 1
                    if event.shot is not None and "doubt" not in event.facts and event.shot not in self.doubted:
                        found.wrong.append(f"{data!r}, older than the flight, is shot {event.shot}'s")
                elif event.shot is not None:
                    self._judge_frame(at_s, event, by_data[data], found)
                    self.framed.add(event.shot)
        for one in self.body.pictures:
            # On a card that was taken out unseen; or without times, when nothing but a name that a card may have had
            # before tells a new process of it; or of the very name, size and second of another card's, by a clock that
            # was set back.
            gone = (one.card is not self.body.card and not one.listed) or (self.restarted and not self.body.dated)
            facts = [(each.file, each.taken_s) for each in self.body.pictures]
            gone = gone or (self.body.dated and facts.count((one.file, one.taken_s)) > 1)
            if one.data not in accounted and not gone:
                found.wrong.append(f"{one.data!r} of {one.shot} made at {one.made_s:.1f} s is unaccounted for")
        ended = {event.shot for _, event, _ in self.events if isinstance(event, Arrival | ShotFailed)}
        found.counts["shots"] += self.shots
        found.counts["shots without an end"] += len(set(self.pending) - ended)
        return found

    def _judge_frame(self, at_s: float, event: Arrival, picture: Picture, found: Outcome) -> None:
        assert event.shot is not None
        doubt = "doubt" in event.facts or event.shot in self.doubted
        fired_s = self.fired_s.get(event.shot, at_s)
        disturbed = any(fired_s - 40 <= one <= at_s + TOLERANCE_S for one in self.disturbed_s)
        found.counts["disturbed" if disturbed else "undisturbed"] += 1
        if not disturbed:
            found.counts["undisturbed in doubt"] += doubt
        if picture.shot == event.shot:
            alone = not any(
                shot != event.shot and shot not in self.framed and abs(at - picture.made_s) <= 2 * TOLERANCE_S
                for shot, at in self.fired_s.items()
            ) and not any(
                one is not picture and abs(one.made_s - picture.made_s) <= TOLERANCE_S for one in self.body.pictures
            )
            stepped = any(fired_s - 60 <= one <= at_s for one in self.steps_s)
            if disturbed and alone and not stepped:
                found.counts["distinct"] += 1
                found.counts["distinct in doubt"] += doubt
        elif not doubt:
            # Within a whole second and the body's latencies no evidence tells pictures apart.
            near = event.facts["taken_s"] is None or abs(picture.made_s - fired_s) <= TOLERANCE_S
            found.counts["alike"] += near
            if not near:
                found.wrong.append(
                    f"shot {event.shot}'s frame is {picture.data!r}, {picture.made_s - fired_s:+.1f} s off"
                )


def judged(ops: Sequence[Op], seed: int) -> Outcome:
    return World(seed).run(ops)


def shrunk(ops: Sequence[Op], seed: int) -> list[Op]:
    """The shortest sequence found, by leaving out one thing after the other, that still goes wrong."""
    left, at = list(ops), 0
    while at < len(left):
        shorter = left[:at] + left[at + 1 :]
        if judged(shorter, seed).wrong:
            left = shorter
        else:
            at += 1
    return left


def check(seeds: Iterable[int]) -> None:
    counts: Counter[str] = Counter()
    for seed in seeds:
        ops = sequence(seed)
        found = judged(ops, seed)
        if found.wrong:
            short = shrunk(ops, seed)
            pytest.fail(f"seed {seed}: {found.wrong}\nshortest: {short}: {judged(short, seed).wrong}")
        counts += found.counts
    assert counts["undisturbed in doubt"] <= 0.02 * counts["undisturbed"], counts
    assert counts["distinct in doubt"] <= 0.2 * counts["distinct"], counts
    assert counts["alike"] <= 0.01 * counts["shots"], counts
    assert counts["shots without an end"] == 0, counts


def test_no_picture_goes_astray_in_100_random_sequences() -> None:
    check(range(100))


@pytest.mark.long
def test_no_picture_goes_astray_in_2000_random_sequences() -> None:
    check(range(2000))
