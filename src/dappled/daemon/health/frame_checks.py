"""Check one frame before a flight: focal length, exposure, carriers, focus, motion blur."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.daemon.health.host_checks import Check, State
from dappled.daemon.pipeline.verdicts import DIRECTIONS, fineness
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult, Recipe
from dappled.drivers.raw.raw_file import MOST_CLIPPED, exposure
from dappled.drivers.raw.reading import RawFile
from dappled.errors import DappledError
from dappled.findings import FRAME, told

DARK_SHARE = 0.01
SHARP = {1: 0.31, 2: 0.335}
"""A picture below this fineness has no detail finer than two pixels; keys are the squared length of the step. 0.25 is
perfectly smooth, 1 is noise; sharp pictures of the ground have 0.4 along rows and columns, 0.5 along diagonals."""
ONE_WAY = 0.85
"""Motion blurs along one direction; at right angles to it the picture stays sharp. Below this ratio it is blur."""
SEEN_SHARE = 0.5


def check_frame(frame: Path, recipe: Recipe | None) -> list[Check]:
    """The results of all checks of a frame. Raises DappledError for a file that can't be read as a frame."""
    raw = reading.read(frame)
    found = [_focal_length(raw), *_tones(raw, "caution" if recipe is None else "no-go"), _exposure(raw)]
    if recipe is None:
        text = "no mask is configured: carriers, focus and motion were not checked (set mask.profile)"
        return [*found, Check("carriers", "caution", text)]
    try:
        made = Darkroom(recipe).decode(frame, views=False)
    except DappledError as error:
        return [*found, Check("carriers", "no-go", f"it can't be decoded: {error}")]
    picture = np.abs(made.light_field.slices[0])
    return [*found, _carriers(made, recipe), *_doubts(made), *sharpness(picture)]


def _focal_length(raw: RawFile) -> Check:
    if raw.focal_length_mm is None:
        text = "the file has none: the carriers can't be predicted (use a lens with contacts)"
        return Check("focal length", "no-go", text, measured={"focal_length_mm": None})
    aperture = "" if raw.f_number is None else f", f/{raw.f_number:g}"
    return Check(
        "focal length", "go", f"{raw.focal_length_mm:g} mm{aperture}", measured={"focal_length_mm": raw.focal_length_mm}
    )


def _tones(raw: RawFile, state: State) -> list[Check]:
    if not raw.developed:
        return []
    return [Check("tones", state, f"{raw.developed}: its tones are not linear; set the camera to raw files")]


def _exposure(raw: RawFile) -> Check:
    exposed = exposure(raw, every=1)
    clipped, mean = exposed.clipped_share, exposed.mean_share
    measured = {"clipped_share": clipped, "mean_share": mean}
    if clipped > MOST_CLIPPED:
        text = f"{clipped:.1%} of the pixels are white: expose less (clipped carriers can't be restored)"
        return Check("exposure", "no-go", text, measured=measured)
    if mean < DARK_SHARE:
        return Check("exposure", "no-go", f"only {mean:.1%} of white on average: expose more", measured=measured)
    return Check("exposure", "go", f"{clipped:.2%} clipped, {mean:.0%} of white on average", measured=measured)


def _carriers(made: DecodeResult, recipe: Recipe) -> Check:
    seen, predicted = made.carriers_found, made.carriers_predicted
    measured = {"seen": seen, "predicted": predicted, "from": made.report.carriers_from}
    if recipe.mask == profiles.LENSLET or predicted == 0:
        return Check("carriers", "go", f"{made.report.carriers_from}", measured=measured)
    text = f"{seen} of {predicted} where they are predicted"
    if made.search is not None and made.search.found is not None:
        law = made.light_field.attributes["law"]
        text = (
            f"{seen} of {predicted} seen by the law {law}, none where configured; a flight is decoded by what is seen"
        )
        return Check("carriers", "caution", f"{text} ({made.search.sentence}): calibrate", measured=measured)
    if made.report.doubts:
        text = f"{seen} of {predicted} seen; {'; '.join(told(one, FRAME) for one in made.report.doubts)}"
    elif not made.observable:
        text = "none can be seen at this aperture, so mask and focal length are not checked: stop down for a test"
    elif seen >= SEEN_SHARE * predicted:
        return Check("carriers", "go", text, measured=measured)
    elif recipe.calibration:
        text = f"{text}: the calibration is used instead; stop down to see more"
    else:
        advice = "check mask, profile and focal length; stop down for a test, then `dappled calibrate`"
        return Check("carriers", "no-go", f"{text}: {advice}", measured=measured)
    return Check("carriers", "caution", text, measured=measured)


def _doubts(made: DecodeResult) -> list[Check]:
    """What no other check says: of the calibration, and of carriers that can't be this mask's."""
    found = *made.calibration_doubts, made.contradiction, made.unsettled
    text = "; ".join(told(one, FRAME) for one in found if one is not None)
    return [Check("doubts", "no-go" if made.contradiction else "caution", text)] if text else []


def sharpness(picture: NDArray[Any]) -> list[Check]:
    """Check focus and motion blur of a picture (rows, columns) by the fineness of its detail in four directions."""
    along = fineness(picture)
    measured = {"fineness": {name: round(value, 3) for name, value in along.items()}}
    shown = ", ".join(f"{value:.2f} {name}" for name, value in along.items())
    sharp = any(along[name] >= SHARP[r * r + c * c] for name, (r, c) in DIRECTIONS.items())
    if not sharp:
        text = f"the picture is not sharp anywhere (fineness {shown}): focus again"
        return [
            Check("focus", "no-go", text, measured=measured),
            Check("motion", "caution", "can't be judged without focus", measured=measured),
        ]
    focus = Check("focus", "go", f"fineness {shown} (sharp: 0.4, diagonally 0.5)", measured=measured)
    for pair in (("across", "along"), ("falling", "rising")):
        soft, fine = sorted(pair, key=lambda name: along[name])
        if along[soft] < ONE_WAY * along[fine]:
            text = f"detail is lost {soft} ({along[soft]:.2f} against {along[fine]:.2f} {fine}): shorten the exposure"
            return [focus, Check("motion", "no-go", text, measured=measured)]
    return [focus, Check("motion", "go", "equally sharp in both directions", measured=measured)]
