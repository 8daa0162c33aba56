"""The thesis' camera by numbers: python benchmarks/masks.py PART [--first N] [--count N] [FOLDER] [--json].

Frames come from a simulator that shares no code with dappled (`tests/decode/ray_frames.py`), at SNR 100. The parts:

matrix       Masks 1 to 5 (linear, octave) and the full Mask 2, both bodies, two focal lengths each, f/8 to f/32, white,
             textures and boards, each cell with its own stop and turn, 540 in all: which calibrate, how well, the law.
seeds        200 frames, half with a film and half without: no wrong lattice, and none without a film.
print        Views of frames (reference camera, 300 × 360, 5 × 5 views of 4 × 4 rays) whose print is up to 1 % off: told
             the design, and told the print.
photographs  30 frames without a film, each searched for four masks; with FOLDER crops of the photographs in it instead.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from limits import show
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is the tests' own

from tests.decode.ray_frames import CANON, FUJI, MASKS, Shot, Stop, floors
from tests.decode.ray_trials import (
    ENOUGH,
    F_NUMBERS,
    LENGTHS_MM,
    SMALL,
    attempt,
    bare,
    noisy,
    off_bins,
    photograph,
    print_costs_db,
    seeded,
    shows_no_carriers,
)

from dappled.decode.calibration.fit import CalibrationFrame

TIMES = 8.0  # an order that many times above the frame's own level is seen: see `orders_above_noise`
RIGHT_BINS = 0.1
SEARCHED = ("mask-1", "mask-2", "mask-2-full", "mask-4-linear")
CROPS = 10  # of each photograph


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the matrix: how many orders of the half plane stand above the level, and what came out (None:
    refused): rms bins over all orders of the mask and over those that stand, and whether the law is right."""

    name: str
    standing: int
    all_bins: float | None
    standing_bins: float | None
    law: bool
    words: str


def cells() -> list[Shot]:
    """The 540 cells, in the order of their numbers."""
    shots = []
    for number, (scene, name, body, place, f_number) in enumerate(
        itertools.product(("white", "texture", "boards"), MASKS, (CANON, FUJI), (0, 1), F_NUMBERS)
    ):
        rng = np.random.default_rng(number)
        shots.append(
            Shot(
                MASKS[name],
                body,
                LENGTHS_MM[body][place],
                f_number,
                turn_deg=float(rng.uniform(-2, 2)),
                stop=Stop(str(rng.choice(["round", "square", "polygon"])), blades=int(rng.integers(5, 8))),  # type: ignore[arg-type]  # one of its shapes
                scene=scene,  # type: ignore[arg-type]  # likewise
                exponent=float(rng.uniform(1.1, 2)),
                seed=number,
                diffraction=bool(rng.integers(2)),
            )
        )
    return shots


def tried(shot: Shot) -> Cell:
    """Calibrate one cell."""
    seen = [order for order in shot.seen() if order > (0, 0)]
    plane = np.asarray(shot.without_film(), dtype=float)
    level = floors(plane, np.array(seen).reshape(-1, 2) @ shot.lattice)
    standing = [o for o, one in zip(seen, level, strict=True) if shot.seen()[o] > TIMES * float(one)]
    found, words = attempt(shot)
    mask = next(name for name, film in MASKS.items() if film is shot.film)
    name = (
        f"{mask}, {shot.body.scale}, {shot.focal_length_mm:g} mm, f/{shot.f_number:g}, {shot.scene}, {shot.stop.shape}"
    )
    if found is None:
        return Cell(name, len(standing), None, None, False, words)
    whole, part = off_bins(shot, found), off_bins(shot, found, standing) if standing else None
    return Cell(name, len(standing), whole, part, found.law == "geometric", "")


