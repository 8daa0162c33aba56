"""One cell of the matrix of `autopilots.py`: a vehicle with one wiring and one fault, and the daemon's own parts.

Component, shutter, telemetry and clocks are the daemon's; its clock is injected, its link is a list of events in the
order of time. Autopilot, body, link and ground station are simulated. The autopilot's errors are smooth over seconds,
as real ones are, and drawn anew for each burst of shots; the daemon is not told how large they are, except by what
real autopilots send (GPS_RAW_INT, and PX4 ODOMETRY).
"""

from __future__ import annotations

import gc
import heapq
import itertools
import math
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

from autopilot_daemon import EXPOSURE_S, LATENCY_MS, LATENCY_SIGMA_MS, START_NS, Daemon
from tests.simulated.personality import CameraPort, CameraTriggers
from tests.simulated.vehicle import heartbeat

from dappled.config.settings import PoseSettings
from dappled.daemon.navigation import ExposureTime
from dappled.decode.geometry import Pose, Vector3, metres_per_radian, multiply, turn_rad
from dappled.drivers.mavlink import MavlinkMessage, mavlink, pack
from dappled.flight import Shot
from dappled.mocks.autopilot.autopilot import BootTime, telemetry_message
from dappled.mocks.autopilot.path import FlightPath, TruePose

