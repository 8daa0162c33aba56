"""The autopilot's time since boot against our UTC: from TIMESYNC answers, or from when packets arrived.

Both are pure functions of what was observed, so a replay gets the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRIFT_SIGMA = 50e-6  # crystals of autopilots: some tens of ppm between two machines
_PRIOR = np.diag([0.0, 1 / (DRIFT_SIGMA * 1e9) ** 2])  # of level (ns) and slope (ns/s)
_TIMESYNC_FLOOR_NS = 50_000.0
_TIMESYNC_ASYMMETRY = 0.05  # share of the least round trip by which the two ways may differ; not observable
_ARRIVAL_FLOOR_NS = 5e6  # the shortest way through radio, UART and scheduler; not observable from one side


@dataclass(frozen=True, slots=True)
class TimesyncAnswer:
    """One answer to our TIMESYNC request: the autopilot's clock between our sending and our receiving."""

    number: int
    sent_utc_ns: int
    received_utc_ns: int
    boot_ns: int

    @property
    def stamp_ns(self) -> int:
        """When it came."""
        return self.received_utc_ns

    @property
    def delay_ns(self) -> int:
        """Round trip."""
        return self.received_utc_ns - self.sent_utc_ns

    @property
    def offset_ns(self) -> int:
        """UTC minus boot time, if both ways took equally long."""
        return (self.sent_utc_ns + self.received_utc_ns) // 2 - self.boot_ns


@dataclass(frozen=True, slots=True)
class BootClock:
    """UTC = boot time + offset + drift × (boot time − reference). Sigma is one standard deviation of UTC."""

    source: Literal["timesync", "arrival"]
    reference_boot_ns: int
    offset_ns: int
    drift: float
    sigma_ns: float

    def utc_ns(self, boot_ns: int) -> int:
        """UTC at a boot time."""
        return boot_ns + self.offset_ns + round(self.drift * (boot_ns - self.reference_boot_ns))

    def boot_ns(self, utc_ns: int) -> int:
        """Boot time at a UTC."""
        near = utc_ns - self.offset_ns
        return near - round(self.drift / (1 + self.drift) * (near - self.reference_boot_ns))


def from_timesync(answers: Sequence[TimesyncAnswer]) -> BootClock | None:
    """A line through the answers, quick ones weighing most; None from fewer than three.

    An answer that took `e` longer than the quickest one is wrong by at most e/2, all of it on one way: its weight is
    1 / (s² + (e/2)²). `s` is half the lower quartile of e, so that on a link where delays spread evenly (no answer is
    much better than the next) all answers share the work. The slope has a prior of 0 ± 50 ppm. Sigma comes from what
    the answers leave over, each at its own weight (White's estimate): right also where the weights are not.
    """
    if len(answers) < 3:
        return None
    reference = answers[-1]
    delay = np.array([answer.delay_ns for answer in answers], dtype=np.float64)
    x = np.array([answer.boot_ns - reference.boot_ns for answer in answers], dtype=np.float64) / 1e9
    y = np.array([answer.offset_ns - reference.offset_ns for answer in answers], dtype=np.float64)
    half = (delay - delay.min()) / 2
    weight = 1 / (max(_TIMESYNC_FLOOR_NS, float(np.sort(half)[len(half) // 4])) ** 2 + half**2)
    freedom = len(answers) - 2
    _, _, left = _line(x, y, weight)
    weight /= max(float(weight @ left**2) / freedom, 1e-4)  # now in the prior's own measure
    (level, slope), inverse, left = _line(x, y, weight)
    sides = np.stack([np.ones_like(x), x]) * (weight * left)
    scatter = sides @ sides.T * (len(answers) / freedom) + _PRIOR
    variance = max(float((inverse @ scatter @ inverse)[0, 0]), 0.1 * float(inverse[0, 0]))
    return BootClock(
        "timesync",
        reference.boot_ns,
        reference.offset_ns + round(level),
        float(slope) / 1e9,
        math.hypot(math.sqrt(variance), _TIMESYNC_ASYMMETRY * float(delay.min())),
    )


def _line(x: Array, y: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Weighted least squares with the prior: (level, slope), the inverse of the normal matrix, what is left over."""
    sides = np.stack([np.ones_like(x), x])
    inverse = np.asarray(np.linalg.inv((sides * weight) @ sides.T + _PRIOR), dtype=np.float64)
    found = inverse @ (sides @ (weight * y))
    return found, inverse, y - found @ sides


def from_arrivals(arrivals: Sequence[tuple[int, int]]) -> BootClock | None:
    """The least of (arrival − boot time) over `arrivals`, pairs (boot_ns, received_utc_ns); None from none.

    Late by the quickest way's own delay, which nothing here can see: sigma allows 5 ms for it, and a tenth of the
    median excess.
    """
    if not arrivals:
        return None
    offsets = sorted(received - boot for boot, received in arrivals)
    median_excess = offsets[len(offsets) // 2] - offsets[0]
    return BootClock("arrival", arrivals[-1][0], offsets[0], 0.0, math.hypot(_ARRIVAL_FLOOR_NS, 0.1 * median_excess))
