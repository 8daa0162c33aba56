"""The true path of the simulated vehicle: a smooth survey flight as a pure function of time.

Camera and autopilot run in processes of their own. Both call this function with the same seed, and so agree on the
truth without communication. Local frame: north, east, down in metres from home. The mathematics does not come from the
daemon, which is checked with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dappled.decode.geometry import Quaternion, Vector3

SPEED_M_S = 4.0
_EQUATOR_M, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84


@dataclass(frozen=True, slots=True)
class TruePose:
    """The vehicle at one moment. `attitude` (w, x, y, z) turns body (forward, right, down) into north-east-down."""

    t_s: float
    position_ned_m: Vector3
    velocity_ned_m_s: Vector3
    attitude: Quaternion
    rates_body_rad_s: Vector3
    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float


@dataclass(frozen=True, slots=True)
class FlightPath:
    """A racetrack over home at a constant mean height, with the sway of a small helicopter.

    `t_s` counts seconds from the simulation's start. The home altitude is that of the ground at home, above mean sea
    level.
    """

    seed: int
    home_latitude_deg: float = 41.6361
    home_longitude_deg: float = -91.5417
    home_altitude_msl_m: float = 203.0
    height_m: float = 20.0
    speed_m_s: float = SPEED_M_S
    radius_m: float = 25.0

    def pose(self, t_s: float) -> TruePose:
        """The true pose at `t_s`. Velocity and body rates are the derivatives of position and attitude."""
        phase = _phases(self.seed)
        turn_rad_s = self.speed_m_s / self.radius_m
        angle = turn_rad_s * t_s + phase[0]
        cos, sin = math.cos(angle), math.sin(angle)
        north, east = self.radius_m * cos, self.radius_m * sin
        down = -self.height_m - 0.4 * math.sin(0.5 * t_s + phase[1])
        velocity = (-self.speed_m_s * sin, self.speed_m_s * cos, -0.2 * math.cos(0.5 * t_s + phase[1]))
        yaw, yaw_rad_s = _sway(4, 0.7, t_s, phase[2])
        yaw, yaw_rad_s = angle + math.pi / 2 + yaw, turn_rad_s + yaw_rad_s
        pitch, pitch_rad_s = _sway(2.5, 1.1, t_s, phase[3])
        pitch += math.radians(-3)
        roll, roll_rad_s = _sway(3, 0.9, t_s, phase[4])
        roll += math.radians(4)
        level, steep, right, left = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
        rates = (
            roll_rad_s - yaw_rad_s * steep,
            pitch_rad_s * right + yaw_rad_s * left * level,
            yaw_rad_s * right * level - pitch_rad_s * left,
        )
        north_m, east_m = self._metres_per_radian()
        return TruePose(
            t_s=t_s,
            position_ned_m=(north, east, down),
            velocity_ned_m_s=velocity,
            attitude=_attitude(yaw, pitch, roll),
            rates_body_rad_s=rates,
            latitude_deg=self.home_latitude_deg + math.degrees(north / north_m),
            longitude_deg=self.home_longitude_deg + math.degrees(east / east_m),
            altitude_msl_m=self.home_altitude_msl_m - down,
        )

    def _metres_per_radian(self) -> tuple[float, float]:
        """Of latitude and of longitude at home, by the ellipsoid's radii of curvature."""
        latitude = math.radians(self.home_latitude_deg)
        squared = _FLATTENING * (2 - _FLATTENING)
        root = math.sqrt(1 - squared * math.sin(latitude) ** 2)
        across_m, along_m = _EQUATOR_M / root, _EQUATOR_M * (1 - squared) / root**3
        height_m = self.home_altitude_msl_m
        return along_m + height_m, (across_m + height_m) * math.cos(latitude)


@lru_cache
def _phases(seed: int) -> tuple[float, ...]:
    return tuple(np.random.default_rng(seed).uniform(0, 2 * math.pi, 6).tolist())


def _sway(size_deg: float, rad_s: float, t_s: float, phase: float) -> tuple[float, float]:
    """An angle that swings, and its rate of change."""
    size, at = math.radians(size_deg), rad_s * t_s + phase
    return size * math.sin(at), size * rad_s * math.cos(at)


def _attitude(yaw: float, pitch: float, roll: float) -> Quaternion:
    """First the yaw about down, then the pitch, then the roll."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(one / 2), math.sin(one / 2)) for one in (yaw, pitch, roll))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
