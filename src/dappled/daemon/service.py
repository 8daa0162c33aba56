"""Build a live flight from its parts, start and stop them in order, and run the loop that looks after them.

Parts know only parts that are built before them, so their references form no circle. Packets go from the links to
Navigation and to the component. Commands go down: component → shutter → FlightControl → PendingShots → camera. Events
go down too: pipeline → ShotEvents → component, shutter, logbook. `_built` reads in that order.
"""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import dappled
from dappled import codec, findings
from dappled.clock import Clock, SystemClock
from dappled.config import profiles
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon.body_plan import BodyPlan
from dappled.daemon.camera_protocol.camera_status import DistanceSensor, ReportedCamera
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes
from dappled.daemon.camera_protocol.own_autopilot import OwnAutopilot
from dappled.daemon.camera_protocol.parameters import Parameters
from dappled.daemon.configured_links import configured_links
from dappled.daemon.console import process as console_process
from dappled.daemon.console.live_view import CameraLook
from dappled.daemon.console.process import Console
from dappled.daemon.console.requests import ConsoleRequests
from dappled.daemon.flight_control import DecodingParameter, FlightControl
from dappled.daemon.flight_handover import FlightHandover, RecipeParameters
from dappled.daemon.health import record as health
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.health.standing import StandingEvents, StandingFindings
from dappled.daemon.health.status_text import Alarms
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation import BodyLatency, Navigation
from dappled.daemon.navigation.machine_clock import utc_known
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.capture import Observer, PendingShots, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.daemon.pipeline.live_depth import LiveDepth
from dappled.daemon.pipeline.live_picture import LivePictures
from dappled.daemon.pipeline.occasional import Occasional
from dappled.daemon.pipeline.overlap import OverlapWatch
from dappled.daemon.pipeline.pipeline import Decoding, Pipeline
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.daemon.pipeline.verdicts import Judge
from dappled.daemon.shot_events import ShotEvents
from dappled.daemon.stream import wire
from dappled.daemon.stream.answers import Answers
from dappled.daemon.stream.publisher import Publisher, Stream
from dappled.daemon.survey_facts import LiveSurvey, distance_trigger
from dappled.drivers.camera import Camera, WritesFiles
from dappled.drivers.child_process import VIEWERS_GO
from dappled.drivers.gnss.port import GnssPort, gnss_port
from dappled.drivers.gnss.recorded import TelemetryNotebook
from dappled.drivers.mavlink import MavlinkLinks, Transport
from dappled.drivers.raw.recipe import Recipe
from dappled.drivers.registry import open_camera
from dappled.drivers.wired.shutter_line import UsesAutopilot
from dappled.errors import DappledError, report
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import Recording, Tag, seal_key
from dappled.flight import recording as flights

log = logging.getLogger(__name__)
HEALTH_NS = 10**9
AGAIN_NS = 10**9
_LOOK_S = 0.02
_STILL_NS = 5_000_000_000  # without a heartbeat for so long ground stations take a camera for lost
_STOOD_TOLD_NS = 60_000_000_000
_STOP_S = 5.0


