"""Check one frame before a flight: focal length, exposure, carriers, focus, motion blur."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.daemon.pipeline.picture_facts import DIRECTIONS, fineness
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
from dappled.drivers.raw.raw_file import MOST_CLIPPED, RawFile, exposure
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, Value, finding, of_subject

CARRIERS = Subject("carriers")
DARK_SHARE = 0.01
SHARP = {1: 0.31, 2: 0.335}
"""A picture below this fineness has no detail finer than two pixels; keys are the squared length of the step. 0.25 is
perfectly smooth, 1 is noise; sharp pictures of the ground have 0.4 along rows and columns, 0.5 along diagonals."""
ONE_WAY = 0.85
"""Motion blurs along one direction; at right angles to it the picture stays sharp. Below this ratio it is blur."""
SEEN_SHARE = 0.5


def check_frame(frame: Path, recipe: Recipe | None) -> list[Finding]:
    """What all checks of a frame find. Raises DappledError for a file that can't be read as a frame."""
    raw = reading.read(frame)
    found = [_focal_length(raw), *_tones(raw, Level.CAUTION if recipe is None else Level.STOP), _exposure(raw)]
    if recipe is None:
        return [*found, finding(Code.FRAME_UNMASKED, CARRIERS)]
    try:
        made = Darkroom(recipe).decode(frame, views=False)
    except DappledError as error:
        return [*found, finding(Code.FRAME_UNDECODABLE, CARRIERS, why=error)]
    picture = np.abs(made.light_field.slices[0])
    return [*found, *_carriers(made, recipe), *_doubts(made), *sharpness(picture)]


def _focal_length(raw: RawFile) -> Finding:
    about = Subject("focal length")
    if raw.focal_length_mm is None:
        return finding(Code.LENS_NO_FOCAL_LENGTH, about)
    return finding(Code.LENS_TOLD, about, focal_length_mm=raw.focal_length_mm, f_number=raw.f_number)


def _tones(raw: RawFile, level: Level) -> list[Finding]:
    return [finding(Code.FRAME_DEVELOPED, Subject("tones"), level, why=raw.developed)] if raw.developed else []


def _exposure(raw: RawFile) -> Finding:
    exposed = exposure(raw, every=1)
    clipped, mean = exposed.clipped_share, exposed.mean_share
    facts = {"clipped_share": clipped, "mean_share": mean}
    about = Subject("exposure")
    if clipped > MOST_CLIPPED:
        return finding(Code.FRAME_CLIPPED, about, Level.STOP, share=clipped).with_facts(**facts)
    if mean < DARK_SHARE:
        return finding(Code.FRAME_DARK, about, share=mean).with_facts(**facts)
    return finding(Code.FRAME_EXPOSED, about).with_facts(**facts)


def _carriers(made: DecodeResult, recipe: Recipe) -> Iterator[Finding]:
    """Whether carriers stand where slices are cut."""
    seen, predicted = made.carriers_found, made.carriers_predicted
    facts: dict[str, Value] = {"seen": seen, "predicted": predicted, "carriers_from": made.report.carriers_from}
    if recipe.mask == profiles.LENSLET or predicted == 0:
        yield finding(Code.CARRIERS_CUT, CARRIERS).with_facts(**facts)
    elif made.search is not None and made.search.found is not None:
        law = made.light_field.attributes["law"]
        yield finding(Code.CARRIERS_BY_LAW, CARRIERS, law=law).with_facts(**facts, **made.search.log10_odds)
    elif made.report.doubts:
        yield from of_subject(made.report.doubts, CARRIERS)
    elif not made.observable:
        yield finding(Code.CARRIERS_UNCHECKED, CARRIERS).with_facts(**facts)
    elif seen >= SEEN_SHARE * predicted:
        yield finding(Code.CARRIERS_SEEN, CARRIERS).with_facts(**facts)
    else:
        code = Code.CARRIERS_REPLACED if recipe.calibration else Code.CARRIERS_TOO_FEW
        yield finding(code, CARRIERS).with_facts(**facts)


def _doubts(made: DecodeResult) -> list[Finding]:
    """What no other check says: of the calibration, and of carriers that can't be this mask's."""
    never = [] if made.contradiction is None else [replace(made.contradiction, level=Level.STOP)]
    return [*made.calibration_doubts, *never, *([made.unsettled] if made.unsettled else [])]


def sharpness(picture: NDArray[Any]) -> list[Finding]:
    """Check focus and motion blur of a picture (rows, columns) by the fineness of its detail in four directions."""
    along = fineness(picture)
    facts: dict[str, Value] = {name: round(value, 3) for name, value in along.items()}
    focus, motion = Subject("focus"), Subject("motion")
    if not any(along[name] >= SHARP[r * r + c * c] for name, (r, c) in DIRECTIONS.items()):
        return [
            finding(Code.FRAME_UNSHARP, focus).with_facts(**facts),
            finding(Code.FRAME_MOTION_UNKNOWN, motion).with_facts(**facts),
        ]
    sharp = finding(Code.FRAME_SHARP, focus).with_facts(**facts)
    for pair in (("across", "along"), ("falling", "rising")):
        soft, fine = sorted(pair, key=lambda name: along[name])
        if along[soft] < ONE_WAY * along[fine]:
            shown: dict[str, Value] = {"soft_fineness": along[soft], "fine_fineness": along[fine]}
            return [sharp, finding(Code.FRAME_SMEARED, motion, soft=soft, fine=fine).with_facts(**shown)]
    return [sharp, finding(Code.FRAME_STEADY, motion)]
