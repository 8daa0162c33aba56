"""The height above the ground by a rangefinder that looks down, as the autopilot passes it on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.clock import Clock
from dappled.drivers.mavlink import Packet, mavlink

_FRESH_NS = 10**9
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270


@dataclass(frozen=True, slots=True)
class Range:
    """Metres along the beam, with its standard deviation; None where the sensor doesn't say."""

    metres: float
    sigma_m: float | None


class Rangefinder:
    """The last DISTANCE_SENSOR that looks down, of the vehicle followed. Any thread may ask.

    A distance at or beyond the sensor's limits, one of quality 1 (invalid) and one older than a second are unknown.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last: tuple[int, Range] | None = None

    def heard(self, packet: Packet, vehicle: int | None) -> None:
        """Take any packet; those of the autopilot of this vehicle count."""
        message = packet.message
        if message.get_type() != "DISTANCE_SENSOR" or message.orientation != _DOWN or packet.sent:
            return
        if (message.get_srcSystem(), message.get_srcComponent()) != (vehicle, mavlink.MAV_COMP_ID_AUTOPILOT1):
            return
        known = message.min_distance < message.current_distance < message.max_distance and message.signal_quality != 1
        variance_cm2 = int(message.covariance)
        sigma_m = math.sqrt(variance_cm2) / 100 if 0 < variance_cm2 < 255 else None
        self._last = (self._clock.monotonic_ns(), Range(message.current_distance / 100, sigma_m)) if known else None

    def range(self) -> Range | None:
        """Of the last second; None where it is unknown."""
        last = self._last
        return last[1] if last is not None and self._clock.monotonic_ns() - last[0] <= _FRESH_NS else None