def matrix(first: int, count: int) -> dict[str, Any]:
    """All cells, or `count` from `first` on in a fixed random order; those that miss are printed."""
    shots = cells()
    order = np.random.default_rng(5).permutation(len(shots))[first : first + count]
    done = []
    for number in order:
        cell = tried(shots[number])
        done.append(cell)
        if cell.standing >= ENOUGH and (cell.all_bins is None or cell.all_bins > RIGHT_BINS or not cell.law):
            print(f"{number}: {cell}", file=sys.stderr)
    able = [one for one in done if one.standing >= ENOUGH]
    rest = [one for one in done if one.standing < ENOUGH]
    return {
        "cells": len(done),
        "with_four_orders": len(able),
        "of_these_calibrated": sum(one.all_bins is not None for one in able),
        "law_right": sum(one.law for one in able),
        "all_orders_within_0.1_bin": sum(one.all_bins is not None and one.all_bins <= RIGHT_BINS for one in able),
        "all_orders_worst_bins": max((one.all_bins or 0.0 for one in able), default=0.0),
        "standing_orders_worst_bins": max((one.standing_bins or 0.0 for one in able), default=0.0),
        "others_refused": sum(one.all_bins is None for one in rest),
        "others_named": sum("seen in this frame" in one.words or "should stand" in one.words for one in rest),
        "others_found": sum(one.all_bins is not None for one in rest),
        "others_found_worst_bins": max((one.all_bins or 0.0 for one in rest), default=0.0),
    }


def seeds(first: int, count: int) -> dict[str, Any]:
    """Odd seeds have a film before the sensor, even ones none."""
    worst, found, refused, false = 0.0, 0, 0, 0
    for seed in range(first, first + min(count, 200)):
        shot = seeded(seed)
        if seed % 2 == 0:
            false += not shows_no_carriers(bare(shot), shot.film)
            continue
        seen, _ = attempt(shot)
        refused += seen is None
        if seen is not None:
            found += 1
            worst = max(worst, off_bins(shot, seen))
    return {"found": found, "worst_bins": worst, "refused": refused, "found_without_a_film": false}


def print_scales(first: int) -> dict[str, Any]:
    """PSNR of views in dB for each scale, worst over two seeds, and what it costs not to know the scale."""
    figures = {}
    for scale in (0.99, 0.995, 1.005, 1.01):
        found = [print_costs_db(scale, seed, beams=20) for seed in (first + 3, first + 4)]
        costs = max(known - told for told, known in found)
        figures[f"{scale:g}"] = {"views_db": min(told for told, _ in found), "costs_db": costs}
    return figures


def photographs(first: int, count: int, folder: Path | None) -> dict[str, Any]:
    """Frames in which carriers of `SEARCHED` were found, of all; each is named."""
    frames = _crops(folder) if folder else (photograph(number) for number in itertools.count(first))
    false = tried_ = 0
    for number, frame in enumerate(itertools.islice(frames, min(count, 10**6 if folder else 30))):
        tried_ += 1
        wrong = [name for name in SEARCHED if not shows_no_carriers(frame, MASKS[name])]
        false += bool(wrong)
        if wrong:
            print(f"photograph {number}: {', '.join(wrong)}", file=sys.stderr)
    return {"photographs": tried_, "with_false_carriers": false}


def _crops(folder: Path) -> Iterator[CalibrationFrame]:
    """Crops of the photographs in a folder as linear frames with noise, at full size or reduced up to 4 times."""
    rng = np.random.default_rng(1)
    high, wide = SMALL.shape
    for path in sorted(one for one in folder.rglob("*") if one.suffix.lower() in (".jpg", ".jpeg", ".png")):
        picture = Image.open(path).convert("L")
        if picture.size[0] < wide or picture.size[1] < high:
            continue
        for _ in range(CROPS):
            most = min(picture.size[0] / wide, picture.size[1] / high, 4.0)
            share = float(rng.uniform(1.0, most)) if most > 1 else 1.0
            size = round(share * wide), round(share * high)
            left, top = (int(rng.integers(0, have - need + 1)) for have, need in zip(picture.size, size, strict=True))
            crop = picture.crop((left, top, left + size[0], top + size[1])).resize((wide, high), Image.Resampling.BOX)
            yield noisy(np.maximum((np.asarray(crop, dtype=np.float64) / 255) ** 2.2, 1e-3), rng)


def main(words: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("matrix", "seeds", "photographs", "print"))
    parser.add_argument("folder", type=Path, nargs="?", help="photographs of your own (.jpg, .png)")
    parser.add_argument("--first", type=int, default=0, help="number of the first cell, seed or photograph")
    parser.add_argument("--count", type=int, default=1000, help="how many (default: all)")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(words)
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "matrix": lambda: matrix(asked.first, asked.count),
        "seeds": lambda: seeds(asked.first, asked.count),
        "print": lambda: print_scales(asked.first),
        "photographs": lambda: photographs(asked.first, asked.count, asked.folder),
    }
    began = time.process_time()
    figures = parts[asked.part]()
    show("masks", {**figures, "cpu_s": time.process_time() - began}, as_json=asked.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
