"""`dappled refocus`: refocused pictures (Eq 28 and 29), focal stacks, all-in-focus pictures, stereo pairs."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from dappled import codec, durable
from dappled.cli import paths
from dappled.cli.field_arguments import doubts, opened_field
from dappled.cli.placing import FieldOrFlight
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, flag, option
from dappled.errors import CallError
from dappled.findings import text

if not words_only:
    import numpy as np
    from numpy.typing import NDArray

    from dappled.decode.depth.estimate import disparity_range
    from dappled.decode.lightfield.fourier_refocus import Spectrum4D, difference
    from dappled.decode.lightfield.refocus import (
        StereoPair,
        all_in_focus,
        anaglyph,
        focal_stack,
        magnified,
        side_by_side,
    )
    from dappled.decode.lightfield.volume_filter import within
    from dappled.products.exports import prints
    from dappled.products.maps.georeference import Survey
    from dappled.products.opened import OpenedLightField
    from dappled.products.survey import stereo_pair, synthetic_aperture

    Picture = NDArray[np.float32]

_MOST_PICTURES = 500  # of a stack, all held in memory at once
_STEP_PX = 0.25  # from plane to plane, of the outermost views


class Note(NamedTuple):
    """What is said of the pictures: for a person, and for a program."""

    text: str
    facts: Mapping[str, float | None]


_FOCUS = "focus (one of them)"


@dataclass(frozen=True, kw_only=True)
class RefocusLightField(Overwriting, FieldOrFlight, Verb):
    """Refocus a light field, or a flight."""

    examples = (
        "dappled refocus frame.zarr --alpha 1 0.98 1.02 1.04 -o four.png   # Fig 39",
        "dappled refocus frame.zarr --distance 20 --focus inf -o at-20-m.png",
        "dappled refocus frame.zarr --stack 0 0.6 9 --all-in-focus -o sharp.png",
        "dappled refocus frame.zarr --volume 0 0.6 -o clear.png   # without rain before it",
        "dappled refocus --flight FLIGHT --height 0 --combine median -o ground.tif   # through foliage",
    )
    notes = "Several planes become one picture with captions. .npy keeps the numbers: linear, 1.0 = sensor white."

    alpha: tuple[float, ...] = option(
        "--alpha", "Eq 28's α, the film's distance from the lens: 1 as taken, above 1 is nearer, below 1 farther; "
        "needs focal length, f-number and camera", (), metavar="A", group=_FOCUS, alone="focus",
    )  # fmt: skip
    disparity: tuple[float, ...] = option(
        "--disparity", "disparities in px from view to view", (), metavar="D", group=_FOCUS, alone="focus",
    )  # fmt: skip
    distance: tuple[float, ...] = option(
        "--distance", "distances (with --focus or a calibration with targets)", (), unit="m", above=0.0,
        infinite=True, group=_FOCUS, alone="focus",
    )  # fmt: skip
    stack: tuple[float, float, float] | None = option(
        "--stack", "a focal stack at N disparities", None, metavar=("FROM", "TO", "N"), group=_FOCUS, alone="focus",
    )  # fmt: skip
    volume: tuple[float, float] | None = option(
        "--volume", "all that lies between two disparities in focus: what lies before and behind it (rain, snow, haze) "
        "and noise are weakened", None, metavar=("FROM", "TO"), group=_FOCUS, alone="focus",
    )  # fmt: skip
    magnify: bool = flag("--magnify", "with --alpha: follow Eq 28 exactly, so that the picture grows with α")
    aperture: float | None = option(
        "--aperture", "diameter of a round synthetic aperture, as a share of the whole", None, metavar="D", above=0.0,
    )  # fmt: skip
    tilt: tuple[float, float] = option(
        "--tilt", "tilted plane: change of disparity over the picture's height and width", (0.0, 0.0),
        metavar=("H", "W"),
    )  # fmt: skip
    all_in_focus: bool = flag(
        "--all-in-focus", "take each pixel from where it is sharpest: of --stack, else of planes through the scene"
    )
    index: Path | None = option("--index", "with --all-in-focus: draw which plane each pixel came from", None)
    eyes: str | None = option("--eyes", "make a stereo pair", None, choices=("anaglyph", "side-by-side", "crossed"))
    fourier: bool = flag("--fourier", "refocus by a slice of the 4D spectrum (Ng), and compare with shift and add")
    flight: Path | None = option(
        "--flight", "without LIGHTFIELD: refocus a flight, its frames as views of one wide aperture; .tif is then a "
        "GeoTIFF", None, metavar="FLIGHT", there=paths.flight,
    )  # fmt: skip
    height: tuple[float, ...] = option(
        "--height", "of a flight: heights to focus on, metres above the ground", (), unit="m", otherwise="0",
    )  # fmt: skip
    combine: str | None = option(
        "--combine", "of a flight: mean, or median, which drops what hides the ground in fewer than half of the frames",
        None, choices=("mean", "median"), otherwise="mean",
    )  # fmt: skip
    output: Path = option("-o --output", ".png, .jpg, .tif or .npy")

    @property
    def _sharpest(self) -> bool:
        return self.all_in_focus or self.index is not None

    def check(self) -> None:
        self._check_mix()
        self.check_source("flight", "height", "combine")
        if self.field is None:
            self._check_flight()
        elif self._sharpest and (self.alpha or self.disparity or self.distance or self.volume):
            raise CallError("--all-in-focus chooses from planes through the scene, or those of --stack FROM TO N")
        if self.stack:
            count = self.stack[2]
            if not count >= 1 or count % 1:
                raise CallError(f"--stack: {count:g} is not a number of pictures")
            if count > _MOST_PICTURES:
                raise CallError(f"--stack: {count:g} pictures are too many: at most {_MOST_PICTURES}")
        self.refuse_existing(self.output, self.index)

    def _check_mix(self) -> None:
        """Refuse words that would be ignored. Raises CallError."""
        ways = {"--all-in-focus": self._sharpest, "--eyes": self.eyes is not None, "--fourier": self.fourier}
        chosen = [name for name, given in ways.items() if given]
        forms = {"--aperture": self.aperture is not None, "--tilt": any(self.tilt), "--magnify": self.magnify}
        if self.volume:
            chosen.insert(0, "--volume")
        unused = chosen[1:] + [name for name, given in forms.items() if given] if chosen else []
        if unused:
            raise CallError(f"{chosen[0]} doesn't go with {', '.join(unused)}: leave one of them out")
        if self.magnify and not self.alpha:
            raise CallError("--magnify goes with --alpha: it is Eq 28's x/α")

    @property
    def _raster(self) -> bool:
        return self.output.suffix.lower() in (".tif", ".tiff")

    def _check_flight(self) -> None:
        """Refuse what only goes with a light field, and what goes with no flight. Raises CallError."""
        of_field = (
            "alpha", "disparity", "distance", "stack", "volume", "aperture", "all_in_focus", "index", "fourier",
            "magnify",
        )  # fmt: skip
        unused = [f"--{way.replace('_', '-')}" for way in of_field if getattr(self, way) not in (None, False, ())]
        if unused:
            raise CallError(f"{unused[0]} is of a light field: a flight is refocused with --height")
        if self._raster and len(self.height) > 1:
            raise CallError(f"{self.output} holds one height: give one --height, or a .png for all of them")
        if self.eyes and (self._raster or self.height or self.combine):
            raise CallError(
                "--eyes of a flight makes a picture of two frames: leave --height and --combine out, -o .png"
            )

    def run(self, output: Output) -> Report:
        if self.field is None:
            return self._flight(output)
        found = opened_field(self.field, self)
        planes, notes = self._planes(found), list[Note]()
        captions = [caption for caption, _ in planes]
        if self._sharpest:
            sharp, note = self._sharp(found, np.array([d for _, d in planes]))
            made, captions, notes, planes = [sharp], [""], [note], []
        elif self.volume:
            made, captions = [within(found.stack, *self.volume, workers=found.workers)], [" to ".join(captions)]
        elif self.eyes:
            made = [_seen(found.eyes(disparity=d), self.eyes) for _, d in planes]
        elif self.fourier:
            made, notes = _fourier(found, planes)
        else:
            made = [found.refocus(disparity=d, aperture=self.aperture, tilt=self.tilt) for _, d in planes]
            if self.magnify:
                made = [magnified(picture, alpha) for picture, alpha in zip(made, self.alpha, strict=True)]
        _write(self.output, made, captions)
        values = {
            "file": str(self.output),
            "disparities_px": [d for _, d in planes],
            "notes": [dict(note.facts) for note in notes],
            "doubts": codec.plain(found.doubts),
        }
        said = f"{', '.join(c for c in captions if c) or 'one picture'}: {self.output}"
        return Report(values, [*(note.text for note in notes), said], findings=doubts(found))

    def _flight(self, output: Output) -> Report:
        """Refocus a whole flight."""
        assert self.flight is not None
        heights = self.height or (0.0,)
        with ExitStack() as stack:
            foresee = stereo_pair.check if self.eyes else synthetic_aperture.check
            made = self.placing().placed(self.flight, output, stack, foresee=foresee)
            if self.eyes:
                return self._flight_eyes(made, self.eyes)
            found = [
                synthetic_aperture.refocus(
                    made, output.show, above_m=height, way=self.combine or "mean", cell_m=self.cell
                )
                for height in heights
            ]
            if self._raster:
                synthetic_aperture.write_raster(made, found[0], self.output)
            else:
                _write(self.output, synthetic_aperture.alike(found), [f"{height:g} m" for height in heights])
        planes = [
            {"height_m": height, **synthetic_aperture.summary(one)} for height, one in zip(heights, found, strict=True)
        ]
        lines: list[str] = []
        for height, one in zip(heights, found, strict=True):
            first, *others = map(text, synthetic_aperture.told(one))
            lines += [f"{height:g} m: {first}", *map(str, others)]
        return Report(
            {"file": str(self.output), "planes": planes}, [*lines, f"written: {self.output}"], findings=made.doubts
        )

    def _flight_eyes(self, made: Survey, form: str) -> Report:
        """Two frames of a flight as a stereo pair."""
        found = stereo_pair.pair(made, self.cell)
        _write(self.output, [_seen(found.eyes, form)], [""])
        left, right = found.names
        facts = {"left": left, "right": right, "baseline_m": found.baseline_m, "baseline_share": found.share}
        apart = f"{found.baseline_m:.3g} m apart, {found.share:.0%} of the distance; {self.output}"
        line = f"frames {left} (left) and {right}: {apart}"
        return Report({"file": str(self.output), **facts}, [line], findings=made.doubts)

    def _planes(self, found: OpenedLightField) -> list[tuple[str, float]]:
        """(caption, disparity) of each plane that was asked for."""
        if self.alpha:
            at = [(a, found.disparity_of(alpha=a)) for a in self.alpha]
            return [(f"alpha = {a:g} ({d:+.3g} px/view)", d) for a, d in at]
        if self.distance:
            return [(f"{z:g} m", found.disparity_of(distance_m=z)) for z in self.distance]
        if self.stack:
            low, high, count = self.stack
            return [(f"{d:.3g} px/view", float(d)) for d in np.linspace(low, high, round(count))]
        if given := self.disparity or self.volume:
            return [(f"{d:g} px/view", d) for d in given]
        if self._sharpest:
            return [(f"{d:.3g} px/view", float(d)) for d in through_scene(found)]
        return [("as taken", 0.0)]

    def _sharp(self, found: OpenedLightField, planes: NDArray[np.float64]) -> tuple[Picture, Note]:
        made = all_in_focus(focal_stack(found.stack, planes, workers=found.workers))
        known = made.index >= 0
        share = float(known.mean())
        if self.index:
            disparity = np.where(known, planes[made.index], np.nan)
            prints.save(self.index, prints.with_scale(disparity, float(planes[0]), float(planes[-1]), "px/view"))
        planes_said = f"of {len(planes)} from {planes[0]:.3g} to {planes[-1]:.3g} px/view"
        facts = {"sharpest_share": share, "from_px": float(planes[0]), "to_px": float(planes[-1])}
        return made.picture, Note(f"{share:.0%} of the pixels have a sharpest picture {planes_said}", facts)


def through_scene(found: OpenedLightField) -> NDArray[np.float64]:
    """Disparities of planes through the scene, so close that the outermost views move by a quarter of a pixel."""
    low, high = disparity_range(replace(found.evidence, filled=None), workers=found.workers)
    count = math.ceil((high - low) * found.stack.reach / _STEP_PX) + 1
    return np.linspace(low, high, min(max(count, 2), _MOST_PICTURES))


def _seen(pair: StereoPair, form: str) -> Picture:
    return anaglyph(pair) if form == "anaglyph" else side_by_side(pair, crossed=form == "crossed")


def _fourier(found: OpenedLightField, planes: list[tuple[str, float]]) -> tuple[list[Picture], list[Note]]:
    """The pictures by Fourier slices, and how far shift and add is from each."""
    stack = found.stack
    most = max(abs(d) for _, d in planes)
    border = min(int(most * stack.reach) + 4, min(stack.views.shape[2:4]) // 4)
    colours = []
    for views in np.moveaxis(stack.views, 4, 0) if stack.colour else stack.views[None]:  # one at a time, in memory
        spectrum = Spectrum4D.of(replace(stack, views=views), most_disparity=most, workers=found.workers)
        colours.append([spectrum.refocused(disparity, workers=found.workers) for _, disparity in planes])
    made = [np.stack(parts, axis=-1) if stack.colour else parts[0] for parts in zip(*colours, strict=True)]
    notes = []
    for (caption, disparity), picture in zip(planes, made, strict=True):
        off = difference(found.refocus(disparity=disparity), picture, border)
        text = f"{caption}: shift and add differs by {off.psnr_db:.1f} dB (largest {off.largest:.4f} of white)"
        psnr = off.psnr_db if math.isfinite(off.psnr_db) else None  # they are equal
        facts = {"disparity_px": disparity, "shift_and_add_psnr_db": psnr, "largest": off.largest}
        notes.append(Note(text, facts))
    return made, notes


def _write(path: Path, pictures: list[Picture], captions: list[str]) -> None:
    if path.suffix == ".npy":
        array = io.BytesIO()
        np.save(array, pictures[0] if len(pictures) == 1 else np.stack(pictures))
        durable.write_file(path, array.getvalue())
    else:
        white = prints.white_of(pictures)
        toned = [prints.toned(p, white) for p in pictures]
        prints.save(path, toned[0] if len(toned) == 1 else prints.mosaic(toned, captions))
