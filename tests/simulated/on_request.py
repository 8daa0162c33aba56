"""What a simulated vehicle sends on request alone, as ArduPilot does: gimbal and height above ground."""

from __future__ import annotations

from dataclasses import dataclass

from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.mocks.autopilot.path import TruePose

GIMBAL = mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS
RANGEFINDER = mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR
TERRAIN = mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT
_LEAST_CM, _MOST_CM = 20, 5000  # of the rangefinder
_SIGMA_CM = 5


@dataclass(frozen=True, slots=True)
class OnRequest:
    """What the vehicle has: a `gimbal`, a rangefinder and terrain over ground `ground_m` above the take-off place
    (None: neither)."""

    gimbal: bool = False
    ground_m: float | None = None

    def has(self, number: float) -> bool:
        """Whether it can send this message."""
        ground = self.ground_m is not None and number in (RANGEFINDER, TERRAIN)
        return ground or (self.gimbal and number == GIMBAL)

    def message(self, number: int, pose: TruePose, boot_ns: int) -> MavlinkMessage:
        """The message now. Raises ValueError for one that it hasn't."""
        if number == GIMBAL:
            return _gimbal_ahead(boot_ns)
        if self.ground_m is None or number not in (RANGEFINDER, TERRAIN):
            raise ValueError(f"the simulated vehicle has nothing for message {number}")
        height_m = -pose.position_ned_m[2] - self.ground_m
        return distance(height_m, pose, boot_ns) if number == RANGEFINDER else terrain(height_m, pose)


def distance(height_m: float, pose: TruePose, boot_ns: int) -> MavlinkMessage:
    """DISTANCE_SENSOR of a beam along the vehicle's own down, over flat ground. Beyond its reach it sends its limit,
    as ArduPilot's do."""
    _, x, y, _ = pose.attitude
    upright = 1 - 2 * (x * x + y * y)
    metres = height_m / upright if upright > 0 else float("inf")
    centimetres = round(min(max(metres * 100, _LEAST_CM), _MOST_CM))
    return mavlink.MAVLink_distance_sensor_message(
        boot_ns // 10**6 % 2**32, _LEAST_CM, _MOST_CM, centimetres, 0, 1, mavlink.MAV_SENSOR_ROTATION_PITCH_270,
        _SIGMA_CM**2,
    )  # fmt: skip


def terrain(height_m: float, pose: TruePose) -> MavlinkMessage:
    """TERRAIN_REPORT: the height above terrain that the autopilot has in a grid of 100 m."""
    latitude, longitude = round(pose.latitude_deg * 1e7), round(pose.longitude_deg * 1e7)
    above_sea_m = pose.altitude_msl_m - height_m
    return mavlink.MAVLink_terrain_report_message(latitude, longitude, 100, above_sea_m, height_m, 0, 8)


def _gimbal_ahead(boot_ns: int) -> MavlinkMessage:
    """A gimbal's attitude: level, looking ahead, turning with the vehicle."""
    flags = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    level = [1.0, 0.0, 0.0, 0.0]
    return mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, boot_ns // 10**6, flags, level, 0, 0, 0, 0)
