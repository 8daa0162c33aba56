"""The daemon of a live flight: the order in which its parts start and stop, and the loop that looks after them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dappled.clock import Clock, SystemClock
from dappled.config.settings import Settings
from dappled.daemon import links, live_record
from dappled.daemon.console import process as console_process
from dappled.daemon.flight_handover import FlightHandover
from dappled.daemon.flight_parts import FlightParts
from dappled.daemon.health import record as health
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.navigation.clocks import utc_known
from dappled.daemon.periodic_tasks import PeriodicTask
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.pending_shot import Names, Observer
from dappled.daemon.pipeline.shutter import CaptureRequest, ShotDecision
from dappled.daemon.reload import merge
from dappled.daemon.stream import curve, wire
from dappled.daemon.stream.publisher import Publisher, Reply
from dappled.drivers.camera import Camera
from dappled.drivers.mavlink import Packet
from dappled.drivers.raw.darkroom import Recipe
from dappled.drivers.registry import open_camera
from dappled.drivers.wired.shutter_line import UsesAutopilot
from dappled.errors import DappledError, report

log = logging.getLogger(__name__)
HEALTH_NS = 10**9
LOOK_S = 0.02
STOP_S = 5.0


class Service:
    """One flight, from `start` to `stop`. `run` is the working loop between them.

    `observer` are told what the street does; `after` takes what the next flight is to be flown with, where there may
    be one. Raises DappledError from `start` when a part can't be had; what was opened is closed again. A camera that
    isn't there, a link without an autopilot and a recipe without a mask are no such failures: the daemon says so and
    goes on.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        observer: Observer | None = None,
        clock: Clock | None = None,
        after: FlightHandover | None = None,
    ) -> None:
        self.settings = settings
        self._outside, self._after = observer or Observer(), after
        self._clock = clock or SystemClock()
        self._began_monotonic_ns = self._clock.monotonic_ns()
        self._logbook = Logbook(self._clock.utc_ns)
        self._stack = ExitStack()
        self._stopping = threading.Event()
        self._started = False
        self.console_url = ""

    # what starts, and in the reverse order stops

    def start(self) -> None:
        """Open everything. Order: what may refuse first, the flight folder after it, the camera last."""
        with ExitStack() as stack:
            names, recipe = recipes.recipe(self.settings)
            camera = open_camera(self.settings.camera)
            if isinstance(camera, UsesAutopilot):
                camera.use_autopilot(self._order)
            door = console_process.open_listener(self.settings, stack)
            self._open_sockets(door.private if door else "", stack)
            kept = self._begin_recording(camera, names, recipe, stack)
            self._begin_parts(names, stack)
            self._links.start(self)
            if door:
                self.console_url = door.url
                console_process.start(door, self.settings, stack, recipe=kept, act=self._act, logbook=self._logbook)
            self._started = True
            self._stack = stack.pop_all()
        for text in self._recording.recovered:
            log.warning("earlier flight: %s", text)

    def _open_sockets(self, private: str, stack: ExitStack) -> None:
        publish = self.settings.publish
        self._publisher = Publisher(
            publish.slices,
            publish.ask,
            answer=self._answer,
            high_water_mark=publish.high_water_mark,
            keys=curve.server(publish.keys, publish.clients),
            mode=int(publish.socket_mode, 8),
            private=private,
        )
        stack.callback(self._publisher.stop)
        self._links = links.configured(self.settings, self._clock)
        self._links.open()
        stack.callback(self._links.stop)

    def _begin_recording(self, camera: Camera, names: Names, recipe: Recipe | None, stack: ExitStack) -> Recipe | None:
        """The flight folder, and the parts that work on it. Returns the recipe as the flight keeps it."""
        known = utc_known(self.settings.record.utc, self._clock.utc_ns())
        self._recording = live_record.begin(
            self.settings, self._clock.utc_ns, names, decodes=recipe is not None, utc_known=known
        )
        stack.callback(self._remove_litter)
        stack.callback(live_record.close, self._recording)
        stack.callback(self._links.stop)  # before the recording closes: packets are logged there
        kept = None if recipe is None else live_record.keep_inputs(self._recording, recipe)
        self._parts = FlightParts(
            lambda: self.settings,
            self._clock,
            self._recording,
            camera=camera,
            names=names,
            recipe=kept,
            links=self._links,
            publisher=self._publisher,
            logbook=self._logbook,
            outside=self._outside,
            utc_known=known,
            after=self._after,
            end=self.ask_to_stop,
        )
        self._chores = self._make_chores()
        return kept

    def _begin_parts(self, names: Names, stack: ExitStack) -> None:
        """The end of the street first: whatever is handed on finds somebody at work. What begins badly is stopped
        too."""
        parts = self._parts
        if parts.decoder is not None:
            stack.callback(parts.decoder.close)
            parts.decoder.begin_warm_up()
        stack.callback(parts.answers.stop)
        parts.answers.start()
        self._publisher.start(self._recording.folder.name)
        header = wire.start_header(self.settings.publish, self._clock.utc_ns(), camera=names.camera, mask=names.mask)
        self._publisher.publish("start", header)
        stack.callback(self._say_end)
        if parts.depth is not None:
            stack.callback(parts.depth.stop)
            parts.depth.start()
        stack.callback(parts.pipeline.stop, STOP_S)
        parts.pipeline.start()
        stack.callback(parts.shutter.stop)
        parts.shutter.start()

    def _say_end(self) -> None:
        try:
            self._parts.writer.write_later()
        except DappledError as error:
            report(log, "events", error)
        now = self._parts.shutter.statistics()
        counts = {"wished": now.shots, "safe": now.succeeded, "failed": now.failed, "open": now.pending}
        self._publisher.publish("end", {"utc_ns": self._clock.utc_ns(), "shots": counts})
        self._publisher.stop()  # answers last questions: before the decoder goes

    def _remove_litter(self) -> None:
        if not self._started:
            live_record.remove_litter(self._recording.folder)

    def ask_to_stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping.set()

    def stop(self) -> None:
        """Finish the frame in hand and close everything, in the reverse order of opening."""
        self._stopping.set()
        self._stack.close()

    # what is looked after

    def _make_chores(self) -> list[PeriodicTask]:
        """What the working loop does, in this order. Without the loop there is no heartbeat."""
        parts = self._parts
        chores = [
            PeriodicTask("events", parts.writer.write_later),
            PeriodicTask("health", self._tell_health, every_ns=HEALTH_NS),
        ]
        if not self.settings.mavlink.url:
            return chores
        return [
            PeriodicTask("MAVLink", parts.component.tick),
            PeriodicTask("vehicle", lambda: parts.navigation.belongs_to(parts.component.vehicle)),
            *chores,
            PeriodicTask("UTC", parts.navigation.look_for_utc, every_ns=HEALTH_NS),
        ]

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """The working loop: heartbeats, health; until `stop` is asked for, or `until()` says so."""
        while not self._stopping.is_set() and not until():
            self.step()
            self._stopping.wait(LOOK_S)

    def step(self) -> None:
        """One turn of the working loop."""
        for chore in self._chores:
            chore.turn(self._clock.monotonic_ns())

    def healthy(self) -> bool:
        """Whether everything works that photographs are taken and kept with."""
        return self._parts.healthy()

    def health(self) -> dict[str, Any]:
        """The state of everything, as published."""
        parts, navigation = self._parts, self._parts.navigation
        doubts = (parts.component.doubt(), navigation.utc.doubt(), parts.herald.doubt())
        return health.record(
            self.settings,
            utc_ns=self._clock.utc_ns(),
            monotonic_ns=self._clock.monotonic_ns(),
            began_monotonic_ns=self._began_monotonic_ns,
            pipeline=parts.pipeline,
            shutter=parts.shutter.statistics(),
            links=self._links.statistics(),
            telemetry=navigation.telemetry.statistics(),
            publisher=self._publisher.statistics(),
            folder=self.folder,
            clock=navigation.telemetry.boot_clock(),
            vehicle=navigation.pose_now(),
            decoding=parts.decoder is not None,
            utc_known=navigation.utc.known,
            dead_threads=parts.dead_threads(),
            doubts=[text for text in (*doubts, *(chore.problem for chore in self._chores)) if text],
        )

    def _tell_health(self) -> None:
        record = self.health()
        self._publisher.publish("health", record)
        component = self._parts.component
        for text, severity in self._parts.alarms.lines(record["problems"], again=component.audience_has_grown()):
            component.say(text, severity)

    # what others may look at, and ask for

    @property
    def folder(self) -> Path:
        """The flight's folder."""
        return self._recording.folder.path

    @property
    def utc_learnt(self) -> bool:
        """Whether the autopilot has told UTC to a machine that didn't know it."""
        return self._parts.navigation.utc.learnt is not None

    @property
    def requested(self) -> int:
        """Shots so far."""
        return self._parts.shutter.statistics().shots

    def request(self, request: CaptureRequest) -> ShotDecision:
        """A wish from this side of the links: a console, or a test."""
        return self._parts.shutter.request(request)

    def reload(self, wanted: Settings) -> list[str]:
        """Take from these settings what can change in flight; a sentence for each change, taken or refused."""
        self.settings, told = merge(self.settings, wanted)
        return told

    # what comes in by the doors that are open before the parts are made; nothing is heard there until `start` has them

    def _act(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        return console_process.answer(request, self._parts.shutter, self._logbook)

    def _answer(self, request: Mapping[str, Any], reply: Reply) -> None:
        self._parts.answers.answer(request, reply)

    def log_packet(self, stamp_us: int, raw: bytes) -> int:
        """See `PacketSink`."""
        return self._recording.telemetry.append(stamp_us, raw)

    def on_packet(self, packet: Packet) -> None:
        """See `PacketSink`."""
        self._parts.on_packet(packet)

    def _order(self, number: int, parameters: Sequence[float]) -> str | None:
        return self._parts.component.command_autopilot(number, parameters)
