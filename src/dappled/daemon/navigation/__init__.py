"""Where the vehicle was, how it pointed, and when a frame was exposed: telemetry, clocks, poses."""

from dappled.daemon.navigation.clocks import BodyLatency, BootClock, CameraClock, ExposureTime
from dappled.daemon.navigation.navigation import Navigation, Telemetry, recorded_doubt, recorded_vehicles
from dappled.daemon.navigation.samples import TelemetryCounts, UtcCorrection, first_position_utc_ns

__all__ = [
    "BodyLatency", "BootClock", "CameraClock", "ExposureTime", "Navigation", "Telemetry", "TelemetryCounts",
    "UtcCorrection", "first_position_utc_ns", "recorded_doubt", "recorded_vehicles",
]  # fmt: skip
