"""`dappled georeference`: make maps of a recorded flight."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dappled.cli.arguments import add_overwrite, metres, positive, refuse_existing
from dappled.cli.calibrate import lens
from dappled.daemon.pipeline import recipes
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import DappledError, counted
from dappled.findings import told
from dappled.flight import layout
from dappled.products.maps import difference, earth, georeference, map_files, photographs, terrain
from dappled.products.maps.difference import DifferenceError, MapDifference
from dappled.products.maps.georeference import Options, Progress, Survey, Watch
from dappled.products.maps.hyperstereo import HyperstereoError
from dappled.products.maps.references import BaseMapError
from dappled.products.maps.terrain import TerrainModel
from dappled.products.mounting import Mounting
from dappled.products.survey import frame_terrain
from dappled.products.survey.frame_depths import FrameDepths
from dappled.products.survey.frame_terrain import FrameTerrainError

_FILES = {
    "kmz": ("mosaic.kmz",),
    "cog": ("mosaic.tif",),
    "footprints": ("footprints.geojson",),
    "terrain": ("terrain.tif", "terrain.las", "ground.tif"),
    "frame-terrain": ("terrain-frames.tif",),
    "difference": ("difference.tif", "height-difference.tif"),
}
KINDS = tuple(_FILES)
_EACH = {"kmz": ".kmz", "cog": ".tif"}


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled georeference ~/flights/20261121T101503Z-0a1b2c3d --as kmz\n"
        "  dappled georeference FLIGHT --as cog footprints --terrain n41_w092_1arc_v3.dt2 --refine neighbours\n"
        "Writes into FLIGHT/maps, whose maps it replaces, unless -o says otherwise. The recording is not changed."
    )
    parser.add_argument("flight", type=Path, metavar="FLIGHT", help="flight folder")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder for the maps (default: FLIGHT/maps)")
    parser.add_argument("--as", dest="kinds", nargs="+", choices=KINDS, default=["kmz", "cog", "footprints"],
                        help="what to make (default: kmz cog footprints)")  # fmt: skip
    parser.add_argument("--each", action="store_true", help="also make a kmz or cog of each frame, in frames/")
    parser.add_argument("--quad", action="store_true", help="write each frame's kmz as a LatLonQuad: the view itself")
    parser.add_argument(
        "--against",
        nargs="+",
        type=Path,
        metavar="FLIGHT",
        help="for difference: the later flight to compare with, or several; all of their frames are used",
    )
    parser.add_argument("--between", nargs=2, type=float, metavar=("LOW", "HIGH"),
                        help="for terrain: heights to search, metres above sea level\n"
                        "(default: from 3 m below to 12 m above the ground given)")  # fmt: skip
    parser.add_argument("--cell", type=positive, metavar="M",
                        help="for frame-terrain: side of a cell (default: half a depth map's window)")  # fmt: skip
    add_overwrite(parser)
    add_placing(parser)
    better = parser.add_argument_group("refinement")
    better.add_argument("--refine", nargs="+", default=[], metavar="WITH",
                        help="neighbours (frames against each other), a base map (GeoTIFF …), or both")  # fmt: skip
    better.add_argument("--gcp", type=Path, metavar="CSV",
                        help="control points: name, frame, column, row, latitude, longitude, altitude")  # fmt: skip
    better.add_argument("--solve-lens", type=Path, metavar="FILE.toml",
                        help="find the lens from the frames' own overlap, telemetry and --gcp,\n"
                        "and write a copy of the camera's profile with it")  # fmt: skip
    better.add_argument("--search", type=positive, default=5.0, metavar="M",
                        help="search radius on the base map (default: 5 m)")  # fmt: skip
    better.add_argument("--pose-sigma", nargs=2, type=positive, metavar=("M", "DEG"),
                        help="σ of the poses (default: as recorded)")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def add_placing(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say how frames are decoded and placed."""
    ground = parser.add_argument_group("ground")
    ground.add_argument("--ground", type=float, metavar="M",
                        help="height of flat ground, metres above sea level (default: home's)")  # fmt: skip
    ground.add_argument("--terrain", type=Path, metavar="FILE", help="terrain raster: DTED, GeoTIFF …")
    ground.add_argument("--terrain-heights", choices=("sea-level", "ellipsoid"), default="sea-level",
                        help="what the raster's heights are measured from (default: sea-level)")  # fmt: skip
    ground.add_argument("--geoid", metavar="FILE|M",
                        help="geoid grid (.gtx, .tif), or metres of sea level above the ellipsoid")  # fmt: skip
    camera = parser.add_argument_group("camera")
    camera.add_argument("--camera", metavar="P", help="camera profile (default: the flight's)")
    camera.add_argument("--mask", metavar="P", help="mask profile (default: the flight's)")
    camera.add_argument("--calibration", metavar="FILE", help="mask calibration (default: the flight's)")
    camera.add_argument("--focal-length", type=positive, metavar="MM", help="focal length, if the frames don't say")
    camera.add_argument("--f-number", type=positive, metavar="N", help="f-number, if the frames don't say")
    camera.add_argument("--view", default="mean", metavar="VIEW",
                        help="mean, ground (all views, refocused on it), or the row,column of one view")  # fmt: skip
    camera.add_argument(
        "--grey", action="store_true", help="make grey maps (default: in colour if the frames have colour)"
    )
    camera.add_argument("--lever-arm", nargs=3, type=float, metavar=("F", "R", "D"),
                        help="antenna to camera, metres forward, right, down (default: the flight's)")  # fmt: skip
    camera.add_argument("--mount", nargs=9, type=float, metavar="R",
                        help="camera axes to body, row by row (default: the flight's)")  # fmt: skip
    camera.add_argument("--focus", type=metres, default=math.inf, metavar="M",
                        help="distance at which the lens was focused (default: infinity)")  # fmt: skip
    maps = parser.add_argument_group("map")
    maps.add_argument("--crs", metavar="EPSG:N", help="projection in metres (default: the UTM zone)")
    maps.add_argument(
        "--gsd",
        type=positive,
        metavar="M",
        help="side of a map cell (default: the ground sample distance of the frames)",
    )
    maps.add_argument("--frames", metavar="N,A-B", help="use only these frames")


