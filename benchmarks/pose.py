"""How well a frame knows where it was taken, by what its time comes from; and how honest the reported sigmas are.

A simulated flight: 15 m/s, turning at 30°/s, 10 Hz position, 50 Hz attitude, link latency 20 ± 10 ms each way, clocks
that drift by 50 ppm, a receiver with 1 cm accuracy (RTK). Each frame is tagged by the daemon's own code from what the
link had delivered by then. Errors are horizontal distances and whole turns, against the truth at mid-exposure.

python benchmarks/pose.py [--json] [--frames 400] [--seed 1] [--log FLIGHT.tlog]

With --log: that real flight instead. Each position and attitude is left out in turn (or every --stride-th) and
predicted from its neighbours.
"""

from __future__ import annotations

import argparse
import math
import random
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import TypeVar

from limits import show

from dappled.daemon.navigation import BodyLatency, CameraClock, ExposureTime, Telemetry, navigation
from dappled.daemon.navigation.clocks import exposure_from_camera, mid_exposure
from dappled.daemon.navigation.navigation import position_at
from dappled.daemon.navigation.samples import AttitudeSample, PositionSample, attitude, position
from dappled.daemon.navigation.vehicle_history import ATTITUDE_GAP_NS, POSITION_GAP_NS
from dappled.decode.geometry import Pose, metres_per_radian, turn_rad
from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink
from dappled.flight import log_reading
from dappled.mocks.autopilot.autopilot import BootTime, telemetry_message
from dappled.mocks.autopilot.path import FlightPath

START_NS = 1_790_000_000 * 10**9
EXACT_RAD = 1e-6  # the simulated autopilot's attitude has no error of its own
SPEED_M_S = 15.0
TURN_RAD_S = math.radians(30)
LATENCY_S, JITTER_S = 0.020, 0.010
DRIFT = 50e-6
RECEIVER_SIGMA_M = 0.010  # horizontal, as a distance; slow: it moves over a minute
EXPOSURE_S = 1 / 1000
BODY = BodyLatency(60.0, 10.0)
CONTACT_SIGMA_S = 0.001  # the worst that counts as a hot shoe
CAMERA_CLOCK_S = -3600.37  # the body's clock against UTC: another zone, and some seconds' part
WARM_UP_S, EVERY_S = 40.0, 1.37
S = TypeVar("S", PositionSample, AttitudeSample)
RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
}


@dataclass(frozen=True, slots=True)
class Taken:
    """One frame's truth: when it was asked for, and mid-exposure, seconds of the simulation."""

    called_s: float
    middle_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=File)
    parser.add_argument("--stride", type=int, default=1)
    arguments = parser.parse_args()
    figures = (
        leave_one_out(arguments.log, arguments.stride) if arguments.log else measure(arguments.frames, arguments.seed)
    )
    show("pose", figures, as_json=arguments.json)


