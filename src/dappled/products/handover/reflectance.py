"""Reflectance by a panel: its factor for each of the camera's colours, and pictures in shares of the light on them.

All on linear values above black, before white balance and matrix. The light, and what the lens takes of it towards the
corners, are taken to be the same on panel and scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from dappled import codec, durable
from dappled.config.schema import read_toml
from dappled.decode.picture.blocks import EMPTY
from dappled.decode.picture.picture import interpolated
from dappled.drivers.raw.picture_maker import MadePicture
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding

STEPS = 32768  # of a TIFF's 16 bits at a reflectance of 1: glints have a stop of room
_UNEVEN = 0.05  # standard deviation over mean
_OVER_NOISE = 10.0
_ISO = 100.0


@dataclass(frozen=True, slots=True)
class PanelColour:
    """A colour of the camera on a panel: mean and standard deviation of `pixels`, as shares of white.

    `factor` is the reflectance over the mean for each unit of exposure: s × ISO / 100 / N², 1 where one is unknown.
    `factor_sigma` holds the mean's standard error and what the panel's reflectance is known to.
    """

    name: str
    mean: float
    deviation: float
    pixels: int
    factor: float
    factor_sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectancePanel:
    """What a photograph of a panel says; settings that are unknown are None. `rectangle_px` is left, top, right,
    bottom in the picture, the latter two excluded."""

    frame: str
    rectangle_px: tuple[int, int, int, int]
    reflectance: float
    reflectance_sigma: float
    camera: str | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    colours: tuple[PanelColour, ...]

    @property
    def exposure(self) -> float | None:
        """How much light a unit of radiance gives."""
        return _exposure(self.exposure_s, self.iso, self.f_number)


@dataclass(frozen=True, slots=True, eq=False)
class ReflectancePicture:
    """uint16 (H, W) or (H, W, 3), `STEPS` at a reflectance of 1. `above_share` of the pixels are brighter than 16 bits
    hold."""

    values: NDArray[np.uint16]
    above_share: float
    description: str


def measured(
    made: MadePicture, frame: str, rectangle_px: tuple[int, int, int, int], *, reflectance: float, sigma: float
) -> tuple[ReflectancePanel, tuple[Finding, ...]]:
    """What the panel in a picture says, and what speaks against it. Raises DappledError where there is none."""
    left, top, right, bottom = rectangle_px
    rows, columns = made.picture.plane.shape
    if not (0 <= left < right <= columns and 0 <= top < bottom <= rows):
        raise DappledError(f"{frame}: the panel isn't inside its {columns} × {rows} px")
    raw, (names, pattern) = made.raw, _colours(made)
    cut = slice(top, bottom), slice(left, right)
    values, noise, trusted = (
        one[cut].astype(np.float64) for one in (made.picture.plane, made.picture.sigma, made.picture.trusted)
    )
    index = pattern[np.arange(top, bottom)[:, None] % len(pattern), np.arange(left, right) % pattern.shape[1]]
    exposure = _exposure(raw.exposure_s, raw.iso, made.f_number)
    colours, over_noise = [], math.inf
    for label, name in enumerate(names):
        own = (index == label) & (trusted > 0)
        pixels = int(np.count_nonzero(own))
        mean = float(values[own].mean()) if pixels > 1 else 0.0
        if mean <= 0:
            raise DappledError(f"{frame}: the panel has no light in {name}, or it is clipped all over")
        deviation, factor = float(values[own].std(ddof=1)), reflectance * (exposure or 1.0) / mean
        relative = math.hypot(deviation / math.sqrt(pixels) / mean, sigma / reflectance)
        colours.append(PanelColour(name, mean, deviation, pixels, factor, factor * relative))
        over_noise = min(over_noise, mean / max(float(np.median(noise[own])), 1e-12))
    subject, found = Subject("frame", frame), []
    clipped = 0.0 if made.picture.valid is None else float(np.mean(~made.picture.valid[cut][index != EMPTY]))
    uneven = max(one.deviation / one.mean for one in colours)
    if exposure is None:
        found.append(finding(Code.PICTURE_EXPOSURE_UNKNOWN, subject))
    if clipped > 0:
        found.append(finding(Code.PICTURE_PANEL_CLIPPED, subject, share=clipped))
    if over_noise < _OVER_NOISE:
        found.append(finding(Code.PICTURE_PANEL_DARK, subject, over_noise=over_noise))
    if uneven > _UNEVEN:
        found.append(finding(Code.PICTURE_PANEL_UNEVEN, subject, share=uneven))
    panel = ReflectancePanel(
        frame=frame,
        rectangle_px=rectangle_px,
        reflectance=reflectance,
        reflectance_sigma=sigma,
        camera=raw.model,
        focal_length_mm=made.focal_length_mm,
        f_number=made.f_number,
        exposure_s=raw.exposure_s,
        iso=raw.iso,
        colours=tuple(colours),
    )
    return panel, tuple(found)


def write(panel: ReflectancePanel, path: Path) -> None:
    """Write a panel's file."""
    durable.write_file(path, tomli_w.dumps(codec.table(panel)).encode())


