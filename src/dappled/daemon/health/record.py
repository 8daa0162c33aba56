"""Make the health record: the state of camera, links, disk, shots and queues, and the list of what was found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.config.settings import RecordSettings, Settings
from dappled.daemon.body_plan import BodyReport
from dappled.daemon.health import go_no_go
from dappled.daemon.health.standing import ALL_IS_WELL, StandingFindings, in_record
from dappled.daemon.navigation import BootClock, TelemetryCounts
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.overlap import FrameOverlap
from dappled.daemon.pipeline.pipeline import DecodeFailures
from dappled.daemon.pipeline.shutter import ShutterStatistics
from dappled.daemon.pipeline.spacing import SpacingStatistics
from dappled.daemon.pipeline.verdicts import STATES, VerdictCounts
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import PublisherStatistics
from dappled.daemon.vehicle_battery import VehicleBattery
from dappled.decode.geometry import Pose
from dappled.drivers.mavlink import LinkStatistics
from dappled.findings import Code, Finding, Level, Subject, above_note, finding, told
from dappled.flight import FlightError, layout
from dappled.workers import Statistics

SILENT_NS = 5 * 10**9
_RECEIVER_MS = 5000.0


@dataclass(frozen=True, slots=True)
class DecodingState:
    """Whether frames are decoded in flight, what could not be decoded, why the calibration can't be used (None where
    it can), and how the decoded frames were judged."""

    running: bool = False
    failures: DecodeFailures = field(default_factory=DecodeFailures)
    misfit: Finding | None = None
    verdicts: VerdictCounts = field(default_factory=VerdictCounts)

    def findings(self) -> list[Finding]:
        """What was found. Where the calibration can't be used, that none could be decoded says nothing more."""
        failures = self.failures.findings() if self.misfit is None else [self.misfit]
        return [*failures, *self.failures.found, *self.verdicts.findings()]

    def judged(self) -> dict[str, Any]:
        """The verdicts, as JSON values."""
        counts = self.verdicts
        last = [
            {"frame": frame, "state": state, "reasons": codec.plain(reasons)} for frame, state, reasons in counts.last
        ]
        return {
            **{state: counts.by_state.get(state, 0) for state in STATES},
            "bad_in_a_row": counts.bad_in_a_row,
            "last": last,
        }


@dataclass(frozen=True, slots=True)
class ServiceTime:
    """When a record is made, whether UTC is known, and since when the links are listened to."""

    utc_ns: int
    monotonic_ns: int
    began_monotonic_ns: int
    utc_known: bool = True


@dataclass(frozen=True, slots=True)
class ShootingState:
    """Camera and shots. `lost` counts the autopilot's triggers that became no request. `series` are photographs by
    distance, None while none run; `body` is how the camera's settings stand to the plan, None while no camera is ready.
    `parameters` are the settings of body and decoder, `overlap` is that of the last two photographs of a series."""

    shots: PendingShots
    shutter: ShutterStatistics
    lost: int = 0
    series: SpacingStatistics | None = None
    body: BodyReport | None = None
    parameters: Sequence[Mapping[str, Any]] = ()
    overlap: FrameOverlap | None = None

    def facts(self) -> dict[str, Any]:
        """The values, as JSON has them."""
        shutter = self.shutter
        return {
            "camera": {"state": self.shots.state, "reason": self.shots.reason},
            "body": None if self.body is None else self.body.values(),
            "shots": {
                "wished": shutter.shots,
                "safe": shutter.succeeded,
                "failed": shutter.failed,
                "pending": shutter.pending,
                "refused": shutter.refused,
                "lost": self.lost,
            },
            "interval_s": shutter.interval_s,
            "interval": _interval(shutter, self.series),
            "overlap": codec.plain(self.overlap),
            "settings": list(self.parameters),
        }


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Links, and what came over them. `clock` relates the autopilot's time to UTC, `pose` is the vehicle's, `battery`
    its battery: None where it isn't known."""

    links: Sequence[LinkStatistics]
    telemetry: TelemetryCounts
    clock: BootClock | None = None
    pose: Pose | None = None
    battery: VehicleBattery | None = None

    @property
    def fresh(self) -> bool:
        """Whether the vehicle's position was heard a short time ago."""
        return self.pose is not None and self.pose.age_ms is not None and self.pose.age_ms * 1e6 < SILENT_NS

    def facts(self) -> dict[str, Any]:
        """The values but the links', as JSON has them."""
        clock, pose = self.clock, self.pose
        return {
            "clock": None if clock is None else {"source": clock.source, "sigma_ms": clock.sigma_ns / 1e6},
            "gnss": None if pose is None else _receiver(pose),
            "vehicle_battery": codec.plain(self.battery),
            "vehicle": None if pose is None or pose.latitude_rad is None else _place(pose),
        }


