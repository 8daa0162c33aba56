"""One gimbal's attitudes: which gimbal and message count, and its clock, which need not be the autopilot's."""

from __future__ import annotations

from dappled.daemon.navigation.autopilot_time import ARRIVAL_WINDOW_NS
from dappled.daemon.navigation.boot_clock import from_arrivals
from dappled.daemon.navigation.history import around, between, keep, last, prune
from dappled.daemon.navigation.pose import NEAREST_NS
from dappled.daemon.navigation.samples import GIMBAL_COMPONENTS, GimbalSample, gimbal
from dappled.drivers.mavlink.links import Message

_AUTOPILOT = 1
GAP_NS = 1_500_000_000


class Gimbals:
    """Keeps to the first gimbal that speaks; MOUNT_ORIENTATION counts until it sends the modern message."""

    def __init__(self) -> None:
        self._samples: list[GimbalSample] = []
        self.seen = 0

    def feed(self, number: int, stamp_ns: int, message: Message) -> None:
        """One packet of the vehicle's system. A sample with an older time is a late copy, or a gimbal begun anew."""
        if message.get_srcComponent() not in GIMBAL_COMPONENTS:
            return
        before = self._samples[-1] if self._samples else None
        sample = gimbal(number, stamp_ns, message, before.epoch if before else 0)
        if sample is None:
            return
        if before is not None:
            modern = sample.kind != "MOUNT_ORIENTATION" and before.kind == "MOUNT_ORIENTATION"
            same = (before.component, before.kind) == (sample.component, sample.kind)
            anew = sample.boot_ns < before.boot_ns - NEAREST_NS
            if not (modern or (same and (anew or sample.boot_ns > before.boot_ns))):
                return
            if modern or anew:
                sample = gimbal(number, stamp_ns, message, before.epoch + 1)
                assert sample is not None
        self.seen += 1
        keep(self._samples, sample)

    def around(self, utc_ns: int, boot_ns: int, first: int, limit: int) -> tuple[tuple[GimbalSample, ...], int]:
        """The samples of the packets below `limit` around an instant (see `telemetry_history.around`), and the instant
        on their clock. `boot_ns` is the instant on the autopilot's clock, which began at packet `first`."""
        known = between(self._samples, 0, limit)
        if not known:
            return (), boot_ns
        if known[-1].component == _AUTOPILOT:
            known = between(known, first, limit)
        samples = [sample for sample in known if sample.epoch == known[-1].epoch]
        if samples and samples[0].component != _AUTOPILOT:
            clock = from_arrivals([(one.boot_ns, one.stamp_ns) for one in last(samples, ARRIVAL_WINDOW_NS)])
            assert clock is not None
            boot_ns = clock.boot_ns(utc_ns)
        return around(samples, boot_ns, gap_ns=GAP_NS, nearest_ns=NEAREST_NS), boot_ns

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        prune(self._samples, before_ns)
