"""The vehicle's battery by SYS_STATUS, as MAVLink's common.xml has it: mV, 65535 unknown; %, -1 unknown."""

from __future__ import annotations

import pytest

from dappled.daemon.vehicle_battery import BatteryReports, VehicleBattery, battery_of
from dappled.drivers.mavlink import MavlinkMessage, mavlink

BATTERY = 0x2000000  # MAV_SYS_STATUS_SENSOR_BATTERY
S = 10**9


def status(voltage_mv: int, percent: int, *, watched: int = BATTERY, health: int = BATTERY) -> MavlinkMessage:
    return mavlink.MAVLink_sys_status_message(watched, watched, health, 0, voltage_mv, -1, percent, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("message", "battery"),
    [
        (status(24_830, 76), VehicleBattery(24.83, 76, False)),
        (status(21_600, 25), VehicleBattery(21.6, 25, True)),
        (status(21_600, 26), VehicleBattery(21.6, 26, False)),
        (status(24_830, 76, health=0), VehicleBattery(24.83, 76, True)),
        (status(24_830, 76, watched=0, health=0), VehicleBattery(24.83, 76, False)),  # not watched: it can't be ill
        (status(24_830, -1), VehicleBattery(24.83, None, None)),
        (status(65_535, -1), VehicleBattery(None, None, None)),
        (status(0, -1, watched=0, health=0), VehicleBattery(None, None, None)),  # no battery monitor
        (status(0, 0), VehicleBattery(None, 0, True)),
        (status(12_000, 127), VehicleBattery(12.0, None, None)),  # what no battery holds
        (status(12_000, -128), VehicleBattery(12.0, None, None)),
    ],
)
def test_what_is_known_and_what_is_not(message: MavlinkMessage, battery: VehicleBattery) -> None:
    assert battery_of(message) == battery


def test_a_report_lasts_for_five_seconds() -> None:
    reports = BatteryReports()
    assert reports.now(100 * S) is None
    reports.heard(status(24_830, 76), 100 * S)
    assert reports.now(105 * S) == VehicleBattery(24.83, 76, False)
    assert reports.now(105 * S + 1) is None