@dataclass(frozen=True, slots=True)
class KeepingState:
    """Where frames go: the flight's folder, the queues behind it, the stream. `frame_bytes` is the mean size of this
    flight's frames, None before the first."""

    folder: Path
    stages: Sequence[Statistics]
    publisher: PublisherStatistics
    frame_bytes: float | None = None


@dataclass(frozen=True, slots=True)
class ServiceState:
    """All that a health record is made of. `dead_threads` have ended without being asked to; `found` are the findings
    of other parts."""

    settings: Settings
    time: ServiceTime
    shooting: ShootingState
    vehicle: VehicleState
    keeping: KeepingState
    decoding: DecodingState
    dead_threads: Sequence[str] = ()
    found: Sequence[Finding] = ()


def record(of: ServiceState, standing: StandingFindings | None = None) -> dict[str, Any]:
    """The header of a `health` message. Its `findings` are the one list of the service, worst first, then newest;
    `standing` knows since when each stands.
    """
    settings, time, shooting, vehicle = of.settings, of.time, of.shooting, of.vehicle
    keeping, decoding = of.keeping, of.decoding
    link, silences = _link(settings, vehicle, time)
    disk, shortages = _disk(settings.record, keeping.folder)
    facts = {
        "utc_ns": time.utc_ns,
        "utc_known": time.utc_known,
        **shooting.facts(),
        "link": link,
        **vehicle.facts(),
        "disk": disk,
        "stages": [*codec.plain(list(keeping.stages)), _publish(keeping.publisher)],
        "min_free_bytes": settings.record.min_free_mb * 1_000_000,
        "frame_bytes": keeping.frame_bytes,
        "decode": {
            "mask": settings.mask.profile,
            "calibration": settings.decode.calibration,
            "running": decoding.running,
            "failed": decoding.failures.count,
            "failed_in_a_row": decoding.failures.in_a_row,
            "judged": decoding.judged(),
        },
    }
    missing, series, body = shooting.shots.without_camera(), shooting.series, shooting.body
    deaf = vehicle.fresh and settings.pose.on_gimbal and vehicle.pose is not None and not vehicle.pose.gimbal_attitude
    now = [
        *(finding(Code.THREAD_ENDED, Subject("thread", name)) for name in of.dead_threads),
        *([] if missing is None else [missing]),
        *silences,
        *of.found,
        *([] if series is None or series.trouble is None else [series.trouble]),
        *([] if body is None else body.findings()),
        *([finding(Code.GIMBAL_UNHEARD, Subject("vehicle"))] if deaf else []),
        *shortages,
        *go_no_go.judge(facts),
        *decoding.findings(),
    ]
    opened = (standing or StandingFindings()).refresh(now, time.monotonic_ns)
    return facts | {"findings": [one.to_json(time.monotonic_ns) for one in opened]}


def _silence(link: LinkStatistics, *, heard: bool, fresh: bool, level: Level) -> Finding | None:
    """What is wrong with a silent link. None for one on which nobody was heard yet, where the vehicle was `heard` on
    another, and for any one while the vehicle's position is `fresh`: a ground station is not there, or has left;
    nothing is lost, and the counters show it."""
    about, signing = Subject("link", link.url), link.signing
    if link.error:
        return finding(Code.LINK_DOWN, about, level, why=link.error)
    if signing is not None and signing.refused > 0:
        facts = {"unsigned": signing.unsigned_refused, "forged": signing.forged, "replayed": signing.replayed}
        return Finding(Code.LINK_REFUSED, about, facts, level)
    if fresh or (heard and link.last_heard_monotonic_ns is None):
        return None
    return finding(Code.LINK_SILENT, about, level)


