"""`dappled georeference`: make maps of a recorded flight."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

from dappled import workers
from dappled.cli import paths
from dappled.cli.calibrate import lens
from dappled.cli.placing import Refining
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, Verb, argument, flag, option
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Code, Finding, Subject, finding, named, text

if not words_only:
    from dappled.flight import layout
    from dappled.products.extras import need
    from dappled.products.maps import difference, map_files, photographs, terrain
    from dappled.products.maps.difference import DifferenceError, MapDifference
    from dappled.products.maps.georeference import Survey
    from dappled.products.maps.hyperstereo import HyperstereoError
    from dappled.products.maps.terrain import TerrainModel
    from dappled.products.survey import frame_terrain
    from dappled.products.survey.frame_depths import FrameDepths
    from dappled.products.survey.frame_terrain import FrameTerrainError
    from dappled.products.whole_files import write_json

_FILES = {
    "kmz": ("mosaic.kmz",),
    "cog": ("mosaic.tif",),
    "footprints": ("footprints.geojson",),
    "terrain": ("terrain.tif", "terrain.las", "ground.tif"),
    "frame-terrain": ("terrain-frames.tif",),
    "difference": ("difference.tif", "height-difference.tif"),
}
KINDS = tuple(_FILES)
_MAP = Subject("map")
_EACH = {"kmz": ".kmz", "cog": ".tif"}


@dataclass(frozen=True, kw_only=True)
class MapFlight(Overwriting, Doubtable, Refining, Verb):
    """Make maps of a flight."""

    examples = (
        "dappled georeference ~/flights/20261121T101503Z-0a1b2c3d --as kmz",
        "dappled georeference FLIGHT --as cog footprints --terrain n41_w092_1arc_v3.dt2 --refine neighbours",
    )
    notes = "Writes into FLIGHT/maps, whose maps it replaces, unless -o says otherwise. The recording is not changed."

    flight: Path = argument("FLIGHT", "flight folder", there=paths.flight)
    output: Path | None = option("-o --output", "folder for the maps", None, metavar="DIR", otherwise="FLIGHT/maps")
    kinds: tuple[str, ...] = option("--as", "what to make", ("kmz", "cog", "footprints"), choices=KINDS)
    each: bool = flag("--each", "also make a kmz or cog of each frame, in frames/")
    quad: bool = flag("--quad", "write each frame's kmz as a LatLonQuad: the view itself")
    against: tuple[Path, ...] = option(
        "--against", "for difference: the later flight to compare with, or several; all of their frames are used", (),
        metavar="FLIGHT", there=paths.flight,
    )  # fmt: skip
    between: tuple[float, float] | None = option(
        "--between", "for terrain: heights to search, metres above sea level", None, metavar=("LOW", "HIGH"),
        otherwise="from 3 m below to 12 m above the ground given",
    )  # fmt: skip
    cell: float | None = option(
        "--cell", "for frame-terrain: side of a cell", None, unit="m", above=0.0,
        otherwise="half a depth map's window",
    )  # fmt: skip

    @property
    def _several(self) -> bool:
        return len(self.against) > 1

    def check(self) -> None:
        self.check_refinement()
        if ("difference" in self.kinds) != bool(self.against):
            raise CallError("--as difference and --against FLIGHT go together")
        if self.between and not self.between[0] < self.between[1]:
            raise CallError("--between: the lower height comes first")
        if "frame-terrain" in self.kinds and self.view not in ("mean", "ground"):
            raise CallError(f"--as frame-terrain is of all views: leave --view {self.view} out")
        if self.solve_lens is not None:
            if self.solve_lens.suffix != ".toml":
                raise CallError(f"{self.solve_lens}: the name of a camera profile must end in .toml")
            self.refuse_existing(self.solve_lens)
        if len({flight.resolve().name for flight in self.against}) < len(self.against):
            raise CallError("--against names a flight twice")
        if self.output is not None:  # a folder that the user named: its report is of the last call
            self.refuse_existing(*self._outputs(self.output))

    def _outputs(self, output: Path) -> Iterator[Path]:
        """What the call will write, but for the report; of single frames, what is there of these kinds."""
        for kind in self.kinds:
            if kind == "difference" and self._several:
                yield from (output / name for name in ("trend.tif", "height-trend.tif"))
                yield from (output / f"difference-{flight.name}.tif" for flight in self.against)
                yield from (output / f"height-difference-{flight.name}.tif" for flight in self.against)
                continue
            yield from (output / name for name in _FILES[kind])
            if self.each and kind in _EACH:
                yield from (output / "frames").glob(f"*{_EACH[kind]}")

    def run(self, output: Output) -> Report:
        flight = layout.open_folder(self.flight).path
        folder = self.output or flight / "maps"
        with ExitStack() as stack:
            missing: list[Finding] = []  # what could not be made
            depths = None
            if "frame-terrain" in self.kinds:
                scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dappled-depths-")))
                depths = FrameDepths(scratch, lambda found: found.depth(), self.focus)
            told: list[Finding] = []  # what is missing that poses alone told, before the first frame was decoded
            foresee = partial(self._foresee, told, output)
            watch = None if depths is None else depths.measure
            made = self.survey(flight, output, stack, missing, watch=watch, foresee=foresee)
            missing += told
            files = self._draw(made, folder, output)
            if made.lens is not None and self.solve_lens is not None:
                lens.write(self.camera or _camera_of(flight), made.lens.lens, self.solve_lens)
                files.append(self.solve_lens)
            if depths is not None:
                try:
                    fused = frame_terrain.of(made, depths.found, output.show, cell_m=self.cell)
                    files.append(frame_terrain.write_raster(made, fused, folder / "terrain-frames.tif"))
                    made = replace(made, notes=(*made.notes, *frame_terrain.told(made, fused)))
                except FrameTerrainError as error:
                    missing.append(_no_heights(error))
                made = replace(made, notes=(*made.notes, *depths.left))
            terrain_of = None
            if "terrain" in self.kinds and not told:
                try:
                    terrain_of = self._heights(made, output)
                    files.append(terrain.write_raster(made, terrain_of, folder / "terrain.tif"))
                    files.append(terrain.write_points(made, terrain_of, folder / "terrain.las"))
                    files.append(terrain.write_ground(made, terrain_of, folder / "ground.tif"))
                except HyperstereoError as error:
                    missing.append(_no_heights(error))
            if self.against:
                files += self._changes(made, terrain_of, folder, output, missing)
        made = replace(made, notes=(*made.notes, *missing))
        facts = map_files.report(made, files)
        files.append(write_json(folder / "report.json", facts))
        for said in (*map(text, made.left), *(named(one, _MAP) for one in made.notes if one not in told)):
            output.remark(str(said))
        frames = counted(len(made.photographs), "frame")
        lines = [f"{frames} on {made.projection.name}, {made.gsd_m:g} m per cell, {made.ground.name}"]
        lines += made.lens.words() if made.lens is not None else ()
        return Report(facts, [*lines, *map(str, files)], findings=made.doubts, failed=bool(missing))

    def _foresee(self, told: list[Finding], output: Output, planned: Survey) -> None:
        """Say what will be missing by poses alone, and add it to `told`. Raises HyperstereoError where that is all, and
        MapError for maps that the chosen cells make too large: how fine the frames are, only their files say."""
        if self.gsd is not None and "kmz" in self.kinds:
            map_files.overlay_grid(planned, planned.photographs)
        if self.gsd is not None and "cog" in self.kinds:
            map_files.mosaic_grid(planned)
        if "terrain" not in self.kinds:
            return
        need("laspy")
        low, high = self.between or (None, None)
        try:
            terrain.check(planned, lowest_m=low, highest_m=high)
        except HyperstereoError as error:
            if self.kinds == ("terrain",):
                raise
            told.append(_no_heights(error))
            output.remark(str(error))

    def _heights(self, made: Survey, output: Output) -> TerrainModel:
        low, high = self.between or (None, None)
        return terrain.of(made, output.show, lowest_m=low, highest_m=high)

    def _draw(self, made: Survey, folder: Path, output: Output) -> list[Path]:
        """Draw the maps, several at a time: each is one thread's, most of which is spent in libraries."""
        gain = map_files.gain_of(made)
        whole = {"kmz": map_files.mosaic_kmz, "cog": map_files.mosaic_cog}
        drawn: dict[Path, Callable[[], Path]] = {}
        for kind, ending in _EACH.items():
            if kind in self.kinds:
                path = folder / f"mosaic{ending}"
                drawn[path] = partial(whole[kind], made, path, gain)
        for one in made.photographs if self.each else ():
            beside = folder / "frames" / one.name
            if "kmz" in self.kinds:
                path = beside.with_suffix(".kmz")
                drawn[path] = partial(map_files.frame_kmz, made, one, path, gain, quad=self.quad)
            if "cog" in self.kinds:
                path = beside.with_suffix(".tif")
                drawn[path] = partial(map_files.frame_cog, made, one, path, gain)
        if drawn:
            output.show("draw maps", 0, len(drawn))  # the bar begins here: threads only move it, one at a time
        done, telling = count(1), threading.Lock()

        def draw(path: Path) -> None:
            drawn[path]()
            with telling:
                output.show("draw maps", next(done), len(drawn))

        workers.each(draw, drawn, self.workers)
        files = list(drawn)
        if "footprints" in self.kinds:
            files.append(map_files.write_footprints(made, folder))
        return files

    def _for_the_other(self, made: Survey) -> Refining:
        """How a flight of --against is placed: without what names frames of the first flight."""
        same = made.gsd_m if self._several else self.gsd  # a trend needs one grid
        return replace(self, crs=made.projection.name, frames=None, gcp=None, solve_lens=None, gsd=same)

    def _changes(
        self, made: Survey, heights: TerrainModel | None, folder: Path, output: Output, missing: list[Finding]
    ) -> list[Path]:
        """Write the change up to each flight of --against and, of several, the change over time."""
        files: list[Path] = []
        times, names = [difference.time_ns(made)], list[str]()
        pictures, raised = list[MapDifference](), list[MapDifference]()
        for flight in self.against:
            tail = f"-{flight.name}" if self._several else ""
            with ExitStack() as stack:
                try:
                    other = self._for_the_other(made).survey(flight, output, stack, missing)
                    changed = difference.of_pictures(made, other)
                    path = folder / f"difference{tail}.tif"
                    files.append(difference.write(made, other, changed, path, "share of brightness"))
                    pictures.append(changed)
                    times.append(difference.time_ns(other))
                    names.append(other.flight)
                    if heights is not None:
                        raised.append(difference.of_heights(heights, self._heights(other, output)))
                        path = folder / f"height-difference{tail}.tif"
                        files.append(difference.write(made, other, raised[-1], path, "m"))
                except DappledError as error:
                    missing.append(finding(Code.MAP_NO_DIFFERENCE, _MAP, flight=flight, why=error))
        kinds = [("trend.tif", pictures, "share of brightness")] if self._several else []
        kinds += [("height-trend.tif", raised, "m")] if self._several and heights is not None else []
        for name, changes, unit in kinds:
            if len(changes) < len(self.against):
                missing.append(
                    finding(Code.MAP_NO_TREND, _MAP, name=name, why=finding(Code.MAP_NOT_ALL_COMPARED, _MAP))
                )
                continue
            try:
                made_trend = difference.over_time(times, changes)
                files.append(difference.write_trend(made, made_trend, names, folder / name, unit))
            except DifferenceError as error:
                missing.append(finding(Code.MAP_NO_TREND, _MAP, name=name, why=error))
        return files


def _no_heights(error: DappledError) -> Finding:
    return finding(Code.MAP_NO_HEIGHTS, _MAP, why=error)


def _camera_of(flight: Path) -> str:
    """The name of the camera's profile."""
    _, tags = photographs.recorded(flight)
    return next(iter(tags.values())).camera
