"""Read the positions of camera marks from a .pos file, as RTKLIB and Emlid Studio write it after PPK (`*_events.pos`).

The form is that of RTKLIB's manual, B.1: lines of comments that begin with %, the last of which names the columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import read_bytes
from dappled.decode.geometry import Symmetric, camera_pose
from dappled.drivers.gps_time import GPS_EPOCH, gps_to_utc
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import disk_error

_MOST_BYTES = 64 << 20
_EAST_9_H = timedelta(hours=9)
_QUALITIES = {1: "fix", 2: "float", 3: "SBAS", 4: "DGPS", 5: "single", 6: "PPP"}
_GEODETIC = ("latitude", "longitude", "height")
_ECEF = ("x-ecef", "y-ecef", "z-ecef")


@dataclass(frozen=True, slots=True)
class Mark:
    """Where the antenna was when the camera's contact closed. `number` counts the marks of the file from 1.

    `height_m` is above the ellipsoid or above the geoid, as `PosFile.above_geoid` says. The covariance is in
    north-east-down, None where the file has none. `quality` is RTKLIB's Q: 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single,
    6 PPP.
    """

    number: int
    utc_ns: int
    latitude_rad: float
    longitude_rad: float
    height_m: float
    quality: int
    satellites: int | None
    covariance_m2: Symmetric | None

    @property
    def solution(self) -> str:
        """The quality as a word."""
        return _QUALITIES.get(self.quality, f"Q{self.quality}")


@dataclass(frozen=True, slots=True)
class PosFile:
    """The marks of a file in the order of time, and what could not be read."""

    marks: tuple[Mark, ...]
    above_geoid: bool
    doubts: tuple[Finding, ...]


def read(path: Path) -> PosFile:
    """The marks of a .pos file. Raises DappledError, and FlightError where the disk refuses."""
    try:
        text = read_bytes(path, _MOST_BYTES).decode("utf-8-sig", "replace")
    except OSError as error:
        raise disk_error("read the marks", path, error) from error
    except ClaimError as error:
        raise DappledError(f"{path} can't be read: {error}; give the file of events, not of all epochs") from None
    lines = text.replace(",", " ").replace(";", " ").splitlines()
    comments = [line for line in lines if line.startswith("%")]
    columns, system = _columns(path, comments)
    _check_datum(path, comments, columns)
    marks: list[Mark] = []
    doubts: list[Finding] = []
    for at, line in enumerate(lines, 1):
        if line.startswith("%") or not line.strip():
            continue
        try:
            marks.append(_mark(len(marks) + 1, line.split(), columns, system))
        except (ValueError, IndexError, OverflowError):
            if at != len(lines):
                raise DappledError(
                    f"{path}, line {at} is not a position under the header's columns: compute the file again"
                ) from None
            doubts.append(finding(Code.MARKS_CUT_SHORT, Subject("file", str(path))))
    if not marks:
        raise DappledError(
            f"{path} holds no mark: was the camera's contact wired to the receiver, and the event file kept?"
        )
    marks.sort(key=lambda mark: mark.utc_ns)
    above_geoid = any("/geodetic" in line for line in comments) and columns[0] == _GEODETIC[0]
    return PosFile(tuple(marks), above_geoid, tuple(doubts))


def _columns(path: Path, comments: Sequence[str]) -> tuple[list[str], str]:
    """Names of the columns after the time, without units, three for an angle in degrees, minutes and seconds; and the
    time's system."""
    for line in reversed(comments):
        words = line[1:].split()
        if words and words[0] in ("GPST", "UTC", "JST"):
            break
    else:
        raise DappledError(
            f"{path} has no header that says GPST or UTC, which differ by 18 s: write it with its header "
            "(RTKLIB: out-outhead=on), and give the file of events"
        )
    columns: list[str] = []
    for word in words[1:]:
        name, _, unit = word.partition("(")
        columns += [name, f"{name}'", f"{name}''"] if "'" in unit else [name]
    if tuple(columns[:1]) == ("e-baseline",):
        raise DappledError(f"{path} holds baselines, not positions: write it again as latitude, longitude, height")
    kind = _ECEF if "x-ecef" in columns else _GEODETIC
    if not {*kind, "Q"} <= set(columns):
        raise DappledError(f"{path} is not a .pos file of RTKLIB or Emlid: its header lacks {', '.join((*kind, 'Q'))}")
    return columns, words[0]


def _check_datum(path: Path, comments: Sequence[str], columns: Sequence[str]) -> None:
    """Raises DappledError where the header names another datum than WGS 84."""
    for line in comments:
        _, found, rest = line.partition("lat/lon/height=")
        datum = rest.split("/")[0].split()[0] if found and rest.split("/")[0].split() else ""
        if columns[0] == _GEODETIC[0] and datum and datum.upper() not in ("WGS84", "ITRF"):
            raise DappledError(f"{path} is in the datum {datum}, not in WGS 84: compute it again with out-datum=wgs84")


