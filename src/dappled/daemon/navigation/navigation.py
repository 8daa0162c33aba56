"""Where the vehicle is and what time it is, live: packets come in, poses go out, what is learnt is noted."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable

from dappled.clock import Clock
from dappled.config.settings import Settings
from dappled.daemon.navigation.telemetry import Telemetry, UtcCorrection
from dappled.daemon.navigation.utc import UtcLearner
from dappled.daemon.navigation.vehicles import Vehicles
from dappled.daemon.pipeline.tagger import ExposureTime
from dappled.decode.geometry.pose import Pose
from dappled.drivers.mavlink.links import Packet
from dappled.flight import Recording

log = logging.getLogger(__name__)
AHEAD_NS = 10**9  # a body's latency and half an exposure; what is said to lie further ahead is not waited for
_LOOK_S = 0.005


class Navigation:
    """Owner of one flight's telemetry, of whose it is, and of what the autopilot told of UTC.

    `settings()` are those of now: `pose.wait_ms` may change in flight.
    """

    def __init__(
        self, settings: Callable[[], Settings], clock: Clock, recording: Recording, *, utc_known: bool
    ) -> None:
        now = settings()
        self._settings, self._clock, self._recording = settings, clock, recording
        self._never = threading.Event()
        self.telemetry = Telemetry(
            component_id=now.mavlink.component_id, attitude_sigma_rad=math.radians(now.pose.attitude_sigma_deg)
        )
        self.utc = UtcLearner(known=utc_known, note=self._learn)
        self._vehicles = Vehicles(self.telemetry, recording.ledger.set_fact)

    def on_packet(self, packet: Packet) -> None:
        """A packet was received or sent. What the telemetry log doesn't hold would not be there in a replay."""
        if packet.number is not None:
            self.telemetry.feed(packet.number, packet.stamp_us, packet.message)

    def belongs_to(self, system_id: int | None) -> None:
        """Which system the camera belongs to now, None while that is open. Raises DappledError where a change can't be
        noted; the next call tries again."""
        self._vehicles.look(system_id)

    def look_for_utc(self) -> None:
        """Whether the autopilot can tell UTC by now. Raises DappledError where it can't be noted; the next call tries
        again."""
        self.utc.look(self.telemetry.utc_correction())

    def pose(self, index: int, exposure: ExposureTime) -> tuple[ExposureTime, Pose]:
        """The pose once telemetry from after the exposure is there, or `pose.wait_ms` after it as it is then."""
        give_up_ns = min(exposure.utc_ns, self._clock.utc_ns() + AHEAD_NS) + round(self._settings().pose.wait_ms * 1e6)
        while not self.telemetry.settled(exposure) and self._clock.utc_ns() < give_up_ns:
            self._clock.wait(self._never, _LOOK_S)
        return self.telemetry.locate(exposure)

    def pose_now(self) -> Pose:
        """The vehicle's pose at this moment."""
        return self.telemetry.pose_at(self._clock.utc_ns(), 0.0)

    def _learn(self, found: UtcCorrection) -> None:
        log.info("UTC is %+.3f s from this machine's, by %s", found.correction_ns / 1e9, found.source)
        self._recording.learn_utc(found.correction_ns, found.sigma_ns, found.source)
