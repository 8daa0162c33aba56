"""Hot-shoe feedback: the autopilot's own word of when a camera exposed, and which word belongs to which shot.

CAMERA_FEEDBACK (ArduPilot: boot time with a feedback pin, else GPS epoch) and CAMERA_TRIGGER (PX4: boot time). Both
are also sent for the mere wish to fire, without a contact in the hot shoe. Such a message is told by its time: it is
not after our own trigger call, and nothing exposes before that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from dappled.daemon.navigation.boot_clock import BootClock
from dappled.daemon.pipeline.tagger import ExposureTime
from dappled.drivers.mavlink.links import Message

CONTACT_SIGMA_NS = 1_000_000  # interrupt and contact bounce; the best bodies were measured at 0.56 ms
EPOCH_US = 10**15  # 2001; no autopilot has been running for that long
_REACH_SIGMAS = 4
_REACH_NS = 50_000_000
_WISH_NS = 3_000_000


@dataclass(frozen=True, slots=True)
class Feedback:
    """One message: the contact's time since boot. `number` is its packet's in the log."""

    number: int
    stamp_ns: int
    boot_ns: int
    kind: str


def boot_ns(message: Message, unix_minus_boot_ns: int | None) -> int | None:
    """When the contact closed, in time since boot; None for a GPS time while SYSTEM_TIME hasn't told the offset."""
    time_us = int(message.time_usec)
    if time_us < EPOCH_US:
        return time_us * 1000 if time_us > 0 else None
    return None if unix_minus_boot_ns is None else time_us * 1000 - unix_minus_boot_ns


def reach_ns(exposure: ExposureTime) -> int:
    """How far from its expected time an exposure may be seen."""
    return _REACH_SIGMAS * exposure.sigma_ns + _REACH_NS


def choose(events: Sequence[Feedback], exposure: ExposureTime, clock: BootClock) -> Feedback | None:
    """The event of this exposure, or None where there is none.

    It is the one nearest to when the exposure was expected to begin, within 4 σ + 50 ms of that (σ of the body and of
    the clocks), and after the trigger call. None also where two are so near that either may be it (half the nearer
    one's distance + 5 ms): a wrong time would be worse than a wide one.
    """
    if exposure.called_utc_ns is None:
        return None
    within_ns = reach_ns(exposure) + _REACH_SIGMAS * clock.sigma_ns
    expected_ns = clock.boot_ns(exposure.utc_ns - exposure.half_ns)
    # the line between wish and contact can be drawn no finer than the clocks agree
    earliest_ns = clock.boot_ns(exposure.called_utc_ns) + max(_WISH_NS, 3 * clock.sigma_ns)
    near = sorted(
        (abs(event.boot_ns - expected_ns), event.number, event)
        for event in events
        if event.boot_ns >= earliest_ns and abs(event.boot_ns - expected_ns) <= within_ns
    )
    if not near:
        return None
    doubtful_ns = near[0][0] * 1.5 + 5_000_000
    if any(distance <= doubtful_ns and event.boot_ns != near[0][2].boot_ns for distance, _, event in near[1:]):
        return None
    return near[0][2]


def refined(exposure: ExposureTime, event: Feedback, clock: BootClock) -> tuple[ExposureTime, int]:
    """The exposure as the hot shoe has it, and mid-exposure in time since boot."""
    middle_boot_ns = event.boot_ns + exposure.half_ns
    sigma_ns = round(math.hypot(CONTACT_SIGMA_NS, clock.sigma_ns))
    source = f"hot shoe ({event.kind})"
    return replace(exposure, utc_ns=clock.utc_ns(middle_boot_ns), sigma_ns=sigma_ns, source=source), middle_boot_ns