def placed(flight: Path, given: Mapping[str, Any], progress: Progress, stack: ExitStack, *,
           watch: Watch | None = None) -> Survey:  # fmt: skip
    """A flight's frames on the map, for other verbs: `given` are arguments of this one, the rest are their defaults.
    What is in doubt about them is said on standard error.

    Raises DappledError.
    """
    parser = argparse.ArgumentParser()
    configure(parser)
    arguments = argparse.Namespace(**{**vars(parser.parse_args([str(flight)])), **given})
    made = _survey(flight, arguments, progress, stack, [], watch=watch)
    for one in made.doubts:
        print(f"in doubt: {told(one)}", file=sys.stderr)
    return made


def run(arguments: argparse.Namespace) -> int:
    folder = layout.open_folder(arguments.flight)
    output = arguments.output or folder.path / "maps"
    _check(arguments, output)
    with ExitStack() as stack:
        progress = stack.enter_context(Bar())
        missing: list[str] = []  # a sentence for each product that could not be made
        depths = _frame_depths(arguments, stack) if "frame-terrain" in arguments.kinds else None
        made = _survey(folder.path, arguments, progress, stack, missing, watch=depths)
        files = _draw(made, output, arguments)
        if made.lens is not None:
            lens.write(_camera(folder.path, arguments), made.lens.lens, arguments.solve_lens)
            files.append(arguments.solve_lens)
        if depths is not None:
            try:
                fused = frame_terrain.of(made, depths.found, progress, cell_m=arguments.cell)
                files.append(frame_terrain.write_raster(made, fused, output / "terrain-frames.tif"))
                made = replace(made, notes=(*made.notes, *frame_terrain.words(made, fused)))
            except FrameTerrainError as error:
                missing.append(str(error))
            made = replace(made, notes=(*made.notes, *(why for _, why in depths.left)))
        terrain_of = None
        if "terrain" in arguments.kinds:
            try:
                terrain_of = _heights(made, arguments, progress)
                files.append(terrain.write_raster(made, terrain_of, output / "terrain.tif"))
                files.append(terrain.write_points(made, terrain_of, output / "terrain.las"))
                files.append(terrain.write_ground(made, terrain_of, output / "ground.tif"))
            except HyperstereoError as error:
                missing.append(str(error))
        if arguments.against is not None:
            files += _changes(made, terrain_of, output, arguments, progress=progress, missing=missing)
    made = replace(made, notes=(*made.notes, *(f"in doubt: {told(one)}" for one in made.doubts), *missing))
    report = map_files.write_report(made, output, files)
    if arguments.json:
        print(report.read_text(), end="")
    else:
        frames = counted(len(made.photographs), "frame")
        print(f"{frames} on {made.projection.name}, {made.gsd_m:g} m per cell, {made.ground.name}")
        for line in made.lens.words() if made.lens is not None else ():
            print(line)
        for path in (*files, report):
            print(path)
    for why in (*(why for _, why in made.left), *made.notes):
        print(why, file=sys.stderr)
    return 1 if missing else 0