def _mark(number: int, fields: list[str], columns: Sequence[str], system: str) -> Mark:
    """One line. Raises ValueError, IndexError and OverflowError."""
    utc_ns = _utc_ns(fields[0], fields[1], system)
    values = dict(zip(columns, fields[2:], strict=False))
    quality = int(_need(values, "Q"))
    satellites = int(values["ns"]) if "ns" in values else None
    if "x-ecef" in columns:
        x, y, z = (float(_need(values, name)) for name in _ECEF)
        if not 6.2e6 < math.hypot(x, y, z) < 6.6e6:
            raise ValueError("not near the Earth's surface")
        latitude, longitude, height = camera_pose.from_ecef(np.array([x, y, z]))
        covariance = _covariance(values, "x", "y", "z")
        if covariance is not None:
            turn = camera_pose.ned_to_ecef(latitude, longitude)
            covariance = turn.T @ covariance @ turn
    else:
        latitude, longitude = (math.radians(_degrees(values, name)) for name in _GEODETIC[:2])
        height = float(_need(values, "height"))
        covariance = _covariance(values, "n", "e", "u")
        if covariance is not None:
            down = np.diag([1.0, 1.0, -1.0])
            covariance = down @ covariance @ down
    if satellites is not None and satellites < 0:
        raise ValueError("not a number of satellites")
    if not (abs(latitude) <= math.pi / 2 and abs(longitude) <= 2 * math.pi and -1e3 < height < 1e5):
        raise ValueError("not a place near the ground")
    upper = None if covariance is None else tuple(float(covariance[i, j]) for i in range(3) for j in range(i, 3))
    assert upper is None or len(upper) == 6
    longitude = math.remainder(longitude, math.tau)
    return Mark(number, utc_ns, latitude, longitude, height, quality, satellites, upper)


def _need(values: dict[str, str], name: str) -> str:
    if name not in values:
        raise IndexError(name)
    return values[name]


def _degrees(values: dict[str, str], name: str) -> float:
    """Decimal degrees, or degrees, minutes and seconds (the sign stands before the degrees, also before 0)."""
    first = _need(values, name)
    if f"{name}'" not in values:
        return float(first)
    minutes, seconds = float(values[f"{name}'"]), float(_need(values, f"{name}''"))
    return math.copysign(abs(float(first)) + minutes / 60 + seconds / 3600, -1.0 if first.startswith("-") else 1.0)


def _covariance(values: dict[str, str], a: str, b: str, c: str) -> camera_pose.Matrix | None:
    """(3, 3) in the file's axes; None where the file has no deviations, or zeros in place of them. RTKLIB writes an
    off-diagonal element as the root of its amount, with its sign."""
    names = [f"sd{a}", f"sd{b}", f"sd{c}", f"sd{a}{b}", f"sd{b}{c}", f"sd{c}{a}"]
    if "sdue" in values:  # RTKLIB's name of sdun where angles are in degrees, minutes and seconds
        names[-1] = "sdue"
    if not set(names) <= values.keys():
        return None
    aa, bb, cc, ab, bc, ca = (math.copysign(float(values[name]) ** 2, float(values[name])) for name in names)
    if not all(map(math.isfinite, (aa, bb, cc, ab, bc, ca))):
        raise ValueError("a deviation is not a number")
    return np.array([[aa, ab, ca], [ab, bb, bc], [ca, bc, cc]]) if min(aa, bb, cc) > 0 else None


def _utc_ns(first: str, second: str, system: str) -> int:
    """yyyy/mm/dd and hh:mm:ss.sss, or week and seconds of it. Raises ValueError and OverflowError."""
    if "/" in first:
        hours, minutes, rest = second.split(":")
        whole, _, fraction = rest.partition(".")
        if not (0 <= int(hours) < 24 and 0 <= int(minutes) <= 60 and 0 <= int(whole) <= 60):
            raise ValueError("not a time of a day")
        day = datetime.strptime(first, "%Y/%m/%d").replace(tzinfo=UTC)
        ticks = int(fraction[:9].ljust(9, "0"))
        at = day + timedelta(hours=int(hours), minutes=int(minutes), seconds=int(whole))
    else:
        whole, _, fraction = second.partition(".")
        ticks = int(fraction[:9].ljust(9, "0"))
        at = GPS_EPOCH + timedelta(weeks=int(first), seconds=int(whole))
    if system == "GPST":
        at = gps_to_utc(at)
    elif system == "JST":
        at -= _EAST_9_H
    return round((at - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()) * 10**9 + ticks
