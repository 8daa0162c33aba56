"""Choose what counts in an autopilot's own log: which samples, which receiver, which UTC; one rule for all kinds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.clock import TimeOfDayClock
from dappled.decode.array_types import Floats
from dappled.decode.geometry.camera_pose import matrix_of
from dappled.drivers.mavlink import log_packets
from dappled.drivers.mavlink.framing import mavlink
from dappled.drivers.mavlink.log_packets import FIX_3D, UNKNOWN_16, AutopilotLogError, BootMap, Timed
from dappled.drivers.mavlink.sample_judge import (
    FASTEST_M_S,
    HIGHEST_M,
    OF_ATTITUDES,
    OF_PLACES,
    OF_VELOCITIES,
    point_m,
    steady,
)
from dappled.drivers.utc_choice import Date, UtcBounds, rolled_over
from dappled.findings import Code, Finding, Subject, finding

BOOT_MAX_US = 2**32 * 1000  # MAVLink's milliseconds since boot
_HIGHEST_DOP = 600.0
_EXTRAPOLATED = 8  # of PX4; MAVLink's 8 is another
_GAP_US = 1_000_000  # a velocity further away is not that of a position
_DAY_US = 86400 * 10**6
_ONE_UTC_US = 900_000  # two receivers' times differ by less: a message is logged some time after it holds
_LAST = 25
Chosen = NDArray[np.bool_]


@dataclass(slots=True)
class Missing:
    """How many values of each message are no numbers, or can't be true: they count as missing at their time."""

    of: dict[str, int] = field(default_factory=dict)

    def count(self, message: str, good: Chosen) -> Chosen:
        """Count the others, and give back the same."""
        if bad := int((~good).sum()):
            self.of[message] = self.of.get(message, 0) + bad
        return good

    def findings(self, path: Path) -> Iterator[Finding]:
        """What is to be said of it."""
        if self.of:
            each = ", ".join(f"{count} of {name}" for name, count in self.of.items())
            yield finding(Code.LOG_VALUES_MISSING, Subject("log", str(path)), values=each)