GPS_MINUS_UTC_US = 370_000  # this machine's clock is so much behind the satellites'
PATH = FlightPath(3, speed_m_s=10.0, radius_m=60.0)
ATTITUDE_SIGMA_RAD = math.radians(0.56)  # of the whole turn, as flown in software in the loop
ACROSS_M, UPRIGHT_M = 0.020, 0.030  # as `telemetry_message` reports them
CONTACT_SIGMA_MS = 1.0
WARM_UP_S, LEAD_S, REST_S = 12.0, 0.5, 0.9
LINK_S, SPREAD_S = 0.002, 0.001
STEP_S = 0.2
FILES_S = 2.2  # where files are late: a USB download, in which later shots are fired
GLITCH_M = 33.0
BUSY_NS = 150_000_000  # the next photograph can't be begun sooner: several requests come at once where a link held them
SILENCE_S = 11.0  # longer than the answers of the autopilot that are compared
DEAD_S = 0.5, 12.0  # how long an autopilot that has crashed is silent
BLIND_S = 10.0  # from then on it has neither a place nor UTC
NUMBERS_NS = 3 * 10**9  # so long a missing number is waited for
DOWN_S = 1.0, 6.0  # until the daemon is back after a crash
WAIT_NS = round(PoseSettings().wait_ms * 1e6)
VEHICLE = (1, 1)
STATIONS = ((255, 190), (254, 190))
WIRINGS: dict[str, tuple[str, tuple[CameraPort, ...], int]] = {  # personality, cameras, which of them is ours
    "ArduPilot, CAM1_TYPE 6": ("ardupilot", (CameraPort("mavlink"),), 0),
    "ArduPilot, CAM1_TYPE 6, pin": ("ardupilot", (CameraPort("mavlink", pin=True),), 0),
    "ArduPilot, CAM1_TYPE 5": ("ardupilot", (CameraPort("broadcast"),), 0),
    "ArduPilot, servo": ("ardupilot", (CameraPort("wire"),), 0),
    "ArduPilot, servo, pin": ("ardupilot", (CameraPort("wire", pin=True),), 0),
    "ArduPilot, CAM2 of two, servo, pin": ("ardupilot", (CameraPort("wire", pin=True),) * 2, 1),
    "PX4, TRIG_INTERFACE 3": ("px4", (CameraPort("mavlink"),), 0),
    "PX4, TRIG_INTERFACE 1": ("px4", (CameraPort("wire"),), 0),
}
FAULTS = (
    "none", "one packet of ten lost", "link down", "every packet twice", "two ports", "late packets", "clock steps",
    "clock 2 % fast", "reboots", "no satellites", "pin wraps", "contacts lost", "contacts doubled",
    "stations broadcast", "forged messages", "late files, clock steps", "silence, clock steps",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """One wiring, one fault or several (", " between), shots at one rate."""

    wiring: str
    fault: str
    hz: float

    @property
    def faults(self) -> frozenset[str]:
        """Each of its faults."""
        return frozenset(self.fault.split(", "))


@dataclass(frozen=True, slots=True)
class Tagged:
    """One frame: errors against the truth in σ; None where σ is unknown. `axes`: north, east, down, by the covariance.
    `doubt`: the tag names one."""

    time: float
    time_ms: float
    across: float | None
    upright: float | None
    attitude: float | None
    doubt: bool
    source: str
    axes: tuple[float, ...] = ()


@dataclass(slots=True)
class Outcome:
    """What a cell gave. `heard` are triggers and requests of which the camera got at least one message; `missed` those
    of which it got none because there was no daemon, `unfinished` shots that a crash left without a tag."""

    requests: int = 0
    heard: int = 0
    shots: int = 0
    files: int = 0
    triggers: int = 0
    named: int = 0
    refused: int = 0
    missed: int = 0
    unfinished: int = 0
    tags: list[Tagged] = field(default_factory=list)


@cache
def sampled(step: int) -> TruePose:
    """The truth at the times of telemetry, the same for all cells."""
    return PATH.pose(step * STEP_S)


class _Slow:
    """Three errors of 1 σ together `sigma`, each smooth: its correlation over Δt is cos(Δt/τ)."""

    def __init__(self, sigmas: Vector3, tau_s: float, rng: random.Random) -> None:
        self._parts = [(rng.gauss(0, sigma), rng.gauss(0, sigma)) for sigma in sigmas]
        self._tau_s = tau_s

    def at(self, t_s: float) -> Vector3:
        sine, cosine = math.sin(t_s / self._tau_s), math.cos(t_s / self._tau_s)
        x, y, z = (a * cosine + b * sine for a, b in self._parts)
        return x, y, z


class World:
    """Everything around the daemon, and the order of events."""

    def __init__(self, cell: Cell, bursts: int, seed: int) -> None:
        self.cell, self.rng = cell, random.Random(f"{cell}{seed}")  # noqa: S311  a simulation
        personality, self.cameras, self.own = WIRINGS[cell.wiring]
        self.outside = self.cameras[self.own].wiring == "wire"
        self.triggers = CameraTriggers(personality, self.cameras)
        self.found = Outcome()
        self.daemon = self._started(None)
        self.of_burst = {0.2: 1, 1.0: 2, 5.0: 3}[cell.hz]
        self.faults = cell.faults
        self.lead_s = LEAD_S + (SILENCE_S if "silence" in self.faults else 0.0)
        self.files_s = FILES_S if "late files" in self.faults else 0.0
        self.burst_s = self.lead_s + (self.of_burst - 1) / cell.hz + max(REST_S, 1 / cell.hz)
        self.bursts = bursts
        self.end_s = WARM_UP_S + bursts * self.burst_s + 4
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._packers = {
            (who, link): mavlink.MAVLink(None, *who) for who in (VEHICLE, *STATIONS, (7, 1)) for link in (0, 1)
        }
        self._truth: dict[tuple[int, int], int] = {}  # (boot, shot or number): mid-exposure, UTC
        self._pending: list[tuple[Shot, ExposureTime, int]] = []
        self._heard: set[tuple[int, int]] = set()
        self._stamps: set[int] = set()
        self._boots = self._requests = 0
        self._down: list[tuple[int, int]] = []
        self._dead: list[tuple[int, int]] = []  # when the autopilot does nothing
        self._deaf: list[tuple[int, int]] = []  # when there is no daemon
        self._gone: list[Daemon] = []  # which have crashed
        self._unheard: set[tuple[int, int]] = set()  # triggers that no daemon may have heard of
        self._blind_ns = 0  # until when the autopilot knows no place
        self._held: list[tuple[int, int]] = []
        self._free_ns = 0
        self.glitch_s = math.inf, math.inf
        self._now_ns = START_NS
        self._plan()

    def _started(self, before: Daemon | None) -> Daemon:
        """A daemon, perhaps the next one after a crash."""
        return Daemon(outside=self.outside, camera=self.own, send=self._asked_time, fired=self._fired, before=before)

    # time

    def _plan(self) -> None:
        rng, cell, faults = self.rng, self.cell, self.faults
        starts = [WARM_UP_S + burst * self.burst_s for burst in range(self.bursts)]
        places, turns = (ACROSS_M / 2**0.5, ACROSS_M / 2**0.5, UPRIGHT_M), (ATTITUDE_SIGMA_RAD / 3**0.5,) * 3
        self._slow = [(_Slow(places, 20.0, rng), _Slow(turns, 3.0, rng)) for _ in range(self.bursts + 2)]
        jumps: list[tuple[float, float]] = []
        near: set[int] = set()
        offset_s, drift = 41.7, 30e-6
        if "pin wraps" in faults:
            offset_s = 2**32 / 1e6 - WARM_UP_S - self.bursts * self.burst_s / 2
        if "clock 2 % fast" in faults:
            drift = 0.02
        for burst, at_s in enumerate(starts):
            shots_s = [at_s + self.lead_s + i / cell.hz + rng.uniform(0, 0.05) for i in range(self.of_burst)]
            for t_s in shots_s:
                self._at(t_s, self._act)
                near.update(range(round(t_s / STEP_S) - 2, round(t_s / STEP_S) + 6))
            edge = burst in (0, self.bursts - 1)
            jumps += self._steps(burst, at_s, shots_s)
            if "glitch" in faults and burst == self.bursts // 3:
                self.glitch_s = at_s, at_s + rng.uniform(5.0, 40.0)
            if "link holds" in faults and burst % 4 == 1 and not edge:
                held_s = shots_s[0] - rng.uniform(0.0, 0.5)
                self._held.append((_utc_ns(held_s), _utc_ns(held_s + rng.uniform(0.5, 3.5))))
            if "reboots" in faults and burst % 40 == min(20, self.bursts // 2):
                boot_s = offset_s + at_s + 0.2
                jumps.append((at_s + 0.2, 3.0 - boot_s - sum(by for _, by in jumps)))
                self._at(at_s + 0.2, self._reboot)
            jumps += self._crashes(burst, at_s, BootTime(offset_s, drift, tuple(jumps)))
            if "link down" in faults and burst % 5 == 2 and not edge:
                lost_s = rng.choice(shots_s)
                self._down.append((_utc_ns(lost_s - 0.05), _utc_ns(lost_s + 0.12)))
        self.boot = BootTime(offset_s, drift, tuple(jumps))
        for step in range(round(self.end_s / STEP_S)):
            if step % 5 == 0 or step in near:  # no pose is made of what is left out
                self._at(step * STEP_S, self._sampler(step))
            self._at(step * STEP_S + 0.05, self._tick)
        if "forged messages" in faults:
            for step in range(round(WARM_UP_S), round(self.end_s)):
                self._at(step + 0.33, self._forge)

    def _steps(self, burst: int, at_s: float, shots_s: Sequence[float]) -> Iterator[tuple[float, float]]:
        """The steps of the clock in one burst, (when, seconds gained); with its silence, which ends just before the
        first trigger."""
        rng, silent = self.rng, "silence" in self.faults
        if "clock steps" in self.faults and burst % 3 == 1:
            step_s = at_s + rng.uniform(1, SILENCE_S - 1) if silent else shots_s[-1] + rng.uniform(-0.3, 0.3)
            yield step_s, rng.choice((-1, 1)) * rng.uniform(0.12, 0.4)
        if silent:
            self._down.append((_utc_ns(at_s), _utc_ns(shots_s[0] - rng.uniform(0.05, 0.8))))

    def _crashes(self, burst: int, at_s: float, boot: BootTime) -> Iterator[tuple[float, float]]:
        """The crashes of one burst; the step of the clock where the autopilot starts again."""
        if "autopilot crashes" in self.faults and burst == self.bursts // 2:
            back_s = at_s + 0.2 + self.rng.uniform(*DEAD_S)
            self._dead.append((_utc_ns(at_s + 0.2), _utc_ns(back_s)))
            self._blind_ns = _utc_ns(back_s + BLIND_S)
            self._at(back_s, self._reboot)
            yield back_s, self.rng.uniform(0.5, 3.0) - boot.ns(back_s) / 1e9
        if "daemon crashes" in self.faults and burst == self.bursts * 3 // 4:
            crash_s = self.rng.uniform(at_s, at_s + self.burst_s)
            back_s = crash_s + self.rng.uniform(*DOWN_S)
            self._deaf.append((_utc_ns(crash_s), _utc_ns(back_s)))
            self._at(crash_s, self._crash)
            self._at(back_s, self._restart)

    def _at(self, t_s: float, do: Callable[[], None]) -> None:
        heapq.heappush(self._events, (_utc_ns(t_s), next(self._order), do))

    @property
    def now_s(self) -> float:
        return (self._now_ns - START_NS) / 1e9

    def run(self) -> Outcome:
        """Fly to the end."""
        self._now_ns = START_NS
        self._heartbeat()
        while self._events:
            self._now_ns, _, do = heapq.heappop(self._events)
            self.daemon.clock.advance_to(self._now_ns)
            do()
        assert not self._pending
        self._gone.append(self.daemon)
        shots = [one.shutter.statistics() for one in self._gone]
        self.found.shots, self.found.refused = sum(one.shots for one in shots), sum(one.refused for one in shots)
        self.found.named = sum(one.named for one in self._gone)
        self.found.missed = len(self._unheard - self._heard)
        self.found.requests, self.found.heard = self._requests, len(self._heard)
        return self.found

    def _heartbeat(self) -> None:
        self._deliver([heartbeat(armed=False, personality=self.triggers.personality)], sure=True)

    def _boot_us(self, t_s: float | None = None) -> int:
        return self.boot.ns(self.now_s if t_s is None else t_s) // 1000

    @property
    def _blind(self) -> bool:
        return bool(self._dead) and self._dead[0][1] <= self._now_ns < self._blind_ns

    def _unix_us(self) -> int:
        return 0 if "no satellites" in self.faults or self._blind else self._now_ns // 1000 + GPS_MINUS_UTC_US

    # the link

    def _deliver(
        self,
        messages: Iterable[MavlinkMessage],
        who: tuple[int, int] = VEHICLE,
        *,
        sure: bool = False,
        request: int = 0,
    ) -> None:
        """Send to the camera; what is a shot's message and arrives is noted as heard, for request `request`."""
        faults, edge_s = self.faults, self.burst_s
        middle = WARM_UP_S + edge_s < self.now_s < self.end_s - 4 - edge_s
        for message in messages:
            if self._within(self._down) or (self._within(self._dead) and who == VEHICLE):
                continue
            for link in (0, 1) if "two ports" in faults else (0,):
                if "one packet of ten lost" in faults and middle and not sure and self.rng.random() < 0.1:
                    continue
                raw = pack(message, self._packers[who, link], version_1=False)
                delay_s = LINK_S + self.rng.expovariate(1 / SPREAD_S) + 0.08 * link
                delay_s += self._hold_s(delay_s)
                if "late packets" in faults:
                    delay_s += self.rng.expovariate(1 / 0.01)
                self._arrives(delay_s, link, message, raw)
                if "every packet twice" in faults:
                    self._arrives(delay_s + 0.01, link, message, raw)
                if not self._within(self._deaf, self._now_ns + round(delay_s * 1e9)):
                    self._note_heard(message, request)

    def _hold_s(self, delay_s: float) -> float:
        """How much longer a link holds what would have come so much later than now. It keeps the order."""
        there_ns = self._now_ns + round(delay_s * 1e9)
        for begin, end in self._held:
            if begin <= there_ns < end:
                return (end - there_ns) / 1e9 + (there_ns - begin) / 1e12
        return 0.0

    def _within(self, spans: Sequence[tuple[int, int]], at_ns: int | None = None) -> bool:
        """Whether an instant (now) is in one of them."""
        return any(begin <= (self._now_ns if at_ns is None else at_ns) < end for begin, end in spans)

    def _arrives(self, delay_s: float, link: int, message: MavlinkMessage, raw: bytes) -> None:
        def receive() -> None:
            if not self._within(self._deaf):
                self.daemon.receive(link, message, raw)

        self._at(self.now_s + delay_s, receive)

    def _note_heard(self, message: MavlinkMessage, request: int) -> None:
        kind = message.get_type()
        if kind == "CAMERA_FEEDBACK" and self.outside and message.cam_idx == self.own:
            if message.time_usec not in self._stamps or message.time_usec == 0:
                self._stamps.add(message.time_usec)
                self._heard.add((self._boots, message.img_idx))
        elif kind == "CAMERA_TRIGGER" or (
            kind == "COMMAND_LONG" and not self.outside and message.target_component in (0, 100)
        ):
            self._heard.add((-1, request))

    def _asked_time(self, message: MavlinkMessage) -> None:
        sent_us = message.ts1

        def answer() -> None:
            self._deliver([mavlink.MAVLink_timesync_message(self._boot_us() * 1000, sent_us)])

        there_s = LINK_S + self.rng.expovariate(1 / SPREAD_S)
        if "late packets" in self.faults:
            there_s += self.rng.expovariate(1 / 0.01)
        self._at(self.now_s + there_s, answer)

    # the vehicle

    def _sampler(self, step: int) -> Callable[[], None]:
        def sample() -> None:
            t_s = step * STEP_S
            truth, boot_ns = sampled(step), self.boot.ns(t_s)
            position, turn = self._slow[max(0, min(int((t_s - WARM_UP_S) // self.burst_s) + 1, self.bursts + 1))]
            x, y, z = (angle / 2 for angle in turn.at(t_s))
            north, east, down = position.at(t_s)
            north += GLITCH_M if self.glitch_s[0] <= t_s < self.glitch_s[1] else 0.0
            north_m, east_m = metres_per_radian(math.radians(truth.latitude_deg), truth.altitude_msl_m)
            seen = replace(
                truth,
                attitude=multiply(truth.attitude, (math.sqrt(1 - x * x - y * y - z * z), x, y, z)),
                latitude_deg=truth.latitude_deg + math.degrees(north / north_m),
                longitude_deg=truth.longitude_deg + math.degrees(east / east_m),
                altitude_msl_m=truth.altitude_msl_m - down,
            )
            numbers = [mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT]
            if step % 5 == 0:
                numbers += [mavlink.MAVLINK_MSG_ID_SYSTEM_TIME]
                numbers += [] if self._blind else [mavlink.MAVLINK_MSG_ID_GPS_RAW_INT]
            if self._blind:
                seen = replace(seen, latitude_deg=0.0, longitude_deg=0.0)
            self._deliver(telemetry_message(number, seen, boot_ns, self._unix_us()) for number in numbers)
            if step % 5 == 0 and self.triggers.personality == "px4":
                self._deliver([_odometry(boot_ns // 1000)])

        return sample

    def _reboot(self) -> None:
        self.triggers = CameraTriggers(self.triggers.personality, self.cameras)
        self._boots += 1

    def _crash(self) -> None:
        """The daemon dies: what it had in hand is left to recovery."""
        self.found.unfinished += len(self._pending)
        self._pending.clear()

    def _restart(self) -> None:
        """It comes back, and knows what its ledger has."""
        self._gone.append(self.daemon)
        self.daemon = self._started(self.daemon)
        self._heartbeat()

    def _act(self) -> None:
        """One photograph is asked for: by the mission, or by a ground station that sends to all components."""
        if self._within(self._dead):
            return
        self._requests += 1
        number = self._requests
        if "stations broadcast" in self.faults:
            digicam = self.triggers.personality == "px4"
            command, seven = (203, (0, 0, 0, 0, 1, 0, 0)) if digicam else (2000, (0, 0, 1, number, 0, 0, 0))
            message = mavlink.MAVLink_command_long_message(0, 0, command, 0, *seven)
            station = STATIONS[number % 2]
            pack(message, self._packers[station, 0], version_1=False)
            self._deliver([message], station, request=number)
            self._at(self.now_s + 0.0006, lambda: self._triggered(message, number))
            return
        self._triggered(None, number)
        if len(self.cameras) > 1 and number % 2:
            self._at(self.now_s + 0.03, self._other_camera)

    def _triggered(self, command: MavlinkMessage | None, number: int) -> None:
        if command is None:
            camera = self.own if len(self.cameras) > 1 else None
            made = self.triggers.trigger(self._boot_us(), self._unix_us(), camera)
        else:
            made = self.triggers.command(command, self._boot_us(), self._unix_us())
        self.found.triggers += 1
        if any(begin - NUMBERS_NS <= self._now_ns < end for begin, end in self._deaf):
            self._unheard.add((self._boots, self.triggers.images[self.own]) if self.outside else (-1, number))
        self._deliver(made, request=number)
        if self.outside:
            self._expose((self._boots, self.triggers.images[self.own]), self.triggers)

    def _other_camera(self) -> None:
        """The autopilot's other camera is triggered, and its hot shoe closes: ours is reported again."""
        other = 1 - self.own
        self._deliver(self.triggers.trigger(self._boot_us(), self._unix_us(), other))
        self._at(self.now_s + 0.07, lambda: self._deliver(self.triggers.contact(self._boot_us(), other)))

    # the body

    def _expose(self, key: tuple[int, int], triggers: CameraTriggers) -> None:
        begin_s = self.now_s + self.rng.gauss(LATENCY_MS, LATENCY_SIGMA_MS) / 1e3
        self._truth[key] = _utc_ns(begin_s + EXPOSURE_S / 2)
        self.found.files += 1
        faults = self.faults
        stamp_us = self._boot_us(begin_s + self.rng.gauss(0, CONTACT_SIGMA_MS) / 1e3)
        middle = 3 < self.found.triggers < self.bursts * self.of_burst - 3
        if "contacts lost" in faults and middle and self.rng.random() < 0.2:
            return
        contacts_us = [stamp_us]
        if "contacts doubled" in faults and self.rng.random() < 0.3:
            contacts_us.append(stamp_us + 15_000)
        for contact_us in contacts_us:  # its loop reports a contact within 20 ms
            at_s = begin_s + (contact_us - stamp_us) / 1e6 + self.rng.uniform(0.001, 0.013)
            self._at(at_s, self._contact(contact_us, triggers))

    def _contact(self, contact_us: int, triggers: CameraTriggers) -> Callable[[], None]:
        return lambda: self._deliver(triggers.contact(contact_us, self.own)) if triggers is self.triggers else None

    def _fired(self, shot: Shot) -> None:
        busy_ns = 0 if self.outside else max(0, self._free_ns - self._now_ns)
        self._free_ns = self._now_ns + busy_ns + BUSY_NS
        self._pending.append((shot, self.daemon.expected(shot, busy_ns), self._boots))
        if not self.outside:
            triggers = self.triggers
            self._at(self.now_s + busy_ns / 1e9, lambda: self._expose((-1, shot.index), triggers))

    # tags

    def _tick(self) -> None:
        if self._within(self._deaf):
            return
        self.daemon.component.tick()
        for pending in list(self._pending):
            shot, expected, boot = pending
            if self._now_ns < expected.utc_ns + self.files_s * 1e9:
                continue
            if self.daemon.telemetry.settled(expected) or self._now_ns > expected.utc_ns + WAIT_NS:
                self._pending.remove(pending)
                self.daemon.shutter.settled(shot.index, ok=True)
                number = shot.cause.sequence or 0
                truth_ns = self._truth[(boot, number) if self.outside else (-1, shot.index)]
                self.found.tags.append(_tagged(truth_ns, *self.daemon.telemetry.locate(expected)))

    def _forge(self) -> None:
        """NaN, stale and foreign versions of everything: none is a shot or a pose."""
        boot_us, nan = self._boot_us(), math.nan
        boot_ms = boot_us // 1000
        forged = [
            mavlink.MAVLink_attitude_quaternion_message(boot_ms, nan, nan, nan, nan, 0, 0, 0),
            mavlink.MAVLink_attitude_quaternion_message(boot_ms, 0, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_global_position_int_message(boot_ms, 0, 0, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_timesync_message(self.rng.randrange(2**40), self._now_ns - 12345),
            mavlink.MAVLink_command_long_message(1, 100, 203, 0, nan, nan, nan, nan, nan, nan, nan),
            mavlink.MAVLink_command_long_message(1, 150, 2000, 0, 0, 0, 1, 1, 0, 0, 0),
            mavlink.MAVLink_camera_feedback_message(0, 0, 5, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9),
            mavlink.MAVLink_camera_feedback_message(boot_us, 0, 5, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9),
        ]
        number = self.triggers.images[self.own]
        if self.outside and self.triggers.personality == "ardupilot" and number:
            old_us = max(1, boot_us - 60 * 10**6)
            forged.append(
                mavlink.MAVLink_camera_feedback_message(old_us, 0, self.own, number, 0, 0, 0, 0, 0, 0, 0, 0, 0, number)
            )
        heard = set(self._heard)
        self._deliver(forged)
        self._deliver(
            [
                mavlink.MAVLink_camera_trigger_message(boot_us, 77),
                mavlink.MAVLink_camera_feedback_message(boot_us, 0, self.own, 77, 0, 0, 0, 0, 0, 0, 0, 0, 0, 77),
                telemetry_message(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, PATH.pose(0.0), boot_us * 1000),
            ],
            (7, 1),
        )
        self._heard = heard


def _odometry(boot_us: int) -> MavlinkMessage:
    """What PX4's estimator says of its own errors; the rest is not used."""
    poses = [math.nan] * 21
    for place in (15, 18, 20):  # roll, pitch, yaw
        poses[place] = ATTITUDE_SIGMA_RAD**2 / 3
    return mavlink.MAVLink_odometry_message(
        boot_us, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, poses, [math.nan] * 21
    )


def _tagged(truth_ns: int, exposure: ExposureTime, pose: Pose) -> Tagged:
    truth = PATH.pose((truth_ns - START_NS) / 1e9)
    off_ms = (exposure.utc_ns - truth_ns) / 1e6
    across = upright = attitude = None
    axes: tuple[float, ...] = ()
    if pose.latitude_rad is not None and pose.longitude_rad is not None and pose.altitude_msl_m is not None:
        north_m, east_m = metres_per_radian(pose.latitude_rad, truth.altitude_msl_m)
        north = (pose.latitude_rad - math.radians(truth.latitude_deg)) * north_m
        east = (pose.longitude_rad - math.radians(truth.longitude_deg)) * east_m
        if (known := pose.position_covariance_m2) is not None:
            down = truth.altitude_msl_m - pose.altitude_msl_m
            axes = tuple(off / math.sqrt(known[place]) for off, place in ((north, 0), (east, 3), (down, 5)))
        if pose.position_sigma_m is not None:
            across = math.hypot(north, east) / pose.position_sigma_m
        if pose.vertical_sigma_m is not None:
            upright = (pose.altitude_msl_m - truth.altitude_msl_m) / pose.vertical_sigma_m
    if pose.attitude is not None and pose.attitude_sigma_rad is not None:
        attitude = turn_rad(pose.attitude, truth.attitude) / pose.attitude_sigma_rad
    doubt = bool(exposure.doubts)
    return Tagged(off_ms * 1e6 / exposure.sigma_ns, off_ms, across, upright, attitude, doubt, exposure.source, axes)


def _utc_ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def fly(cell: Cell, bursts: int = 120, seed: int = 1) -> Outcome:
    """Fly one cell: `bursts` independent bursts of one to three shots at its rate."""
    gc.disable()
    try:
        return World(cell, bursts, seed).run()
    finally:
        gc.enable()
