"""The vehicle's battery, as its autopilot reports it."""

from __future__ import annotations

from dataclasses import dataclass

from dappled.drivers.mavlink import MavlinkMessage, mavlink

BATTERY_STREAM = (mavlink.MAVLINK_MSG_ID_SYS_STATUS, 1_000_000)  # message, interval in microseconds
LOW_PERCENT = 25
_FRESH_NS = 5 * 10**9
_UNKNOWN_MV = 65535
_SENSOR = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY


@dataclass(frozen=True, slots=True)
class VehicleBattery:
    """Voltage and what is left; None where the autopilot doesn't know. `low`: a quarter or less is left, or the
    autopilot reports the battery as not healthy (ArduPilot: by its own failsafe); None where it says neither."""

    voltage_v: float | None
    remaining_percent: int | None
    low: bool | None


class BatteryReports:
    """The autopilot's last SYS_STATUS. Times are monotonic. Any thread may call."""

    def __init__(self) -> None:
        self._last: tuple[int, VehicleBattery] | None = None

    def heard(self, message: MavlinkMessage, now_ns: int) -> None:
        """Take a SYS_STATUS of our autopilot."""
        self._last = now_ns, battery_of(message)

    def now(self, now_ns: int) -> VehicleBattery | None:
        """The battery by a report of the last five seconds; None without one."""
        last = self._last
        return last[1] if last is not None and now_ns - last[0] <= _FRESH_NS else None


def battery_of(message: MavlinkMessage) -> VehicleBattery:
    """What a SYS_STATUS says about the first battery. An autopilot without a battery monitor sends 0 V or 65535 mV, and
    -1 % left."""
    voltage_mv, percent = int(message.voltage_battery), int(message.battery_remaining)
    voltage_v = voltage_mv / 1000 if 0 < voltage_mv < _UNKNOWN_MV else None
    remaining = percent if 0 <= percent <= 100 else None
    watched = message.onboard_control_sensors_present & message.onboard_control_sensors_enabled & _SENSOR
    unhealthy = bool(watched) and not message.onboard_control_sensors_health & _SENSOR
    low = True if unhealthy else None if remaining is None else remaining <= LOW_PERCENT
    return VehicleBattery(voltage_v, remaining, low)
