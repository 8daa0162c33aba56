"""Reconcile three books after landing: the triggers in the autopilot's own log, the flight's shots, and its files.

The log is placed in the flight by the autopilot's time (SYSTEM_TIME in the telemetry): a log of another boot is
refused. A trigger and a shot are the same where the shot has the trigger's number, within `_NUMBERED_US` and in the
same power-up of the autopilot, as numbers begin again with each. Shots whose
message has no number (DO_DIGICAM_CONTROL, PX4's commands) belong to the triggers left by order and time (`in_order`),
which may leave a doubt; shots of ground stations to one within `_BROADCAST_US`, which the autopilot executed too.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Literal, Self

import numpy as np

from dappled.clock import TimeOfDayClock
from dappled.config import settings as configuration
from dappled.config.settings import MavlinkSettings
from dappled.daemon.navigation import recorded_vehicles
from dappled.daemon.replay.in_order import paired_in_order
from dappled.drivers.mavlink import PacketParser, mavlink
from dappled.drivers.mavlink.framing import message_of
from dappled.drivers.mavlink.log_packets import BootMap, LoggedTrigger, TriggerLog
from dappled.drivers.mavlink.own_logs import own_log
from dappled.drivers.utc_choice import LOGS_FROM_NS, UtcBounds
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding, text
from dappled.flight import LedgerReader, ShotRow, Stray, Tag, layout, log_reading

_NUMBERED_US = 6_000_000  # a trigger that is reported later than 5 s is no shot
_LATE_US = 2_600_000  # over a second link
_BROADCAST_US = 300_000
_HELD_US = 1_000_000  # a request that comes so long after its trigger was held by its link
_SAME_BOOT_US = 3_000_000
_STEADY_US = 100_000  # a link that delays less places a log so well
_WINDOW_US = 15_000_000  # of SYSTEM_TIME: the one that was delayed least counts
_MOST_NAMED = 3
_MOST_PASSED_OVER = 256
_START = mavlink.MAV_CMD_IMAGE_START_CAPTURE
_READ = {
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
    mavlink.MAVLINK_MSG_ID_CAMERA_FEEDBACK,
    mavlink.MAVLINK_MSG_ID_CAMERA_TRIGGER,
}

Kind = Literal["lost", "refused", "without a file", "late", "doubled", "phantom"]


@dataclass(frozen=True, slots=True)
class Imbalance:
    """What does not balance: a trigger, a shot or a file, each with what is known of it. `utc_ns` is None where UTC
    was never known, `place` is latitude and longitude (degrees). `instead`: numbers of the triggers (of shots without
    one, the shots) of which any may be meant, as requests without numbers were told apart by time alone."""

    kind: Kind
    number: int | None
    shots: tuple[int, ...]
    utc_ns: int | None
    place: tuple[float, float] | None
    reason: Finding
    instead: tuple[int, ...] = ()

    def text(self) -> str:
        """One line."""
        shots = " and ".join(str(index) for index in self.shots)
        subject = f"shot{'s' * (len(self.shots) > 1)} {shots}" if self.shots else "file"
        if self.number is not None:
            subject = f"trigger {self.number}{_or(self.instead)}" + (f" ({subject})" if self.shots else "")
        else:
            subject += _or(self.instead)
        return f"{self.kind}: {subject}{_when(self.utc_ns)}{_where(self.place)}: {text(self.reason)}"


@dataclass(frozen=True, slots=True)
class ThreeBooks:
    """The books side by side. `triggers` of the logs within the flight, `shots` made for them, `files` of these.

    `elsewhere` counts triggers before or after the flight was recorded; `uncovered` are shots of the autopilot at times
    that no log holds, which can't be judged. `contacts`: what the feedback pin saw, None without one. `findings`: the
    logs, where none of them holds a trigger: then nobody can say whether none was given, or none was logged.
    """

    by: str
    triggers: int
    contacts: int | None
    shots: int
    files: int
    elsewhere: int
    uncovered: tuple[int, ...]
    imbalances: tuple[Imbalance, ...]
    findings: tuple[Finding, ...] = ()

    @property
    def balanced(self) -> bool:
        """Whether every trigger is one shot with one file, and every shot of the autopilot's one trigger of its."""
        return (
            not self.findings
            and not self.imbalances
            and not self.uncovered
            and self.triggers == self.shots == self.files
        )