def _check(arguments: argparse.Namespace, output: Path) -> None:
    """Refuse what can't be done before the work begins. Raises DappledError."""
    if ("difference" in arguments.kinds) != (arguments.against is not None):
        raise DappledError("--as difference and --against FLIGHT go together")
    if arguments.between and not arguments.between[0] < arguments.between[1]:
        raise DappledError("--between: the lower height comes first")
    if "frame-terrain" in arguments.kinds and arguments.view not in ("mean", "ground"):
        raise DappledError(f"--as frame-terrain is of all views: leave --view {arguments.view} out")
    if arguments.solve_lens is not None:
        if arguments.solve_lens.suffix != ".toml":
            raise DappledError(f"{arguments.solve_lens}: the name of a camera profile must end in .toml")
        refuse_existing(arguments, arguments.solve_lens)
    for flight in arguments.against or ():
        layout.open_folder(flight)
    if len({flight.resolve().name for flight in arguments.against or ()}) < len(arguments.against or ()):
        raise DappledError("--against names a flight twice")
    if arguments.output is not None:  # a folder that the user named: its report is of the last call
        refuse_existing(arguments, *_outputs(output, arguments))


def _outputs(output: Path, arguments: argparse.Namespace) -> Iterator[Path]:
    """What the call will write, but for the report; of single frames, what is there of these kinds."""
    several = arguments.against is not None and len(arguments.against) > 1
    for kind in arguments.kinds:
        if kind == "difference" and several:
            yield from (output / name for name in ("trend.tif", "height-trend.tif"))
            yield from (output / f"difference-{flight.name}.tif" for flight in arguments.against)
            yield from (output / f"height-difference-{flight.name}.tif" for flight in arguments.against)
            continue
        yield from (output / name for name in _FILES[kind])
        if arguments.each and kind in _EACH:
            yield from (output / "frames").glob(f"*{_EACH[kind]}")


def _heights(made: Survey, arguments: argparse.Namespace, progress: Progress) -> TerrainModel:
    low, high = arguments.between or (None, None)
    return terrain.of(made, progress, lowest_m=low, highest_m=high)


def _frame_depths(arguments: argparse.Namespace, stack: ExitStack) -> FrameDepths:
    """What measures single frames while they are decoded."""
    scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dappled-depths-")))
    return FrameDepths(scratch, lambda found: found.depth(), arguments.focus)


def _changes(
    made: Survey,
    heights: TerrainModel | None,
    output: Path,
    arguments: argparse.Namespace,
    *,
    progress: Progress,
    missing: list[str],
) -> list[Path]:
    """Write the change up to each flight of --against and, of several, the change over time."""
    files: list[Path] = []
    times, names = [difference.time_ns(made)], list[str]()
    pictures, raised = list[MapDifference](), list[MapDifference]()
    several = len(arguments.against) > 1
    for flight in arguments.against:
        tail = f"-{flight.name}" if several else ""
        with ExitStack() as stack:
            try:
                other = _survey(flight, _for_the_other(arguments, made), progress, stack, missing)
                changed = difference.of_pictures(made, other)
                path = output / f"difference{tail}.tif"
                files.append(difference.write(made, other, changed, path, "share of brightness"))
                pictures.append(changed)
                times.append(difference.time_ns(other))
                names.append(other.flight)
                if heights is not None:
                    raised.append(difference.of_heights(heights, _heights(other, arguments, progress)))
                    files.append(
                        difference.write(made, other, raised[-1], output / f"height-difference{tail}.tif", "m")
                    )
            except DappledError as error:
                missing.append(f"no difference to {flight}: {error}")
    if several:
        kinds = (("trend.tif", pictures, "share of brightness"), ("height-trend.tif", raised, "m"))
        for name, changes, unit in kinds[: 1 if heights is None else 2]:
            if len(changes) < len(arguments.against):
                missing.append(f"no {name}: not every flight could be compared")
                continue
            try:
                made_trend = difference.over_time(times, changes)
                files.append(difference.write_trend(made, made_trend, names, output / name, unit))
            except DifferenceError as error:
                missing.append(f"no {name}: {error}")
    return files


def _for_the_other(arguments: argparse.Namespace, made: Survey) -> argparse.Namespace:
    """The arguments for a flight of --against, without those that name frames of the first flight."""
    same = {"gsd": made.gsd_m} if len(arguments.against) > 1 else {}  # a trend needs one grid
    return argparse.Namespace(**{**vars(arguments), "crs": made.projection.name, "frames": None, "gcp": None,
                                 "solve_lens": None, **same})  # fmt: skip


