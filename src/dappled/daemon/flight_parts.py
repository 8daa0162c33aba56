"""What one live flight is made of, and what its parts ask of each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dappled.clock import Clock
from dappled.config.settings import Settings
from dappled.daemon import flight_handover
from dappled.daemon.camera_protocol import camera_status
from dappled.daemon.camera_protocol.camera_status import CameraFacts, Captured, Storage
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.camera_protocol.parameters import OwnParameter, Parameters
from dappled.daemon.flight_handover import FlightHandover
from dappled.daemon.health import record
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.health.status_text import Alarms
from dappled.daemon.navigation import BodyLatency, Navigation
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.daemon.pipeline.live_depth import LiveDepth
from dappled.daemon.pipeline.pending_shot import Names, Observer
from dappled.daemon.pipeline.pipeline import Pipeline
from dappled.daemon.pipeline.shot_events import ShotEvents
from dappled.daemon.pipeline.shutter import CaptureRequest, Shutter
from dappled.daemon.stream.answers import Answers
from dappled.daemon.stream.publisher import Publisher
from dappled.decode.geometry import Pose
from dappled.drivers.camera import Camera, CameraError
from dappled.drivers.mavlink import MavlinkLinks, Packet
from dappled.drivers.raw.darkroom import Recipe
from dappled.flight import Recording, Shot


class Part(Protocol):
    """Something with threads."""

    def dead_threads(self) -> list[str]:
        """Those that have ended without being asked to."""


class FlightParts:
    """Made in the order in which they need each other, none of them at work yet.

    `settings()` are those of now, `recipe` what frames are decoded with (None: they are not), `after` takes what the
    next flight is to be flown with, and `end()` ends this one soon.
    """

    def __init__(
        self,
        settings: Callable[[], Settings],
        clock: Clock,
        recording: Recording,
        *,
        camera: Camera,
        names: Names,
        recipe: Recipe | None,
        links: MavlinkLinks,
        publisher: Publisher,
        logbook: Logbook,
        outside: Observer,
        utc_known: bool,
        after: FlightHandover | None,
        end: Callable[[], None],
    ) -> None:
        self._settings, self._clock, self._recording, self._links = settings, clock, recording, links
        self._after, self._end, self._publisher = after, end, publisher
        now = settings()
        self.alarms = Alarms()
        self.writer = LedgerWriter(recording, clock)
        self.navigation = Navigation(settings, clock, recording, utc_known=utc_known)
        self.decoder = None if recipe is None else DecodeProcess(recipe)
        self.depth = self._depth_of(recipe, publisher) if recipe is not None and now.decode.depth else None
        self.shutter = Shutter(self, clock, next_index=recording.next_index, capacity=now.camera.max_pending)
        self.component = Component(
            links,
            self.shutter,
            clock,
            self._parameters(camera, names),
            self,
            feedback_is_shot=now.mavlink.feedback_is_shot,
        )
        self.herald = ShotEvents(
            now,
            recording,
            self.shutter,
            self.component,
            logbook,
            utc_ns=self.navigation.utc.utc_ns,
            outside=outside,
            depth=self.depth,
        )
        self.pipeline = Pipeline(
            camera=camera,
            writer=self.writer,
            poses=self.navigation.pose,
            decoder=self.decoder,
            publisher=publisher,
            latency=BodyLatency.of(now.camera),
            names=names,
            observer=self.herald.observer(),
            decode_queue=now.decode.queue,
            preview_interval_s=now.publish.preview_interval_s,
        )
        self._vital: tuple[Part, ...] = (self.pipeline, links, self.shutter)
        self.answers = Answers(self.writer, self.decoder, self.pipeline.decoding_idle)

    def dead_threads(self) -> list[str]:
        """Threads that have ended without being asked to: none, unless there is a bug."""
        parts: list[Part] = [*self._vital, self._publisher, self.answers]
        if self.depth is not None:
            parts.append(self.depth)
        return [name for part in parts for name in part.dead_threads()]

    def healthy(self) -> bool:
        """Whether everything works that photographs are taken and kept with: no viewer's loss ends a flight."""
        return not any(part.dead_threads() for part in self._vital)

    def on_packet(self, packet: Packet) -> None:
        """A packet came over a link, or went out: to the poses first, so that what it asks for finds it there."""
        self.navigation.on_packet(packet)
        self.component.on_packet(packet)

    # making

    def _depth_of(self, recipe: Recipe, publisher: Publisher) -> LiveDepth:
        decode = self._settings().decode
        return LiveDepth(
            DecodeProcess(recipe),
            method=decode.depth,
            interval_s=decode.depth_interval_s,
            path=lambda pending: self.writer.path(pending.frame) if pending.frame else "",
            publish=publisher.publish,
            give_way=lambda: self.pipeline.decoding_idle(),  # noqa: PLW0108  # the street is made after depth
            tell=self._tell_distance if decode.depth_to_autopilot else lambda _: None,
        )

    def _parameters(self, camera: Camera, names: Names) -> Parameters:
        """What a ground station may set: the body's settings, and here whether and by what frames are decoded."""
        decoding = OwnParameter(
            "LF_DECODE",
            "Decode in flight",
            lambda: "on" if self.pipeline.decoding else "off",
            ("on", "off"),
            self._decode_in_flight if self.decoder else None,
        )
        return Parameters(
            camera, (decoding, *flight_handover.parameters(names, self._after, self._settings, self._hand_over))
        )

    # for the shutter (ShotSink)

    def note(self, shot: Shot) -> None:
        """See ShotSink."""
        self._recording.journal.note(shot)
        self.writer.requested(shot)
        self.pipeline.expect(shot)

    def fire(self, shot: Shot) -> None:
        """See ShotSink."""
        self.pipeline.fire(shot.index)

    def obstacle(self) -> str | None:
        """See ShotSink."""
        if self._after is not None and self._after.next is not None:
            return "the next flight begins in a moment, with what the ground station has set"
        return record.obstacle(self.pipeline, self._recording.folder.path, self._settings().record.min_free_mb)

    def refused(self, request: CaptureRequest, reason: str) -> None:
        """See ShotSink."""
        self.writer.later("refused", f"{request.kind} from {request.source}: {reason}")

    # for the ground station (CameraModel)

    @property
    def mount(self) -> tuple[float, ...]:
        """See CameraModel."""
        return self._settings().pose.mount

    def facts(self) -> CameraFacts:
        """See CameraModel."""
        return self.herald.facts()

    def storage(self) -> Storage | None:
        """See CameraModel."""
        return camera_status.disk_storage(self._recording.folder.path)

    def lookup(self, index: int) -> Captured | None:
        """See CameraModel."""
        if self.pipeline.in_hand(index):
            return None  # its own message will come
        return camera_status.captured_image(index, self._recording.index)

    def pose(self) -> Pose | None:
        """See CameraModel."""
        return self.navigation.pose_now()

    def troubled(self) -> bool:
        """See CameraModel."""
        return self.alarms.troubled

    def _decode_in_flight(self, value: str) -> None:
        self.pipeline.decoding = value == "on"
        self.writer.later("decoding", f"{value} from now on, by the ground station")

    def _hand_over(self, following: Settings, text: str) -> None:
        """The ground station has set what belongs to a flight: this one ends between two frames, and the next follows.
        Raises CameraError where that would cut something short."""
        assert self._after is not None
        now = self.shutter.statistics()
        if now.interval_s is not None:
            raise CameraError(f"{text} would begin another flight: stop the interval first")
        if now.pending:
            raise CameraError(f"{text} would begin another flight: {now.pending} shots are under way, ask again")
        self._after.next = following
        self.writer.later("next flight", f"{text} from there on, by the ground station")
        self._end()

    # depth tells

    def _tell_distance(self, nearest_m: tuple[float, float]) -> None:
        boot_ms = (self._clock.monotonic_ns() // 10**6) % 2**32
        told = camera_status.distance_message(nearest_m, boot_ms, self._settings().pose.mount)
        if told is not None:
            self._links.send(told)
