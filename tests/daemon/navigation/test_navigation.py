"""Live poses: waited for no longer than the settings say, whatever an exposure's time claims to be."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.config.settings import PoseSettings, Settings
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation import ExposureTime, Navigation
from dappled.daemon.navigation.navigation import AHEAD_NS
from dappled.flight import TimeSource, recording

NOW_NS = 1_790_000_000 * 10**9


class TurningClock(SystemClock):
    """Goes on only while somebody waits for it."""

    def __init__(self) -> None:
        super().__init__(NOW_NS)
        self.now_ns = NOW_NS

    def monotonic_ns(self) -> int:
        return self.now_ns - NOW_NS

    def utc_ns(self) -> int:
        return self.now_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        self.now_ns += round(timeout_s * 1e9)
        return event.is_set()


@pytest.mark.parametrize(
    ("ahead_ns", "waited_ns"), [(-(10**9), 0), (0, 300 * 10**6), (3600 * 10**9, AHEAD_NS + 300 * 10**6)]
)
def test_without_telemetry_the_wait_is_bounded(tmp_path: Path, ahead_ns: int, waited_ns: int) -> None:
    clock, settings = TurningClock(), Settings(pose=PoseSettings(wait_ms=300.0))
    flight = recording.begin(tmp_path, clock, {})
    try:
        navigation = Navigation(LiveSettings(settings), clock, flight, utc_known=True)
        exposure = ExposureTime(NOW_NS + ahead_ns, 10**6, TimeSource.REQUEST)
        found, pose = navigation.pose(0, exposure)
        assert (found, pose.source) == (exposure, "none")
        assert waited_ns <= clock.now_ns - NOW_NS <= waited_ns + 10**7
        assert navigation.pose_now().source == "none"
    finally:
        flight.close()