def _survey(
    flight: Path,
    arguments: argparse.Namespace,
    progress: Progress,
    stack: ExitStack,
    missing: list[str],
    *,
    watch: Watch | None = None,
) -> Survey:
    """Decode, place and refine a flight as the arguments say; `watch` gets each decoded frame. Adds what could
    not be done to `missing`."""
    rasters = [Path(word) for word in arguments.refine if word != "neighbours"]
    if len(rasters) > 1:
        raise DappledError(f"--refine takes one base map, not {len(rasters)}")
    facts = layout.read_facts(layout.open_folder(flight))
    made = georeference.survey(
        flight, recipe(flight, facts, arguments), options(facts, arguments), progress, stack, watch=watch
    )
    if arguments.solve_lens is not None:
        sigmas = _pose_sigmas(arguments)
        made = georeference.with_own_lens(made, control=arguments.gcp, sigmas=sigmas, progress=progress)
    if rasters:
        try:
            return _refined(made, rasters[0], arguments, progress)
        except BaseMapError as error:
            missing.append(f"not refined against a base map: {error}")
    if "neighbours" in arguments.refine or arguments.gcp is not None:
        return _refined(made, None, arguments, progress)
    return made


def _refined(made: Survey, base: Path | None, arguments: argparse.Namespace, progress: Progress) -> Survey:
    return georeference.refined(
        made,
        base=base,
        neighbours="neighbours" in arguments.refine,
        control=arguments.gcp,
        search_m=arguments.search,
        sigmas=_pose_sigmas(arguments),
        progress=progress,
    )


def _pose_sigmas(arguments: argparse.Namespace) -> tuple[float, float] | None:
    given = arguments.pose_sigma
    return None if given is None else (given[0], math.radians(given[1]))


def _camera(flight: Path, arguments: argparse.Namespace) -> str:
    """The name of the camera's profile."""
    if arguments.camera is not None:
        return str(arguments.camera)
    _, tags = photographs.recorded(flight)
    return next(iter(tags.values())).camera


def _draw(made: Survey, output: Path, arguments: argparse.Namespace) -> list[Path]:
    files: list[Path] = []
    gain = map_files.gain_of(made)
    if "kmz" in arguments.kinds:
        files.append(map_files.mosaic_kmz(made, output / "mosaic.kmz", gain))
    if "cog" in arguments.kinds:
        files.append(map_files.mosaic_cog(made, output / "mosaic.tif", gain))
    if arguments.each:
        for one in made.photographs:
            beside = output / "frames" / one.name
            if "kmz" in arguments.kinds:
                files.append(map_files.frame_kmz(made, one, beside.with_suffix(".kmz"), gain, quad=arguments.quad))
            if "cog" in arguments.kinds:
                files.append(map_files.frame_cog(made, one, beside.with_suffix(".tif"), gain))
    if "footprints" in arguments.kinds:
        files.append(map_files.write_footprints(made, output))
    return files


def recipe(flight: Path, facts: Mapping[str, Any], arguments: argparse.Namespace) -> Recipe:
    """The recipe of the flight, changed as the arguments say."""
    given = {name: getattr(arguments, name) for name in ("camera", "mask", "calibration")}
    made = recipes.of_flight(flight, facts, given)
    if made is None:
        raise DappledError(f"{flight} names no mask: give --camera and --mask")
    return replace(made, workers=2, colour=not arguments.grey)


def options(facts: Mapping[str, Any], arguments: argparse.Namespace) -> Options:
    """The arguments of `add_placing`, with the flight's own mounting where they don't give one."""
    mounting = Mounting.of(facts)
    if arguments.lever_arm is not None:
        mounting = replace(mounting, lever_m=tuple(arguments.lever_arm))
    if arguments.mount is not None:
        mounting = replace(mounting, mount=tuple(arguments.mount))
    ellipsoidal = arguments.terrain_heights == "ellipsoid"
    return Options(
        mounting=mounting,
        ground_m=arguments.ground,
        terrain=arguments.terrain,
        terrain_geoid=earth.geoid(arguments.geoid) if ellipsoidal else None,
        crs=arguments.crs,
        gsd_m=arguments.gsd,
        view=arguments.view,
        focus_m=arguments.focus,
        focal_length_mm=arguments.focal_length,
        f_number=arguments.f_number,
        frames=None if arguments.frames is None else numbers(arguments.frames),
    )


def numbers(text: str) -> frozenset[int]:
    """Frames named as "0,3-5". Raises DappledError."""
    found: set[int] = set()
    for word in text.split(","):
        first, dash, last = word.partition("-")
        try:
            found.update(range(int(first), int(last if dash else first) + 1))
        except ValueError:
            raise DappledError(f"--frames {text}: write numbers as 0,3-5") from None
    return frozenset(found)


class Bar:
    """A progress bar on a terminal's stderr, one for each stretch of work."""

    def __init__(self) -> None:
        self._bar: tqdm[Any] | None = None
        self._what = ""

    def __enter__(self) -> Progress:
        return self.show

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, what: str, done: int, total: int) -> None:
        """So much of it is done."""
        if self._bar is None or what != self._what:
            self.__exit__()
            self._bar = tqdm(
                total=total, desc=what, unit="frame", disable=not sys.stderr.isatty(), leave=False, file=sys.__stderr__
            )
            self._what = what
        self._bar.update(done - self._bar.n)
