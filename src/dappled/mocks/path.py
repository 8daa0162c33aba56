"""Where the simulated vehicle truly is: a smooth survey flight as a pure function of time.

Camera and autopilot run in processes of their own; both call this function with the same seed and so agree on the
truth without a word between them. Local frame: north, east, down in metres from home.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dappled.daemon.interpolation import conjugate, from_euler, metres_per_radian, multiply
from dappled.flight.records import Quaternion, Vector3


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
class Path:
    """A racetrack over home at a constant mean height, with the sway of a small helicopter.

    `t_s` counts seconds from the simulation's start. The home altitude is that of the ground at home, above mean sea
    level.
    """

    seed: int
    home_latitude_deg: float = 41.6361
    home_longitude_deg: float = -91.5417
    home_altitude_msl_m: float = 203.0
    height_m: float = 20.0
    speed_m_s: float = 4.0
    radius_m: float = 25.0

    def pose(self, t_s: float) -> TruePose:
        """The true pose at `t_s`. Velocity and body rates are derivatives of what position and attitude say."""
        step = 1e-3
        before, now, after = (self._place(t_s + dt) for dt in (-step, 0.0, step))
        velocity = (np.array(after[0]) - np.array(before[0])) / (2 * step)
        turn = multiply(conjugate(before[1]), after[1])  # small rotation in body axes over two steps
        sign = math.copysign(1.0, turn[0])
        rates = tuple(float(2 * sign * c / (2 * step)) for c in turn[1:])
        north, east, down = now[0]
        north_m, east_m = metres_per_radian(math.radians(self.home_latitude_deg), self.home_altitude_msl_m)
        latitude = self.home_latitude_deg + math.degrees(north / north_m)
        longitude = self.home_longitude_deg + math.degrees(east / east_m)
        return TruePose(
            t_s=t_s,
            position_ned_m=now[0],
            velocity_ned_m_s=(float(velocity[0]), float(velocity[1]), float(velocity[2])),
            attitude=now[1],
            rates_body_rad_s=(rates[0], rates[1], rates[2]),
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_msl_m=self.home_altitude_msl_m - down,
        )

    def _place(self, t_s: float) -> tuple[Vector3, Quaternion]:
        rng = np.random.default_rng(self.seed)
        phase = rng.uniform(0, 2 * math.pi, 6)
        angle = self.speed_m_s / self.radius_m * t_s + phase[0]
        north = self.radius_m * math.cos(angle)
        east = self.radius_m * math.sin(angle)
        down = -self.height_m - 0.4 * math.sin(0.5 * t_s + phase[1])
        yaw = angle + math.pi / 2 + math.radians(4) * math.sin(0.7 * t_s + phase[2])
        pitch = math.radians(-3) + math.radians(2.5) * math.sin(1.1 * t_s + phase[3])
        roll = math.radians(4) + math.radians(3) * math.sin(0.9 * t_s + phase[4])
        return (north, east, down), from_euler(roll, pitch, yaw)