@dataclass(frozen=True, slots=True)
class _Trigger:
    """A trigger on the daemon's clock (`at_us`), of one of `_PowerUps`; `passed_over`: numbers since the one before it
    in the log."""

    logged: LoggedTrigger
    power_up: int
    at_us: int
    utc_us: int
    numbered: frozenset[str]  # the kinds of messages that have its number
    passed_over: range = range(0)


@dataclass(frozen=True, slots=True)
class _PowerUps:
    """When the autopilot started, µs on the daemon's clock, in order: as its logs say."""

    starts_us: tuple[int, ...]

    @classmethod
    def of_logs(cls, boots_us: Sequence[int]) -> Self:
        """Of the starts of several logs: one start may have several."""
        ordered = sorted(boots_us)
        return cls(tuple(b for a, b in pairwise([-(2**62), *ordered]) if b - a > _SAME_BOOT_US))

    def of(self, at_us: int) -> int:
        """The one that an instant is of, by place."""
        return max(0, bisect_right(self.starts_us, at_us) - 1)


@dataclass(frozen=True, slots=True)
class _Pairs:
    """The shot of each trigger that has one, by place among the triggers; triggers that repeat an earlier one's number,
    with the place of that one. Requests without numbers came `delay_us` after their triggers; `instead` are the numbers
    of others that a place may stand for, `beside` the shots that another may stand for."""

    shots: Mapping[int, int]
    repeated: Mapping[int, int]
    delay_us: float
    instead: Mapping[int, tuple[int, ...]]
    beside: Mapping[int, tuple[int, ...]]


@dataclass(slots=True)
class _Heard:
    """What the flight's telemetry says: times of autopilots (boot, UTC minus boot, when it came), and the triggers
    that reached the camera ((kind of message, number): when). All in µs."""

    times: list[tuple[int, int, int]] = field(default_factory=list)
    numbers: dict[tuple[str, int], list[int]] = field(default_factory=dict)
    first_us: int | None = None
    last_us: int = 0


@dataclass(frozen=True, slots=True)
class _Flight:
    rows: Mapping[int, ShotRow]
    files: frozenset[int]
    strays: Sequence[Stray]
    tags: Mapping[int, Tag]
    autopilots: frozenset[str]  # as sources of shots
    correction_ns: int | None

    def at_us(self, index: int) -> int:
        return self.rows[index].shot.wished_utc_ns // 1000

    def utc_ns(self, recorded_ns: int) -> int | None:
        return None if self.correction_ns is None else recorded_ns + self.correction_ns

    def place(self, index: int) -> tuple[float, float] | None:
        pose = self.tags[index].pose if index in self.tags else None
        if pose is None or pose.latitude_rad is None or pose.longitude_rad is None:
            return None
        return math.degrees(pose.latitude_rad), math.degrees(pose.longitude_rad)

    def of_autopilot(self, index: int) -> bool:
        return self.rows[index].shot.cause.source in self.autopilots


