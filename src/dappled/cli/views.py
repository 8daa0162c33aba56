"""`dappled views`: draw views, slices (Figs 37 and 43) or the shift of each view (Fig 57) as one picture."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

from dappled import codec
from dappled.cli.field_arguments import FieldArguments, doubts, opened_field, views_words
from dappled.cli.refocus import through_scene
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, option
from dappled.errors import CallError

if not words_only:
    import numpy as np

    from dappled.decode.depth.evidence import of_light_field
    from dappled.decode.depth.stereo import shifts_from_middle
    from dappled.decode.lightfield import ViewStack
    from dappled.decode.lightfield.light_field import needs_parallax, slice_mosaic
    from dappled.decode.lightfield.refocus import focal_stack
    from dappled.products.exports import animations, epi, prints
    from dappled.products.opened import OpenedLightField, OpenError

_LONGEST = 2400  # px


@dataclass(frozen=True, kw_only=True)
class DrawViews(Overwriting, FieldArguments, Verb):
    """Draw views, slices or shifts as one picture."""

    examples = (
        "dappled views frame.zarr -o views.png",
        "dappled views frame.zarr --of slices -o slices.png",
        "dappled views frame.zarr --of shifts -o shifts.png",
        "dappled views frame.zarr --animate parallax -o parallax.webp",
    )

    of: str = option(
        "--of", "views, slices at their carriers, or shifts: how far each view has moved from the middle; "
        "slice-shifts: the same for slices, as the thesis tried; epi: a row and a column of the picture in each view "
        "(Fig 54)", "views", choices=("views", "slices", "shifts", "slice-shifts", "epi"),
    )  # fmt: skip
    row: int | None = option("--row", "of epi: row of the picture", None, otherwise="the middle one")
    column: int | None = option("--column", "of epi: column of the picture", None)
    animate: str | None = option(
        "--animate", "an animation instead (.webp, or .mp4 with OpenCV): parallax, the eye goes round in the aperture; "
        "focus, from the nearest to the farthest plane of the scene and back", None, choices=("parallax", "focus"),
    )  # fmt: skip
    output: Path = option("-o --output", "picture or animation to write")

    def check(self) -> None:
        if self.of != "epi" and (self.row, self.column) != (None, None):
            raise CallError(f"--row and --column are of --of epi: leave them out of {self.of}")
        if self.animate and self.of != "views":
            raise CallError(f"--animate doesn't go with --of {self.of}")
        if self.animate and self.output.suffix not in (".webp", ".mp4"):
            raise CallError(f"-o {self.output}: an animation is .webp or .mp4")
        self.refuse_existing(self.output)

    def run(self, output: Output) -> Report:
        found = opened_field(self.field)
        if self.animate:
            pictures = _parallax(found) if self.animate == "parallax" else _focus(found)
            animations.save(self.output, pictures)
            note = f"{len(pictures)} pictures: {self.animate}"
        elif self.of == "epi":
            made, note = epi.drawn(found.stack, self.row, self.column), ""
        else:
            draw = {"views": _views, "slices": _slices, "shifts": _shifts, "slice-shifts": _slice_shifts}[self.of]
            made, note = draw(found)
            made = _small(made)
        if not self.animate:
            prints.save(self.output, made)
        count_v, count_u, height, width = found.views.shape[:4]
        note = "; ".join(words for words in (note, views_words(found.field)) if words)
        facts = {"file": str(self.output), "of": self.of, "views": list(found.views.shape[:4])}
        said = f"{count_v} × {count_u} views of {width} × {height} px; {self.output}"
        return Report(
            {**facts, "doubts": codec.plain(found.doubts), **({"note": note} if note else {})},
            [*([note] if note else []), said],
            findings=doubts(found),
        )


def _parallax(found: OpenedLightField) -> list[prints.Bytes]:
    """The views around the middle one, half-way to the aperture's edge, once round. Raises DecodeError for one view."""
    needs_parallax(found.stack, "an animation of parallax")
    views = found.stack.views
    rows, columns = views.shape[:2]
    out_v, out_u = (rows // 2 + 1) // 2, (columns // 2 + 1) // 2
    count = 4 * (out_v + out_u)
    at = []
    for angle in (2 * math.pi * n / count for n in range(count)):
        v, u = rows // 2 + round(out_v * math.sin(angle)), columns // 2 + round(out_u * math.cos(angle))
        at.append((min(v, rows - 1), min(u, columns - 1)))  # of 2 views the middle one is the last
    white = prints.white_of([views])
    return [prints.toned(views[place], white) for place, _ in itertools.groupby(at)]


def _focus(found: OpenedLightField) -> list[prints.Bytes]:
    """Pictures focused on planes through the scene, there and back."""
    pictures = focal_stack(found.stack, through_scene(found), workers=found.workers)
    white = prints.white_of([*pictures])
    drawn = [prints.toned(one, white) for one in pictures]
    return [*drawn, *drawn[-2:0:-1]]


def _views(found: OpenedLightField) -> tuple[prints.Bytes, str]:
    """The picture, and what its colours mean."""
    stack = found.stack
    white = prints.white_of([stack.views])
    pictures = [prints.toned(view, white) for line in stack.views for view in line]
    return prints.mosaic(pictures, columns=stack.views.shape[1]), ""


def _slices(found: OpenedLightField) -> tuple[prints.Bytes, str]:
    if len(found.slices) == 0:
        raise OpenError(f"{found.path} was stored as views and has no slices")
    return slice_mosaic(found.slices, found.field.carriers, longest_side=_LONGEST), ""


def _shifts(found: OpenedLightField) -> tuple[prints.Bytes, str]:
    # Wiener weights shrink the parallax of noisy views, so measure on views without them.
    return _coloured(shifts_from_middle(of_light_field(found.field).stack))


def _slice_shifts(found: OpenedLightField) -> tuple[prints.Bytes, str]:
    if len(found.slices) == 0:
        raise OpenError(f"{found.path} was stored as views and has no slices")
    stack = found.stack
    orders = {(int(ky), int(kx)): k for k, (ky, kx) in enumerate(found.field.carriers[:, :2])}
    reach = max(max(abs(ky), abs(kx)) for ky, kx in orders)
    side = 2 * reach + 1
    images = np.zeros((side, side, *found.slices.shape[1:]), dtype=np.float32)
    for (ky, kx), k in orders.items():
        magnitude = np.abs(found.slices[k])
        magnitude /= max(float(np.quantile(magnitude, 0.995)), 1e-12)
        images[reach + ky, reach + kx] = images[reach - ky, reach - kx] = magnitude
    steps = np.arange(side, dtype=np.float64) - reach
    return _coloured(shifts_from_middle(ViewStack(images, steps * stack.row_steps[-1] / reach, steps)))


def _coloured(shifts: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> tuple[prints.Bytes, str]:
    low, high = (float(x) for x in np.quantile(shifts, [0.01, 0.99]))
    pictures = [prints.coloured(shift, low, high) for line in shifts for shift in line]
    note = f"dark {low:.2f} px, bright {high:.2f} px from the middle view"
    return prints.mosaic(pictures, columns=shifts.shape[1]), note


def _small(picture: prints.Bytes) -> prints.Bytes:
    step = max(1, -(-max(picture.shape[:2]) // _LONGEST))
    return picture[::step, ::step]
