"""Report what becomes of shots and camera: to shutter, ground station, logbook, viewers' parts, outside observers."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence

from dappled.daemon.body_plan import BodyNews, BodyTemperature
from dappled.daemon.camera_protocol.camera_status import ReportedCamera, captured_shot
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.health.logbook import Logbook, of_shot
from dappled.daemon.navigation.clocks import UtcLearner
from dappled.daemon.pipeline.capture import Observer, PendingShot
from dappled.daemon.pipeline.occasional import Occasional
from dappled.drivers.camera import Identity, SettingsChanged, StateChanged
from dappled.drivers.mavlink import mavlink
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError, report
from dappled.findings import Code, Evidence, Finding, Subject, finding, text
from dappled.flight import Recording

log = logging.getLogger(__name__)
_OF_BODY = 1000  # the working loop takes them fifty times a second


class ShotEvents(Observer):
    """Observes a live pipeline. `camera` and `utc` are what is known of the camera and of the time.

    `outside` is called last. `misfit` says why the calibration of `recipe` is not for this camera; None where
    it is, or nothing is known of the camera.
    `of_body` is what the plan of the body is compared with, in order; the working loop takes it.
    """

    def __init__(
        self,
        recording: Recording,
        camera: ReportedCamera,
        utc: UtcLearner,
        *,
        component: Component,
        logbook: Logbook,
        viewers: Sequence[Occasional],
        recipe: Recipe | None,
        outside: Observer,
    ) -> None:
        self._recording, self._camera, self._utc = recording, camera, utc
        self._shutter, self._component, self._logbook = component.shutter, component, logbook
        self._viewers, self._recipe, self._outside = viewers, recipe, outside
        self.misfit: Finding | None = None
        self.of_body: deque[BodyNews] = deque(maxlen=_OF_BODY)

    def settled(self, index: int, ok: bool) -> None:
        self._shutter.settled(index, ok)
        self._outside.settled(index, ok)

    def tagged(self, pending: PendingShot) -> None:
        captured = captured_shot(pending, self._utc.utc_ns)
        if self._component.announce(captured):
            self._note_reported(captured.index)
        if not captured.ok and pending.problem is not None:
            words = f"image {pending.shot.index} failed: {text(pending.problem)}"
            self._component.say(words, mavlink.MAV_SEVERITY_ERROR)
        zoomed = None if pending.tag is None else self._camera.zoomed(pending.tag.focal_length_mm)
        if zoomed is not None:
            before_mm, now_mm = zoomed
            words = f"image {pending.shot.index} was zoomed from {before_mm:g} to {now_mm:g} mm: is it calibrated?"
            self._component.say(words)
        if pending.tag is not None:
            self.of_body.append(pending.tag)
        if pending.body_c is not None:
            self.of_body.append(BodyTemperature(pending.body_c))
        self._outside.tagged(pending)

    def finished(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot."""
        self._logbook.add(*of_shot(pending))
        for one in self._viewers:
            one.offer(pending)
        self._outside.finished(pending)

    def camera_changed(self, change: StateChanged) -> None:
        log.debug("camera %s %s", change.state, change.reason)
        if change.state != "busy" and not (change.state == "ready" and self._camera.known):
            reason = f": {change.reason}" if change.reason else ""
            calm = change.state in ("ready", "starting")
            self._logbook.add(f"camera {change.state}{reason}", "info" if calm else "warning")
        self.of_body.append(change)
        self._component.state_changed()
        if change.identity is not None and self._camera.identify(change.identity):
            self._record_camera(change.identity)
            self._judge_calibration(change.identity.model)
        self._outside.camera_changed(change)

    def settings_changed(self, change: SettingsChanged) -> None:
        self.of_body.append(change)
        if change.refused:
            self._logbook.add(f"the camera refused a setting: {change.refused}", "warning")
        self._component.settings_changed(change.refused)
        self._outside.settings_changed(change)

    def _note_reported(self, index: int) -> None:
        """Remember over a restart that the ground station was sent this outcome."""
        try:
            self._recording.index.note_reported(index)
        except DappledError as error:
            report(log, "index", error)

    def _judge_calibration(self, model: str) -> None:
        """Whether the calibration is for this camera. Its mask and law were judged before the flight began."""
        if self._recipe is not None:
            try:
                found = calibration_files.misfit(self._recipe, model)
                # the flight's own copy is read: a pilot on the field has no use for its long name
                why: Evidence = None if found is None else found.with_facts(file="the calibration")
            except DappledError as error:
                why = error
            self.misfit = None if why is None else finding(Code.DECODE_MISFIT, Subject("decoding"), why=why)

    def _record_camera(self, camera: Identity) -> None:
        """Write down which camera it is: the first one, or another."""
        facts = {"make": camera.make, "model": camera.model, "serial": camera.serial, "port": camera.port}
        try:
            self._recording.add_facts({"camera": facts})
        except DappledError as error:
            report(log, "camera", error)
