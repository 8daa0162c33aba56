"""The true path of the simulated vehicle: a smooth survey flight as a pure function of time.

Camera and autopilot run in processes of their own. Both call this function with the same seed, and so agree on the
truth without communication. Local frame: north, east, down in metres from home. The mathematics does not come from the
daemon, which is checked with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dappled.decode.geometry import Quaternion, Vector3

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
    speed_m_s: float = 4.0
    radius_m: float = 25.0

    def pose(self, t_s: float) -> TruePose:
        """The true pose at `t_s`. Velocity and body rates are derivatives of what position and attitude say."""
        step = 1e-3
        places, turns = self._places(t_s + step * np.array((-1.0, 0.0, 1.0)))
        velocity = (places[2] - places[0]) / (2 * step)
        before, _, after = turns.as_matrix()
        turned = before.T @ after  # in body axes, over two steps: so little that its skew part says it all
        rates = np.array((turned[2, 1], turned[0, 2], turned[1, 0])) / (2 * step)
        x, y, z, w = turns.as_quat()[1].tolist()
        north, east, down = places[1].tolist()
        north_m, east_m = self._metres_per_radian()
        return TruePose(
            t_s=t_s,
            position_ned_m=(north, east, down),
            velocity_ned_m_s=_vector(velocity),
            attitude=(w, x, y, z),
            rates_body_rad_s=_vector(rates),
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

    def _places(self, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], Rotation]:
        """Positions (n, 3), north-east-down, and attitudes at n times."""
        phase = np.random.default_rng(self.seed).uniform(0, 2 * math.pi, 6)
        angle = self.speed_m_s / self.radius_m * t_s + phase[0]
        north = self.radius_m * np.cos(angle)
        east = self.radius_m * np.sin(angle)
        down = -self.height_m - 0.4 * np.sin(0.5 * t_s + phase[1])
        yaw = angle + math.pi / 2 + math.radians(4) * np.sin(0.7 * t_s + phase[2])
        pitch = math.radians(-3) + math.radians(2.5) * np.sin(1.1 * t_s + phase[3])
        roll = math.radians(4) + math.radians(3) * np.sin(0.9 * t_s + phase[4])
        turns = Rotation.from_euler("ZYX", np.stack((yaw, pitch, roll), axis=-1))
        return np.stack((north, east, down), axis=-1), turns


def _vector(parts: NDArray[np.float64]) -> Vector3:
    return float(parts[0]), float(parts[1]), float(parts[2])