def read(path: Path) -> ReflectancePanel:
    """Read a panel's file. Raises DappledError for another one."""
    try:
        panel = codec.read(ReflectancePanel, read_toml(path)[0])
    except codec.CodecError as error:
        raise DappledError(f"{path} is no file of a panel: {error}; dappled picture --panel writes one") from None
    settings = (panel.focal_length_mm, panel.f_number, panel.exposure_s, panel.iso)
    numbers = [*(one.factor for one in panel.colours), *(one for one in settings if one is not None)]
    if not panel.colours or not all(math.isfinite(one) and one > 0 for one in numbers):
        raise DappledError(f"{path}: factors and settings of a panel are numbers above 0")
    return panel


def reflected(made: MadePicture, frame: str, panel: ReflectancePanel) -> tuple[ReflectancePicture, tuple[Finding, ...]]:
    """A picture in reflectances, and what speaks against it. Where an exposure is unknown it is taken for the panel's.

    Raises DappledError for a panel of another camera.
    """
    raw, (names, pattern) = made.raw, _colours(made)
    if (raw.model, names) != (panel.camera, tuple(one.name for one in panel.colours)):
        raise DappledError(f"{frame}: the panel was taken with another camera, {panel.camera or 'unknown'}")
    own, subject, found = _exposure(raw.exposure_s, raw.iso, made.f_number), Subject("frame", frame), []
    if own is None or panel.exposure is None:
        found.append(finding(Code.PICTURE_EXPOSURE_UNKNOWN, subject))
        own = panel.exposure or 1.0
    pairs = {
        "f_number": (made.f_number, panel.f_number),
        "iso": (raw.iso, panel.iso),
        "focal_mm": (made.focal_length_mm, panel.focal_length_mm),
    }
    facts: dict[str, float] = {}
    for name, (its, the_panel_s) in pairs.items():
        if its and the_panel_s and not math.isclose(its, the_panel_s, rel_tol=1e-3):
            facts |= {name: its, f"panel_{name}": the_panel_s}
    if facts:
        found.append(finding(Code.PICTURE_PANEL_DIFFERS, subject, None, **facts))
    plane = made.picture.plane.copy()
    for (row, column), label in np.ndenumerate(pattern):
        if label != EMPTY:
            plane[row :: len(pattern), column :: pattern.shape[1]] *= np.float32(panel.colours[label].factor / own)
    steps = np.round(interpolated(replace(made.picture, plane=plane, pattern=pattern)) * STEPS)
    description = (
        f"reflectance x {STEPS}, linear, camera colours {' '.join(names)}; panel {panel.frame}, "
        f"reflectance {panel.reflectance:g}"
    )
    picture = ReflectancePicture(np.clip(steps, 0, 65535).astype(np.uint16), float(np.mean(steps > 65535)), description)
    return picture, tuple(found)


def _exposure(exposure_s: float | None, iso: float | None, f_number: float | None) -> float | None:
    return exposure_s * iso / _ISO / f_number**2 if exposure_s and iso and f_number else None


def _colours(made: MadePicture) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """The colours' names, and the picture's pattern of their numbers: both greens are one colour."""
    pattern, known = made.picture.pattern, made.raw.colour_names
    used = {known[index] for index in np.unique(pattern) if index != EMPTY}
    names = tuple("RGB") if used == set("RGB") else tuple(sorted(used))
    labels = np.array([names.index(name) if name in used else EMPTY for name in known], dtype=np.intp)
    return names, np.where(pattern == EMPTY, EMPTY, labels[pattern])
