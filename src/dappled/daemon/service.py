"""The daemon of a live flight: opens every part, runs the working loop, and closes all in the reverse order."""

from __future__ import annotations

import logging
import math
import re
import shutil
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import dappled
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon import battery, curve, distance_sensor, ground_facts, health, inputs, links, succession, utc
from dappled.daemon.answers import Answers
from dappled.daemon.books import LiveBook
from dappled.daemon.cameras import open_camera
from dappled.daemon.clock import Clock, SystemClock
from dappled.daemon.component import Captured, Component
from dappled.daemon.console import acts
from dappled.daemon.console import process as console_process
from dappled.daemon.development import DevelopmentError, WorkerDeveloper
from dappled.daemon.knobs import Knobs, OwnKnob
from dappled.daemon.live_depth import LiveDepth
from dappled.daemon.logbook import Logbook, of_story
from dappled.daemon.publisher import Publisher, Reply
from dappled.daemon.reload import merge
from dappled.daemon.shutter import Shutter, Verdict, Wish
from dappled.daemon.story import Names, Story, Watchers
from dappled.daemon.street import Street
from dappled.daemon.succession import Succession
from dappled.daemon.tagger import LATENCY_SOURCE, BodyLatency, Exposure
from dappled.daemon.telemetry import Telemetry, UtcCorrection
from dappled.daemon.utc import UtcLearner
from dappled.daemon.vehicles import Vehicles
from dappled.drivers.camera import Camera, CameraError, Identity, SettingsChanged, StateChanged
from dappled.drivers.darkroom import Recipe
from dappled.drivers.mavlink import Packet, mavlink
from dappled.drivers.shutter_line import UsesAutopilot
from dappled.errors import DappledError, report
from dappled.flight import layout
from dappled.flight import recording as flights
from dappled.flight.records import Pose, Shot

log = logging.getLogger(__name__)
HEALTH_S = 1.0
_KIND = re.compile(r"\d+")  # a problem whose numbers change is still the same
LOOK_S = 0.02


