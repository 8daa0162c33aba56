"""Read ArduPilot's own log (DataFlash, .bin) as the MAVLink packets that a telemetry link would have carried.

Positions are POS with the velocities of XKF1 or NKF1, attitudes ATT, the receiver GPS and GPA. UTC comes from the
receiver's time (`log_packets.log_clock`). Triggers of a camera are TRIG, with CAM as contacts of its feedback pin, or,
without a pin, CAM.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader

from dappled.decode.array_types import Floats
from dappled.decode.geometry import from_euler
from dappled.drivers.mavlink import log_packets
from dappled.drivers.mavlink.log_packets import (
    FIX_3D,
    AutopilotLogError,
    LogClock,
    LoggedTrigger,
    ReceiverFix,
    Timed,
    TriggerLog,
)
from dappled.errors import first_line

_USED = ["POS", "ATT", "GPS", "GPA", "XKF1", "NKF1"]
_OF_CAMERAS = ["CAM", "TRIG"]
_GPS_EPOCH_US = 315_964_800 * 10**6
_LEAP_US = 18 * 10**6  # since 2017; no older log is of use here
_WEEK_US = 7 * 86400 * 10**6
_GAP_US = 1_000_000  # a velocity further away is not that of a position


class DataFlashError(AutopilotLogError):
    """A log of ArduPilot can't be used; one sentence."""


def packets(path: Path, report: Callable[[str], object] = lambda _: None) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time. `report` gets a sentence where the log was cut
    short. Raises DataFlashError."""
    with _sound(path):
        rows, cut = _rows(path, _USED)
        clock = _clock(path, rows["GPS"])
        messages = [*_positions(path, rows), *_attitudes(rows), *_receiver(rows, clock)]
    if cut:
        report(f"{path}: {log_packets.CUT_SHORT}")
    yield from log_packets.packets(messages, clock)


def triggers(path: Path, cam_idx: int) -> TriggerLog:
    """The triggers of one camera (0 is CAM1). Raises DataFlashError."""
    with _sound(path):
        rows, _ = _rows(path, ["GPS", *_OF_CAMERAS])
        clock = _clock(path, rows["GPS"])
        # before ArduPilot 4.3 the messages don't say which camera: there is one
        mine = {name: [row for row in rows[name] if getattr(row, "I", 0) == cam_idx] for name in _OF_CAMERAS}
        given = mine["TRIG"] or mine["CAM"]
        if any(not hasattr(row, name) for row in given for name in ("Img", "TimeUS", "Lat", "Lng")):
            raise DataFlashError(f"{path} holds messages CAM or TRIG in a form that is not ArduPilot's since 4.0")
        found = sorted(
            (
                LoggedTrigger(
                    int(row.Img), int(row.TimeUS), (float(row.Lat), float(row.Lng)) if row.Lat or row.Lng else None
                )
                for row in given
            ),
            key=lambda one: one.boot_us,
        )
        if not found:
            raise DataFlashError(
                f"{path} holds no trigger of CAM{cam_idx + 1} (messages CAM and TRIG): choose Camera in LOG_BITMASK"
            )
        times_us = [int(row.TimeUS) for name in rows for row in rows[name]]
        contacts = len(mine["CAM"]) if mine["TRIG"] else None
        return TriggerLog("ArduPilot", tuple(found), contacts, min(times_us), max(times_us), clock)


@contextlib.contextmanager
def _sound(path: Path) -> Iterator[None]:
    """What damage does to the reader, or to a field of a message, is one sentence; what is printed of it is dropped."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    except OSError as error:
        raise DataFlashError(f"{path} can't be read: {error.strerror}") from None
    except DataFlashError:
        raise
    except Exception as error:  # noqa: BLE001  the reader raises that class itself, beside many others
        raise DataFlashError(f"{path} is damaged as a log of ArduPilot ({first_line(error)}): copy it again") from None


