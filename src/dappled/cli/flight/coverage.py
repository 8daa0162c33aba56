"""`dappled flight coverage`: which ground a flight's frames have seen, the holes, and the mission that closes them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dappled.cli.arguments import refuse_existing
from dappled.decode.geometry import area as areas
from dappled.errors import DappledError, counted
from dappled.findings import to_rows, told
from dappled.products.maps import coverage, coverage_files, refly
from dappled.shown import printable


class CoverageCallError(DappledError):
    """A wrong call; one sentence."""

    exit_code = 2


def run(flight: Path, arguments: argparse.Namespace) -> int:
    _check(arguments)
    output: Path | None = arguments.output
    files = [] if output is None else [output / f"coverage.{kind}" for kind in ("tif", "geojson", "png")]
    refuse_existing(arguments, *files, *([arguments.refly] if arguments.refly else []))
    area = None if arguments.area is None else areas.read(arguments.area)
    seen = coverage.of_flight(
        flight,
        area=area,
        terrain=arguments.terrain,
        ground_m=arguments.ground,
        count_bad=arguments.count_bad,
        count_doubtful=arguments.count_doubtful,
    )
    covered = coverage.cover(seen, coverage.grid_of(seen, area, arguments.cell), area)
    if not covered.planned.any():
        raise CoverageCallError(f"{arguments.area}: the area is smaller than a cell of the map: give a smaller --cell")
    mission = None
    if arguments.refly is not None:
        lap = {"overlap": arguments.overlap, "sidelap": arguments.sidelap}
        mission = refly.plan(seen, covered, least=arguments.least, **lap)
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        tif, geojson, png = files
        coverage_files.write_raster(covered, tif, least=arguments.least)
        coverage_files.write_geojson(covered, seen.projection, geojson, least=arguments.least)
        coverage_files.write_picture(covered, seen.projection, area, png, least=arguments.least)
    if mission is not None:
        refly.write(mission, arguments.refly)
        files.append(arguments.refly)
    return _said(seen, covered, mission, files, arguments, area=area)


def _check(arguments: argparse.Namespace) -> None:
    for name in ("overlap", "sidelap"):
        if not 0 <= getattr(arguments, name) <= 0.95:
            raise CoverageCallError(f"--{name} {getattr(arguments, name):g}: give a share from 0 to 0.95")
    if arguments.least < 1:
        raise CoverageCallError("--least 0: every place is seen by 0 frames; give 1 or more")
    if arguments.refly is not None and arguments.refly.suffix != ".plan":
        raise CoverageCallError(f"--refly {arguments.refly}: QGroundControl opens .plan files only")
    if arguments.refly is not None and arguments.area is None:
        raise CoverageCallError("--refly needs --area: without an area it is not known what should have been seen")


def _said(
    seen: coverage.FramesSeen,
    covered: coverage.Coverage,
    mission: refly.Refly | None,
    files: list[Path],
    arguments: argparse.Namespace,
    *,
    area: areas.PlannedArea | None,
) -> int:
    planned, missed = int(covered.planned.sum()), int(covered.holes(arguments.least).sum())
    unknown_m2 = round(covered.unknown_cells * covered.cell_m2, 1)
    facts = {
        "flight": seen.flight,
        "frames": len(seen.eyes),
        "left_out": to_rows(seen.left),
        "ground": seen.ground.name,
        "cell_m": covered.grid.step_x,
        "area_m2": round(planned * covered.cell_m2, 1),
        "holes_m2": None if area is None else round(missed * covered.cell_m2, 1),
        "unknown_m2": unknown_m2,
        "unjudged": seen.unjudged,
        "not_in_area": [] if area is None else list(area.left),
        "median_frames": float(_median(covered)),
        "lines": None if mission is None else len(mission.lines),
        "files": [str(file) for file in files],
    }
    if arguments.json:
        print(json.dumps(facts, indent=2))
        return 1 if missed else 0
    print(f"{counted(len(seen.eyes), 'frame')} on ground {seen.ground.name}, cells of {covered.grid.step_x:.2g} m")
    for one in seen.left:
        print(printable(f"not counted: {told(one)}"))
    if seen.unjudged:
        print(f"frames that were not judged in flight, or judged unknown, and count as seen: {seen.unjudged}")
    if area is not None and area.left:
        print(printable(f"not in the area: {', '.join(area.left)}"))
    if area is None:
        print("no --area: what should have been seen is not known, and holes are not told")
    else:
        share = 1 - missed / planned
        often = counted(arguments.least, "frame")
        print(f"{planned * covered.cell_m2:.0f} m² planned, {share:.1%} seen by {often} or more")
        print(f"HOLES: {missed * covered.cell_m2:.0f} m²" if missed else "no holes")
    if unknown_m2:
        print(f"the terrain has no height for {unknown_m2:.0f} m²: they count as not seen")
    if mission is not None:
        lines = counted(len(mission.lines), "line")
        print(f"{lines} at {mission.altitude_m:.0f} m above home, a photograph every {mission.trigger_m:.1f} m")
    elif arguments.refly is not None:
        print(f"{arguments.refly} was not written: there is nothing to fly again")
    for file in files:
        print(printable(str(file)))
    return 1 if missed else 0


def _median(covered: coverage.Coverage) -> float:
    found = sorted(covered.frames[covered.planned].tolist())
    return float(found[len(found) // 2])