def reconcile(flight: Path, logs: Sequence[Path]) -> ThreeBooks:
    """Compare a flight with the logs of the autopilot's boots in it.

    Raises DappledError, FlightError, AutopilotLogError.
    """
    folder = layout.open_folder(flight)
    with LedgerReader.open(folder.ledger) as ledger:
        systems = {system for _, system in recorded_vehicles(ledger)}
        found = _Flight(
            {row.shot.index: row for row in ledger.shots()},
            frozenset(frame.index for frame in ledger.frames()),
            ledger.strays(),
            ledger.tags(),
            frozenset(f"mavlink:{system}/1" for system in systems),
            ledger.utc_correction_ns(),
        )
    tables = layout.read_facts(folder).get("settings", {})
    settings = configuration.of_tables(tables, str(folder.settings))
    heard = _heard(folder.telemetry, systems, settings.mavlink, outside=settings.camera.fired_outside)
    known_ns = [utc_ns for index in found.rows if (utc_ns := found.utc_ns(found.at_us(index) * 1000)) is not None]
    bounds = UtcBounds.of_log(TimeOfDayClock().utc_ns(), known_ns[:1])
    read = [(path, _read(path, settings.mavlink.cam_idx, bounds)) for path in logs]
    logged = any(log.triggers for _, log in read)
    triggers: list[_Trigger] = []
    spans, elsewhere = [], 0
    placed = [_placed(path, log, heard) for path, log in read]
    steady = all(late_us <= _STEADY_US for _, late_us in placed)
    power_ups = _PowerUps.of_logs([here.utc_us(0) for here, _ in placed])
    for (_, log), (here, _) in zip(read, placed, strict=True):
        if logged:
            spans.append((here.utc_us(log.begins_us), here.utc_us(log.ends_us)))
        power_up = power_ups.of(here.utc_us(0) + _SAME_BOOT_US)
        within = [one for one in _triggers(log, here, power_up) if (heard.first_us or 0) <= one.at_us <= heard.last_us]
        elsewhere += len(log.triggers) - len(within)
        triggers += within
    contacts = [log.contacts for _, log in read if log.contacts is not None]
    pairs = _paired(triggers, found, power_ups, steady=steady)
    made = [pairs.shots[place] for place in sorted(pairs.shots)]
    uncovered = tuple(
        index
        for index in found.rows
        if index not in made
        and found.of_autopilot(index)
        and not any(begins - _LATE_US <= found.at_us(index) <= ends + _LATE_US for begins, ends in spans)
    )
    return ThreeBooks(
        by=" and ".join(sorted({log.by for _, log in read})),
        triggers=len(triggers) - len(pairs.repeated),
        contacts=sum(contacts) if contacts else None,
        shots=len(made),
        files=len(found.files.intersection(made)),
        elsewhere=elsewhere,
        uncovered=uncovered,
        imbalances=tuple(
            _Comparison(triggers, pairs, found, heard, power_ups, settings.camera.fired_outside).imbalances(uncovered)
        ),
        findings=()
        if logged
        else tuple(finding(Code.LOG_NO_TRIGGER, Subject("log", path.name), records=log.records) for path, log in read),
    )


def _read(path: Path, cam_idx: int, bounds: UtcBounds) -> TriggerLog:
    reader = own_log(path)
    if reader is None:
        raise DappledError(f"{path} is no log of an autopilot: give ArduPilot's .bin or PX4's .ulg")
    return reader.triggers(path, cam_idx, bounds)


def _heard(telemetry: Path, systems: set[int], mine: MavlinkSettings, *, outside: bool) -> _Heard:
    """Read a flight's telemetry. `outside`: CAMERA_FEEDBACK about `mine` is a trigger."""
    found, parse = _Heard(), PacketParser()
    for _, stamp_us, raw in log_reading.read_telemetry(telemetry) if telemetry.is_file() else ():
        found.first_us = stamp_us if found.first_us is None else found.first_us
        found.last_us = max(found.last_us, stamp_us)
        message = parse(raw) if message_of(raw) in _READ else None
        if message is None or message.get_srcSystem() not in systems or message.get_srcComponent() != 1:
            continue
        name = message.get_type()
        if name == "SYSTEM_TIME" and message.time_unix_usec * 1000 >= LOGS_FROM_NS and message.time_boot_ms:
            boot_us = message.time_boot_ms * 1000
            found.times.append((boot_us, message.time_unix_usec - boot_us, stamp_us))
        elif name == "CAMERA_TRIGGER":
            found.numbers.setdefault((name, message.seq), []).append(stamp_us)
        elif name == "CAMERA_FEEDBACK" and outside and message.cam_idx == mine.cam_idx:
            found.numbers.setdefault((name, message.img_idx), []).append(stamp_us)
        elif (
            name == "COMMAND_LONG"
            and message.command == _START
            and message.target_component in (0, mine.component_id)
            and math.isfinite(message.param4)
        ):
            found.numbers.setdefault(("IMAGE_START_CAPTURE", int(message.param4)), []).append(stamp_us)
    return found