@runtime_checkable
class HasThreads(Protocol):
    """A part with threads. A camera driver may be one."""

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped."""


@dataclass(frozen=True, slots=True)
class StandIns:
    """Parts of a daemon in place of those that its settings name; None: as they name it."""

    camera: Camera | None = None
    transport: Transport | None = None
    stream: Stream | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FlightParts:
    """The parts of a flight, each built from some above it. `vital` are those without which no photograph is taken and
    kept; None: the settings ask for none."""

    recording: Recording
    links: MavlinkLinks
    publisher: Stream
    shots: PendingShots
    writer: LedgerWriter
    navigation: Navigation
    control: FlightControl
    shutter: Shutter
    autopilot: OwnAutopilot
    distance: DistanceTrigger
    overlap: OverlapWatch
    gnss: GnssPort | None
    body: BodyPlan
    parameters: Parameters
    component: Component
    decoder: DecodeProcess | None
    viewers: tuple[Occasional, ...]
    events: ShotEvents
    pipeline: Pipeline
    answers: Answers
    vital: tuple[HasThreads, ...]


class Service:
    """One flight, from `start` to `stop`. `run` is the working loop between them.

    `observer` follows the pipeline; `after` takes what the next flight is to be flown with, where there may be one.
    `start` raises DappledError when a part can't be had, and closes what it has opened. A camera that isn't there, a
    link without an autopilot and a recipe without a mask are no such failures: health reports them. `instead` stands
    in for parts of the world. `parts` are there from `start` on.
    """

    parts: FlightParts

    def __init__(
        self,
        settings: Settings,
        *,
        observer: Observer | None = None,
        clock: Clock | None = None,
        after: FlightHandover | None = None,
        instead: StandIns | None = None,
    ) -> None:
        self.console_url = ""
        self._console: Console | None = None
        self._settings = LiveSettings(settings)
        self._outside, self._after = observer or Observer(), after
        self._instead = instead or StandIns()
        self._clock = clock or SystemClock()
        self._began_monotonic_ns = self._clock.monotonic_ns()
        self._logbook = Logbook(self._clock)
        self._alarms, self._standing, self._told = Alarms(), StandingFindings(), StandingEvents()
        self._stack = ExitStack()
        self._stopping = threading.Event()
        self._turns = LoopTurns()
        self._started = False

    # start, and in the reverse order stop

    def start(self) -> None:
        """Open everything. Order: what may refuse first, the flight folder after it, the camera last."""
        settings = self._settings.now
        with ExitStack() as stack:
            names, recipe = recipes.recipe(settings)
            camera = self._instead.camera or open_camera(settings.camera)
            listener = console_process.open_listener(settings, stack)
            private = listener.private if listener else ""
            publisher = self._instead.stream or Publisher.of(settings.publish, private=private, clock=self._clock)
            stack.callback(publisher.stop)
            links = configured_links(settings, self._clock, self._instead.transport)
            links.open()
            stack.callback(links.stop)
            recording, recipe = self._begin_recording(names, recipe, links, stack)
            self.parts = parts = self._built(
                camera, names, recipe, recording=recording, links=links, publisher=publisher
            )
            if listener:  # before the publisher, so that it ends after it: the pages are told how the flight ended
                self.console_url = listener.url
                look = CameraLook(camera, parts.shutter, self._clock)
                requests = ConsoleRequests(
                    parts.shutter, parts.parameters, look, self._logbook, series=parts.distance, clock=self._clock
                )
                self._console = console_process.start(
                    listener, settings, stack, recipe=recipe, requests=requests, clock=self._clock
                )
            self._tasks = self._periodic_tasks()
            self._start_parts(names, stack)
            self._started = True
            self._stack = stack.pop_all()
        for one in recording.recovered:
            log.warning("earlier flight: %s", findings.told(one))

    def _begin_recording(
        self, names: Names, recipe: Recipe | None, links: MavlinkLinks, stack: ExitStack
    ) -> tuple[Recording, Recipe | None]:
        """Begin the flight folder. Returns its recording, and the recipe with the copies of its files that it keeps."""
        settings, clock = self._settings.now, self._clock
        known = utc_known(settings.record.utc, clock.utc_ns())
        if known:
            links.clock_known()
        facts = {
            "software": {"dappled": dappled.__version__, **recipes.versions()},
            "settings": configuration.to_tables(settings),
            "names": codec.plain(names),
            "decode_in_flight": recipe is not None,
        }
        directory, key = Path(settings.record.directory), settings.record.seal_key
        recording = flights.begin(
            directory, clock, facts, utc_known=known, seal_key=seal_key.load(Path(key)) if key else None
        )
        stack.callback(self._remove_unused_flight, recording)
        stack.callback(_close, recording)
        stack.callback(links.stop)  # before the recording closes: packets are logged there
        if recipe is None:
            return recording, None
        kept = recipes.keep(recipe, recording.folder.path)
        recording.note_inputs(recipes.FOLDER)
        return recording, kept

    def _built(
        self,
        camera: Camera,
        names: Names,
        recipe: Recipe | None,
        *,
        recording: Recording,
        links: MavlinkLinks,
        publisher: Stream,
    ) -> FlightParts:
        """Build the parts, each from parts built before it. None of them runs yet."""
        settings, clock = self._settings.now, self._clock
        shots = PendingShots(camera, clock)
        writer = LedgerWriter(recording, clock)
        known = recording.ledger.fact(bool, "utc_known") is True
        navigation = Navigation(self._settings, clock, recording, utc_known=known)
        reported, sender = ReportedCamera(settings), links.sender
        control = FlightControl(
            self._settings,
            shots,
            writer,
            navigation,
            camera=reported,
            alarms=self._alarms,
            handover=self._after,
        )
        shutter = Shutter(
            control,
            clock,
            next_index=recording.next_index,
            capacity=settings.camera.max_pending,
            fires=not settings.camera.fired_outside,
        )
        on_gimbal, cam_idx = settings.pose.on_gimbal, settings.mavlink.cam_idx
        autopilot = OwnAutopilot(sender, clock, on_gimbal=on_gimbal, cam_idx=cam_idx)
        if isinstance(camera, UsesAutopilot):
            camera.use_autopilot(autopilot.command)
        if isinstance(camera, WritesFiles):
            camera.receive_into(recording.folder.frames)
        survey = LiveSurvey(navigation, reported, shots)
        distance = distance_trigger(shutter, survey, clock, settings)
        overlap = OverlapWatch(survey, settings.pose.mount, settings.trigger.overlap)
        gnss = gnss_port(settings.gnss, TelemetryNotebook(sender, navigation, clock), clock)
        body = BodyPlan(settings.body, settings.camera.capture_target, camera)
        parameters = self._settable(body, shots, writer, shutter, names, decodes=recipe is not None)
        component = Component(
            autopilot,
            shutter,
            parameters,
            model=control,
            earlier=EarlierOutcomes(recording.index),
            series=distance,
        )
        decoder = None if recipe is None else DecodeProcess(recipe, clock=clock)
        viewers: list[Occasional] = []
        if recipe is not None:
            making = DecodeProcess(recipe, clock=clock, goes_first=VIEWERS_GO)  # begins with what is first wanted of it
            common = (making, writer, shots, publisher)
            if recipe.mask != profiles.LENSLET:
                every_s = settings.publish.picture_interval_s
                viewers.append(LivePictures(*common, interval_s=every_s))
            if settings.decode.depth:
                ranging = DistanceSensor(sender, self._settings, clock)
                depth = LiveDepth(
                    *common,
                    method=settings.decode.depth,
                    interval_s=settings.decode.depth_interval_s,
                    nearest=ranging.send if settings.decode.depth_to_autopilot else None,
                )
                viewers.append(depth)
        events = ShotEvents(
            recording,
            reported,
            navigation.utc,
            component=component,
            logbook=self._logbook,
            viewers=viewers,
            recipe=recipe,
            outside=self._outside,
        )
        decoding = Decoding(
            ShotEnds(shots, writer, events),
            decoder,
            publisher,
            capacity=settings.decode.queue,
            judge=Judge(settings.pose.mount, on_gimbal=on_gimbal, plan=body),
            preview_interval_s=settings.publish.preview_interval_s,
        )
        pipeline = Pipeline(decoding, navigation, BodyLatency.of(settings.camera), names)
        answers = Answers(writer, decoder, shots.wait_decoded, clock=clock)
        driver = tuple(part for part in (camera, gnss) if isinstance(part, HasThreads))
        return FlightParts(
            recording,
            links,
            publisher,
            shots,
            writer,
            navigation,
            control,
            shutter,
            autopilot,
            distance,
            overlap,
            gnss,
            body,
            parameters,
            component,
            decoder,
            tuple(viewers),
            events,
            pipeline,
            answers,
            vital=(pipeline, links, shutter, distance, *driver),
        )

    def _settable(
        self,
        body: BodyPlan,
        shots: PendingShots,
        writer: LedgerWriter,
        shutter: Shutter,
        names: Names,
        *,
        decodes: bool,
    ) -> Parameters:
        """What a ground station may set: the body's settings, decoding in flight, the next flight's mask and law."""
        decoding = DecodingParameter(shots, writer, decodes=decodes)
        recipe = RecipeParameters(names, self._after, self._settings, shutter, writer.later)
        return Parameters(body, (decoding, recipe), unsigned=self._settings.now.mavlink.unsigned_parameters)

    def _start_parts(self, names: Names, stack: ExitStack) -> None:
        """Start the last stage first, so that each item finds its receiver. A part that fails is stopped too."""
        if self.parts.decoder is not None:
            stack.callback(self.parts.decoder.close)
            self.parts.decoder.begin_warm_up()
        stack.callback(self.parts.answers.stop)
        self.parts.answers.start()
        self.parts.publisher.start(self.parts.recording.folder.name, self.parts.answers.answer)
        publish = self._settings.now.publish
        start = wire.start_header(publish, self._clock.utc_ns(), camera=names.camera, mask=names.mask)
        self.parts.publisher.publish("start", start)
        stack.callback(self._publish_end)
        for one in self.parts.viewers:
            stack.callback(one.stop)
            one.start()
        stack.callback(self.parts.pipeline.stop, _STOP_S)
        self.parts.pipeline.start()
        stack.callback(self.parts.shutter.stop)
        self.parts.shutter.start()
        stack.callback(self.parts.distance.stop)
        self.parts.distance.start()
        self.parts.links.start(self.parts.navigation, self.parts.component)
        if self.parts.gnss is not None:
            stack.callback(self.parts.gnss.stop)
            self.parts.gnss.start()

    def _remove_unused_flight(self, recording: Recording) -> None:
        """Remove the folder of a flight whose start failed. A flight that has begun is kept, however it ends."""
        if not self._started:
            _remove_empty(recording)

    def _publish_end(self) -> None:
        self.parts.component.finish()
        self.parts.shutter.settle_refusals(all_of_them=True)
        try:
            self.parts.writer.write_later()
        except DappledError as error:
            report(log, "events", error)
        now = self.parts.shutter.statistics()
        counts = {"wished": now.shots, "safe": now.succeeded, "failed": now.failed, "open": now.pending}
        self.parts.publisher.publish("end", {"utc_ns": self._clock.utc_ns(), "shots": counts})
        self.parts.publisher.stop()  # answers the last questions, for which the decoder is still there

    def ask_to_stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping.set()

    def stop(self) -> None:
        """Finish the frame in hand and close everything, in the reverse order of opening."""
        self._stopping.set()
        self._stack.close()

    # the working loop

    def _periodic_tasks(self) -> dict[PeriodicTask, Callable[[], object]]:
        """The tasks of the working loop, in order, and what each does. Without the loop there is no heartbeat."""
        tasks: dict[PeriodicTask, Callable[[], object]] = {
            PeriodicTask("events"): self.parts.writer.write_later,
            PeriodicTask("body"): self._follow_body,
            PeriodicTask("resources", every_ns=HEALTH_NS): self.parts.control.look,
            PeriodicTask("health", every_ns=HEALTH_NS): self._publish_health,
            PeriodicTask("viewers", every_ns=HEALTH_NS): self._look_at_viewers,
        }
        if not self._settings.now.mavlink.url:
            return tasks
        return {
            PeriodicTask("MAVLink"): self._tick,
            PeriodicTask("vehicle"): self._follow_vehicle,
            **tasks,
            PeriodicTask("UTC", every_ns=HEALTH_NS): self._look_for_utc,
        }

    def _look_for_utc(self) -> None:
        self.parts.navigation.look_for_utc()
        if (learnt := self.parts.navigation.utc.learnt) is not None:
            self.parts.links.clock_known(learnt.correction_ns)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Send heartbeats and health until `ask_to_stop` or `stop` is called, the ground station has set what the next
        flight is flown with, or `until()` is true."""
        while not (self._stopping.is_set() or self._next_is_set() or until()):
            self.step()
            self._clock.wait(self._stopping, _LOOK_S)

    def step(self) -> None:
        """Do once what is due."""
        self._turns.turned(self._clock.monotonic_ns())
        for task, do in self._tasks.items():
            task.turn(do, self._clock.monotonic_ns())

    def _next_is_set(self) -> bool:
        return self._after is not None and self._after.next is not None

    def _tick(self) -> None:
        self.parts.component.tick(healthy=self.healthy)

    def _follow_body(self) -> None:
        """Compare what has come from the camera with the plan; here, so that no frame waits for that."""
        while self.parts.events.of_body:
            news = self.parts.events.of_body.popleft()
            if isinstance(news, Tag):
                self.parts.overlap.take(news)
            if drift := self.parts.body.take(news):
                self._logbook.add(str(findings.text(drift)), "warning")

    def _follow_vehicle(self) -> None:
        self.parts.navigation.belongs_to(self.parts.component.vehicle)
        self.parts.navigation.note_doubt()

    def _look_at_viewers(self) -> None:
        for one in self.parts.viewers:
            one.look()

    def _publish_health(self) -> None:
        record = self.health()
        self.parts.publisher.publish("health", record)
        for kind, one in self._told.of(record):
            self.parts.writer.later(kind, one)
        for text, severity in self._alarms.lines(record, again=self.parts.component.audience_has_grown()):
            self.parts.component.say(text, severity, news=True)  # it began or ended again

    def healthy(self) -> bool:
        """Whether everything runs that photographs are taken and kept with. Viewers' parts don't count."""
        return not any(part.dead_threads() for part in self.parts.vital)

    def health(self) -> dict[str, Any]:
        """The state of everything, as published."""
        navigation, utc_ns = self.parts.navigation, self._clock.utc_ns()
        shutter, series = self.parts.shutter.statistics(), self.parts.distance.statistics()
        viewers: list[HasThreads] = [
            self.parts.publisher,
            self.parts.answers,
            *self.parts.viewers,
            *([] if self._console is None else [self._console]),
        ]
        found = (
            *self.parts.component.findings(),
            navigation.utc.doubt(),
            *navigation.telemetry.doubts(),
            self.parts.control.shortage,
            *self.parts.links.findings(),
            None if self.parts.gnss is None else self.parts.gnss.problem(),
            *self.parts.body.unseen(),
            self.parts.overlap.trouble(utc_ns) if series is None else None,  # a series by distance tells it itself
            *(task.failing for task in self._tasks),
            self._turns.stood_still(self._clock.monotonic_ns()),
        )
        now = health.ServiceState(
            self._settings.now,
            health.ServiceTime(utc_ns, self._clock.monotonic_ns(), self._began_monotonic_ns, navigation.utc.known),
            health.ShootingState(
                self.parts.shots,
                shutter,
                self.parts.control.lost_triggers,
                series,
                self.parts.body.report(),
                codec.plain(self.parts.parameters.all()),
                self.parts.overlap.last(utc_ns),
            ),
            health.VehicleState(
                self.parts.links.statistics(),
                navigation.telemetry.statistics(),
                navigation.telemetry.boot_clock(),
                navigation.pose_now(),
                self.parts.autopilot.battery(),
            ),
            health.KeepingState(
                self.folder,
                self.parts.pipeline.statistics(),
                self.parts.publisher.statistics(),
                self.parts.writer.frame_bytes,
            ),
            health.DecodingState(
                self.parts.decoder is not None,
                self.parts.pipeline.decode_failures,
                self.parts.events.misfit,
                self.parts.pipeline.verdicts,
            ),
            dead_threads=[name for part in (*self.parts.vital, *viewers) for name in part.dead_threads()],
            found=[one for one in found if one is not None],
        )
        return health.record(now, self._standing)

    # what others may look at, and ask for

    @property
    def folder(self) -> Path:
        """The flight's folder."""
        return self.parts.recording.folder.path

    @property
    def requested(self) -> int:
        return self.parts.shutter.statistics().shots

    def request(self, request: CaptureRequest) -> ShotDecision:
        """Take a capture request that did not come over a link: from a console, or a test."""
        return self.parts.shutter.request(request)

    def reload(self, wanted: Settings) -> list[str]:
        """Take over what may change in flight."""
        return self._settings.reload(wanted)


