"""Read ArduPilot's own log (DataFlash, .bin) as the MAVLink packets that a telemetry link would have carried.

Positions are POS with the velocities of XKF1 or NKF1, attitudes ATT, the receiver GPS and GPA. UTC comes from the
receiver's time; of all its messages the one that was logged with the least delay counts.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader

from dappled.decode.array_types import Floats
from dappled.decode.geometry import from_euler
from dappled.drivers.mavlink.links import MavlinkMessage, mavlink, pack
from dappled.errors import DappledError, first_line

MAGIC = b"\xa3\x95\x80\x80"
_USED = ["POS", "ATT", "GPS", "GPA", "XKF1", "NKF1"]
_GPS_EPOCH_US = 315_964_800 * 10**6
_LEAP_US = 18 * 10**6  # since 2017; no older log is of use here
_WEEK_US = 7 * 86400 * 10**6
_FIX_3D = 3
_UNKNOWN_16 = 2**16 - 1
_GAP_US = 1_000_000  # a velocity further away is not that of a position


class DataFlashError(DappledError):
    """An autopilot's log can't be used; one sentence."""


def packets(path: Path) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time. Raises DataFlashError."""
    rows = _rows(path)
    offset_us = _utc_offset_us(path, rows["GPS"])
    messages = sorted([*_positions(path, rows), *_attitudes(rows), *_receiver(rows, offset_us)], key=lambda one: one[0])
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for number, (boot_us, message) in enumerate(messages):
        yield number, boot_us + offset_us, pack(message, packer, version_1=False)


_Timed = tuple[int, MavlinkMessage]


def _rows(path: Path) -> dict[str, list[Any]]:
    """The messages in use, by name. A log that was cut off is read up to there."""
    rows: dict[str, list[Any]] = {name: [] for name in _USED}
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # the reader prints what it skips
            log = DFReader.DFReader_binary(str(path))
            while (message := log.recv_match(type=_USED)) is not None:
                if (
                    getattr(message, "I", 0) == 0 and getattr(message, "C", 0) == 0
                ):  # the first receiver, the first core
                    rows[message.get_type()].append(message)
            log.filehandle.close()
    except OSError as error:
        raise DataFlashError(f"{path} can't be read: {error.strerror}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, struct.error) as error:
        raise DataFlashError(f"{path} is damaged as a log of ArduPilot ({first_line(error)}): copy it again") from None
    return rows


def _utc_offset_us(path: Path, receiver: list[Any]) -> int:
    """UTC minus time since boot, from the receiver's fixes. Raises DataFlashError without one."""
    offsets = [
        _GPS_EPOCH_US + row.GWk * _WEEK_US + row.GMS * 1000 - _LEAP_US - row.TimeUS
        for row in receiver
        if row.Status >= _FIX_3D and row.GWk > 0
    ]
    if not offsets:
        raise DataFlashError(f"{path} holds no fix of a satellite receiver: its time in UTC is not known")
    return int(max(offsets))


def _positions(path: Path, rows: dict[str, list[Any]]) -> Iterator[_Timed]:
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
        vx, vy, vz = (round(float(np.interp(row.TimeUS, times, speed)) * 100) for speed in velocities)
        places = round(row.Lat * 1e7), round(row.Lng * 1e7), round(row.Alt * 1e3), round(row.RelHomeAlt * 1e3)
        yield (
            int(row.TimeUS),
            mavlink.MAVLink_global_position_int_message(int(row.TimeUS) // 1000, *places, vx, vy, vz, _UNKNOWN_16),
        )


def _attitudes(rows: dict[str, list[Any]]) -> Iterator[_Timed]:
    for row in rows["ATT"]:
        turned = from_euler(*np.radians([row.Roll, row.Pitch, row.Yaw]).tolist())
        unknown = (float("nan"),) * 3
        yield (
            int(row.TimeUS),
            mavlink.MAVLink_attitude_quaternion_message(int(row.TimeUS) // 1000, *turned, *unknown),
        )


def _receiver(rows: dict[str, list[Any]], offset_us: int) -> Iterator[_Timed]:
    accuracies = rows["GPA"]
    times = _column(accuracies, "TimeUS")
    for row in rows["GPS"]:
        at = int(row.TimeUS)
        quality = accuracies[int(np.abs(times - at).argmin())] if accuracies else None
        of_mm = (
            [0, 0, 0]
            if quality is None
            else [round(1000 * value) for value in (quality.HAcc, quality.VAcc, quality.SAcc)]
        )
        dilution = _UNKNOWN_16 if quality is None else round(quality.VDop * 100)
        places = round(row.Lat * 1e7), round(row.Lng * 1e7), round(row.Alt * 1e3)
        yield (
            at,
            mavlink.MAVLink_gps_raw_int_message(
                at, int(row.Status), *places, round(row.HDop * 100), dilution, _UNKNOWN_16, _UNKNOWN_16, int(row.NSats),
                0, *of_mm,
            ),
        )  # fmt: skip
        yield at, mavlink.MAVLink_system_time_message(at + offset_us, at // 1000)


def _column(rows: list[Any], name: str) -> Floats:
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)
