"""Who hears what becomes of the shots and of the camera: shutter, ground station, log, depth, and those who watch."""

from __future__ import annotations

import logging
from collections.abc import Callable

from dappled.config.settings import Settings
from dappled.daemon.camera_protocol import camera_status
from dappled.daemon.camera_protocol.camera_status import CameraFacts
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.health.logbook import Logbook, battery_doubt, of_shot
from dappled.daemon.pipeline.live_depth import LiveDepth
from dappled.daemon.pipeline.pending_shot import Observer, PendingShot
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.camera import Identity, SettingsChanged, StateChanged
from dappled.drivers.mavlink import mavlink
from dappled.errors import DappledError, report
from dappled.flight import Recording

log = logging.getLogger(__name__)


class ShotEvents:
    """Tells everybody; remembers which camera it is and how its lens stood last, for a ground station that asks.

    `utc_ns` puts a stamp of this flight right, None while that can't be done. `outside` hears last.
    """

    def __init__(
        self,
        settings: Settings,
        recording: Recording,
        shutter: Shutter,
        component: Component,
        logbook: Logbook,
        *,
        utc_ns: Callable[[int], int | None],
        outside: Observer,
        depth: LiveDepth | None,
    ) -> None:
        self._settings, self._recording, self._shutter, self._component = settings, recording, shutter, component
        self._logbook, self._utc_ns, self._outside, self._depth = logbook, utc_ns, outside, depth
        self._identity: Identity | None = None
        self._focal_length_mm: float | None = None
        self._chip = camera_status.sensor_facts(settings, "")
        self._battery_doubt: str | None = None

    def observer(self) -> Observer:
        """For the street."""
        return Observer(self._settled, self._tagged, self._finished, self._camera_changed, self._settings_changed)

    def facts(self) -> CameraFacts:
        """The camera as it is known by now."""
        return camera_status.camera_facts(self._identity, self._focal_length_mm, self._chip)

    def doubt(self) -> str | None:
        """A sentence where the camera will soon be of no use."""
        return self._battery_doubt

    def _settled(self, index: int, ok: bool) -> None:
        self._shutter.settled(index, ok)
        self._outside.settled(index, ok)

    def _tagged(self, pending: PendingShot) -> None:
        captured = camera_status.captured_shot(pending, self._utc_ns)
        self._component.announce(captured)
        if not captured.ok:
            self._component.say(f"image {pending.shot.index} failed: {pending.problem}", mavlink.MAV_SEVERITY_ERROR)
        if pending.tag is not None:
            before_mm, now_mm = self._focal_length_mm, pending.tag.focal_length_mm
            if before_mm and now_mm and before_mm != now_mm:
                text = f"image {pending.shot.index} was zoomed from {before_mm:g} to {now_mm:g} mm: is it calibrated?"
                self._component.say(text)
            self._focal_length_mm = now_mm or before_mm
        self._outside.tagged(pending)

    def _finished(self, pending: PendingShot) -> None:
        self._logbook.add(*of_shot(pending))
        if self._depth is not None:
            self._depth.offer(pending)
        self._outside.finished(pending)

    def _camera_changed(self, change: StateChanged) -> None:
        log.debug("camera %s %s", change.state, change.reason)  # whoever runs the daemon says it in words
        if change.state != "busy" and not (change.state == "ready" and self._identity):
            reason = f": {change.reason}" if change.reason else ""
            calm = change.state in ("ready", "starting")
            self._logbook.add(f"camera {change.state}{reason}", "info" if calm else "warning")
        self._component.state_changed()
        if change.identity is not None and change.identity != self._identity:
            self._meet(change.identity)
        self._outside.camera(change)

    def _meet(self, who: Identity) -> None:
        """Another camera than before, or the first one."""
        self._identity = who
        self._chip = camera_status.sensor_facts(self._settings, who.model)
        facts = {"make": who.make, "model": who.model, "serial": who.serial, "port": who.port}
        try:
            self._recording.add_facts({"camera": facts})
        except DappledError as error:
            report(log, "camera", error)

    def _settings_changed(self, change: SettingsChanged) -> None:
        self._battery_doubt = battery_doubt(change.settings)
        self._component.settings_changed(change.refused)
        self._outside.settings(change)