def _link(settings: Settings, vehicle: VehicleState, time: ServiceTime) -> tuple[dict[str, Any], list[Finding]]:
    """The state of the links, and a finding for each that should be heard: a stop where all of them are silent."""
    links, telemetry = vehicle.links, vehicle.telemetry
    silent = [
        link
        for link in links
        if link.error or time.monotonic_ns - (link.last_heard_monotonic_ns or time.began_monotonic_ns) > SILENT_NS
    ]
    heard = telemetry.positions > 0
    level = Level.STOP if len(silent) == len(links) else Level.CAUTION
    found = [one for link in silent if (one := _silence(link, heard=heard, fresh=vehicle.fresh, level=level))]
    facts = {
        "urls": len(links),
        "silent": len(silent),
        "packets": telemetry.packets,
        "positions": telemetry.positions,
        "impossible": telemetry.impossible,
        "jumps": telemetry.jumps,
        "each": [_counters(link, time.monotonic_ns) for link in links],
    }
    return facts, found if settings.mavlink.url else [finding(Code.LINK_NONE, Subject("service")), *found]


def _disk(record: RecordSettings, folder: Path) -> tuple[dict[str, Any], list[Finding]]:
    """What the disk has left, None where that is unknown; and a finding where it is full, or will be."""
    facts: dict[str, Any] = {"free_bytes": None, "free_files": None, "folder": str(folder)}
    try:
        space = layout.disk_space(folder)
    except FlightError as error:
        return facts, [finding(Code.DISK_UNREADABLE, Subject("disk"), why=error)]
    facts |= {"free_bytes": space.available, "free_files": space.files}
    if (short := space.shortage(record.min_free_mb)) is not None:
        return facts, [short]
    if space.available >= record.warn_free_mb * 1_000_000:
        return facts, []
    sizes = {"left_mb": space.available // 10**6, "least_mb": record.min_free_mb}
    return facts, [Finding(Code.DISK_FILLING, Subject("disk"), sizes, Level.CAUTION)]


def _interval(shutter: ShutterStatistics, series: SpacingStatistics | None) -> dict[str, Any] | None:
    """How far an interval has got, or photographs by distance; None while neither runs."""
    if shutter.interval_s is None and series is not None:
        counts = {"taken": series.taken, "refused": series.refused, "began_ms": series.began_ns // 10**6}
        return {**counts, "count": None, "next_s": None, "distance_m": series.spacing_m}
    if shutter.interval_s is None:
        return None
    counts = {"taken": shutter.interval_taken, "refused": shutter.interval_refused}
    counts["began_ms"] = shutter.interval_began_ns // 10**6
    return {**counts, "count": shutter.interval_count, "next_s": shutter.interval_next_s}


def _counters(link: LinkStatistics, now_ns: int) -> dict[str, Any]:
    """The counters of a link, and how long ago something was heard on it; None: never."""
    heard_ns = link.last_heard_monotonic_ns
    return {
        "url": link.url,
        "age_s": None if heard_ns is None else (now_ns - heard_ns) / 1e9,
        "in": link.packets_in,
        "out": link.packets_out,
        "bad": link.packets_bad,
        "unsent": link.packets_unsent,
        "unlogged": link.packets_unlogged,
        "unrecorded": link.packets_unrecorded,
        "signing": codec.plain(link.signing),
    }


def _publish(publisher: PublisherStatistics) -> dict[str, Any]:
    """Its counters; what waits is told by the other stages alone, whose work it is."""
    return {"name": "publish"} | {name: value for name, value in codec.plain(publisher).items() if name != "waiting"}


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


def four_numbers(shots: Mapping[str, int]) -> dict[str, int]:
    """What became of all requests so far: taken are those that have, or will have, a photograph."""
    return {
        "taken": shots["wished"] - shots["failed"],
        "on disk": shots["safe"],
        "refused": shots["refused"],
        "lost": shots["failed"] + shots["lost"],
    }


def line(health: Mapping[str, Any]) -> str:
    """A health record in one line, for `systemctl status`."""
    shots, found = health["shots"], above_note(in_record(health))
    counts = f"camera {health['camera']['state']}, {shots['safe']} of {shots['wished']} frames safe"
    return f"{counts}; {'; '.join(str(told(one)) for one in found) or ALL_IS_WELL}"
