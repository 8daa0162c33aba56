"""The height above the ground below, as a rangefinder that looks down or the autopilot's terrain gives it."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence

from dappled.daemon.navigation.samples import GroundSample
from dappled.decode.geometry import GroundHeight, Quaternion, turned
from dappled.drivers.mavlink import MavlinkMessage, mavlink

_WITHIN_NS: Mapping[str, int] = {"rangefinder": 10**9, "terrain": 3 * 10**9}
"""So long before or after an instant a report counts for it; the first source that knows the height is taken."""
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270
_UPRIGHT = 0.5  # cosine of the tilt: at more than 60° the beam meets the ground elsewhere


def ground_sample(number: int, stamp_ns: int, message: MavlinkMessage) -> GroundSample | None:
    """A DISTANCE_SENSOR or TERRAIN_REPORT; None for a sensor that doesn't look down.

    The height is unknown at or beyond the sensor's limits, with quality 1 (invalid), and where the autopilot has no
    terrain (spacing 0).
    """
    if message.get_type() == "TERRAIN_REPORT":
        height_m = float(message.current_height) if message.spacing else math.nan
        return GroundSample(number, stamp_ns, "terrain", height_m if math.isfinite(height_m) else None, None)
    if message.orientation != _DOWN:
        return None
    known = message.min_distance < message.current_distance < message.max_distance and message.signal_quality != 1
    variance_cm2 = int(message.covariance)
    sigma_m = math.sqrt(variance_cm2) / 100 if 0 < variance_cm2 < 255 else None
    return GroundSample(number, stamp_ns, "rangefinder", message.current_distance / 100 if known else None, sigma_m)


def ground_height(
    samples: Sequence[GroundSample], utc_ns: int, attitude: Quaternion | None, sinking_m_s: float | None
) -> GroundHeight | None:
    """The height at an instant, by the nearest report of each source; None where none knows it.

    A rangefinder's beam is along the vehicle's own down: without an attitude, or tilted by more than 60°, it says
    nothing. The sigma grows by the vertical speed times the report's age.
    """
    for source, within_ns in _WITHIN_NS.items():
        since = bisect_left(samples, utc_ns - within_ns, key=lambda sample: sample.stamp_ns)
        upto = bisect_right(samples, utc_ns + within_ns, key=lambda sample: sample.stamp_ns)
        of_source = [one for one in samples[since:upto] if one.source == source]
        if not of_source:
            continue
        one = min(of_source, key=lambda sample: abs(sample.stamp_ns - utc_ns))
        upright = 1.0
        if source == "rangefinder":
            upright = 0.0 if attitude is None else turned(attitude, (0.0, 0.0, 1.0))[2]
        if one.height_m is None or upright < _UPRIGHT:
            continue
        age_s = abs(one.stamp_ns - utc_ns) / 1e9
        sigma_m = None if one.sigma_m is None else math.hypot(one.sigma_m, (sinking_m_s or 0.0) * age_s)
        return GroundHeight(one.height_m * upright, sigma_m, source, age_s * 1e3)
    return None
