"""What the packets of one vehicle told, in order: samples of position, attitude, receiver, gimbal and hot shoe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dappled.daemon.navigation import hot_shoe
from dappled.daemon.navigation import samples as telemetry_samples
from dappled.daemon.navigation.autopilot_time import AutopilotTime
from dappled.daemon.navigation.boot_clock import BootClock
from dappled.daemon.navigation.gimbals import Gimbals
from dappled.daemon.navigation.history import around, between, keep, prune
from dappled.daemon.navigation.hot_shoe import Feedback
from dappled.daemon.navigation.pose import NEAREST_NS, Around
from dappled.daemon.navigation.samples import AttitudeSample, GnssSample, PositionSample
from dappled.drivers.mavlink.links import Message

POSITION_GAP_NS = 2_500_000_000
ATTITUDE_GAP_NS = 1_500_000_000
_ALIVE_NS = 5 * 10**9


@dataclass(slots=True)
class Counts:
    """What was taken of all vehicles so far, and what came out of order."""

    positions: int = 0
    attitudes: int = 0
    feedbacks: int = 0
    out_of_order: int = 0


class VehicleHistory:
    """A fold over packets (number, stamp, message). `system_id` is whose: None for the first autopilot (component 1)
    that is heard. `component_id` is our own (see AutopilotTime). One thread at a time.
    """

    def __init__(self, system_id: int | None, component_id: int, counts: Counts) -> None:
        self.system_id, self.counts = system_id, counts
        self.time = AutopilotTime(component_id)
        self.gimbals = Gimbals()
        self._positions: list[PositionSample] = []
        self._attitudes: list[AttitudeSample] = []
        self._receiver: list[GnssSample] = []
        self._feedbacks: list[Feedback] = []

    def feed(self, number: int, stamp_ns: int, message: Message) -> bool:
        """One packet; False for a kind of no interest. One of another vehicle changes nothing."""
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            handler(self, number, stamp_ns, message)
        return handler is not None

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        prune(self._positions, before_ns)
        prune(self._attitudes, before_ns)
        prune(self._receiver, before_ns)
        prune(self._feedbacks, before_ns)
        self.gimbals.prune(before_ns)
        self.time.prune(before_ns)

    def clock(self, limit: int) -> BootClock | None:
        """The autopilot's clock against ours, from the packets below `limit`; None while unknown."""
        return self.time.clock(limit, (self._positions, self._attitudes))

    def feedbacks(self, limit: int) -> Sequence[Feedback]:
        """What was told of the hot shoe, from the packets below `limit` since the autopilot's last boot."""
        return between(self._feedbacks, self.time.first(limit), limit)

    def reached(self, boot_ns: int) -> bool:
        """Whether samples from after this instant have arrived. Attitude counts only if there was any in the last five
        seconds."""
        positions, attitudes = self._positions[-1:], self._attitudes[-1:]
        if not positions or positions[0].boot_ns < boot_ns:
            return False
        alive = bool(attitudes) and attitudes[0].boot_ns >= positions[0].boot_ns - _ALIVE_NS
        return not alive or attitudes[0].boot_ns >= boot_ns

    def around(self, utc_ns: int, boot_ns: int, sigma_ns: float, limit: int) -> Around:
        """What the packets below `limit` tell of an instant, which is `boot_ns` ± sigma on the autopilot's clock."""
        first = self.time.first(limit)
        receiver = between(self._receiver, first, limit)
        nearest = min(receiver, key=lambda sample: abs(sample.stamp_ns - utc_ns), default=None)
        if nearest is not None and abs(nearest.stamp_ns - utc_ns) > NEAREST_NS:
            nearest = None
        gimbals, gimbal_boot_ns = self.gimbals.around(utc_ns, boot_ns, first, limit)
        return Around(
            utc_ns,
            boot_ns,
            sigma_ns,
            around(between(self._positions, first, limit), boot_ns, gap_ns=POSITION_GAP_NS, nearest_ns=NEAREST_NS),
            around(between(self._attitudes, first, limit), boot_ns, gap_ns=ATTITUDE_GAP_NS, nearest_ns=NEAREST_NS),
            nearest,
            gimbals,
            gimbal_boot_ns,
        )

    def _position(self, number: int, stamp_ns: int, message: Message) -> None:
        sample = telemetry_samples.position(number, stamp_ns, message)
        if sample is not None and self._believed(sample, message, self._positions):
            self.counts.positions += 1
            keep(self._positions, sample)

    def _attitude(self, number: int, stamp_ns: int, message: Message) -> None:
        sample = telemetry_samples.attitude(number, stamp_ns, message)
        if sample is not None and self._believed(sample, message, self._attitudes):
            self.counts.attitudes += 1
            keep(self._attitudes, sample)

    def _gnss(self, number: int, stamp_ns: int, message: Message) -> None:
        if self._ours(message):
            keep(self._receiver, telemetry_samples.gnss(number, stamp_ns, message))

    def _gimbal(self, number: int, stamp_ns: int, message: Message) -> None:
        if message.get_srcSystem() == self.system_id:
            self.gimbals.feed(number, stamp_ns, message)

    def _system_time(self, number: int, stamp_ns: int, message: Message) -> None:
        if self._ours(message):
            self.time.system_time(message)

    def _timesync(self, number: int, stamp_ns: int, message: Message) -> None:
        self.time.timesync(number, stamp_ns, message, from_autopilot=self._ours(message))

    def _feedback(self, number: int, stamp_ns: int, message: Message) -> None:
        if not self._ours(message):
            return
        boot_ns, now_ns = hot_shoe.boot_ns(message, self.time.unix_minus_boot_ns), self.time.now_boot_ns
        if boot_ns is None or now_ns is None or abs(boot_ns - now_ns) > NEAREST_NS:
            return
        self.counts.feedbacks += 1
        keep(self._feedbacks, Feedback(number, stamp_ns, boot_ns, message.get_type()))

    def _ours(self, message: Message) -> bool:
        if message.get_srcComponent() != 1:
            return False
        if self.system_id is None and message.get_type() != "TIMESYNC":
            self.system_id = message.get_srcSystem()
        return bool(message.get_srcSystem() == self.system_id)

    def _believed(
        self,
        sample: PositionSample | AttitudeSample,
        message: Message,
        samples: list[PositionSample] | list[AttitudeSample],
    ) -> bool:
        """Not another vehicle's, not from before a reboot, not a copy, not out of order."""
        if not self._ours(message) or not self.time.believe(sample.number, sample.stamp_ns, sample.boot_ns):
            return False
        if samples and samples[-1].number >= self.time.first(sample.number + 1):
            before_ns = samples[-1].boot_ns
            self.counts.out_of_order += sample.boot_ns < before_ns
            return sample.boot_ns > before_ns
        return True


_HANDLERS: dict[str, Callable[[VehicleHistory, int, int, Message], None]] = {
    "GLOBAL_POSITION_INT": VehicleHistory._position,
    "ATTITUDE_QUATERNION": VehicleHistory._attitude,
    "ATTITUDE_QUATERNION_COV": VehicleHistory._attitude,
    "ATTITUDE": VehicleHistory._attitude,
    "GPS_RAW_INT": VehicleHistory._gnss,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": VehicleHistory._gimbal,
    "MOUNT_ORIENTATION": VehicleHistory._gimbal,
    "TIMESYNC": VehicleHistory._timesync,
    "SYSTEM_TIME": VehicleHistory._system_time,
    "CAMERA_FEEDBACK": VehicleHistory._feedback,
    "CAMERA_TRIGGER": VehicleHistory._feedback,
}
