"""A MAVLink camera on real UDP links, without hardware: links, component and shutter as the daemon has them."""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType

from dappled.clock import Clock, RecordedClock, SystemClock
from dappled.config.settings import PoseSettings
from dappled.daemon.camera_protocol.camera_status import CameraFacts, Captured
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes
from dappled.daemon.camera_protocol.own_autopilot import OwnAutopilot
from dappled.daemon.camera_protocol.parameters import Parameters
from dappled.daemon.navigation import Telemetry
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink import MavlinkLinks, MavlinkMessage, Packet, Signing, mavlink, pack
from dappled.findings import Finding
from dappled.flight import Cause, Shot
from dappled.flight.layout import DiskSpace
from tests.daemon.fakes import Nowhere
from tests.waiting import eventually


class NothingEarlier(EarlierOutcomes):
    """No outcome of an earlier flight is left to report."""

    def __init__(self) -> None:
        pass

    def summary(self) -> None:
        """Nothing was lost."""

    def due(self, now_ns: int) -> tuple[()]:
        return ()

    def sent(self, index: int) -> None:
        """Never: nothing is due."""


class Camera:
    """A camera with each frame `exposure_s` after its request. `fails` are indices that fail; `hung`: none ever comes.
    `settled`: it belongs to system 1 without having listened for autopilots.

    `causes` are the shots, in order; `done` how they ended."""

    def __init__(
        self,
        *,
        urls: Sequence[str] = ("udpin:127.0.0.1:0",),
        first: int = 0,
        capacity: int = 8,
        exposure_s: float = 0.02,
        fails: Sequence[int] = (),
        done: dict[int, Captured] | None = None,
        signing: Signing | None = None,
        settled: bool = True,
        clock: Clock | None = None,
        settable: Callable[[Camera], Parameters] = Parameters,
    ) -> None:
        self.clock = clock or SystemClock()
        self.telemetry = Telemetry()
        self.logged = 0
        self.causes: list[Cause] = []
        self.lost_triggers: list[Finding] = []
        self.done: dict[int, Captured] = {} if done is None else done
        self.hung = False
        self._first, self._exposure_s, self._fails = first, exposure_s, fails
        self._fired: queue.Queue[int | None] = queue.Queue()
        self.links = MavlinkLinks(
            urls,
            system_id=1,
            component_id=100,
            clock=self.clock,
            signing=signing,
        )
        self.shutter = Shutter(self, self.clock, next_index=first, capacity=capacity)
        autopilot = OwnAutopilot(self.links.sender, self.clock)
        autopilot.identity.settled = settled
        self.component = Component(
            autopilot,
            self.shutter,
            settable(self),
            model=self,
            earlier=NothingEarlier(),
            series=DistanceTrigger(self.shutter, Nowhere(), self.clock, mount=self.mount),
        )
        self._worker = threading.Thread(target=self._work)

    def __enter__(self) -> Camera:
        self.links.start(self, self.component)
        self.shutter.start()
        self._worker.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(self.clock, RecordedClock):
            self.clock.close()
        self.shutter.stop()
        self.links.stop()
        self._fired.put(None)
        self._worker.join(60)

    @property
    def url(self) -> str:
        return f"udpout:127.0.0.1:{self.links.port(0)}"

    def idle(self) -> None:
        """Wait until every shot has ended and was announced."""
        eventually(
            lambda: all(index in self.done for index in range(self._first, self._first + len(self.causes))),
            f"every shot ended: {sorted(self.done)}",
        )

    def received(self) -> int:
        """Packets that came in and were handled, on all links."""
        with self.links.sender.order:  # the one that was counted last is handled too
            return sum(link.packets_in for link in self.links.statistics())

    def failures(self) -> int:
        """Packets whose handling raised: always a bug."""
        return sum(link.failures for link in self.links.statistics())

    def obstacle(self) -> None:
        """There is none."""

    def note(self, shot: Shot) -> None:
        self.causes.append(shot.cause)

    def fire(self, shot: Shot) -> None:
        self._fired.put(shot.index)

    def refused(self, why: Finding) -> None:
        """Told to the sender alone."""

    mount = PoseSettings().mount
    on_gimbal = False

    def facts(self) -> CameraFacts:
        return CameraFacts("dappled", "test", (0, 1, 0))

    def storage(self) -> DiskSpace:
        return DiskSpace(2**34, 2**33, 2**33)

    def lookup(self, index: int) -> Captured | None:
        return self.done.get(index)

    def pose(self) -> None:
        """Not known."""

    def lost(self, triggers: Finding) -> None:
        self.lost_triggers.append(triggers)

    def troubled(self) -> bool:
        return False

    def settings(self) -> tuple[Setting, ...]:
        return (Setting("iso", "100", ("100", "200")),)

    def change(self, name: SettingName, value: str) -> None:
        """Never done: the body is deaf."""

    def log_packet(self, stamp_us: int, raw: bytes) -> int:
        self.logged += 1
        return self.logged - 1

    def on_packet(self, packet: Packet) -> None:
        assert packet.number is not None
        self.telemetry.feed(packet.number, packet.stamp_us, packet.message)

    def _work(self) -> None:
        while True:
            try:
                index = self._fired.get(timeout=0.005)
            except queue.Empty:
                self.component.tick()
                continue
            if index is None:
                return
            if self.hung:
                continue
            threading.Event().wait(self._exposure_s)
            captured = Captured(index, ok=index not in self._fails, utc_ns=self.clock.utc_ns())
            self.shutter.settled(index, captured.ok)
            self.component.announce(captured)
            self.done[index] = captured