def measure(frames: int, seed: int) -> dict[str, dict[str, float]]:
    """By the source of the exposure's time: rms errors, rms reported sigmas, and their ratio."""
    rng = random.Random(seed)  # noqa: S311  a simulation
    path = FlightPath(seed, speed_m_s=SPEED_M_S, radius_m=SPEED_M_S / TURN_RAD_S)
    taken = [_take(WARM_UP_S + EVERY_S * number, rng) for number in range(frames)]
    packets = sorted(_packets(path, taken, rng), key=lambda packet: packet[0])
    found: dict[str, list[tuple[Taken, ExposureTime, Pose]]] = {"hot_shoe": [], "body_latency": [], "camera_clock": []}
    with_shoe, without = Telemetry(attitude_sigma_rad=EXACT_RAD), Telemetry(attitude_sigma_rad=EXACT_RAD)
    camera, told = CameraClock(), 0
    for number, (stamp_ns, message) in enumerate(packets):
        with_shoe.feed(number, stamp_ns // 1000, message)
        if message.get_type() != "CAMERA_FEEDBACK":
            without.feed(number, stamp_ns // 1000, message)
        while told < frames and stamp_ns > _utc_ns(taken[told].middle_s) + 400_000_000:
            one, told = taken[told], told + 1
            expected = mid_exposure(_utc_ns(one.called_s), BODY, EXPOSURE_S)
            found["hot_shoe"].append((one, *with_shoe.locate(expected)))
            found["body_latency"].append((one, *without.locate(expected)))
            begin_s = one.middle_s - EXPOSURE_S / 2
            says_s = math.floor(START_NS / 1e9 + begin_s + CAMERA_CLOCK_S)  # EXIF has whole seconds
            by_camera = exposure_from_camera(camera, says_s * 10**9, 10**9, EXPOSURE_S)
            if by_camera is not None:
                found["camera_clock"].append((one, *without.locate(by_camera)))
            camera = camera.learnt(says_s * 10**9, 10**9, expected)
    return {name: _figures(path, rows) for name, rows in found.items()}


def leave_one_out(log: File, stride: int = 1) -> dict[str, dict[str, float]]:
    """How far each recorded position (metres, horizontal) and attitude (degrees) is from what its two neighbours say of
    it, and how far they say that they may be off. Refused: the neighbours are too far apart to be bridged."""
    positions, attitudes = _samples(log)
    return {
        "position_m": _left_out(positions, POSITION_GAP_NS, _position_miss, 0.03, stride),
        "attitude_deg": _left_out(attitudes, ATTITUDE_GAP_NS, _attitude_miss, 0.02, stride),
    }


def _left_out(
    samples: Sequence[S], gap_ns: int, miss: Callable[[S, S, S], tuple[float, float]], rounding: float, stride: int
) -> dict[str, float]:
    """`rounding` is what the messages themselves round to."""
    refused, found = 0, []
    for before, left_out, after in list(zip(samples, samples[1:], samples[2:], strict=False))[::stride]:
        if 0 < after.boot_ns - before.boot_ns <= gap_ns:
            found.append(miss(before, left_out, after))
        else:
            refused += 1
    misses = sorted(one for one, _ in found)
    doubts = [doubt for _, doubt in found]
    return {
        "samples": len(found),
        "refused": refused,
        "median": statistics.median(misses),
        "rms": _rms(misses),
        "p95": misses[int(0.95 * len(misses))],
        "doubt_rms": _rms(doubts),
        "doubt_over_error": _rms(doubts) / _rms(misses),
        "within_2_doubts": sum(one <= 2 * doubt + rounding for one, doubt in found) / len(found),
    }


def _samples(log: File) -> tuple[list[PositionSample], list[AttitudeSample]]:
    """All positions and attitudes of the autopilot, once each."""
    decode = PacketParser()
    positions: list[PositionSample] = []
    attitudes: list[AttitudeSample] = []
    for number, stamp_us, raw in log_reading.read_telemetry(log):
        message = decode(raw)
        if message is None or message.get_srcComponent() != 1:
            continue
        if message.get_type() == "GLOBAL_POSITION_INT" and (place := position(number, stamp_us * 1000, message)):
            positions.append(place)
        elif message.get_type() == "ATTITUDE" and (turned := attitude(number, stamp_us * 1000, message)):
            attitudes.append(turned)
    return positions, attitudes


def _position_miss(before: PositionSample, left_out: PositionSample, after: PositionSample) -> tuple[float, float]:
    found, doubt_m, _ = position_at((before, after), left_out.boot_ns)
    north_m, east_m = metres_per_radian(left_out.latitude_rad, left_out.altitude_msl_m)
    north = (found.latitude_rad - left_out.latitude_rad) * north_m
    east = (found.longitude_rad - left_out.longitude_rad) * east_m
    return math.hypot(north, east), doubt_m


def _attitude_miss(before: AttitudeSample, left_out: AttitudeSample, after: AttitudeSample) -> tuple[float, float]:
    found, doubt_rad = navigation.attitude_at((before, after), left_out.boot_ns)
    return math.degrees(turn_rad(found, left_out.attitude)), math.degrees(doubt_rad)


def _take(called_s: float, rng: random.Random) -> Taken:
    latency_s = rng.gauss(BODY.mean_ms, BODY.sigma_ms) / 1e3
    called_s += rng.uniform(0, 0.5)
    return Taken(called_s, called_s + latency_s + EXPOSURE_S / 2)


def _packets(path: FlightPath, taken: Sequence[Taken], rng: random.Random) -> Iterator[tuple[int, MavlinkMessage]]:
    """(arrival UTC, message): telemetry, TIMESYNC at 5 Hz, a hot-shoe feedback for each frame."""
    boot = BootTime(drift=DRIFT)
    end_s = taken[-1].middle_s + 2
    phase = [rng.uniform(0, 2 * math.pi) for _ in range(2)]

    def delay_s() -> float:
        return max(0.001, rng.gauss(LATENCY_S, JITTER_S))

    for message_id, rate in RATES_HZ.items():
        for step in range(int(end_s * rate)):
            t_s = step / rate
            message = telemetry_message(message_id, path.pose(t_s), boot.ns(t_s), (_utc_ns(t_s)) // 1000)
            if message_id == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
                message = _received(message, t_s, phase)
            if message_id == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
                message.h_acc = round(RECEIVER_SIGMA_M * 1e3)
            yield _utc_ns(t_s + delay_s()), _headed(message)
    for step in range(int(end_s * 5)):
        sent_s = step / 5
        there_s = sent_s + delay_s()
        yield _utc_ns(sent_s), _headed(mavlink.MAVLink_timesync_message(0, _utc_ns(sent_s)), 100)
        answer = mavlink.MAVLink_timesync_message(boot.ns(there_s), _utc_ns(sent_s))
        yield _utc_ns(there_s + delay_s()), _headed(answer)
    for number, one in enumerate(taken):
        contact_s = one.middle_s - EXPOSURE_S / 2 + rng.gauss(0, CONTACT_SIGMA_S)
        message = mavlink.MAVLink_camera_feedback_message(
            boot.ns(contact_s) // 1000, 1, 0, number % 65536, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, number
        )
        yield _utc_ns(contact_s + delay_s()), _headed(message)


def _received(message: MavlinkMessage, t_s: float, phase: Sequence[float]) -> MavlinkMessage:
    """With the receiver's slow error: each axis a sine of one minute, both together RECEIVER_SIGMA_M rms."""
    north_m, east_m = metres_per_radian(math.radians(message.lat / 1e7), message.alt / 1e3)
    for name, metres, shift in (("lat", north_m, phase[0]), ("lon", east_m, phase[1])):
        error_m = RECEIVER_SIGMA_M * math.sin(2 * math.pi * t_s / 61 + shift)
        setattr(message, name, getattr(message, name) + round(math.degrees(error_m / metres) * 1e7))
    return message


def _headed(message: MavlinkMessage, component: int = 1) -> MavlinkMessage:
    message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
    return message


def _utc_ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def _figures(path: FlightPath, rows: Sequence[tuple[Taken, ExposureTime, Pose]]) -> dict[str, float]:
    metres, turns, sigma_m, sigma_rad, late_ms, sigma_ms = [], [], [], [], [], []
    for one, exposure, pose in rows:
        if pose.latitude_rad is None or pose.longitude_rad is None or pose.attitude is None:
            continue
        truth = path.pose(one.middle_s)
        north_m, east_m = metres_per_radian(pose.latitude_rad, truth.altitude_msl_m)
        metres.append(
            math.hypot(
                (pose.latitude_rad - math.radians(truth.latitude_deg)) * north_m,
                (pose.longitude_rad - math.radians(truth.longitude_deg)) * east_m,
            )
        )
        turns.append(math.degrees(turn_rad(pose.attitude, truth.attitude)))
        sigma_m.append(pose.position_sigma_m or 0.0)
        sigma_rad.append(math.degrees(pose.attitude_sigma_rad or 0.0))
        late_ms.append((exposure.utc_ns - _utc_ns(one.middle_s)) / 1e6)
        sigma_ms.append(exposure.sigma_ns / 1e6)
    return {
        "frames": len(metres),
        "time_rms_ms": _rms(late_ms),
        "time_sigma_ms": _rms(sigma_ms),
        "time_sigma_over_error": _rms(sigma_ms) / _rms(late_ms),
        "position_rms_m": _rms(metres),
        "position_sigma_m": _rms(sigma_m),
        "position_sigma_over_error": _rms(sigma_m) / _rms(metres),
        "attitude_rms_deg": _rms(turns),
        "attitude_sigma_deg": _rms(sigma_rad),
        "attitude_sigma_over_error": _rms(sigma_rad) / _rms(turns),
    }


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


if __name__ == "__main__":
    main()
