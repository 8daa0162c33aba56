"""`dappled mask make`: write the image that goes on film, or a step wedge."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.config import profiles
from dappled.config.profiles import MaskProfile
from dappled.config.schema import ConfigError
from dappled.decode.optics import Mask, film
from dappled.decode.optics.film import FILMS, Film, MaskImage, period_on
from dappled.decode.optics.lenses import within
from dappled.products.exports import mask_files

HELP = "write the image that goes on film, or a step wedge"
EXAMPLE = "dappled mask make mask-2 --negative -o mask-2.png"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mask", nargs="?", metavar="P", help="mask profile or TOML file (or --period/--frequency)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="image to write, .png or .tif")
    parser.add_argument("--film", default="4k", metavar="F", help="4k (default), 8k, 16k, or WIDTHxHEIGHT in pixels")
    parser.add_argument("--density", type=float, metavar="PX/MM", help="pixel density of a film given as WIDTHxHEIGHT")
    parser.add_argument(
        "--size-mm",
        type=float,
        nargs=2,
        metavar=("H", "W"),
        help="size of the mask, in the middle of the film (default: the whole film)",
    )
    parser.add_argument("--period", type=float, metavar="PX", help="longest period, in pixels of the film")
    parser.add_argument("--frequency", type=float, metavar="1/MM", help="fundamental frequency, instead of --period")
    parser.add_argument("--p", type=int, metavar="N", help="number of harmonics (default: the profile's, else 2)")
    parser.add_argument(
        "--pattern",
        choices=("full", "diagonal"),
        help="Eq 11's product, or Fig 14's diagonals (default: the profile's, else full)",
    )
    parser.add_argument(
        "--harmonics", choices=("linear", "octave"), help="1, 2, 3 … or 1, 2, 4 … (default: the profile's, else linear)"
    )
    parser.add_argument(
        "--negative", action="store_true", help="write the negative (Eq 13), for black-and-white negative film"
    )
    parser.add_argument("--bits", type=int, default=8, choices=(8, 16), help="bits per pixel (default: 8)")
    parser.add_argument(
        "--curve",
        type=Path,
        metavar="CSV",
        help="level,density measured on this film's wedge; the image compensates for it",
    )
    parser.add_argument("--drawable-only", action="store_true", help="leave out harmonics finer than two pixels")
    parser.add_argument(
        "--wedge", type=int, nargs="?", const=21, metavar="STEPS", help="write a step wedge instead (default: 21 steps)"
    )
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(arguments: argparse.Namespace) -> int:
    refuse_existing(arguments, arguments.output)
    chosen = _film(arguments)
    if arguments.size_mm:
        chosen = chosen.cut_to(*arguments.size_mm)
    bits = arguments.bits
    if arguments.wedge is not None:
        levels = np.rint(film.wedge((1, chosen.shape[1]), arguments.wedge) * (2**bits - 1))
        levels = levels.astype(np.uint8 if bits == 8 else np.uint16)

        def tile(rows: slice, columns: slice) -> mask_files.Levels:
            return np.repeat(levels[:, columns], rows.stop - rows.start, axis=0)

        report: dict[str, Any] = {"wedge_steps": arguments.wedge, "warnings": []}
    else:
        image = _image(arguments, chosen)
        tile = image.levels
        report = {
            "carriers": len(image.orders_drawn()),
            "period_px": list(image.period_px),
            "harmonics": [{**asdict(h), "drawable": h.drawable} for h in image.harmonics()],
            "warnings": image.warnings(),
        }
    for text in report["warnings"]:
        print(f"dappled mask: warning: {text}", file=sys.stderr)
    with tqdm(total=chosen.shape[0], unit="row", disable=not sys.stderr.isatty(), delay=1, file=sys.__stderr__) as bar:
        mask_files.write(arguments.output, chosen.shape, bits, chosen.px_per_mm, tile, progress=bar.update)
    report = {"file": str(arguments.output), "shape": list(chosen.shape), "px_per_mm": list(chosen.px_per_mm), **report}
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        high, wide = chosen.vertical.length_mm, chosen.horizontal.length_mm
        print(f"{arguments.output}: {chosen.shape[1]} × {chosen.shape[0]} px, {bits} bits, {wide:.4g} × {high:.4g} mm")
    return 0


def _film(arguments: argparse.Namespace) -> Film:
    if arguments.film in FILMS:
        if arguments.density is not None:
            raise ConfigError(f"film {arguments.film} has its own density; --density is for --film WIDTHxHEIGHT")
        chosen = FILMS[arguments.film]
    elif size := re.fullmatch(r"(\d+)x(\d+)", arguments.film):
        if arguments.density is None:
            raise ConfigError(f"--film {arguments.film} needs --density in px/mm")
        chosen = film.film_of(int(size[1]), int(size[2]), arguments.density)
    else:
        raise ConfigError(f"no film {arguments.film!r}; known are {', '.join(FILMS)}, or WIDTHxHEIGHT with --density")
    return chosen


def _image(arguments: argparse.Namespace, chosen: Film) -> MaskImage:
    known = profiles.mask(arguments.mask) if arguments.mask else None
    if known is None and arguments.period is None and arguments.frequency is None:
        raise ConfigError("name a mask profile, or give --period in px or --frequency in 1/mm")
    if arguments.period is not None and arguments.frequency is not None:
        raise ConfigError("--period and --frequency set the same thing: give only one of them")
    if arguments.period is not None:
        period = within("period", arguments.period, "px", 1e-2, 1e6)
        mask = Mask(chosen.px_per_mm[1] / period, 2)
        periods = (period, period * chosen.px_per_mm[0] / chosen.px_per_mm[1])
        if math.isclose(*chosen.px_per_mm, rel_tol=1e-3):
            periods = (period, period)
    elif arguments.frequency is not None:
        mask = Mask(within("frequency", arguments.frequency, "1/mm", 1e-3, 1e5), 2)
        periods = period_on(chosen, mask)
    else:
        assert known is not None
        mask, periods = known.mask, periods_on(known, chosen)
    base = known.mask if known else mask
    mask = Mask(
        mask.frequency_per_mm,
        base.p if arguments.p is None else int(within("p", arguments.p, "", 1, 20)),
        arguments.pattern or base.pattern,
        arguments.harmonics or base.harmonics,
    )
    curve = mask_files.read_density_curve(arguments.curve) if arguments.curve else None
    return MaskImage(mask, chosen, periods, arguments.negative, arguments.bits, curve, arguments.drawable_only)


def periods_on(known: MaskProfile, chosen: Film) -> tuple[float, float]:
    """The periods (y, x): whole pixels if the mask was designed for this film, else by its frequency."""
    own = known.film_px_per_mm
    if own is not None and known.period_px is not None and np.allclose(chosen.px_per_mm, own, rtol=1e-3):
        return known.period_px, known.period_px
    return period_on(chosen, known.mask)
