"""Read stopped-down frames for a calibration: what each shows of the mask, and what they show together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from dappled.cli.table import words_only
from dappled.errors import DappledError
from dappled.findings import Finding, Subject, told

if not words_only:
    from dappled.config import profiles
    from dappled.config.profiles import CameraProfile
    from dappled.decode.calibration import Calibration
    from dappled.decode.calibration.fit import CalibrationFrame, from_lattices, lattice_of
    from dappled.decode.calibration.lattice_fit import FrameLattice
    from dappled.decode.optics import MaskedOptics
    from dappled.drivers.raw.darkroom import Darkroom, naming
    from dappled.drivers.raw.raw_file import RawFile, exposure, not_linear


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """What a calibration frame shows, with its camera and size. `overridden` is why its values may not be linear."""

    shown: FrameLattice
    shape: tuple[int, int]
    model: str
    overridden: tuple[Finding, ...] = ()


class Given(NamedTuple):
    """What a call says of all its frames; `anyway` takes also those that are not linear."""

    focal_length_mm: float | None = None
    f_number: float | None = None
    anyway: bool = False


_NOTHING = Given()


def view_of(darkroom: Darkroom, path: Path, given: Given = _NOTHING) -> CalibrationView:
    """What one frame shows. Raises DappledError where it can't be used."""
    raw = darkroom.read(path)
    length, stop = given.focal_length_mm or raw.focal_length_mm, given.f_number or raw.f_number
    if length is None or stop is None:
        raise DappledError(f"{path} doesn't say its focal length and f-number: give --focal-length and --f-number")
    bent = not_linear(raw, exposure(raw), of=Subject("calibration frame", path.name))
    if bent and not given.anyway:
        raise DappledError(
            f"{path}: {'; '.join(str(told(one, one.subject)) for one in bent)}; --anyway calibrates with it"
        )
    camera = darkroom.camera(raw.model or "")
    stops = camera.f_numbers
    with naming(path):
        plane = darkroom.plane(raw)
        shape = plane.shape[0], plane.shape[1]
        shown = lattice_of(
            CalibrationFrame(plane, length, stop, _focal_sigma_mm(raw, given.focal_length_mm), stops and stops[1]),
            _optics(darkroom, camera, shape),
            workers=2,
        )
    return CalibrationView(shown, shape, raw.model or "", tuple(bent))


def views_of(
    darkroom: Darkroom, paths: Iterable[Path], given: Given
) -> tuple[list[CalibrationView], list[tuple[Path, DappledError]]]:
    """What the good frames show, and why the others can't be used. All are of one camera and size."""
    good: list[CalibrationView] = []
    bad: list[tuple[Path, DappledError]] = []
    for path in paths:
        try:
            one = view_of(darkroom, path, given)
            if good and (one.shape, one.model) != (good[0].shape, good[0].model):
                first, this = (f"{s.model} {s.shape[0]} × {s.shape[1]}" for s in (good[0], one))
                bad.append((path, DappledError(f"{path} is of another camera or size ({this}, the first {first})")))
            else:
                good.append(one)
        except DappledError as error:
            bad.append((path, error))
    return good, bad


def _focal_sigma_mm(raw: RawFile, named_mm: float | None) -> float:
    """The standard error of a frame's focal length, which EXIF rounds within ± focal_sigma_mm; 0 if it is named."""
    return 0.0 if named_mm or raw.focal_sigma_mm is None else raw.focal_sigma_mm / math.sqrt(3)


def fit_views(darkroom: Darkroom, seen: Sequence[CalibrationView], *, choose_law: bool = False) -> Calibration:
    """The calibration that these frames show together; with `choose_law` also which law explains them best."""
    camera = darkroom.camera(seen[0].model)
    found = from_lattices(
        [one.shown for one in seen],
        _optics(darkroom, camera, seen[0].shape),
        choose_law=choose_law,
    )
    return replace(found, overridden=(*found.overridden, *(bent for one in seen for bent in one.overridden)))


def _optics(darkroom: Darkroom, camera: CameraProfile, shape: tuple[int, int]) -> MaskedOptics:
    mask, law = profiles.mask(darkroom.recipe.mask).mask, darkroom.recipe.law or camera.law
    return MaskedOptics(camera.sensor(shape), mask, law, camera.mask_distance_mm)
