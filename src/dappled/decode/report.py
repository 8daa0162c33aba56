"""What a decoder says about a frame: which carriers it used, and why; and the light field's value with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dappled.decode.lightfield.light_field import LightField
from dappled.decode.lightfield.views import Views
from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.own_lattice import stretch
from dappled.decode.spectrum.peaks import Measured
from dappled.decode.spectrum.slices import Slices

CarriersFrom = Literal["measured", "calibrated", "predicted", "found"]
DOUBTED = 0.04  # of a carrier's frequency: so far off lies no mask that is where it is said to be
ViewsFrom = Literal["calibration", "frame", "white", "none"]


@dataclass(frozen=True, slots=True)
class DecodeReport:
    """Which carriers a frame was decoded at, and why.

    `predicted` are the half plane's carriers on the sensor as predicted, (0, 0) first, `measured` what was seen near
    each (None: nothing there), `used` those that the slices were cut at. `carriers_from`: "measured" in this frame;
    "calibrated": predicted by the calibration, as too little was to be seen; "predicted": by the law alone; "found":
    a lattice that nobody had named. `views_from`: whose phases and transfer made the views. `noise_rms` is the
    plane's white noise, 1.0 = sensor white.
    """

    predicted: tuple[Carrier, ...]
    measured: tuple[Measured | None, ...]
    used: tuple[Carrier, ...]
    carriers_from: CarriersFrom
    views_from: ViewsFrom
    noise_rms: float

    @property
    def found(self) -> int:
        """How many carriers were seen, the mean (0, 0) included; suspect ones don't count."""
        return sum(m is not None and not m.suspect for m in self.measured)

    @property
    def doubt(self) -> str | None:
        """What is strange about the carriers that were measured, in a sentence."""
        return doubt(self.used, self.predicted) if self.carriers_from == "measured" else None


def doubt(used: Sequence[Carrier], predicted: Sequence[Carrier]) -> str | None:
    """Carriers of a mask that seems not to be where it is said to be, in a sentence; None for those near enough."""
    off = stretch(used, predicted)
    if abs(off) <= DOUBTED:
        return None
    way = "farther out" if off > 0 else "farther in"
    return f"they stand {abs(off):.1%} {way} than predicted: check mask distance and focal length, or calibrate"


def no_views(slices: Slices) -> tuple[Views, NDArray[np.float64]]:
    """The views (0, 0, h, w) and offsets (0, 0, 2) of slices alone."""
    return np.zeros((0, 0, *slices.values.shape[1:]), dtype=np.float32), np.zeros((0, 0, 2))


def light_field(
    slices: Slices,
    views: Views,
    offsets: NDArray[np.float64],
    *,
    shape: tuple[int, ...],
    report: DecodeReport,
    facts: Mapping[str, Any],
) -> LightField:
    """The light field's value, its attributes the facts and what the report says in numbers and words."""
    rows = np.array([(c.ky, c.kx, c.fy, c.fx) for c in slices.carriers], dtype=np.float64)
    attributes = {
        "shape": [int(side) for side in shape],
        **facts,
        "carriers_from": report.carriers_from,
        "views_from": report.views_from,
        "carriers_predicted": len(report.predicted),
        "carriers_found": report.found,
        "noise_rms": report.noise_rms,
    }
    return LightField(slices.values, rows, views, offsets, slices.grid, attributes)
