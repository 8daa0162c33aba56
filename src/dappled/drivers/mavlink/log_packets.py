"""Make the MAVLink packets that a telemetry link would have carried, from what an autopilot's own log holds."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.decode.geometry import Quaternion, Vector3
from dappled.drivers.mavlink.framing import MavlinkMessage, mavlink, pack
from dappled.errors import DappledError, first_line
from dappled.findings import Code, Finding, Subject, finding

FIX_3D = 3
UNKNOWN_16 = 2**16 - 1
_LATEST_US = 500_000  # a receiver's message is logged within that time, all but always
_AGREEING = 0.75  # share of a receiver's messages that must give one time
_STEADY = 0.95
_DRIFT = 1e-4  # of an autopilot's clock, at most

Timed = tuple[int, MavlinkMessage]  # µs since boot


class AutopilotLogError(DappledError):
    """An autopilot's log can't be used; one sentence."""


@contextlib.contextmanager
def sound(path: Path, by: str) -> Iterator[None]:
    """What damage does to the reader of a log of `by`, or to a field of a message, is one sentence."""
    try:
        yield
    except OSError as error:
        raise AutopilotLogError(f"{path} can't be read: {error.strerror}") from None
    except MemoryError as error:
        raise AutopilotLogError(f"{path} is damaged as a log of {by}, or made to exhaust memory: {error}") from None
    except (ValueError, TypeError, KeyError, IndexError, ArithmeticError, AttributeError) as error:
        raise AutopilotLogError(f"{path} is damaged as a log of {by} ({first_line(error)}): copy it again") from None


@dataclass(frozen=True, slots=True, eq=False)
class BootMap:
    """UTC, by a receiver or as this machine has it, minus time since boot: `offsets_us` (n,) at `boots_us` (n,), which
    increase. `step_us`: how much later the receiver's UTC was before these than it would be by them; 0 where it was
    the same."""

    boots_us: Floats
    offsets_us: Floats
    step_us: int = 0

    def utc_us(self, boot_us: int) -> int:
        """A time since boot in UTC."""
        begins = self.offsets_us[0]  # small numbers keep their digits
        return boot_us + int(begins) + round(float(np.interp(boot_us, self.boots_us, self.offsets_us - begins)))


@dataclass(frozen=True, slots=True)
class LoggedTrigger:
    """A trigger that an autopilot gave, by its own number. `place`: latitude and longitude (degrees), where known."""

    number: int
    boot_us: int
    place: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class TriggerLog:
    """The triggers of one camera in an autopilot's log, in the order of time.

    `contacts` counts what a feedback pin saw, None where none is set up. The log holds from `begins_us` to `ends_us`
    since boot. `by`: "ArduPilot" or "PX4". `records`: the messages that would hold a trigger.
    """

    by: str
    triggers: tuple[LoggedTrigger, ...]
    contacts: int | None
    begins_us: int
    ends_us: int
    clock: BootMap
    records: str


def log_clock(boots_us: NDArray[np.int64], offsets_us: NDArray[np.int64]) -> BootMap:
    """The clock by a receiver's messages, (n,) each: when they were logged, and UTC minus that.

    A message is logged some time after it holds, so of messages near each other the largest offset is the truest. What
    another message nearby says counts less by what the two clocks may have drifted apart meanwhile. Messages that are
    half a second away from what most say are left out (a receiver that doesn't know the leap seconds yet, or a damaged
    message). Where more than a quarter are, what the receiver says from some time on counts. Raises AutopilotLogError
    where it goes on changing.
    """
    order = np.argsort(boots_us, kind="stable")
    boots_us, offsets_us = boots_us[order], offsets_us[order]
    away = np.abs(offsets_us - int(np.median(offsets_us)))
    good = away < _LATEST_US
    step_us = 0
    if good.mean() < _AGREEING:
        good = _since_its_last_step(offsets_us)
        if not good.any():
            raise AutopilotLogError(
                f"the receiver's time in UTC changes by {float(away.max()) / 1e6:.1f} s within the log, so the time of "
                "a frame is not certain: give the ground station's .tlog"
            )
        step_us = int(np.median(offsets_us[: np.flatnonzero(good)[0]])) - int(np.median(offsets_us[good]))
    times, offsets = boots_us[good].astype(np.float64), offsets_us[good]
    begins = int(offsets[0])
    rising = _DRIFT * times
    values = (offsets - begins).astype(np.float64)
    since = np.maximum.accumulate(values + rising) - rising
    until = np.maximum.accumulate((values - rising)[::-1])[::-1] + rising
    return BootMap(times, np.maximum(since, until) + begins, step_us)


def _since_its_last_step(offsets_us: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which offsets (n,) in the order of time agree with the last ones, from the time on when all but a few do; none
    where that is less than a quarter, or others agree before."""
    good = np.abs(offsets_us - int(np.median(offsets_us[-(len(offsets_us) + 3) // 4 :]))) < _LATEST_US
    gain = np.concatenate([[0], np.cumsum(np.where(good, -1, 1))])
    begins = int(np.argmax(gain))
    after, before = good[begins:], good[:begins]
    sure = 0 < begins <= _AGREEING * len(good) and after.mean() >= _STEADY and before.mean() <= 1 - _STEADY
    return good & (np.arange(len(good)) >= begins) & sure


def tell(path: Path, found: Iterable[Finding], report: Callable[[Finding], object], *, cut: bool) -> None:
    """Report what was found in a log, and whether it was cut short."""
    for one in found:
        report(one)
    if cut:
        report(finding(Code.LOG_CUT_SHORT, Subject("log", str(path))))


def packets(messages: Iterable[Timed], clock: BootMap) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet), in the order of time."""
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for number, (boot_us, message) in enumerate(sorted(messages, key=lambda one: one[0])):
        yield number, clock.utc_us(boot_us), pack(message, packer, version_1=False)


def position(boot_us: int, place: tuple[float, float, float], above_home_m: float, velocity_ned_m_s: Vector3) -> Timed:
    """A GLOBAL_POSITION_INT. `place`: latitude and longitude (degrees), height above mean sea level (m)."""
    latitude_deg, longitude_deg, altitude_m = place
    whole = round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1e3), round(above_home_m * 1e3)
    speeds = (round(speed * 100) for speed in velocity_ned_m_s)
    return boot_us, mavlink.MAVLink_global_position_int_message(boot_us // 1000, *whole, *speeds, UNKNOWN_16)


def attitude(boot_us: int, turned: Quaternion) -> Timed:
    """An ATTITUDE_QUATERNION without rates."""
    unknown = (float("nan"),) * 3
    return boot_us, mavlink.MAVLink_attitude_quaternion_message(boot_us // 1000, *turned, *unknown)
