"""Tag a frame: when and where it was exposed, from its file, its trigger call and the telemetry."""

from __future__ import annotations

import logging
from typing import Protocol

from dappled.daemon.navigation import BodyLatency, CameraClock, ExposureTime, clocks
from dappled.daemon.pipeline.capture import NextStage, PendingShot, ShotEnds
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.stream.publisher import Stream
from dappled.daemon.stream.wire import frame_header
from dappled.decode.geometry import Pose, Vector3
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.recipe import camera_name
from dappled.errors import DappledError, report
from dappled.findings import FRAME, Code, Finding, Subject, finding, told
from dappled.flight import Frame, Tag
from dappled.workers import Worker

log = logging.getLogger(__name__)
_QUEUE = 1000


class PoseSource(Protocol):
    """Poses of a flight: live navigation, or recorded telemetry."""

    def pose(self, index: int, exposure: ExposureTime) -> tuple[ExposureTime, Pose]:
        """The exposure as it is known better, and its pose. `exposure` is as expected. Waits a limited time."""

    def rates(self, pose: Pose) -> Vector3 | None:
        """The turn rates of the body (rad/s, about its own axes) at a pose that `pose` gave; None where unknown."""


class Zoom:
    """The focal length from frame to frame. A change in flight moves every carrier."""

    def __init__(self) -> None:
        self._last: tuple[int, float] | None = None

    def look(self, index: int, focal_length_mm: float | None) -> Finding | None:
        """A finding where a frame's focal length differs from that of the last frame that has one."""
        if focal_length_mm is None:
            return None
        before, self._last = self._last, (index, focal_length_mm)
        if before is None or before[1] == focal_length_mm:
            return None
        frame, (earlier, before_mm) = Subject("frame", index), before
        return finding(Code.FRAME_ZOOMED, frame, focal_length_mm=focal_length_mm, before_mm=before_mm, before=earlier)


def tag(
    frame: Frame,
    exposure: ExposureTime,
    settings: ExposureSettings,
    *,
    camera: str,
    mask: str,
    pose: Pose,
    doubt: Finding | None = None,
) -> Tag:
    """All that is known of a frame, in one record. `doubt` says why it may be another shot's."""
    return Tag(
        index=frame.index,
        utc_ns=exposure.utc_ns,
        utc_sigma_ns=exposure.sigma_ns,
        time_source=exposure.source,
        focal_length_mm=settings.focal_length_mm,
        f_number=settings.f_number,
        exposure_s=settings.exposure_s,
        iso=settings.iso,
        camera=camera,
        mask=mask,
        frame_sha256=frame.sha256,
        pose=pose,
        doubts=exposure.doubts if doubt is None else (*exposure.doubts, doubt),
    )