class PeriodicTask:
    """When a task of the working loop is due: in every turn, or every `every_ns`.

    A task that fails is tried again a second later. The log has the first of the same failures. Times are monotonic.
    """

    def __init__(self, name: str, *, every_ns: int = 0) -> None:
        self.name = name
        self.failing: Finding | None = None
        self._every_ns = every_ns
        self._due_ns = 0

    def turn(self, do: Callable[[], object], now_ns: int) -> None:
        """Do it if it is due."""
        if now_ns < self._due_ns:
            return
        try:
            do()
        except Exception as error:  # noqa: BLE001  # a disk that refuses, or a bug in one task: the flight goes on
            if self.failing is None or self.failing.facts["error"] != type(error).__name__:
                report(log, self.name, error)
            about = Subject("task", self.name)
            self.failing = finding(Code.TASK_FAILING, about, error=type(error).__name__, why=error)
            self._due_ns = now_ns + AGAIN_NS
        else:
            self.failing = None
            self._due_ns = now_ns + self._every_ns


class LoopTurns:
    """When the working loop turned last, and for how long it stood still. Times are monotonic."""

    def __init__(self) -> None:
        self._turned_ns: int | None = None
        self._stood_ns, self._ended_ns = 0, 0

    def turned(self, now_ns: int) -> None:
        """Note a turn."""
        if self._turned_ns is not None and now_ns - self._turned_ns >= _STILL_NS:
            self._stood_ns, self._ended_ns = now_ns - self._turned_ns, now_ns
        self._turned_ns = now_ns

    def stood_still(self, now_ns: int) -> Finding | None:
        """That it did within the last minute, by the last time."""
        if not self._stood_ns or now_ns - self._ended_ns > _STOOD_TOLD_NS:
            return None
        return finding(Code.SERVICE_STOOD_STILL, Subject("service"), seconds=self._stood_ns / 1e9)


def _close(recording: Recording) -> None:
    for one in recording.close():
        log.warning("%s", findings.told(one))


def _remove_empty(recording: Recording) -> None:
    """After a start that failed: remove the flight's folder if no shot stands in it."""
    journal = recording.folder.journal
    if journal.exists() and journal.stat().st_size == 0:
        shutil.rmtree(recording.folder.path, ignore_errors=True)