def _placed(path: Path, log: TriggerLog, heard: _Heard) -> tuple[BootMap, float]:
    """The autopilot's time since boot on the daemon's clock; and by how much the link delays half of its messages.
    Raises DappledError where the flight heard no such boot."""
    mine = [
        (boot_us, stamp_us - boot_us)
        for boot_us, unix_minus_boot_us, stamp_us in heard.times
        if abs(unix_minus_boot_us - (log.clock.utc_us(boot_us) - boot_us)) < _SAME_BOOT_US
    ]
    if mine:
        boots_us, offsets_us = np.array(sorted(mine), dtype=np.float64).T
        near = zip(*(np.searchsorted(boots_us, boots_us + way * _WINDOW_US) for way in (-1, 1)), strict=True)
        least_us = np.array([offsets_us[begins : ends + 1].min() for begins, ends in near])
        return BootMap(boots_us, least_us), float(np.median(offsets_us - least_us))
    if not heard.times:
        raise DappledError(
            "the flight's telemetry has no time of the autopilot (SYSTEM_TIME with UTC), so no log can be placed in it"
        )
    flown = _utc_text(min(unix_us for _, unix_us, _ in heard.times) * 1000)
    raise DappledError(
        f"{path} is not a log of this flight: its autopilot was started at {_utc_text(log.clock.utc_us(0) * 1000)}, "
        f"that of the flight at {flown}; give the log of that start"
    )


def _triggers(log: TriggerLog, here: BootMap, power_up: int) -> Iterator[_Trigger]:
    kinds = ("CAMERA_TRIGGER",) if log.by == "PX4" else ("CAMERA_FEEDBACK", "IMAGE_START_CAPTURE")
    before: int | None = None
    for one in log.triggers:
        passed = range(0 if before is None else before + 1, 0 if before is None else one.number)
        at_us, utc_us = here.utc_us(one.boot_us), log.clock.utc_us(one.boot_us)
        yield _Trigger(one, power_up, at_us, utc_us, frozenset(kinds), passed)
        before = one.number


def _paired(triggers: Sequence[_Trigger], flight: _Flight, power_ups: _PowerUps, *, steady: bool) -> _Pairs:
    """What belongs together. `steady`: the links delay nothing much, so the log is placed well."""
    repeated: dict[int, int] = {}
    last: dict[tuple[int, int], int] = {}
    for place, one in enumerate(triggers):
        earlier = last.get((one.power_up, one.logged.number))
        if earlier is not None and one.at_us - triggers[earlier].at_us <= _NUMBERED_US:
            repeated[place] = earlier
        else:
            last[one.power_up, one.logged.number] = place
    shots = sorted(flight.rows, key=flight.at_us)
    numbered, nearby = [], []
    for place, one in enumerate(triggers):
        if place in repeated:
            continue
        first = bisect_left(shots, one.at_us - _NUMBERED_US, key=flight.at_us)
        for index in shots[first : bisect_right(shots, one.at_us + _NUMBERED_US, key=flight.at_us)]:
            away_us = abs(flight.at_us(index) - one.at_us)
            number = _number(flight, index, one.numbered)
            if number == one.logged.number and power_ups.of(flight.at_us(index)) == one.power_up:
                numbered.append((away_us, place, index))
            elif away_us <= _BROADCAST_US and not flight.of_autopilot(index):
                nearby.append((away_us, place, index))
    pairs = _nearest(numbered, {})
    kinds = frozenset[str]().union(*(one.numbered for one in triggers))
    bare = [index for index in shots if flight.of_autopilot(index) and _number(flight, index, kinds) is None]
    left = [place for place in range(len(triggers)) if place not in pairs and place not in repeated]
    left.sort(key=lambda place: triggers[place].at_us)
    found = paired_in_order(
        [triggers[place].at_us for place in left],
        [flight.at_us(index) for index in bare],
        known_us=_STEADY_US if steady else 0,
        late_us=_LATE_US,
    )
    pairs |= {left[place]: bare[shot] for place, shot in found.pairs.items()}
    return _Pairs(
        _nearest(nearby, pairs),
        repeated,
        found.delay_us,
        {
            left[place]: tuple(triggers[left[other]].logged.number for other in others)
            for place, others in {**found.of, **found.triggers}.items()
        },
        {bare[shot]: tuple(bare[other] for other in others) for shot, others in found.shots.items()},
    )


