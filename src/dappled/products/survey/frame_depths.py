"""Measure the inverse distances of single frames of a flight, each from its own light field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.depth import DepthMap, Ranging
from dappled.decode.lightfield import LightField
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.products.maps.photographs import Photograph
from dappled.products.opened import OpenedLightField, OpenError

_KINDS = ("inverse", "sigma")  # arrays of a frame, in files
Estimate = Callable[[OpenedLightField], DepthMap]


@dataclass(frozen=True, slots=True, eq=False)
class InverseDepth:
    """Inverse distances along the lens' axis float32 (h, w), 1/m, of the middle view's pixels, with their standard
    errors; both NaN where the disparity is unknown.

    Inverse distances have errors that are normal and don't depend on the distance, and below 2 σ they can't be told
    from infinity: so frames are averaged in them. `ranging` made them, and tells what error they have in common; `grid`
    maps their pixels to the sensor, as in `LightField`.
    """

    inverse_per_m: Singles
    sigma_per_m: Singles
    ranging: Ranging
    grid: NDArray[np.float64]


def of_field(found: OpenedLightField, made: DepthMap) -> InverseDepth:
    """Convert a depth map (Eq 5: 1/Z = (S − offset)/gain). Raises DappledError where there are no metres."""
    ranging, scale = found.metres(), found.stack.sensor_px_per_disparity
    if scale is None:
        raise OpenError("views from a folder have no sensor, so they give only relative depth")
    share = np.float32(scale / ranging.gain_px_m)
    inverse = made.disparity * share - np.float32(ranging.offset_px / ranging.gain_px_m)
    return InverseDepth(inverse.astype(np.float32), (made.sigma * share).astype(np.float32), ranging, found.field.grid)


@dataclass(frozen=True, slots=True)
class FrameDepths:
    """Collects the inverse distances of frames as they are decoded; arrays lie in files in the folder `scratch`.

    `focus_m` is where the lens was focused; a calibration with targets replaces it. `left` names the frames without
    distances.
    """

    scratch: Path
    estimate: Estimate
    focus_m: float
    found: dict[str, InverseDepth] = field(default_factory=dict)
    left: list[Finding] = field(default_factory=list)

    def measure(self, one: Photograph, decoded: LightField) -> None:
        """Measure one decoded frame; one that has no distances is left out and named."""
        opened = OpenedLightField(decoded, Path(one.name), self.focus_m)
        try:
            made = of_field(opened, self.estimate(opened))
        except DappledError as error:
            self.left.append(finding(Code.FRAME_NO_HEIGHTS, Subject("frame", one.name), why=error))
            return
        for kind, values in zip(_KINDS, (made.inverse_per_m, made.sigma_per_m), strict=True):
            np.save(self.scratch / f"{one.name}-{kind}.npy", values)
        inverse, sigma = (np.load(self.scratch / f"{one.name}-{kind}.npy", mmap_mode="r") for kind in _KINDS)
        self.found[one.name] = replace(made, inverse_per_m=inverse, sigma_per_m=sigma)
