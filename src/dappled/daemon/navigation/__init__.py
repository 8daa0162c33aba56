"""Where the vehicle was, how it pointed, and when a frame was exposed: telemetry, clocks, poses."""

from dappled.daemon.navigation.clocks import BodyLatency, BootClock, CameraClock, ExposureTime, UtcCorrection
from dappled.daemon.navigation.navigation import (
    Navigation,
    Telemetry,
    TelemetryStatistics,
    first_position_utc_ns,
    recorded_vehicles,
)

__all__ = [
    "BodyLatency", "BootClock", "CameraClock", "ExposureTime", "Navigation", "Telemetry", "TelemetryStatistics",
    "UtcCorrection", "first_position_utc_ns", "recorded_vehicles",
]  # fmt: skip
