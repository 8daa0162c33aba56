"""`dappled flight coverage`: which ground a flight's frames have seen, the holes, and the mission that closes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import codec
from dappled.cli.flight.arguments import EXAMPLE, FlightArgument
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, flag, option
from dappled.errors import CallError, counted
from dappled.findings import told

if not words_only:
    from dappled.decode.geometry import area as areas
    from dappled.products.maps import coverage, coverage_files
    from dappled.products.maps import refly as reflying


@dataclass(frozen=True, kw_only=True)
class CoverageOfFlight(Overwriting, FlightArgument, Verb):
    """Which ground the frames have seen."""

    examples = (
        f"dappled flight coverage {EXAMPLE} --area field.kml",
        "dappled flight coverage --area field.plan --least 2 --refly again.plan",
    )

    area: Path | None = option("--area", "the planned area: GeoJSON, KML, or a QGroundControl .plan", None, there=True)
    least: int = option("--least", "ground seen by fewer frames is a hole", 1, low=1)
    refly: Path | None = option("--refly", "write a mission over the holes (.plan)", None)
    overlap: float = option("--overlap", "of the mission, along a line", 0.8, metavar="SHARE", low=0, high=0.95)
    sidelap: float = option("--sidelap", "of the mission, between lines", 0.6, metavar="SHARE", low=0, high=0.95)
    interval: float | None = option(
        "--interval", "of the mission: time that the body needs for a photograph", None, unit="s", above=0.0,
        otherwise="the flight's usual one",
    )  # fmt: skip
    slowest: float = option(
        "--slowest", "of the mission: the vehicle's lowest speed", 0.5, unit="m/s", above=0.0,
    )  # fmt: skip
    output: Path | None = option(
        "-o --output", "write coverage.tif, .geojson and .png into this folder", None, metavar="DIR",
    )  # fmt: skip
    cell: float | None = option(
        "--cell", "side of a map cell", None, unit="m", above=0.0, otherwise="1/500 of the map",
    )  # fmt: skip
    ground: float | None = option("--ground", "height of flat ground", None, unit="m", otherwise="home's")
    terrain: Path | None = option("--terrain", "terrain raster: DTED, GeoTIFF …", None, there=True)
    count_bad: bool = flag("--count-bad", "also count frames that were judged bad in flight")
    count_doubtful: bool = flag("--count-doubtful", "also count frames whose place or time is in doubt")

    def _files(self) -> list[Path]:
        return [] if self.output is None else [self.output / f"coverage.{kind}" for kind in ("tif", "geojson", "png")]

    def check(self) -> None:
        if self.refly is not None and self.refly.suffix != ".plan":
            raise CallError(f"--refly {self.refly}: QGroundControl opens .plan files only")
        if self.refly is not None and self.area is None:
            raise CallError("--refly needs --area: without an area it is not known what should have been seen")
        self.refuse_existing(*self._files(), self.refly)

    def run(self, output: Output) -> Report:
        files = self._files()
        area = None if self.area is None else areas.read(self.area)
        seen = coverage.of_flight(
            self.chosen(output),
            area=area,
            terrain=self.terrain,
            ground_m=self.ground,
            count_bad=self.count_bad,
            count_doubtful=self.count_doubtful,
        )
        covered = coverage.cover(seen, coverage.grid_of(seen, area, self.cell), area)
        if not covered.planned.any():
            raise CallError(f"{self.area}: the area is smaller than a cell of the map: give a smaller --cell")
        mission = None
        if self.refly is not None:
            mission = reflying.plan(
                seen,
                covered,
                least=self.least,
                overlap=self.overlap,
                sidelap=self.sidelap,
                body_s=self.interval,
                slowest_m_s=self.slowest,
            )
        if self.output is not None:
            self.output.mkdir(parents=True, exist_ok=True)
            tif, geojson, png = files
            coverage_files.write_raster(covered, tif, least=self.least)
            coverage_files.write_geojson(covered, seen.projection, geojson, least=self.least)
            coverage_files.write_picture(covered, seen.projection, area, png, least=self.least)
        if mission is not None and self.refly is not None:
            reflying.write(mission, self.refly)
            files.append(self.refly)
        return self._report(seen, covered, mission, files, area)

    def _report(
        self,
        seen: coverage.FramesSeen,
        covered: coverage.Coverage,
        mission: reflying.Refly | None,
        files: list[Path],
        area: areas.PlannedArea | None,
    ) -> Report:
        planned, missed = int(covered.planned.sum()), int(covered.holes(self.least).sum())
        unknown_m2 = round(covered.unknown_cells * covered.cell_m2, 1)
        values = {
            "flight": seen.flight,
            "frames": len(seen.eyes),
            "left_out": codec.plain(seen.left),
            "ground": seen.ground.name,
            "cell_m": covered.grid.step_x,
            "area_m2": round(planned * covered.cell_m2, 1),
            "holes_m2": None if area is None else round(missed * covered.cell_m2, 1),
            "unknown_m2": unknown_m2,
            "unjudged": seen.unjudged,
            "not_in_area": [] if area is None else list(area.left),
            "median_frames": float(_median(covered)),
            "lines": None if mission is None else len(mission.lines),
            "speed_m_s": None if mission is None else mission.speed_m_s,
            "interval_s": None if mission is None else mission.interval_s,
            "files": [str(file) for file in files],
        }
        cells = f"cells of {covered.grid.step_x:.2g} m"
        lines = [f"{counted(len(seen.eyes), 'frame')} on ground {seen.ground.name}, {cells}"]
        lines += [f"not counted: {told(one)}" for one in seen.left]
        if seen.unjudged:
            lines.append(
                f"frames that were not judged in flight, or judged unknown, and count as seen: {seen.unjudged}"
            )
        if area is not None and area.left:
            lines.append(f"not in the area: {', '.join(area.left)}")
        if area is None:
            lines.append("no --area: what should have been seen is not known, and holes are not told")
        else:
            often = f"{1 - missed / planned:.1%} seen by {counted(self.least, 'frame')} or more"
            lines.append(f"{planned * covered.cell_m2:.0f} m² planned, {often}")
            lines.append(f"HOLES: {missed * covered.cell_m2:.0f} m²" if missed else "no holes")
        if unknown_m2:
            lines.append(f"the terrain has no height for {unknown_m2:.0f} m²: they count as not seen")
        if mission is not None:
            every = f"a photograph every {mission.trigger_m:.1f} m at {mission.speed_m_s:g} m/s"
            lines.append(f"{counted(len(mission.lines), 'line')} at {mission.altitude_m:.0f} m above home, {every}")
            body = "has to be able to: give --interval" if mission.body_s is None else f"needs {mission.body_s:.2g} s"
            lines.append(f"that is one in {mission.interval_s:.2g} s; the body {body}")
        elif self.refly is not None:
            lines.append(f"{self.refly} was not written: there is nothing to fly again")
        return Report(values, [*lines, *map(str, files)], failed=bool(missed))


def _median(covered: coverage.Coverage) -> float:
    found = sorted(covered.frames[covered.planned].tolist())
    return float(found[len(found) // 2])