@dataclass(frozen=True, slots=True, eq=False)
class LoggedPlaces:
    """Estimated places (n,): µs since boot, degrees, metres above mean sea level and above home."""

    message: str
    boots_us: NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt: Floats
    above: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """What one satellite receiver said (n,). `number` counts from 1; `utc_us` is 0 where it told none; `accuracy`
    (3, n): horizontal, vertical (m), speed (m/s), NaN where unknown; `used`: where the autopilot used it, None where
    the log doesn't say. `later_us`: what 1024 weeks add, less the leap seconds since."""

    number: int
    boots_us: NDArray[np.int64]
    utc_us: NDArray[np.int64]
    fix_type: NDArray[np.int64]
    lat: Floats
    lon: Floats
    alt: Floats
    satellites: Floats
    hdop: Floats
    vdop: Floats
    accuracy: Floats
    later_us: NDArray[np.int64]
    used: Chosen | None = None

    @property
    def fixed(self) -> Chosen:
        """Where it had a fix."""
        known = (self.fix_type >= FIX_3D) & (self.fix_type < _EXTRAPOLATED)
        return known & in_time(self.boots_us) & placed(self.lat, self.lon, self.alt)

    def messages(self, which: Chosen, clock: BootMap) -> Iterator[Timed]:
        """A GPS_RAW_INT and a SYSTEM_TIME for each of its messages, as far as they can be told."""
        here = placed(self.lat, self.lon, self.alt)
        for n in np.flatnonzero(which & in_time(self.boots_us)).tolist():
            at, fix, satellites = int(self.boots_us[n]), int(self.fix_type[n]), float(self.satellites[n])
            lat, lon, alt = (float(side[n]) if here[n] else 0.0 for side in (self.lat, self.lon, self.alt))
            hdop, vdop, accuracy = float(self.hdop[n]), float(self.vdop[n]), self.accuracy[:, n].tolist()
            message = mavlink.MAVLink_gps_raw_int_message(
                at, fix if here[n] and 0 <= fix < _EXTRAPOLATED else 0,
                round(lat * 1e7), round(lon * 1e7), round(alt * 1e3),
                round(hdop * 100) if 0 <= hdop < _HIGHEST_DOP else 0,
                round(vdop * 100) if 0 < vdop < _HIGHEST_DOP else UNKNOWN_16,
                UNKNOWN_16, UNKNOWN_16, min(254, max(0, int(satellites))) if math.isfinite(satellites) else 255, 0,
                *(round(1000 * one) if all(0 <= each < HIGHEST_M for each in accuracy) else 0 for one in accuracy),
            )  # fmt: skip
            yield at, message
            yield at, mavlink.MAVLink_system_time_message(clock.utc_us(at), at // 1000)

    def _rank(self) -> tuple[float, float, float, int]:
        fixed = self.fixed
        if not fixed.any():
            return 0.0, 0.0, 0.0, -self.number
        kind, satellites = float(np.median(self.fix_type[fixed])), float(np.nanmedian(self.satellites[fixed]))
        return round(float(fixed.mean()), 1), kind, satellites, -self.number


def begins_us(times_us: Sequence[NDArray[Any]]) -> int:
    """Since when a log's stamps (µs) are to be counted: 0, but where they pass MAVLink's 32 bits of milliseconds (a
    vehicle that is on for weeks, a simulator whose stamps are Unix time): half of that before their median."""
    stamps = np.concatenate([np.zeros(0, dtype=np.int64), *times_us])
    stamps = stamps[(stamps >= 0) & (stamps < 2**53)]
    usual = int(np.median(stamps)) if stamps.size else 0
    return max(0, usual - BOOT_MAX_US // 2) // 10**6 * 10**6


def in_time(boots_us: Any) -> Chosen:
    """Which times since boot MAVLink can say (n,)."""
    return np.asarray((boots_us >= 0) & (boots_us < BOOT_MAX_US))


def placed(lat: Floats, lon: Floats, alt: Floats) -> Chosen:
    """Which places are on the globe, and within 100 km of the sea's level (n,)."""
    return np.asarray((np.abs(lat) <= 90) & (np.abs(lon) <= 180) & (np.abs(alt) < HIGHEST_M))


def positions(
    places: LoggedPlaces, message: str, times_us: NDArray[np.int64], velocities: Floats, missing: Missing
) -> Iterator[Timed]:
    """The positions with the velocities (3, m; north, east, down, m/s) of `message` that were measured nearby."""
    good = missing.count(message, in_time(times_us) & (np.abs(velocities) < FASTEST_M_S).all(axis=0))
    order = np.argsort(times_us[good], kind="stable")
    times_us, velocities = times_us[good][order], velocities[:, good][:, order]
    sound = missing.count(message, steady(times_us, velocities, OF_VELOCITIES))
    times_us, velocities = times_us[sound], velocities[:, sound]
    at = places.boots_us
    here = placed(places.lat, places.lon, places.alt) & (np.abs(places.above) < HIGHEST_M)
    rows = np.flatnonzero(missing.count(places.message, in_time(at) & here))
    rows = rows[np.argsort(at[rows], kind="stable")]
    here_m = np.stack(point_m(np.radians(places.lat[rows]), np.radians(places.lon[rows]), places.alt[rows]))
    here_m = np.vstack([here_m, places.above[rows]])
    rows = rows[missing.count(places.message, steady(at[rows], here_m, OF_PLACES))]
    if not times_us.size:
        return
    after = np.clip(np.searchsorted(times_us, at[rows]), 0, len(times_us) - 1)
    away = np.minimum(np.abs(times_us[after] - at[rows]), np.abs(times_us[np.maximum(after - 1, 0)] - at[rows]))
    for n in rows[away <= _GAP_US]:
        north, east, down = (float(np.interp(at[n], times_us, speed)) for speed in velocities)
        place = float(places.lat[n]), float(places.lon[n]), float(places.alt[n])
        yield log_packets.position(int(at[n]), place, float(places.above[n]), (north, east, down))


def attitudes(message: str, boots_us: NDArray[np.int64], attitude: Floats, missing: Missing) -> Iterator[Timed]:
    """The attitudes of quaternions (n, 4)."""
    length = np.linalg.norm(attitude, axis=1)
    rows = np.flatnonzero(missing.count(message, in_time(boots_us) & (length > 0.5) & (length < 2.0)))
    rows = rows[np.argsort(boots_us[rows], kind="stable")]
    matrices = matrix_of(tuple((attitude[rows] / length[rows, None]).T)).reshape(9, -1)
    for n in rows[missing.count(message, steady(boots_us[rows], matrices, OF_ATTITUDES))]:
        w, x, y, z = attitude[n].tolist()
        yield log_packets.attitude(int(boots_us[n]), (w, x, y, z))


def chosen(path: Path, receivers: Sequence[Receiver]) -> tuple[list[tuple[Receiver, Chosen]], list[Finding]]:
    """The messages that count: of whichever receiver the autopilot used at the time, where the log says so and these
    had a fix for half of the time or more; else of the receiver that had the best fix."""
    best = max(receivers, key=Receiver._rank, default=None)
    if best is None:
        return [], []
    subject = Subject("log", str(path))
    using = [(one, one.used) for one in receivers if one.used is not None and one.used.any()]
    if using:
        fixed = sum(int((one.fixed & which).sum()) for one, which in using)
        if 2 * fixed >= sum(int(which.sum()) for _, which in using):
            most, _ = max(using, key=lambda pair: int(pair[1].sum()))
            told = [finding(Code.LOG_RECEIVER_USED, subject, receiver=most.number, receivers=len(receivers))]
            return using, told if most.number > 1 else []
    share = 100.0 * float(best.fixed.mean()) if len(best.boots_us) else 0.0
    told = [finding(Code.LOG_RECEIVER_BETTER, subject, receiver=best.number, fix_percent=share)]
    return [(best, np.ones(len(best.boots_us), dtype=bool))], told if best.number > 1 else []


def in_turn(counting: list[tuple[Receiver, Chosen]], others: Sequence[Receiver]) -> list[tuple[Receiver, Chosen]]:
    """The messages that count, and where a log doesn't say which receiver was used, those with a fix of the next best
    one where all before it had none for two of the best one's messages."""
    if not counting or counting[0][0].used is not None:
        return counting
    best, which = counting[0]
    gap_us = 2 * int(np.median(np.diff(best.boots_us))) if len(best.boots_us) > 1 else _GAP_US
    found, known_us = [], best.boots_us[best.fixed]
    for one in sorted((one for one in others if one is not best), key=Receiver._rank, reverse=True):
        instead = one.fixed & (_away_us(one.boots_us, known_us) > gap_us)
        if instead.any():
            found.append((one, instead))
            known_us = np.concatenate([known_us, one.boots_us[instead]])
    by_others_us = np.concatenate([one.boots_us[instead] for one, instead in found] or [known_us[:0]])
    replaced = ~best.fixed & (_away_us(best.boots_us, by_others_us) <= gap_us)
    return [(best, which & ~replaced), *found]


def _away_us(times_us: NDArray[np.int64], others_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """How far the nearest of some other times is from each (n,)."""
    known_us = np.concatenate([[-(2**62)], np.sort(others_us), [2**62]])
    after = np.searchsorted(known_us, times_us)
    nearest: NDArray[np.int64] = np.minimum(times_us - known_us[after - 1], known_us[after] - times_us)
    return nearest


def utc_clock(
    path: Path, ranked: Sequence[tuple[Receiver, Chosen]], others: Sequence[Receiver], bounds: UtcBounds | None
) -> tuple[BootMap, list[Finding]]:
    """The autopilot's clock by the receiver that counts; where that one told no UTC that can be true, by the best other
    one. Raises AutopilotLogError without any."""
    bounds = bounds or UtcBounds.of_log(TimeOfDayClock().utc_ns())
    doubted: tuple[BootMap, list[Finding]] | None = None
    any_fix = False
    others = sorted(others, key=Receiver._rank, reverse=True)
    of_others = [[(one, np.ones(len(one.boots_us), dtype=bool))] for one in others]
    for group in (ranked, *of_others):
        rows = [(one, which & one.fixed) for one, which in group]
        any_fix = any_fix or any(bool(which.any()) for _, which in rows)
        if not rows:
            continue
        boots_us = np.concatenate([one.boots_us[which] for one, which in rows])
        utc_us = np.concatenate([one.utc_us[which] for one, which in rows])
        later_us = np.concatenate([one.later_us[which] for one, which in rows])
        wanted, true_us, told = _dated(path, utc_us - boots_us, utc_us, later_us, bounds)
        if wanted is None:
            continue
        these = true_us > 0
        try:
            clock = log_packets.log_clock(boots_us[these], (true_us - boots_us)[these])
        except AutopilotLogError as error:
            raise AutopilotLogError(f"{path}: {error}") from None
        if clock.step_us:
            told.append(finding(Code.TIME_PUT_RIGHT, Subject("log", str(path)), off_s=clock.step_us / 1e6))
        if wanted is not Date.ROLLED_OVER:
            return clock, [*told, *_contradicting(path, clock, others, bounds)]
        doubted = doubted or (clock, told)
    if doubted is not None:
        return doubted
    if any_fix:
        raise AutopilotLogError(
            f"{path} holds fixes of a satellite receiver, but no date that can be true: its time in UTC is not known"
        )
    raise AutopilotLogError(f"{path} holds no fix of a satellite receiver: its time in UTC is not known")


def _contradicting(path: Path, clock: BootMap, others: Sequence[Receiver], bounds: UtcBounds) -> Iterator[Finding]:
    """The receivers with a fix whose UTC is another one than the clock's at the end of what they say."""
    for one in others:
        boots_us, utc_us, later_us = (each[one.fixed] for each in (one.boots_us, one.utc_us, one.later_us))
        date, true_us, _ = _dated(path, utc_us - boots_us, utc_us, later_us, bounds)
        last = np.flatnonzero((true_us > 0) & (date is Date.TRUE))[-_LAST:]
        if last.size and abs(off_us := int(np.median((true_us - boots_us)[last]) - clock.offsets_us[-1])) > _ONE_UTC_US:
            yield finding(
                Code.TIME_RECEIVERS_DIFFER, Subject("log", str(path)), receiver=one.number, off_s=off_us / 1e6
            )


def _dated(
    path: Path, offsets_us: NDArray[np.int64], utc_us: NDArray[np.int64], later_us: NDArray[np.int64], bounds: UtcBounds
) -> tuple[Date | None, NDArray[np.int64], list[Finding]]:
    """What most of a receiver's dates that can be true are, the times that count (n,), 0 for the others, and what is to
    be said of them. Dates that others of the same clock show to have rolled over are mended."""
    dates = _dates(utc_us, bounds)
    true, mended, rolled = (dates == one.value for one in (Date.TRUE, Date.MENDED, Date.ROLLED_OVER))
    sure = true | mended
    if sure.any() and rolled.any():
        begun_us = np.median((offsets_us + np.where(mended, later_us, 0))[sure])
        agrees = np.abs(offsets_us + later_us - begun_us) < _DAY_US
        mended, rolled = mended | (rolled & agrees), rolled & ~agrees
    counts = {Date.TRUE: int(true.sum()), Date.MENDED: int(mended.sum()), Date.ROLLED_OVER: int(rolled.sum())}
    if not any(counts.values()):
        return None, utc_us, []
    early = rolled if counts[Date.ROLLED_OVER] > counts[Date.TRUE] + counts[Date.MENDED] else mended
    subject, later = Subject("log", str(path)), np.where(early, utc_us + later_us, 0)
    told = (
        [
            rolled_over(
                subject,
                int(np.median(utc_us[early])) * 1000,
                int(np.median(later[early])) * 1000,
                mended=early is mended,
            )
        ]
        if early.any()
        else []
    )
    if early is rolled:
        return Date.ROLLED_OVER, np.where(rolled, utc_us, 0), told
    return Date.TRUE, np.where(mended, later, np.where(true, utc_us, 0)), told


def _dates(utc_us: NDArray[np.int64], bounds: UtcBounds) -> NDArray[np.int64]:
    """What is to be thought of each date (n,), as values of Date, by its day."""
    days, place = np.unique(utc_us // _DAY_US, return_inverse=True)
    judged = [bounds.judge((int(day) * _DAY_US + _DAY_US // 2) * 1000) if day > 0 else Date.IMPOSSIBLE for day in days]
    return np.array([one.value for one in judged], dtype=np.int64)[place.reshape(-1)]