class Tagging:
    """Tag one shot after the other, in one thread. `following` takes those with a frame, tagged and published."""

    def __init__(
        self,
        ends: ShotEnds,
        poses: PoseSource,
        publisher: Stream | None,
        *,
        latency: BodyLatency,
        names: Names,
        following: NextStage,
    ) -> None:
        self._ends, self._poses, self._publisher = ends, poses, publisher
        self._latency, self._names, self._following = latency, names, following
        self._clock = ends.shots.clock
        self._zoom = Zoom()
        self._camera_clock = CameraClock()
        self.worker: Worker[PendingShot] = Worker(
            "tag",
            self._work,
            capacity=_QUEUE,
            on_failure=self._failed,
            on_drop=self._dropped,
            clock=self._clock,
        )

    def take(self, pending: PendingShot) -> None:
        """Queue a shot."""
        self.worker.put(pending)

    def _work(self, pending: PendingShot) -> None:
        """Tag a shot's frame. Where its file stays at the camera, report where it was exposed, and end it."""
        if pending.frame is None:
            pending.where = self._poses.pose(pending.shot.index, self._expected(pending, ExposureSettings()))
            self._ends.tell(self._ends.observer.tagged, pending)
            self._ends.finish(pending)
            return
        self._tag(pending, pending.frame)
        self._following.take(pending)

    def _failed(self, pending: PendingShot, error: Exception) -> None:
        """A frame that can't be tagged."""
        report(log, f"tag of frame {pending.shot.index}", error)
        self._ends.tell(self._ends.observer.tagged, pending)
        self._ends.leave(pending, Code.FRAME_UNTAGGED, error)

    def _dropped(self, pending: PendingShot) -> None:
        self._ends.leave(pending, Code.FRAME_UNTAGGED, finding(Code.QUEUE_FULL, FRAME))

    def _tag(self, pending: PendingShot, frame: Frame) -> None:
        began = self._clock.monotonic_ns()
        settings = self._settings(frame)
        if zoomed := self._zoom.look(frame.index, settings.focal_length_mm):
            log.warning("zoom: %s", told(zoomed))
            self._ends.note("zoom", zoomed, frame.index)
        exposure, pose = self._poses.pose(frame.index, self._expected(pending, settings))
        # The time of a file that may belong to another shot says nothing about the camera's clock.
        if pending.fired and not pending.doubt and (shown := clocks.camera_time(settings.taken)):
            self._camera_clock = self._camera_clock.learnt(*shown, exposure)
        camera = camera_name(self._names.camera, settings.model)
        mask, doubt = self._names.mask, pending.doubt
        pending.tag = tag(frame, exposure, settings, camera=camera, mask=mask, pose=pose, doubt=doubt)
        self._ends.writer.tagged(pending.tag)
        pending.body_c = settings.temperature_c
        pending.rates_rad_s = self._rates(pose)
        pending.ms["tag"] = (self._clock.monotonic_ns() - began) / 1e6
        self._ends.tell(self._ends.observer.tagged, pending)
        if self._publisher:
            self._publisher.publish("frame", frame_header(pending.tag, frame, self._names.law or None))

    def _rates(self, pose: Pose) -> Vector3 | None:
        try:
            return self._poses.rates(pose)
        except Exception as error:  # noqa: BLE001  # a tag must not be lost with what only its verdict needs
            report(log, "turn rates", error)
            return None

    def _settings(self, frame: Frame) -> ExposureSettings:
        from dappled.drivers.raw import reading  # noqa: PLC0415  # see `after_ready`

        try:
            return reading.read_metadata(self._ends.writer.path(frame))
        except DappledError as error:
            found = finding(Code.FILE_UNREADABLE, FRAME, name=frame.name, why=error)
            self._ends.note("unreadable", found, frame.index)
            return ExposureSettings()

    def _expected(self, pending: PendingShot, settings: ExposureSettings) -> ExposureTime:
        """When the frame was exposed, and when it was requested (see `clocks.asked`)."""
        return clocks.asked(self._timed(pending, settings), pending.shot)

    def _timed(self, pending: PendingShot, settings: ExposureSettings) -> ExposureTime:
        """When the frame was exposed, as far as trigger call and file say. See `clocks.owned` for a shot that the
        autopilot's message created.

        By the trigger call and the body's latency; by the camera's own clock, where the driver did not report when it
        fired; else by the request.
        """
        shot = pending.shot
        if pending.fired is not None:
            called_utc_ns = clocks.called_utc_ns(shot, pending.fired.called_monotonic_ns)
            return clocks.owned(
                clocks.mid_exposure(called_utc_ns, self._latency, settings.exposure_s), shot, self._latency
            )
        shown = clocks.camera_time(settings.taken)
        by_camera = shown and clocks.exposure_from_camera(self._camera_clock, *shown, settings.exposure_s)
        if by_camera:
            self._ends.note("untimed", finding(Code.FRAME_UNTIMED, FRAME, by="the camera's clock"), shot.index)
            return by_camera
        self._ends.note("untimed", finding(Code.FRAME_UNTIMED, FRAME, by="the request's time"), shot.index)
        arrived_utc_ns = pending.frame.arrived_utc_ns if pending.frame else None
        return clocks.mid_exposure_by_request(shot.wished_utc_ns, arrived_utc_ns, self._latency, settings.exposure_s)