class Service:
    """One flight, from `start` to `stop`. `run` does both, with the working loop between.

    `watchers` are told what the street does; `after` takes what the next flight is to be flown with, where there may be
    one. Raises DappledError from `start` when a part can't be had; what was opened is closed again. A camera that
    isn't there, a link without an autopilot and a recipe without a mask are no such failures: the daemon says so and
    goes on.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        watchers: Watchers | None = None,
        clock: Clock | None = None,
        after: Succession | None = None,
    ) -> None:
        self.settings = settings
        self._after = after
        self._outside = watchers or Watchers()
        self._clock = clock or SystemClock()
        self._stack = ExitStack()
        self._stopping = threading.Event()
        self._telemetry = Telemetry(
            component_id=settings.mavlink.component_id,
            attitude_sigma_rad=math.radians(settings.pose.attitude_sigma_deg),
        )
        self._component: Component | None = None
        self._recording: flights.Recording | None = None
        self._started = False
        self._health_due_ns = 0
        self._identity: Identity | None = None
        self._notes: deque[tuple[str, str]] = deque(maxlen=1000)
        self._said: set[str] = set()
        self._focal_length_mm: float | None = None
        self._battery_doubt: str | None = None
        self._chip = ground_facts.chip(settings, "")
        self._began_monotonic_ns = self._clock.monotonic_ns()
        self._logbook = Logbook(self._clock.utc_ns)
        self._recipe: Recipe | None = None
        self._depth: LiveDepth | None = None
        self.console_url = ""

    # life

    def start(self) -> None:
        """Open everything. Order: what may refuse first, the flight folder after it, the camera last."""
        with ExitStack() as stack:
            names, recipe = inputs.recipe(self.settings)
            camera = open_camera(self.settings.camera)
            if isinstance(camera, UsesAutopilot):
                camera.use_autopilot(self._order)
            door = console_process.open_door(self.settings, stack)
            self._publisher = Publisher(
                self.settings.publish.slices,
                self.settings.publish.ask,
                answer=self._answer,
                high_water_mark=self.settings.publish.high_water_mark,
                keys=curve.server(self.settings.publish.keys, self.settings.publish.clients),
                mode=int(self.settings.publish.socket_mode, 8),
                private=door.private if door else "",
            )
            stack.callback(self._publisher.stop)
            self._links = links.configured(self.settings, self._clock, tap=self._log_packet, on_packet=self._packet)
            self._links.open()
            stack.callback(self._links.stop)
            utc_known = utc.known(self.settings.record.utc, self._clock.utc_ns())
            self._recording = flights.begin(
                Path(self.settings.record.directory),
                self._clock.utc_ns,
                self._facts(names, recipe),
                utc_known=utc_known,
            )
            self._vehicles = Vehicles(self._telemetry, self._recording.ledger.set_fact)
            self._utc = UtcLearner(known=utc_known, note=self._learn_utc)
            stack.callback(self._remove_litter)
            stack.callback(self._close_recording)
            stack.callback(self._links.stop)  # before the recording closes: packets are logged there
            self._begin_street(camera, names, self._developer(recipe, stack), stack)
            self._begin_component(self._knobs(camera, names, recipe))
            if door:
                self.console_url = door.url
                console_process.begin(
                    door, self.settings, stack, recipe=self._recipe, act=self._act, logbook=self._logbook
                )
            self._started = True
            self._stack = stack.pop_all()
        for text in self._recording.recovered:
            log.warning("earlier flight: %s", text)

    def _developer(self, recipe: Recipe | None, stack: ExitStack) -> WorkerDeveloper | None:
        assert self._recording is not None
        if recipe is None:
            return None
        kept = self._recipe = inputs.keep(recipe, self._recording.folder.path)
        self._recording.note_inputs(inputs.FOLDER)
        developer = WorkerDeveloper(kept)
        stack.callback(developer.close)
        threading.Thread(target=_warm_up, args=[developer], name="decoder warm-up", daemon=True).start()
        return developer

    def _begin_street(self, camera: Camera, names: Names, developer: WorkerDeveloper | None, stack: ExitStack) -> None:
        assert self._recording is not None
        self._book = LiveBook(self._recording, self._clock)
        self._street = Street(
            camera=camera,
            book=self._book,
            poses=self._pose,
            developer=developer,
            publisher=self._publisher,
            latency=BodyLatency(self.settings.camera.latency_ms, self.settings.camera.latency_sigma_ms, LATENCY_SOURCE),
            names=names,
            watchers=Watchers(
                self._settled, self._story_tagged, self._finished, self._camera_changed, self._settings_changed
            ),
            decode_queue=self.settings.decode.queue,
            preview_interval_s=self.settings.publish.preview_interval_s,
        )
        self._answers = Answers(self._book, developer, self._street.decoding_idle)
        self._shutter = Shutter(
            next_index=self._recording.next_index,
            note=self._note,
            fire=self._street.fire,
            clock=self._clock,
            capacity=self.settings.camera.max_pending,
            obstacle=self._obstacle,
            on_change=self._changed,
            on_refused=self._refused,
        )
        self._answers.start()
        stack.callback(self._answers.stop)
        self._publisher.start(self._recording.folder.name)
        self._publisher.publish("start", self._start_header(names))
        stack.callback(self._say_end)
        if self._recipe is not None and self.settings.decode.depth:
            self._begin_depth(self._recipe, stack)
        self._street.start()
        stack.callback(lambda: self._street.stop(5.0))
        self._shutter.start()
        stack.callback(self._shutter.stop)

    def _begin_depth(self, recipe: Recipe, stack: ExitStack) -> None:
        """A decoder of its own: depth takes longer than a frame may wait."""
        maker = WorkerDeveloper(recipe)
        stack.callback(maker.close)
        self._depth = LiveDepth(
            maker,
            method=self.settings.decode.depth,
            interval_s=self.settings.decode.depth_interval_s,
            path=lambda story: self._book.path(story.frame) if story.frame else "",
            publish=self._publisher.publish,
            give_way=self._street.decoding_idle,
            tell=self._tell_distance if self.settings.decode.depth_to_autopilot else lambda _: None,
        )
        self._depth.start()
        stack.callback(self._depth.stop)

    def _tell_distance(self, nearest_m: tuple[float, float]) -> None:
        boot_ms = (self._clock.monotonic_ns() // 10**6) % 2**32
        told = distance_sensor.message(nearest_m, boot_ms, self.settings.pose.mount)
        if told is not None:
            self._links.send(told)

    def _knobs(self, camera: Camera, names: Names, recipe: Recipe | None) -> Knobs:
        """What a ground station may set: the body's settings; and here, whether frames are decoded in flight."""
        decoding = OwnKnob(
            "LF_DECODE",
            "Decode in flight",
            lambda: "on" if recipe and self._street.decoding else "off",
            ("on", "off"),
            self._decode_in_flight if recipe else None,
        )
        return Knobs(camera, (decoding, *succession.knobs(names, self._after, lambda: self.settings, self._hand_over)))

    def _begin_component(self, knobs: Knobs) -> None:
        self._component = Component(
            self._links,
            self._shutter,
            self._clock,
            knobs,
            facts=lambda: ground_facts.camera(self._street.identity, self._focal_length_mm, self._chip),
            storage=lambda: ground_facts.storage(self.folder),
            lookup=self._lookup,
            healthy=lambda: not (self._street.dead() or self._links.dead()),
            troubled=lambda: bool(self._said),
            pose=lambda: self._telemetry.pose_at(self._clock.utc_ns(), 0.0),
            mount=self.settings.pose.mount,
            feedback_is_shot=self.settings.mavlink.feedback_is_shot,
        )
        self._links.start()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """The working loop: heartbeats, health; until `stop` is asked for, or `until()` says so."""
        while not self._stopping.is_set() and not until():
            self.step()
            self._stopping.wait(LOOK_S)

    def step(self) -> None:
        """One turn of the working loop."""
        if self._component is not None and self.settings.mavlink.url:
            self._component.tick()
            self._look_whose()
        self._write_notes()
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._health_due_ns:
            self._health_due_ns = now_ns + round(HEALTH_S * 1e9)
            record = self.health()
            self._publisher.publish("health", record)
            self._tell_pilot(record["problems"])
            self._look_for_utc()

    def ask_to_stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping.set()

    def stop(self) -> None:
        """Finish the frame in hand and close everything, in the reverse order of opening."""
        self._stopping.set()
        self._stack.close()

    def wish(self, wish: Wish) -> Verdict:
        """A wish from this side of the links: a console, or a test."""
        return self._shutter.wish(wish)

    def _act(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """What the console asks for."""
        return acts.act(request, self._shutter, self._logbook)

    def reload(self, wanted: Settings) -> list[str]:
        """Take from these settings what can change in flight; a sentence for each change, taken or refused."""
        self.settings, told = merge(self.settings, wanted)
        return told

    # what others may look at

    def whole(self) -> bool:
        """Whether every part of the street still works."""
        return not (self._street.dead() or self._links.dead())

    @property
    def folder(self) -> Path:
        """The flight's folder."""
        assert self._recording is not None
        return self._recording.folder.path

    @property
    def utc_learnt(self) -> bool:
        """Whether the autopilot has told UTC to a machine that didn't know it."""
        return self._utc.learnt is not None

    @property
    def wished(self) -> int:
        """Shots so far."""
        return self._shutter.statistics().shots

    def health(self) -> dict[str, Any]:
        """The state of everything, as published."""
        return health.record(
            self.settings,
            utc_ns=self._clock.utc_ns(),
            monotonic_ns=self._clock.monotonic_ns(),
            began_monotonic_ns=self._began_monotonic_ns,
            street=self._street,
            shutter=self._shutter.statistics(),
            links=self._links.statistics(),
            telemetry=self._telemetry.statistics(),
            publisher=self._publisher.statistics(),
            folder=self.folder,
            clock=self._telemetry.boot_clock(),
            vehicle=self._telemetry.pose_at(self._clock.utc_ns(), 0.0),
            decoding=self._recipe is not None,
            utc_known=self._utc.known,
            dead=self._links.dead(),
            doubts=[
                text
                for text in (self._component and self._component.doubt(), self._utc.doubt(), self._battery_doubt)
                if text
            ],
        )

    # wishes

    def _note(self, shot: Shot) -> None:
        assert self._recording is not None
        self._recording.journal.note(shot)
        self._book.wished(shot)
        self._street.expect(shot)

    def _obstacle(self) -> str | None:
        if self._after is not None and self._after.next is not None:
            return "the next flight begins in a moment, with what the ground station has set"
        if self._street.camera_state not in ("ready", "busy"):
            return health.camera_sentence(self._street)
        try:
            free = layout.free_bytes(self.folder)
        except DappledError as error:
            return str(error)
        if free < self.settings.record.min_free_mb * 1_000_000:
            return f"the disk is nearly full: {free // 1_000_000} MB left, record.min_free_mb asks for more"
        return None

    def _refused(self, refused: tuple[Wish, str]) -> None:
        wish, reason = refused
        self._notes.append(("refused", f"{wish.kind} from {wish.source}: {reason}"))

    def _decode_in_flight(self, value: str) -> None:
        self._street.decoding = value == "on"
        self._notes.append(("decoding", f"{value} from now on, by the ground station"))

    def _hand_over(self, following: Settings, text: str) -> None:
        """The ground station has set what belongs to a flight: this one ends between two frames, and the next follows.
        Raises CameraError where that would cut something short."""
        assert self._after is not None
        now = self._shutter.statistics()
        if now.interval_s is not None:
            raise CameraError(f"{text} would begin another flight: stop the interval first")
        if now.pending:
            raise CameraError(f"{text} would begin another flight: {now.pending} shots are under way, ask again")
        self._after.next = following
        self._notes.append(("next flight", f"{text} from there on, by the ground station"))
        self.ask_to_stop()

    def _write_notes(self) -> None:
        """Refused wishes and the like stand in the flight too, as events; written here, where nobody waits for an
        answer."""
        while self._notes:
            kind, text = self._notes.popleft()
            try:
                self._book.event(kind, text)
            except DappledError as error:
                report(log, "events", error)
                return

    def _settled(self, index: int, ok: bool) -> None:
        self._shutter.settled(index, ok)
        self._outside.settled(index, ok)

    def _finished(self, story: Story) -> None:
        self._logbook.add(*of_story(story))
        if self._depth is not None:
            self._depth.offer(story)
        self._outside.finished(story)

    def _camera_changed(self, change: StateChanged) -> None:
        log.info("camera %s %s", change.state, change.reason)
        if change.state != "busy" and not (change.state == "ready" and self._identity):
            reason = f": {change.reason}" if change.reason else ""
            calm = change.state in ("ready", "starting")
            self._logbook.add(f"camera {change.state}{reason}", "info" if calm else "warning")
        self._changed()
        if change.identity not in (None, self._identity) and self._recording is not None:
            who = self._identity = change.identity
            self._chip = ground_facts.chip(self.settings, who.model)
            facts = {"make": who.make, "model": who.model, "serial": who.serial, "port": who.port}
            try:
                self._recording.add_facts({"camera": facts})
            except DappledError as error:
                report(log, "camera", error)
        self._outside.camera(change)

    def _settings_changed(self, change: SettingsChanged) -> None:
        self._battery_doubt = battery.doubt(change.settings)
        if self._component is not None:
            self._component.settings_changed(change.refused)
        self._outside.settings(change)

    def _changed(self) -> None:
        if self._component is not None:
            self._component.state_changed()

    # poses

    def _log_packet(self, stamp_us: int, raw: bytes) -> int:
        assert self._recording is not None
        return self._recording.telemetry.append(stamp_us, raw)

    def _packet(self, packet: Packet) -> None:
        if packet.number is not None:
            self._telemetry.feed(packet.number, packet.stamp_us, packet.message)
        if self._component is not None:
            self._component.on_packet(packet)

    def _look_whose(self) -> None:
        assert self._component is not None
        try:
            self._vehicles.look(self._component.vehicle)
        except DappledError as error:
            report(log, "vehicle", error)

    def _look_for_utc(self) -> None:
        try:
            self._utc.look(self._telemetry.utc_correction())
        except DappledError as error:
            report(log, "UTC", error)

    def _learn_utc(self, found: UtcCorrection) -> None:
        assert self._recording is not None
        log.info("UTC is %+.3f s from this machine's, by %s", found.correction_ns / 1e9, found.source)
        self._recording.learn_utc(found.correction_ns, found.sigma_ns, found.source)

    def _pose(self, index: int, exposure: Exposure) -> tuple[Exposure, Pose]:
        """The pose once telemetry from after the exposure is there, or `pose.wait_ms` after it as it is then."""
        give_up_ns = exposure.utc_ns + round(self.settings.pose.wait_ms * 1e6)
        while not self._telemetry.settled(exposure) and self._clock.utc_ns() < give_up_ns:
            self._stopping.wait(0.005) if not self._stopping.is_set() else self._clock.wait(threading.Event(), 0.005)
        return self._telemetry.locate(exposure)

    def _order(self, number: int, parameters: Sequence[float]) -> str | None:
        return "the daemon is still starting" if self._component is None else self._component.order(number, parameters)

    # what the ground station hears

    def _story_tagged(self, story: Story) -> None:
        index = story.shot.index
        captured = ground_facts.of_story(story, self._utc.utc_ns)
        if self._component is not None:
            self._component.announce(captured)
            if not captured.ok:
                self._component.say(f"image {index} failed: {story.problem}", mavlink.MAV_SEVERITY_ERROR)
        if story.tag is not None:
            before_mm, now_mm = self._focal_length_mm, story.tag.focal_length_mm
            if self._component is not None and before_mm and now_mm and before_mm != now_mm:
                self._component.say(f"image {index} was zoomed from {before_mm:g} to {now_mm:g} mm: is it calibrated?")
            self._focal_length_mm = now_mm or before_mm
        self._outside.tagged(story)

    def _tell_pilot(self, problems: list[str]) -> None:
        """Each problem once, when it comes up; and when the last has gone."""
        component, now = self._component, {_KIND.sub("#", text) for text in problems}
        if component is None:
            return
        for text in problems:
            if _KIND.sub("#", text) not in self._said:
                component.say(text)
        if self._said and not now:
            component.say("all is well again", mavlink.MAV_SEVERITY_INFO)
        self._said = now

    def _lookup(self, index: int) -> Captured | None:
        assert self._recording is not None
        if self._street.in_hand(index):
            return None  # its own message will come
        return ground_facts.of_record(index, self._recording.index)

    # beginning and end

    def _facts(self, names: Names, recipe: Recipe | None) -> Mapping[str, Any]:
        return {
            "software": {"dappled": dappled.__version__, **inputs.versions()},
            "settings": configuration.to_tables(self.settings),
            "names": asdict(names),
            "decode_in_flight": recipe is not None,
        }

    def _start_header(self, names: Names) -> dict[str, Any]:
        return {
            "utc_ns": self._clock.utc_ns(),
            "software": f"dappled {dappled.__version__}",
            "camera": names.camera,
            "mask": names.mask,
            "slices": self.settings.publish.slices,
            "ask": self.settings.publish.ask,
        }

    def _answer(self, request: Mapping[str, Any], reply: Reply) -> None:
        self._answers.answer(request, reply)

    def _say_end(self) -> None:
        self._write_notes()
        now = self._shutter.statistics()
        counts = {"wished": now.shots, "safe": now.succeeded, "failed": now.failed, "open": now.pending}
        self._publisher.publish("end", {"utc_ns": self._clock.utc_ns(), "shots": counts})
        self._publisher.stop()  # answers last questions: before the decoder goes

    def _remove_litter(self) -> None:
        """A start that failed leaves no flight without a shot behind."""
        assert self._recording is not None
        folder = self._recording.folder
        if not self._started and folder.journal.exists() and folder.journal.stat().st_size == 0:
            shutil.rmtree(folder.path, ignore_errors=True)

    def _close_recording(self) -> None:
        assert self._recording is not None
        for text in self._recording.close():
            log.warning("%s", text)


def _warm_up(developer: WorkerDeveloper) -> None:
    try:
        developer.warm_up()
    except DevelopmentError as error:
        log.warning("decoding will fail: %s", error)
