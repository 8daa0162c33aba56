"""`dappled refocus`: refocused pictures (Eq 28 and 29), focal stacks, all-in-focus pictures, stereo pairs."""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dappled import durable
from dappled.cli import decode_arguments, georeference
from dappled.cli.arguments import add_overwrite, metres, refuse_existing
from dappled.cli.decode_arguments import FieldCallError
from dappled.decode.lightfield.fourier_refocus import Spectrum4D, difference
from dappled.decode.lightfield.refocus import StereoPair, all_in_focus, anaglyph, focal_stack, magnified, side_by_side
from dappled.findings import to_rows
from dappled.products.exports import prints
from dappled.products.maps.georeference import Survey
from dappled.products.opened import OpenedLightField, OpenError
from dappled.products.survey import stereo_pair, synthetic_aperture
from dappled.products.survey.synthetic_aperture import WAYS

_MOST_PICTURES = 500  # of a stack, all held in memory at once
Picture = NDArray[np.float32]


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled refocus frame.zarr --alpha 1 0.98 1.02 1.04 -o four.png   # Fig 39\n"
        "  dappled refocus frame.zarr --distance 20 --focus inf -o at-20-m.png\n"
        "  dappled refocus frame.zarr --stack 0 0.6 9 --all-in-focus -o sharp.png\n"
        "  dappled refocus --flight FLIGHT --height 0 --combine median -o ground.tif   # through foliage\n"
        "Several planes become one picture with captions. .npy keeps the numbers: linear, 1.0 = sensor white."
    )
    decode_arguments.add_field(parser, needed=False)
    where = parser.add_argument_group("focus (one of them)").add_mutually_exclusive_group()
    where.add_argument("--alpha", nargs="+", type=float, metavar="A",
                       help="Eq 28's α, the film's distance from the lens: 1 as taken, above 1 is nearer, below 1\n"
                       "farther; needs focal length, f-number and camera")  # fmt: skip
    where.add_argument("--disparity", nargs="+", type=float, metavar="D", help="disparities in px from view to view")
    where.add_argument(
        "--distance",
        nargs="+",
        type=metres,
        metavar="M",
        help="distances in metres; needs --focus or a calibration with targets",
    )
    where.add_argument(
        "--stack", nargs=3, type=float, metavar=("FROM", "TO", "N"), help="a focal stack at N disparities"
    )
    parser.add_argument("--magnify", action="store_true",
                        help="with --alpha: follow Eq 28 exactly, so that the picture grows with α")  # fmt: skip
    parser.add_argument(
        "--aperture", type=float, metavar="D", help="diameter of a round synthetic aperture, as a share of the whole"
    )
    parser.add_argument("--tilt", nargs=2, type=float, default=(0.0, 0.0), metavar=("H", "W"),
                        help="tilted plane: change of disparity over the picture's height and width")  # fmt: skip
    parser.add_argument(
        "--all-in-focus",
        action="store_true",
        help="with --stack: take each pixel from the picture where it is sharpest",
    )
    parser.add_argument(
        "--index", type=Path, metavar="FILE", help="with --all-in-focus: draw which plane each pixel came from"
    )
    parser.add_argument("--eyes", choices=("anaglyph", "side-by-side", "crossed"), help="make a stereo pair")
    parser.add_argument("--fourier", action="store_true",
                        help="refocus by a slice of the 4D spectrum (Ng), and compare with shift and add")  # fmt: skip
    parser.add_argument("--flight", type=Path, metavar="FLIGHT",
                        help="without LIGHTFIELD: refocus a flight, its frames as views of one wide aperture;\n"
                        ".tif is then a GeoTIFF")  # fmt: skip
    decode_arguments.add_flight(parser)
    parser.add_argument("--height", nargs="+", type=float, metavar="M",
                        help="of a flight: heights to focus on, metres above the ground (default: 0)")  # fmt: skip
    parser.add_argument("--combine", choices=WAYS, help="of a flight: mean (default), or median, which drops what\n"
                        "hides the ground in fewer than half of the frames")  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .jpg, .tif or .npy")
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    _check_mix(arguments)
    refuse_existing(arguments, arguments.output, *([arguments.index] if arguments.index else []))
    if arguments.field is None:
        return _flight(arguments)
    decode_arguments.refuse_of_flight(arguments, "flight", "height", "combine")
    found = decode_arguments.opened_field(arguments)
    planes, notes = _planes(found, arguments), list[Note]()
    if arguments.all_in_focus or arguments.index:
        sharp, note = _sharp(found, arguments)
        made, captions, notes = [sharp], [""], [note]
    elif arguments.eyes:
        made, captions = [_eyes(found, d, arguments.eyes) for _, d in planes], [c for c, _ in planes]
    elif arguments.fourier:
        made, notes = _fourier(found, planes)
        captions = [c for c, _ in planes]
    else:
        made = [
            found.refocus(disparity=d, aperture=arguments.aperture, tilt=(arguments.tilt[0], arguments.tilt[1]))
            for _, d in planes
        ]
        captions = [c for c, _ in planes]
        if arguments.magnify:
            made = [magnified(picture, alpha) for picture, alpha in zip(made, arguments.alpha, strict=True)]
    _write(arguments.output, made, captions)
    if arguments.json:
        disparities = [] if arguments.all_in_focus or arguments.index else [d for _, d in planes]
        facts = [dict(note.facts) for note in notes]
        made_of = {"disparities_px": disparities, "notes": facts, "doubts": to_rows(found.doubts)}
        print(json.dumps({"file": str(arguments.output), **made_of}))
        return 0
    for note in notes:
        print(note.text)
    print(f"{', '.join(c for c in captions if c) or 'one picture'}: {arguments.output}")
    return 0


