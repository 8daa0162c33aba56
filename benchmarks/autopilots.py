"""Autopilots as people wire them: each trigger one shot, and every σ as large as the errors are. A matrix of wirings,
faults and rates, ArduPilot and PX4, on an injected clock.

python benchmarks/autopilots.py [--json] [--seed 1] [--cells TEXT]

A line is a cell (see `autopilot_cell.py`): the counts of requests, shots, files, the autopilot's triggers, triggers
that were named as lost, and the rms of errors over their σ for time, position and attitude, against the simulation's
truth. `unknown` counts tags whose attitude σ is not known. Tags in doubt are judged apart: their σ contains the
clock's step, so their ratio may be small. `--cells` flies only those whose line contains this text.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator

from autopilot_cell import FAULTS, WIRINGS, Cell, Outcome, Tagged, fly
from limits import show

RATES_HZ = (0.2, 1.0, 5.0)
LEAST, MOST = 0.8, 1.2
_FEWEST = 30  # tags: the ratio of fewer says little
_AT_PINS = ("pin wraps", "contacts lost", "contacts doubled")
_MIXED = ("late files, clock steps", "silence, clock steps")
_OF_EACH = 3  # wirings for each fault


def cells() -> Iterator[Cell]:
    """Every wiring without a fault, at every rate or, without a pin, at the slowest and the fastest; and every fault at
    three wirings, by turns; two at once at every pin."""
    wirings = list(WIRINGS)
    pins = [name for name in wirings if "pin" in name]
    for wiring in wirings:
        yield from (Cell(wiring, "none", hz) for hz in (RATES_HZ if wiring in pins else RATES_HZ[::2]))
    for number, fault in enumerate(FAULTS[1:]):
        if fault in _AT_PINS:
            yield from (Cell(wiring, fault, RATES_HZ[1 + place % 2]) for place, wiring in enumerate(pins))
            continue
        px4 = wirings[6 + number % 2]
        if fault in _MIXED:
            yield from (Cell(wiring, fault, RATES_HZ[1 + place % 2]) for place, wiring in enumerate((*pins, px4)))
            continue
        others = [wirings[(number + 3 * place) % 6] for place in range(_OF_EACH - 1)]
        for place, wiring in enumerate((*others, px4)):
            yield Cell(wiring, fault, RATES_HZ[1 + (number + place) % 2])


def bursts(cell: Cell) -> int:
    """How many independent bursts of shots: at least 180 shots."""
    return 180 if cell.hz < 1 else 120


def ratios(tags: Iterable[Tagged]) -> dict[str, float]:
    """The rms of error over σ: of time, place (three axes), attitude; NaN where no σ is known."""
    rows = list(tags)
    places = [
        (2 * one.across**2 + one.upright**2) / 3 for one in rows if one.across is not None and one.upright is not None
    ]
    return {
        "time": _root_mean(one.time**2 for one in rows),
        "place": _root_mean(places),
        "attitude": _root_mean(one.attitude**2 for one in rows if one.attitude is not None),
    }


def misses(cell: Cell, found: Outcome) -> list[str]:
    """What is not as asked, a sentence each."""
    outside = "servo" in cell.wiring or cell.wiring.endswith("INTERFACE 1")
    # the numbers of CAM1_TYPE 5's broadcasts are not known here
    lost = 0 if cell.wiring.endswith("TYPE 5") else found.triggers - found.shots
    early = int("daemon crashes" in cell.faults)  # a first report without a time is told, and no shot
    counts = (
        ("requests", found.requests, found.triggers),
        ("shots", found.shots, min(max(found.shots, found.heard - early), found.heard)),
        ("files", found.files, found.triggers if outside else found.heard),
        ("tags", len(found.tags), found.shots - found.unfinished),
        ("triggers named as lost", found.named, min(max(found.named, lost - found.missed), lost)),
        ("refused", found.refused, 0),
    )
    said = [f"{name}: {count}, not {asked}" for name, count, asked in counts if count != asked]
    for doubt in (False, True):
        tags = [one for one in found.tags if one.doubt == doubt]
        if len(tags) < _FEWEST:
            continue
        for name, ratio in ratios(tags).items():
            if ratio > MOST or (ratio < LEAST and not doubt):
                said.append(f"{name}{' in doubt' if doubt else ''}: {ratio:.2f} of σ")
    return said


def line(cell: Cell, found: Outcome) -> str:
    """A cell of the table."""
    sure, doubtful = ([one for one in found.tags if one.doubt == doubt] for doubt in (False, True))
    numbers = (found.requests, found.shots, found.files, found.triggers, found.named)
    parts = [f"{cell.wiring:34} {cell.fault:23} {cell.hz:3g}", *(f"{number:5}" for number in numbers)]
    for tags in (sure, doubtful):
        parts += [f"{len(tags):6}", *(f"{ratio:5.2f}" for ratio in ratios(tags).values())]
    unknown = sum(one.attitude is None for one in found.tags)
    return " ".join([*parts, f"{unknown:7}", "; ".join(misses(cell, found))]).rstrip().replace("  nan", "    –")


HEAD = (
    f"{'wiring':34} {'fault':23}  Hz  asked shots files trigs named"
    "   sure  time place  att.  doubt  time place  att. unknown"
)


def measure(seed: int = 1, *, only: str = "", told: bool = False) -> dict[str, float]:
    """Fly the matrix; `told`: print it."""
    if told:
        print(HEAD)
    flown = missed = shots = unknown = 0
    extremes = {name: [math.inf, 0.0] for name in ("time", "place", "attitude")}
    for cell in cells():
        if only not in f"{cell.wiring} {cell.fault} {cell.hz:g}":
            continue
        found = fly(cell, bursts(cell), seed)
        flown, missed, shots = flown + 1, missed + bool(misses(cell, found)), shots + found.shots
        unknown += sum(one.attitude is None for one in found.tags)
        sure = [one for one in found.tags if not one.doubt]
        for name, ratio in ratios(sure).items() if len(sure) >= _FEWEST else ():
            if not math.isnan(ratio):
                extremes[name] = [min(extremes[name][0], ratio), max(extremes[name][1], ratio)]
        if told:
            print(line(cell, found), flush=True)
    figures: dict[str, float] = {
        "cells": flown,
        "cells_missed": missed,
        "shots": shots,
        "attitude_sigma_unknown": unknown,
    }
    for name, (least, most) in extremes.items():
        if most:
            figures |= {f"{name}_least": least, f"{name}_most": most}
    return figures


def _root_mean(squares: Iterable[float]) -> float:
    values = list(squares)
    return math.sqrt(sum(values) / len(values)) if values else math.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cells", default="", metavar="TEXT")
    wanted = parser.parse_args()
    show("autopilots", measure(wanted.seed, only=wanted.cells, told=not wanted.json), as_json=wanted.json)


if __name__ == "__main__":
    main()
