"""The daemon's parts between link and tag, on an injected clock: what `autopilot_cell.py` flies."""

from __future__ import annotations

from collections.abc import Callable

from dappled.clock import RecordedClock
from dappled.config.settings import PoseSettings
from dappled.daemon.camera_protocol.camera_status import CameraFacts, Captured
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes
from dappled.daemon.camera_protocol.own_autopilot import OwnAutopilot
from dappled.daemon.camera_protocol.parameters import Parameters
from dappled.daemon.navigation import BodyLatency, ExposureTime, Telemetry, clocks
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.decode.geometry import Pose
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink, pack
from dappled.findings import Finding
from dappled.flight import Shot
from dappled.flight.layout import DiskSpace

START_NS = 1_790_000_000 * 10**9
LATENCY_MS, LATENCY_SIGMA_MS = 60.0, 10.0
EXPOSURE_S = 1 / 500
US = (1, 100)


class _Body:
    """A body without settings."""

    def settings(self) -> tuple[Setting, ...]:
        return ()

    def change(self, name: SettingName, value: str) -> None:
        raise AssertionError(name)


class _NothingEarlier(EarlierOutcomes):
    def __init__(self) -> None:
        pass

    def summary(self) -> None:
        """Nothing was lost."""

    def due(self, now_ns: int) -> tuple[()]:
        return ()

    def sent(self, index: int) -> None:
        """Never."""


class Daemon:
    """The daemon's parts between link and tag. `send` gets what it sends, `fired` each shot that it makes. `before` is
    one that has crashed."""

    system_id, component_id = US
    mount = PoseSettings().mount
    on_gimbal = False

    def __init__(
        self,
        *,
        outside: bool,
        camera: int,
        send: Callable[[MavlinkMessage], None],
        fired: Callable[[Shot], None],
        before: Daemon | None,
    ) -> None:
        self.clock: RecordedClock = before.clock if before else RecordedClock(START_NS, START_NS - 10**12)
        next_index: int = before.shutter.statistics().next_index if before else 0
        self.telemetry: Telemetry = Telemetry(
            component_id=US[1], cam_idx=camera, doubt=before.telemetry.position_doubt() if before else None
        )
        self.shutter: Shutter = Shutter(self, self.clock, next_index=next_index, capacity=1000, fires=not outside)
        self.latency = BodyLatency(LATENCY_MS, LATENCY_SIGMA_MS, fired_outside=outside)
        self.named = 0
        self._send, self._fired, self._packets = send, fired, 0
        self._packer = mavlink.MAVLink(None, *US)
        self.component = Component(
            OwnAutopilot(self, self.clock, cam_idx=camera),
            self.shutter,
            Parameters(_Body()),
            model=self,
            earlier=_NothingEarlier(),
            series=DistanceTrigger(self.shutter, self, self.clock, mount=self.mount),
        )

    def receive(self, link: int, message: MavlinkMessage, raw: bytes) -> None:
        """As a link does: navigation first, then the component."""
        stamp_us = self.clock.utc_ns() // 1000
        self.telemetry.feed(self._packets, stamp_us, message)
        self._packets += 1
        self.component.on_packet(Packet(self._packets - 1, stamp_us, link, message, raw))

    def send(self, message: MavlinkMessage, link: int | None = None, *, without: int | None = None) -> bool:
        if message.get_type() == "TIMESYNC":
            pack(message, self._packer, version_1=False)
            self.telemetry.feed(self._packets, self.clock.utc_ns() // 1000, message)
            self._packets += 1
            self._send(message)
        return True

    def expected(self, shot: Shot, busy_ns: int = 0) -> ExposureTime:
        """As `Tagging` has it: the call is a millisecond after the request, or after the body was `busy_ns`."""
        called_ns = clocks.called_utc_ns(shot, shot.wished_monotonic_ns + busy_ns + 10**6)
        return clocks.owned(clocks.mid_exposure(called_ns, self.latency, EXPOSURE_S), shot, self.latency)

    def obstacle(self) -> None:
        """There is none."""

    def note(self, shot: Shot) -> None:
        """Not written down."""

    def fire(self, shot: Shot) -> None:
        self._fired(shot)

    def refused(self, why: Finding) -> None:
        """Counted by the shutter."""

    def facts(self) -> CameraFacts:
        return CameraFacts("dappled", "matrix", (0, 1, 0))

    def storage(self) -> DiskSpace | None:
        return None

    def lookup(self, index: int) -> Captured | None:
        return None

    def pose(self) -> Pose | None:
        return None

    def height(self) -> None:
        """Photographs by distance are asked of nobody here."""

    def field(self) -> None:
        """As above."""

    def busy(self) -> bool:
        return False

    def troubled(self) -> bool:
        return False

    def lost(self, triggers: Finding) -> None:
        self.named += triggers.number("triggers")