def _nearest(candidates: Sequence[tuple[int, int, int]], pairs: Mapping[int, int]) -> dict[int, int]:
    """`pairs` and, of (distance, place, shot), the nearest ones of what is left."""
    found, taken = dict(pairs), set(pairs.values())
    for _, place, index in sorted(candidates):
        if place not in found and index not in taken:
            found[place] = index
            taken.add(index)
    return found


def _number(flight: _Flight, index: int, kinds: frozenset[str]) -> int | None:
    """The autopilot's number of a shot, where its message has one of these kinds."""
    cause = flight.rows[index].shot.cause
    return cause.sequence if flight.of_autopilot(index) and cause.kind in kinds else None


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Triggers and shots with what belongs together (see `_paired`). `outside`: the autopilot fires the camera, and a
    late message is about an exposure that was in time."""

    triggers: Sequence[_Trigger]
    pairs: _Pairs
    flight: _Flight
    heard: _Heard
    power_ups: _PowerUps
    outside: bool

    def imbalances(self, uncovered: Sequence[int]) -> Iterator[Imbalance]:
        """What does not balance, but for shots that no log covers."""
        kinds = frozenset[str]().union(*(one.numbered for one in self.triggers))
        known = {(one.power_up, one.logged.number) for one in self.triggers}
        for index in self.flight.rows:
            if (number := _number(self.flight, index, kinds)) is not None:
                known.add((self.power_ups.of(self.flight.at_us(index)), number))
        for place, one in enumerate(self.triggers):
            yield from _passed_over(one, known)
            yield from self._of_trigger(place, one)
        made = frozenset(self.pairs.shots.values())
        for index in self.flight.rows:
            if index not in made and index not in uncovered:
                yield from self._of_shot(index)
        for stray in self.flight.strays:
            reason = finding(Code.FILE_NO_TRIGGER, Subject("file", stray.name), file=stray.name, why=stray.reason)
            yield Imbalance("phantom", None, (), self.flight.utc_ns(stray.arrived_utc_ns), None, reason)

    def _of_trigger(self, place: int, one: _Trigger) -> Iterator[Imbalance]:
        number, at = one.logged.number, (one.utc_us * 1000, one.logged.place)
        about = Subject("trigger", number)
        instead = self.pairs.instead.get(place, ())
        if place in self.pairs.repeated:
            yield Imbalance("doubled", number, (), *at, finding(Code.TRIGGER_TWICE, about))
        elif place not in self.pairs.shots:
            if self._reached(one):
                yield Imbalance("refused", number, (), *at, finding(Code.TRIGGER_NO_SHOT, about))
            else:
                yield Imbalance("lost", number, (), *at, finding(Code.TRIGGER_UNHEARD, about), instead)
        elif self.pairs.shots[place] not in self.flight.files:
            row = self.flight.rows[self.pairs.shots[place]]
            reason = row.reason or finding(Code.SHOT_OPEN, Subject("shot", row.shot.index), state=row.state)
            yield Imbalance("without a file", number, (row.shot.index,), *at, reason, instead)
        elif not self.outside:
            index = self.pairs.shots[place]
            late_us = self.flight.at_us(index) - one.at_us
            if late_us > _HELD_US:
                reason = finding(Code.FRAME_REQUEST_LATE, Subject("frame", index), late_s=late_us / 1e6)
                yield Imbalance("late", number, (index,), *at, reason, instead)

    def _reached(self, one: _Trigger) -> bool:
        """Whether a message with a trigger's number reached the camera."""
        heard = (self.heard.numbers.get((kind, one.logged.number), []) for kind in one.numbered)
        return any(
            abs(stamp_us - one.at_us) <= _NUMBERED_US and self.power_ups.of(stamp_us) == one.power_up
            for times in heard
            for stamp_us in times
        )

    def _of_shot(self, index: int) -> Iterator[Imbalance]:
        """A shot without a trigger of its own: a second one of a trigger, or the autopilot's without any."""
        flight, shot = self.flight, self.flight.rows[index].shot
        beside = self.pairs.beside.get(index, ())
        delay_us = self.pairs.delay_us if index in self.pairs.beside else 0.0
        for place, other in self.pairs.shots.items():
            one = self.triggers[place]
            away_us = abs(flight.at_us(index) - one.at_us - delay_us)
            same = _number(flight, index, one.numbered) == one.logged.number and away_us <= _NUMBERED_US
            same = same and self.power_ups.of(flight.at_us(index)) == one.power_up
            if same or away_us <= _BROADCAST_US:
                at, number = (one.utc_us * 1000, one.logged.place), one.logged.number
                reason = finding(Code.TRIGGER_TWO_SHOTS, Subject("trigger", number))
                yield Imbalance("doubled", number, (other, index), *at, reason, self.pairs.instead.get(place, ()))
                return
        if flight.of_autopilot(index):
            by, about = shot.cause, Subject("shot", index)
            reason = finding(Code.SHOT_NO_TRIGGER, about, source=by.source, kind=by.kind, number=by.sequence)
            yield Imbalance(
                "phantom", None, (index,), flight.utc_ns(shot.wished_utc_ns), flight.place(index), reason, beside
            )


