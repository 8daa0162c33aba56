"""The tag stage: when and where a frame was exposed, from its file, its trigger call and the telemetry."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace

from dappled.daemon.navigation import BodyLatency, CameraClock, ExposureTime, clocks
from dappled.daemon.pipeline import tagger
from dappled.daemon.pipeline.pending_shot import FlightWriter, Names, Observer, PendingShot, PoseSource
from dappled.daemon.pipeline.pending_shots import PendingShots
from dappled.daemon.pipeline.tagger import Zoom
from dappled.daemon.stream.publisher import Publisher
from dappled.daemon.stream.wire import frame_header
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import camera_name
from dappled.errors import DappledError
from dappled.flight import Frame

log = logging.getLogger(__name__)


class Tagging:
    """Tags one story after the other, in one thread. `hand_on` takes those with a frame, tagged and published."""

    def __init__(
        self,
        writer: FlightWriter,
        shots: PendingShots,
        observer: Observer,
        publisher: Publisher | None,
        *,
        poses: PoseSource,
        latency: BodyLatency,
        names: Names,
        hand_on: Callable[[PendingShot], object],
    ) -> None:
        self._writer, self._shots, self._observer, self._publisher = writer, shots, observer, publisher
        self._poses, self._latency, self._names, self._hand_on = poses, latency, names, hand_on
        self._zoom = Zoom()
        self._camera_clock = CameraClock()

    def work(self, pending: PendingShot) -> None:
        """Tag a story's frame. Where its file stays at the camera, tell where it was exposed, and end it."""
        if pending.frame is None:
            pending.where = self._poses(pending.shot.index, self._expected(pending, tagger.FrameSettings()))
            self._shots.tell(self._observer.tagged, pending)
            self._shots.finish(pending)
            return
        self._tag(pending, pending.frame)
        self._hand_on(pending)

    def failed(self, pending: PendingShot, why: str) -> None:
        """A frame that can't be tagged."""
        self._shots.tell(self._observer.tagged, pending)
        self._shots.leave(pending, "not tagged", why)

    def _tag(self, pending: PendingShot, frame: Frame) -> None:
        began = time.monotonic_ns()
        settings = self._settings(frame)
        if zoomed := self._zoom.look(frame.index, settings.focal_length_mm):
            log.warning("zoom: %s", zoomed)
            self._shots.note("zoom", zoomed, frame.index)
        exposure, pose = self._poses(frame.index, self._expected(pending, settings))
        # A file that may be another shot's would teach another shot's time.
        if pending.fired and not pending.doubt and (told := clocks.camera_time(settings.taken)):
            self._camera_clock = self._camera_clock.learnt(*told, exposure)
        if pending.doubt:
            exposure = replace(exposure, source=f"{exposure.source}; in doubt: {pending.doubt}")
        camera = camera_name(self._names.camera, settings.model)
        pending.tag = tagger.tag(frame, exposure, settings, camera=camera, mask=self._names.mask, pose=pose)
        self._writer.tagged(pending.tag)
        pending.ms["tag"] = (time.monotonic_ns() - began) / 1e6
        self._shots.tell(self._observer.tagged, pending)
        if self._publisher:
            self._publisher.publish("frame", frame_header(pending.tag, frame, self._names.law or None))

    def _settings(self, frame: Frame) -> tagger.FrameSettings:
        try:
            return tagger.FrameSettings.of(reading.read_metadata(self._writer.path(frame)))
        except DappledError as error:
            self._shots.note("unreadable", str(error), frame.index)
            return tagger.FrameSettings()

    def _expected(self, pending: PendingShot, settings: tagger.FrameSettings) -> ExposureTime:
        """When the frame was exposed, as far as trigger call and file tell: by the trigger call and the body's latency;
        by the camera's own clock, where the driver never said when it fired; else by the wish."""
        shot = pending.shot
        if pending.fired is not None:
            called_utc_ns = clocks.called_utc_ns(shot, pending.fired.called_monotonic_ns)
            return clocks.mid_exposure(called_utc_ns, self._latency, settings.exposure_s)
        told = clocks.camera_time(settings.taken)
        by_camera = told and clocks.exposure_from_camera(self._camera_clock, *told, settings.exposure_s)
        if by_camera:
            self._shots.note("untimed", "the driver never said when it fired: the camera's clock is used", shot.index)
            return by_camera
        self._shots.note("untimed", "the driver never said when it fired: the wish's time is used", shot.index)
        arrived_utc_ns = pending.frame.arrived_utc_ns if pending.frame else None
        return clocks.mid_exposure_by_request(shot.wished_utc_ns, arrived_utc_ns, self._latency, settings.exposure_s)
