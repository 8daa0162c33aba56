"""Random sorties: several faults at once, by seed. What is undoubted is true, and each trigger is in exactly one book.

python benchmarks/sorties.py [--json] [--seed 1] [--sorties 500]

A sortie is a cell of `autopilot_cell.py` with a random wiring and up to three random faults: a link that holds its
bytes, steps of the clock, a receiver that jumps by 33 m and back, a reboot, a crash and restart of the autopilot or of
the daemon, two ports, two ground stations, losses, doubles. A sortie that misses is printed with its seed:
`--seed N --sorties 1` flies it again.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator

from autopilot_cell import WIRINGS, Cell, Outcome, fly
from autopilots import misses, ratios
from limits import show

BURSTS = 10
FAR, WRONG = 4.0, 6.0  # σ on an axis: hardly ever, and never
CALM = ("two ports", "every packet twice", "stations broadcast", "contacts doubled", "late packets")
ROUGH = ("link holds", "clock steps", "glitch", "reboots", "link down", "contacts lost", "late files",
         "autopilot crashes", "daemon crashes")  # fmt: skip
_CRASHES = {"reboots", "autopilot crashes"}
_APART = (
    {"link holds", "link down"},
    {"reboots", "clock steps"},
    {"autopilot crashes", "clock steps"},
    _CRASHES,
)
_WITH_PIN = {"contacts lost", "contacts doubled"}


def sortie(seed: int) -> Cell:
    """The wiring, faults and rate of a seed."""
    rng = random.Random(seed)  # noqa: S311  a simulation
    wiring = rng.choice(list(WIRINGS))
    while True:
        faults = {*rng.sample(ROUGH, rng.choice((0, 1, 1, 2))), *rng.sample(CALM, rng.choice((0, 1)))}
        by_wire = "servo" in wiring or wiring.endswith("INTERFACE 1")
        if any(pair <= faults for pair in _APART) or ("pin" not in wiring and faults & _WITH_PIN):
            continue
        if "stations broadcast" in faults and (by_wire or faults & _CRASHES):
            continue
        return Cell(wiring, ", ".join(sorted(faults)) or "none", rng.choice((1.0, 5.0)))


def wrong(cell: Cell, found: Outcome) -> list[str]:
    """What is in no book or in two, and undoubted frames that are far off, a sentence each."""
    sure = [one for one in found.tags if not one.doubt]
    return [
        *(said for said in misses(cell, found) if not said.endswith("σ")),
        *(f"{max(map(abs, one.axes)):.1f} σ off" for one in sure if max(map(abs, one.axes), default=0) > WRONG),
        *(f"its time {one.time:.1f} σ off" for one in sure if abs(one.time) > WRONG),
    ]


def sorties(first: int, count: int) -> Iterator[tuple[int, Cell, Outcome]]:
    """Fly the sorties of so many seeds."""
    for seed in range(first, first + count):
        cell = sortie(seed)
        yield seed, cell, fly(cell, BURSTS, seed)


def measure(first: int = 1, count: int = 500, *, told: bool = False) -> dict[str, float]:
    """Fly them; `told`: print each that misses."""
    flown = missed = calm = doubted = 0
    tags = []
    for seed, cell, found in sorties(first, count):
        sure = [one for one in found.tags if not one.doubt]
        said = wrong(cell, found)
        flown, missed = flown + 1, missed + bool(said)
        tags += sure
        if not cell.faults & {*ROUGH}:
            calm, doubted = calm + len(found.tags), doubted + len(found.tags) - len(sure)
        if told and said:
            print(f"seed {seed}: {cell.wiring}, {cell.fault}, {cell.hz:g} Hz: {'; '.join(said)}", flush=True)
    axes = [abs(axis) for one in tags for axis in one.axes]
    figures = ratios(tags)
    return {
        "sorties": flown,
        "sorties_missed": missed,
        "frames_undoubted": len(tags),
        "axes_beyond_4_sigma_per_5000": 5000 * sum(axis > FAR for axis in axes) / max(1, len(axes)),
        "axes_beyond_6_sigma": sum(axis > WRONG for axis in axes),
        "time_of_sigma": figures["time"],
        "place_of_sigma": figures["place"],
        "false_doubts_percent": 100 * doubted / max(1, calm),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sorties", type=int, default=500)
    wanted = parser.parse_args()
    show("sorties", measure(wanted.seed, wanted.sorties, told=not wanted.json), as_json=wanted.json)


if __name__ == "__main__":
    main()
