"""Make the health record: the state of camera, links, disk, shots and queues, with a sentence for each problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dappled import findings
from dappled.config.settings import RecordSettings, Settings
from dappled.daemon.body_plan import BodyReport
from dappled.daemon.health.go_no_go import FAILING
from dappled.daemon.navigation import BootClock, TelemetryStatistics
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.pipeline import DecodeFailures
from dappled.daemon.pipeline.shutter import ShutterStatistics
from dappled.daemon.pipeline.spacing import SpacingStatistics
from dappled.daemon.pipeline.verdicts import STATES, VerdictCounts
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import PublisherStatistics
from dappled.daemon.vehicle_battery import VehicleBattery
from dappled.decode.geometry import Pose
from dappled.drivers.mavlink import LinkStatistics
from dappled.errors import counted
from dappled.flight import FlightError, layout
from dappled.workers import Statistics

SILENT_NS = 5 * 10**9
_RECEIVER_MS = 5000.0
_NO_LINK = "no MAVLink link is configured: frames are tagged without poses"
_NO_MASK = "no mask is configured: frames are kept, not decoded (set mask.profile)"
_NO_GIMBAL = (
    "no gimbal's attitude arrives (GIMBAL_DEVICE_ATTITUDE_STATUS, MOUNT_ORIENTATION), and the camera is on one "
    "(pose.on_gimbal): frames are tagged without the direction of view"
)
_NO_UTC = "UTC is not known yet: all time stamps will be corrected when the autopilot gets it from its satellites"


@dataclass(frozen=True, slots=True)
class DecodingState:
    """Whether frames are decoded in flight, what could not be decoded, why the calibration can't be used ("" where
    it can), and how the decoded frames were judged."""

    running: bool = False
    failures: DecodeFailures = field(default_factory=DecodeFailures)
    misfit: str = ""
    verdicts: VerdictCounts = field(default_factory=VerdictCounts)

    def problems(self, now_ns: int) -> list[str]:
        """What is wrong, a sentence each. Time is monotonic."""
        failed = self.failures
        found = [f"frames can't be decoded: {self.misfit}"] if self.misfit else []
        if failed.in_a_row >= FAILING:
            found.append(f"decoding fails: the last {_frames(failed.in_a_row)} are kept, not decoded: {failed.reason}")
        elif failed.count:
            found.append(f"decoding failed: {_frames(failed.count)} kept, not decoded: {failed.reason}")
        judged = (self.verdicts.problem(now_ns), self.verdicts.drifted(now_ns))
        return [*found, *(one for one in judged if one is not None)]

    def judged(self) -> dict[str, Any]:
        """The verdicts, as JSON values."""
        counts = self.verdicts
        last = [
            {"frame": frame, "state": state, "reasons": findings.to_rows(reasons)}
            for frame, state, reasons in counts.last
        ]
        return {
            **{state: counts.by_state.get(state, 0) for state in STATES},
            "bad_in_a_row": counts.bad_in_a_row,
            "last": last,
        }


def record(
    settings: Settings,
    *,
    utc_ns: int,
    monotonic_ns: int,
    began_monotonic_ns: int,
    shots: PendingShots,
    stages: Sequence[Statistics],
    shutter: ShutterStatistics,
    links: Sequence[LinkStatistics],
    telemetry: TelemetryStatistics,
    publisher: PublisherStatistics,
    folder: Path,
    clock: BootClock | None = None,
    vehicle: Pose | None = None,
    decoding: DecodingState | None = None,
    utc_known: bool = True,
    dead_threads: Sequence[str] = (),
    doubts: Sequence[str] = (),
    parameters: Sequence[Mapping[str, Any]] = (),
    frame_bytes: float | None = None,
    body: BodyReport | None = None,
    series: SpacingStatistics | None = None,
    battery: VehicleBattery | None = None,
) -> dict[str, Any]:
    """The header of a `health` message. Its `problems` are sentences, none when all is well.

    `doubts` are further problems, found by other parts. `dead_threads` have ended without being asked to. `parameters`
    are the settings of body and decoder; `frame_bytes` is the mean size of this flight's frames, None before the first.
    `body` is how the camera's settings stand to the plan; None where nothing is compared. `series` are photographs by
    distance, while they run. `battery` is the vehicle's; None while the autopilot doesn't report it.
    """
    decoding = decoding or DecodingState()
    fresh = vehicle is not None and vehicle.age_ms is not None and vehicle.age_ms * 1e6 < SILENT_NS
    link, silences = _link(settings, links, telemetry, monotonic_ns, began_monotonic_ns, fresh=fresh)
    disk, shortages = _disk(settings.record, folder)
    problems = [
        *(f"the {name} thread has ended: restart dappled" for name in dead_threads),
        *([] if shots.state == "starting" or (gone := shots.without_camera()) is None else [findings.text(gone)]),
        *silences,
        *doubts,
        *([] if series is None or series.problem is None else [series.problem]),
        *([] if body is None else body.problems()),
        *([_NO_GIMBAL] if fresh and settings.pose.on_gimbal and vehicle and not vehicle.gimbal_attitude else []),
        *([] if utc_known else [_NO_UTC]),
        *shortages,
        *([] if settings.mask.profile else [_NO_MASK]),
        *decoding.problems(monotonic_ns),
        *(f"{one.name} fell behind by {_frames(one.dropped)}, kept in the record" for one in stages if one.dropped),
    ]
    return {
        "utc_ns": utc_ns,
        "camera": {"state": shots.state, "reason": shots.reason},
        "body": None if body is None else body.values(),
        "link": link,
        "disk": disk,
        "shots": {
            "wished": shutter.shots,
            "safe": shutter.succeeded,
            "failed": shutter.failed,
            "pending": shutter.pending,
            "refused": shutter.refused,
        },
        "stages": [*(asdict(one) for one in stages), _publish(publisher)],
        "problems": problems,
        "dead": list(dead_threads),
        "utc_known": utc_known,
        "interval_s": shutter.interval_s,
        "interval": _interval(shutter, series),
        "clock": None if clock is None else {"source": clock.source, "sigma_ms": clock.sigma_ns / 1e6},
        "gnss": None if vehicle is None else _receiver(vehicle),
        "vehicle_battery": None if battery is None else asdict(battery),
        "vehicle": None if vehicle is None or vehicle.latitude_rad is None else _place(vehicle),
        "decode": {
            "mask": settings.mask.profile,
            "calibration": settings.decode.calibration,
            "running": decoding.running,
            "failed": decoding.failures.count,
            "failed_in_a_row": decoding.failures.in_a_row,
            "failure": decoding.failures.reason,
            "misfit": decoding.misfit,
            "doubt": decoding.failures.doubt,
            "judged": decoding.judged(),
        },
        "min_free_bytes": settings.record.min_free_mb * 1_000_000,
        "frame_bytes": frame_bytes,
        "settings": list(parameters),
    }


def _link_problem(link: LinkStatistics, *, heard: bool, fresh: bool) -> str | None:
    """What is wrong with a silent link. None for one on which nobody was heard yet, where the vehicle was `heard` on
    another, and for any one while the vehicle's position is `fresh`: a ground station is not there, or has left;
    nothing is lost, and go/no-go and the counters show it."""
    if link.error:
        return link.error
    if (fresh or (heard and link.last_heard_monotonic_ns is None)) and not _refused(link):
        return None
    return f"MAVLink link {link.url}: {_silence(link)}"


def _refused(link: LinkStatistics) -> bool:
    """Whether packets came that signing refused."""
    return link.signing is not None and link.signing.refused > 0


def _link(
    settings: Settings,
    links: Sequence[LinkStatistics],
    telemetry: TelemetryStatistics,
    monotonic_ns: int,
    began_monotonic_ns: int,
    *,
    fresh: bool,
) -> tuple[dict[str, Any], list[str]]:
    """The state of the links, and a problem for each that should be heard."""
    silent = [
        link
        for link in links
        if link.error or monotonic_ns - (link.last_heard_monotonic_ns or began_monotonic_ns) > SILENT_NS
    ]
    heard = telemetry.positions > 0
    problems = [text for link in silent if (text := _link_problem(link, heard=heard, fresh=fresh))]
    facts = {
        "urls": len(links),
        "silent": len(silent),
        "packets": telemetry.packets,
        "positions": telemetry.positions,
        "impossible": telemetry.impossible,
        "jumps": telemetry.jumps,
        "each": [_counters(link) for link in links],
    }
    return facts, problems if settings.mavlink.url else [_NO_LINK, *problems]


def _disk(record: RecordSettings, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """What the disk has left, None where that is unknown; and a problem where it is full, or will be."""
    facts: dict[str, Any] = {"free_bytes": None, "free_files": None, "folder": str(folder)}
    try:
        space = layout.disk_space(folder)
    except FlightError as error:
        return facts, [f"{error}; new shots are refused"]
    facts |= {"free_bytes": space.available, "free_files": space.files}
    if (short := space.shortage(record.min_free_mb)) is not None:
        return facts, [f"{findings.text(short)}; new shots are refused"]
    if space.available >= record.warn_free_mb * 1_000_000:
        return facts, []
    left = f"{space.available // 10**6} MB left"
    return facts, [f"the disk is filling up: {left}; shots are refused below {record.min_free_mb} MB"]


def _interval(shutter: ShutterStatistics, series: SpacingStatistics | None) -> dict[str, Any] | None:
    """How far an interval has got, or photographs by distance; None while neither runs."""
    if shutter.interval_s is None and series is not None:
        return {"taken": series.taken, "count": None, "next_s": None, "distance_m": series.spacing_m}
    if shutter.interval_s is None:
        return None
    return {"taken": shutter.interval_taken, "count": shutter.interval_count, "next_s": shutter.interval_next_s}


def _silence(link: LinkStatistics) -> str:
    """Why a link is not usable, as far as this end knows."""
    signing = link.signing
    if signing is None or not _refused(link):
        return "nothing was heard for 5 s"
    return (
        f"nothing with a valid signature was heard for 5 s ({counted(signing.unsigned_refused, 'packet')} unsigned, "
        f"{signing.forged} forged, {signing.replayed} too old); give both ends the same key"
    )


def _frames(count: int) -> str:
    return counted(count, "frame")


def _counters(link: LinkStatistics) -> dict[str, Any]:
    """The counters of a link."""
    return {
        "url": link.url,
        "in": link.packets_in,
        "out": link.packets_out,
        "bad": link.packets_bad,
        "unsent": link.packets_unsent,
        "unlogged": link.packets_unlogged,
        "unrecorded": link.packets_unrecorded,
        "signing": None if link.signing is None else asdict(link.signing),
    }


def _publish(publisher: PublisherStatistics) -> dict[str, Any]:
    return {
        "name": "publish",
        "sent": dict(publisher.sent),
        "dropped": dict(publisher.dropped),
        "questions": publisher.questions,
        "refused": publisher.refused,
        "wrong_keys": publisher.wrong_keys,
    }


def _place(pose: Pose) -> dict[str, float | None]:
    """The vehicle's position, for a map."""
    speed = pose.velocity_ned_m_s
    return {
        "latitude_deg": wire.degrees(pose.latitude_rad),
        "longitude_deg": wire.degrees(pose.longitude_rad),
        "altitude_msl_m": pose.altitude_msl_m,
        "height_above_home_m": pose.height_above_home_m,
        "yaw_deg": wire.degrees(wire.euler(pose.attitude)[2]) if pose.attitude else None,
        "speed_m_s": math.hypot(*speed) if speed else None,
        "position_sigma_m": pose.position_sigma_m,
        "age_ms": pose.age_ms,
    }


def _receiver(vehicle: Pose) -> dict[str, Any] | None:
    """The satellite receiver's last report; None where there is none, or it is old."""
    gnss = vehicle.gnss
    if gnss is None or gnss.age_ms > _RECEIVER_MS:
        return None
    return {"fix_type": gnss.fix_type, "satellites": gnss.satellites}


def line(health: Mapping[str, Any]) -> str:
    """A health record in one line, for `systemctl status`."""
    shots, problems = health["shots"], health["problems"]
    counts = f"camera {health['camera']['state']}, {shots['safe']} of {shots['wished']} frames safe"
    return f"{counts}; {'; '.join(problems)}" if problems else f"{counts}; all is well"