def _flight(arguments: argparse.Namespace) -> int:
    """Refocus a whole flight."""
    given = decode_arguments.of_flight(arguments)
    heights = arguments.height or [0.0]
    ways = (
        "alpha",
        "disparity",
        "distance",
        "stack",
        "aperture",
        "all_in_focus",
        "index",
        "fourier",
        "magnify",
    )
    unused = [f"--{way.replace('_', '-')}" for way in ways if getattr(arguments, way) not in (None, False)]
    if unused:
        raise FieldCallError(f"{unused[0]} is of a light field: a flight is refocused with --height")
    raster = arguments.output.suffix.lower() in (".tif", ".tiff")
    if raster and len(heights) > 1:
        raise FieldCallError(f"{arguments.output} holds one height: give one --height, or a .png for all of them")
    if arguments.eyes and (raster or arguments.height or arguments.combine):
        raise FieldCallError(
            "--eyes of a flight makes a picture of two frames: leave --height and --combine out, -o .png"
        )
    with ExitStack() as stack:
        progress = stack.enter_context(georeference.Bar())
        made = georeference.placed(arguments.flight, given, progress, stack)
        for _, why in made.left:
            print(why, file=sys.stderr)
        if arguments.eyes:
            return _flight_eyes(arguments, made)
        found = [
            synthetic_aperture.refocus(
                made, progress, above_m=height, way=arguments.combine or "mean", cell_m=arguments.cell
            )
            for height in heights
        ]
        if raster:
            synthetic_aperture.write_raster(made, found[0], arguments.output)
        else:
            _write(arguments.output, synthetic_aperture.alike(found), [f"{height:g} m" for height in heights])
    if arguments.json:
        planes = [
            {"height_m": height, **synthetic_aperture.summary(one)} for height, one in zip(heights, found, strict=True)
        ]
        print(json.dumps({"file": str(arguments.output), "planes": planes}))
        return 0
    for height, one in zip(heights, found, strict=True):
        print(f"{height:g} m: " + "\n".join(synthetic_aperture.words(one)))
    print(f"written: {arguments.output}")
    return 0


def _flight_eyes(arguments: argparse.Namespace, made: Survey) -> int:
    """Two frames of a flight as a stereo pair."""
    found = stereo_pair.pair(made, arguments.cell)
    _write(arguments.output, [_seen(found.eyes, arguments.eyes)], [""])
    left, right = found.names
    if arguments.json:
        facts = {"left": left, "right": right, "baseline_m": found.baseline_m, "baseline_share": found.share}
        print(json.dumps({"file": str(arguments.output), **facts}))
        return 0
    print(
        f"frames {left} (left) and {right}: {found.baseline_m:.3g} m apart, {found.share:.0%} of the distance; "
        f"{arguments.output}"
    )
    return 0


class Note(NamedTuple):
    """What is said of the pictures: for a person, and for a program."""

    text: str
    facts: Mapping[str, float | None]


def _check_mix(arguments: argparse.Namespace) -> None:
    """Refuse words that would be ignored. Raises OpenError."""
    ways = {
        "--all-in-focus": arguments.all_in_focus or arguments.index is not None,
        "--eyes": arguments.eyes is not None,
        "--fourier": arguments.fourier,
    }
    chosen = [name for name, given in ways.items() if given]
    forms = {
        "--aperture": arguments.aperture is not None,
        "--tilt": any(arguments.tilt),
        "--magnify": arguments.magnify,
    }
    unused = chosen[1:] + [name for name, given in forms.items() if given] if chosen else []
    if unused:
        raise OpenError(f"{chosen[0]} doesn't go with {', '.join(unused)}: leave one of them out")
    if arguments.magnify and not arguments.alpha:
        raise OpenError("--magnify goes with --alpha: it is Eq 28's x/α")


def _planes(found: OpenedLightField, arguments: argparse.Namespace) -> list[tuple[str, float]]:
    """(caption, disparity) of each plane that was asked for."""
    if arguments.alpha:
        at = [(a, found.disparity_of(alpha=a)) for a in arguments.alpha]
        return [(f"alpha = {a:g} ({d:+.3g} px/view)", d) for a, d in at]
    if arguments.distance:
        return [(f"{z:g} m", found.disparity_of(distance_m=z)) for z in arguments.distance]
    if arguments.stack:
        low, high, count = arguments.stack
        if not count >= 1 or count % 1:
            raise OpenError(f"--stack: {count:g} is not a number of pictures")
        if count > _MOST_PICTURES:
            raise OpenError(f"--stack: {count:g} pictures are too many: at most {_MOST_PICTURES}")
        return [(f"{d:.3g} px/view", float(d)) for d in np.linspace(low, high, round(count))]
    if arguments.disparity:
        return [(f"{d:g} px/view", d) for d in arguments.disparity]
    return [("as taken", 0.0)]


def _sharp(found: OpenedLightField, arguments: argparse.Namespace) -> tuple[Picture, Note]:
    if not arguments.stack:
        raise OpenError("--all-in-focus needs --stack FROM TO N: the planes to choose from")
    planes = np.array([d for _, d in _planes(found, arguments)])
    made = all_in_focus(focal_stack(found.stack, planes, workers=found.workers))
    known = made.index >= 0
    share = float(known.mean())
    if arguments.index:
        disparity = np.where(known, planes[made.index], np.nan)
        prints.save(arguments.index, prints.with_scale(disparity, float(planes[0]), float(planes[-1]), "px/view"))
    return made.picture, Note(f"{share:.0%} of the pixels have a sharpest picture", {"sharpest_share": share})


def _eyes(found: OpenedLightField, disparity: float, form: str) -> Picture:
    return _seen(found.eyes(disparity=disparity), form)


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