class _Reader(DFReader.DFReader_binary):  # type: ignore[misc]  # it has no types
    """The reader, which leaves no file open where it finds nothing to read."""

    def __init__(self, path: Path) -> None:
        try:
            super().__init__(str(path))
        except BaseException:
            if hasattr(self, "filehandle"):
                self.filehandle.close()
            raise

    def cut_short(self) -> bool:
        """Whether the last message ends after the file, or bytes follow it that are none."""
        ends = (
            at[-1] + self.formats[number].len
            for number, at in enumerate(self.offsets)
            if number in self.formats and len(at)
        )
        return max(ends, default=0) != int(self.data_len)


def _rows(path: Path, used: list[str]) -> tuple[dict[str, list[Any]], bool]:
    """The messages in use, by name, and whether the log was cut short: then it is read up to there."""
    rows: dict[str, list[Any]] = {name: [] for name in used}
    log = _Reader(path)
    try:
        while (message := log.recv_match(type=used)) is not None:
            name = message.get_type()
            first = getattr(message, "I", 0) == 0 and getattr(message, "C", 0) == 0
            if first or name in _OF_CAMERAS:  # the first receiver, the first core
                rows[name].append(message)
        return rows, log.cut_short()
    finally:
        log.filehandle.close()


def _clock(path: Path, receiver: list[Any]) -> LogClock:
    """The autopilot's clock by the receiver's fixes. Raises DataFlashError without one."""
    fixes = [row for row in receiver if row.Status >= FIX_3D and row.GWk > 0]
    if not fixes:
        raise DataFlashError(f"{path} holds no fix of a satellite receiver: its time in UTC is not known")
    boots_us = np.array([row.TimeUS for row in fixes], dtype=np.int64)
    gps_us = np.array([row.GWk * _WEEK_US + row.GMS * 1000 for row in fixes], dtype=np.int64)
    try:
        return log_packets.log_clock(boots_us, _GPS_EPOCH_US + gps_us - _LEAP_US - boots_us)
    except AutopilotLogError as error:
        raise DataFlashError(f"{path}: {error}") from None


def _positions(path: Path, rows: dict[str, list[Any]]) -> Iterator[Timed]:
    moving = rows["XKF1"] or rows["NKF1"]
    if not rows["POS"] or not moving:
        raise DataFlashError(
            f"{path} holds no positions with velocities (POS, and XKF1 or NKF1): set LOG_BITMASK for them"
        )
    times = _column(moving, "TimeUS")
    velocities = np.stack([_column(moving, name) for name in ("VN", "VE", "VD")])
    for row in rows["POS"]:
        if np.abs(times - row.TimeUS).min() > _GAP_US:
            continue
        north, east, down = (float(np.interp(row.TimeUS, times, speed)) for speed in velocities)
        place = row.Lat, row.Lng, row.Alt
        yield log_packets.position(int(row.TimeUS), place, row.RelHomeAlt, (north, east, down))


def _attitudes(rows: dict[str, list[Any]]) -> Iterator[Timed]:
    for row in rows["ATT"]:
        yield log_packets.attitude(int(row.TimeUS), from_euler(*np.radians([row.Roll, row.Pitch, row.Yaw]).tolist()))


def _receiver(rows: dict[str, list[Any]], clock: LogClock) -> Iterator[Timed]:
    accuracies = rows["GPA"]
    times = _column(accuracies, "TimeUS")
    for row in rows["GPS"]:
        at = int(row.TimeUS)
        quality = accuracies[int(np.abs(times - at).argmin())] if accuracies else None
        yield from log_packets.receiver(
            ReceiverFix(
                at,
                int(row.Status),
                row.Lat,
                row.Lng,
                row.Alt,
                int(row.NSats),
                row.HDop,
                None if quality is None else quality.VDop,
                None if quality is None else (quality.HAcc, quality.VAcc, quality.SAcc),
            ),
            clock,
        )


def _column(rows: list[Any], name: str) -> Floats:
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)
