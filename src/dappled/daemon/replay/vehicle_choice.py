"""Which vehicle of a telemetry log carried the camera: the one that is named, else by evidence, never the first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled.daemon.navigation.samples import NO_VEHICLES, is_impossible
from dappled.drivers.mavlink import PacketParser, mavlink
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import log_reading
from dappled.flight.logs import MAVLINK_2

_MOVED_1E7_DEG = 2000  # some 20 m: a vehicle that stands drifts by less
_OF_A_CAMERA = frozenset({"CAMERA_FEEDBACK", "CAMERA_TRIGGER", "CAMERA_IMAGE_CAPTURED", "CAMERA_INFORMATION"})
_POSITION = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
_READ = frozenset({
    _POSITION, mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_CAMERA_FEEDBACK,
    mavlink.MAVLINK_MSG_ID_CAMERA_TRIGGER, mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED,
    mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,
})  # fmt: skip


class VehicleError(DappledError):
    """The vehicle of a telemetry log isn't certain, or isn't in it; one sentence."""


@dataclass(slots=True)
class _Evidence:
    """What a log tells of one vehicle."""

    first: tuple[int, int] | None = None  # latitude, longitude (1e-7 degrees)
    moved: int = 0
    camera: bool = False


def vehicle_of(log: Path, wanted: int | None) -> tuple[int | None, list[Finding]]:
    """The system id of the vehicle whose telemetry counts, of a .tlog; None where it holds no position. What is to be
    said of a choice among several. Raises VehicleError and FlightError.

    Of several, the one counts that is `wanted`; else the only one that reports a camera; else the only one that moves.
    """
    found = dict(sorted(_evidence(log).items()))
    if wanted is not None:
        if wanted not in found:
            there = f"it holds {_listed(found)}" if found else "it holds no positions"
            raise VehicleError(f"{log} holds no positions of vehicle {wanted}: {there}; check --vehicle")
        return wanted, []
    if len(found) < 2:
        return next(iter(found), None), []
    by_camera = [one for one, evidence in found.items() if evidence.camera]
    moving = [one for one in by_camera or found if found[one].moved > _MOVED_1E7_DEG]
    chosen, by = (by_camera, "camera") if len(by_camera) == 1 else (moving, "movement")
    if len(chosen) != 1:
        raise VehicleError(
            f"{log} holds the telemetry of {_listed(found)}, and nothing in it says which one carried the camera: say "
            "which with --vehicle"
        )
    others = ", ".join(str(one) for one in found if one != chosen[0])
    subject = Subject("log", str(log))
    return chosen[0], [finding(Code.LOG_VEHICLE, subject, vehicle=chosen[0], others=others, by=by)]


def _evidence(log: Path) -> dict[int, _Evidence]:
    """What is known of each vehicle whose autopilot sent a position."""
    found: dict[int, _Evidence] = {}
    cameras, others = set[int](), set[int]()
    parse = PacketParser()
    several = len({system for system, _, number, _ in _headers(log) if number == _POSITION}) > 1
    for system, component, number, raw in _headers(log):
        if number not in _READ or (not several and (number != _POSITION or system in found)):
            continue
        message = parse(raw)  # one with a wrong checksum is none
        if message is None:
            continue
        if number == _POSITION and component == 1 and (message.lat or message.lon) and not is_impossible(message):
            one = found.setdefault(system, _Evidence((message.lat, message.lon)))
            lat, lon = one.first or (message.lat, message.lon)
            one.moved = max(one.moved, abs(message.lat - lat), abs(message.lon - lon))
        elif message.get_type() in _OF_A_CAMERA or (
            number == mavlink.MAVLINK_MSG_ID_HEARTBEAT and message.type == mavlink.MAV_TYPE_CAMERA
        ):
            cameras.add(system)
        elif number == mavlink.MAVLINK_MSG_ID_HEARTBEAT and component == 1 and message.type in NO_VEHICLES:
            others.add(system)
    if len(found.keys() - others) > 0:  # an antenna tracker has a position too
        found = {system: one for system, one in found.items() if system not in others}
    for system, one in found.items():
        one.camera = system in cameras
    return found


def _headers(log: Path) -> Iterator[tuple[int, int, int, bytes]]:
    """(system id, component id, message id, packet) of each packet."""
    for _, _, raw in log_reading.read_telemetry(log):
        if raw[0] == MAVLINK_2:
            yield raw[5], raw[6], int.from_bytes(raw[7:10], "little"), raw
        else:
            yield raw[3], raw[4], raw[5], raw


def _listed(found: dict[int, _Evidence]) -> str:
    *others, last = map(str, found)
    return f"vehicles {', '.join(others)} and {last}" if others else f"vehicle {last}"
