"""One frame, judged before a flight: go or no-go, with what was measured and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.daemon.health.go_no_go import State
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult, Recipe
from dappled.drivers.raw.reading import RawFile
from dappled.errors import DappledError

CLIPPED_SHARE = 0.01
DARK_SHARE = 0.01
SHARP = {1: 0.31, 2: 0.335}
"""Below this fineness a picture holds nothing finer than two pixels; by the square of the step's length. 0.25 is
perfectly smooth, 1 noise; sharp pictures of the ground have 0.4 along rows and columns and 0.5 along diagonals."""
ONE_WAY = 0.85
"""Motion blurs along one direction; along the one at right angles the picture stays as sharp as it was."""
SEEN_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. `measured` holds the numbers behind the text."""

    name: str
    state: State
    text: str
    measured: dict[str, Any]


def examine(frame: Path, recipe: Recipe | None) -> list[Finding]:
    """All findings of a frame. Raises DappledError for a file that is no picture."""
    raw = reading.read(frame)
    found = [_focal_length(raw), _exposure(raw)]
    if recipe is None:
        text = "no mask is configured: carriers, focus and motion were not looked at (set mask.profile)"
        return [*found, Finding("carriers", "caution", text, {})]
    try:
        made = Darkroom(recipe).develop(frame, views=False)
    except DappledError as error:
        return [*found, Finding("carriers", "no-go", f"it can't be decoded: {error}", {})]
    picture = np.abs(made.light_field.slices[0])
    return [*found, _carriers(made, recipe), *sharpness(picture)]


def _focal_length(raw: RawFile) -> Finding:
    if raw.focal_length_mm is None:
        text = "the file names none: where the carriers lie can't be predicted (a lens with contacts says it)"
        return Finding("focal length", "no-go", text, {"focal_length_mm": None})
    aperture = "" if raw.f_number is None else f", f/{raw.f_number:g}"
    return Finding(
        "focal length", "go", f"{raw.focal_length_mm:g} mm{aperture}", {"focal_length_mm": raw.focal_length_mm}
    )


def _exposure(raw: RawFile) -> Finding:
    black = float(np.mean(raw.black))
    share = (raw.mosaic.astype(np.float32) - black) / (raw.white - black)
    clipped, mean = float(np.mean(share >= 0.99)), float(np.mean(share))
    measured = {"clipped_share": clipped, "mean_share": mean}
    if clipped > CLIPPED_SHARE:
        text = f"{clipped:.1%} of the pixels are white: expose less (clipped carriers can't be mended)"
        return Finding("exposure", "no-go", text, measured)
    if mean < DARK_SHARE:
        return Finding("exposure", "no-go", f"only {mean:.1%} of white on average: expose more", measured)
    return Finding("exposure", "go", f"{clipped:.2%} clipped, {mean:.0%} of white on average", measured)


def _carriers(made: DecodeResult, recipe: Recipe) -> Finding:
    seen, predicted = made.carriers_found, made.carriers_predicted
    measured = {"seen": seen, "predicted": predicted, "from": made.report.carriers_from}
    if recipe.mask == profiles.LENSLET or predicted == 0:
        return Finding("carriers", "go", f"{made.report.carriers_from}", measured)
    text = f"{seen} of {predicted} where they are predicted"
    if made.report.doubt:
        return Finding("carriers", "caution", f"{seen} of {predicted} seen; {made.report.doubt}", measured)
    if seen >= SEEN_SHARE * predicted:
        return Finding("carriers", "go", text, measured)
    if recipe.calibration:
        return Finding("carriers", "caution", f"{text}: the calibration stands in; stop down to see more", measured)
    advice = "is the mask in, the profile right, the focal length read? stop down for a test, then `dappled calibrate`"
    return Finding("carriers", "no-go", f"{text}: {advice}", measured)


def sharpness(picture: NDArray[Any]) -> list[Finding]:
    """Focus and motion blur of a picture (rows, columns): how fine its detail is along four directions."""
    along = {name: _fineness(picture, step) for name, step in _DIRECTIONS.items()}
    measured = {"fineness": {name: round(value, 3) for name, value in along.items()}}
    shown = ", ".join(f"{value:.2f} {name}" for name, value in along.items())
    sharp = any(along[name] >= SHARP[r * r + c * c] for name, (r, c) in _DIRECTIONS.items())
    if not sharp:
        text = f"nothing in the picture is sharp (fineness {shown}): focus anew"
        return [Finding("focus", "no-go", text, measured), Finding("motion", "caution", "not to be told", measured)]
    focus = Finding("focus", "go", f"fineness {shown} (sharp: 0.4, diagonally 0.5)", measured)
    for pair in (("across", "along"), ("falling", "rising")):
        soft, fine = sorted(pair, key=lambda name: along[name])
        if along[soft] < ONE_WAY * along[fine]:
            text = f"detail is lost {soft} ({along[soft]:.2f} against {along[fine]:.2f} {fine}): shorten the exposure"
            return [focus, Finding("motion", "no-go", text, measured)]
    return [focus, Finding("motion", "go", "as sharp one way as the other", measured)]


_DIRECTIONS = {"across": (0, 1), "along": (1, 0), "falling": (1, 1), "rising": (1, -1)}


def _fineness(picture: NDArray[Any], step: tuple[int, int]) -> float:
    """Mean squared differences one step apart against two steps, in logarithms so that light and shade count alike."""
    logs = np.log(np.maximum(picture, 1e-6 * max(float(picture.max()), 1e-12)))
    one, two = (_differences(logs, (step[0] * n, step[1] * n)) for n in (1, 2))
    return one / two if two > 0 else 0.0


def _differences(values: NDArray[Any], step: tuple[int, int]) -> float:
    (rows, columns), (height, width) = step, values.shape
    a = values[_part(height, rows), _part(width, columns)]
    b = values[_part(height, -rows), _part(width, -columns)]
    return float(np.mean((a - b) ** 2))


def _part(length: int, shift: int) -> slice:
    return slice(max(shift, 0), length + min(shift, 0))