def _passed_over(one: _Trigger, known: set[tuple[int, int]]) -> Iterator[Imbalance]:
    """Numbers before a trigger that neither its log nor a shot has."""
    number, at = one.logged.number, (one.utc_us * 1000, one.logged.place)
    if len(one.passed_over) > _MOST_PASSED_OVER:
        set_back = finding(Code.TRIGGER_COUNTER_SET, Subject("trigger", number), numbers=len(one.passed_over))
        yield Imbalance("lost", number, (), *at, set_back)
        return
    for missing in one.passed_over:
        if (one.power_up, missing) not in known:
            reason = finding(Code.TRIGGER_PASSED_OVER, Subject("trigger", missing), before=number)
            yield Imbalance("lost", missing, (), *at, reason)


def _or(others: tuple[int, ...]) -> str:
    """What is meant instead, perhaps."""
    if len(others) > _MOST_NAMED:
        return f" or one of {len(others)} others from {others[0]} to {others[-1]}"
    return "".join(f" or {one}" for one in others)


def _when(utc_ns: int | None) -> str:
    return "" if utc_ns is None else f" at {_utc_text(utc_ns)}"


def _where(place: tuple[float, float] | None) -> str:
    return "" if place is None else f" near {place[0]:.6f}, {place[1]:.6f}"


def _utc_text(utc_ns: int) -> str:
    """2026-11-21T10:15:03.2Z, rounded."""
    try:
        return datetime.fromtimestamp(utc_ns / 1e9 + 0.05, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-5] + "Z"
    except (ValueError, OverflowError, OSError):
        return "an impossible time"