class Peer:
    """A program at the other end of a link, byte by byte: what it sends and hears is in the test's hand."""

    def __init__(self, port: int, system: int = 255, component: int = 190) -> None:
        self.packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.heard: list[MavlinkMessage] = []
        self.decode = mavlink.MAVLink(None).decode

    def __enter__(self) -> Peer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.socket.close()

    def packed(self, message: MavlinkMessage, *, version_1: bool = False) -> bytes:
        return pack(message, self.packer, version_1=version_1)

    def raw(self, data: bytes) -> None:
        self.socket.send(data)

    def send(self, message: MavlinkMessage) -> None:
        self.raw(self.packed(message))

    def heartbeat(self) -> None:
        """As the kind of machine that this one's ids say it is."""
        kind = (2, 3) if self.packer.srcComponent == 1 else (6, 8)
        self.send(mavlink.MAVLink_heartbeat_message(*kind, 0, 0, 4, 3))

    def command(self, name: int, *parameters: float, confirmation: int = 0, target: tuple[int, int] = (1, 100)) -> None:
        padded = (*parameters, *[0.0] * (7 - len(parameters)))
        self.send(mavlink.MAVLink_command_long_message(*target, name, confirmation, *padded))

    def until(self, wanted: Callable[[MavlinkMessage], bool], what: str, timeout_s: float = 60.0) -> MavlinkMessage:
        """The first message not returned yet that is wanted; others before it are kept in `heard` alone."""
        deadline = time.monotonic() + timeout_s
        while True:
            left = deadline - time.monotonic()
            assert left > 0, f"never heard: {what}; heard {[m.get_type() for m in self.heard[-20:]]}"
            self.socket.settimeout(left)
            try:
                message = self.decode(bytearray(self.socket.recv(65536)))
            except TimeoutError:
                continue
            self.heard.append(message)
            if wanted(message):
                return message

    def ack(self, name: int) -> int:
        """The result of the command that was sent last."""
        message = self.until(lambda m: m.get_type() == "COMMAND_ACK" and m.command == name, f"an answer to {name}")
        return int(message.result)

    def one(self, kind: str) -> MavlinkMessage:
        """The next message of this type."""
        return self.until(lambda m: m.get_type() == kind, kind)

    def count(self, kind: str) -> int:
        """How many of this type were heard."""
        return sum(m.get_type() == kind for m in self.heard)
