"""Survey a recorded flight: decode its frames, place them on a map, and refine their poses where asked for."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from dappled.decode.lightfield import LightField
from dappled.drivers.raw import reading, recipe_check
from dappled.drivers.raw.picture_maker import LensFrame, ToldShadow, beside
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Finding, Subject, text
from dappled.flight import FlightFolder
from dappled.flight.flight_mask import doubts_over
from dappled.products import processes
from dappled.products.maps import map_grid, photographs, references, refine, self_calibration
from dappled.products.maps.earth import Geoid, Projection, utm
from dappled.products.maps.eye import EyeError
from dappled.products.maps.ground import Flat, Ground, Raster, level_shown
from dappled.products.maps.ground import check as check_ground
from dappled.products.maps.ground import load as load_ground
from dappled.products.maps.laboratory import MEAN, Laboratory, ShadowAsked, exposures, laboratory, shadows
from dappled.products.maps.map_grid import MapError
from dappled.products.maps.photographs import Photograph, Station
from dappled.products.maps.references import BaseMap
from dappled.products.maps.refine import RefinedBy
from dappled.products.maps.self_calibration import FlightLens
from dappled.products.mounting import Mounting

_SWEPT_PX = 60_000  # of a picture: heights come from windows of many pixels
_CHOSEN = 1.5  # of the pictures' own ground sample: a map that is coarser was chosen to be

Progress = Callable[[str, int, int], None]  # what, done, of
Watch = Callable[[Photograph, LightField], None]  # gets each decoded frame while its light field is in memory


@dataclass(frozen=True, slots=True)
class Options:
    """How a flight is mapped; None takes the flight's own value.

    `ground_m` is the ground's height above sea level (default: home's); `terrain` a raster file, with ellipsoidal
    heights where `terrain_geoid` is given. `gsd_m` defaults to the finest of the frames'. `view` is "mean" (the picture
    at the sensor's own resolution), "ground" (all views, refocused on the ground) or "v,u". `focus_m` is the distance
    at which the lens was focused. `frames` holds the frames' numbers. `as_flown`: camera, mask, calibration
    and focal length are those of decoding in flight, so that what this told of the mask counts where no light field is
    made. `workers`: how many processes make the frames.
    """

    mounting: Mounting = field(default_factory=Mounting)
    ground_m: float | None = None
    terrain: Path | None = None
    terrain_geoid: Geoid | None = None
    crs: str | None = None
    gsd_m: float | None = None
    view: str = MEAN
    focus_m: float = float("inf")
    focal_length_mm: float | None = None
    f_number: float | None = None
    frames: frozenset[int] | None = None
    as_flown: bool = False
    workers: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A flight's photographs on one map. `left` says why other frames are not among them, `notes` what else could not
    be done; `lens` is the one that the flight told, where it was asked."""

    flight: str
    photographs: tuple[Photograph, ...]
    projection: Projection
    ground: Ground
    gsd_m: float
    focus_m: float
    left: tuple[Finding, ...]
    notes: tuple[Finding, ...] = ()
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    lens: FlightLens | None = None

    @property
    def doubts(self) -> list[Finding]:
        """What is in doubt about the photographs, the mask that their light fields or the flight show, and what their
        lens was not told."""
        of_lens = self.lens.doubts if self.lens else ()
        return [*doubts_over((one.name, one.mask_nats, one.doubts) for one in self.photographs), *of_lens]

    def coarse(self) -> Survey:
        """The survey in pictures that heights are searched in: as fine as its own map where that was chosen coarser
        than the pictures, else of `_SWEPT_PX`: what a search takes grows with the cube of their fineness."""
        finest = min(one.eye.gsd_m(level_shown(self.ground, one.eye)) for one in self.photographs)
        chosen = self.gsd_m / finest
        largest = max(math.prod(one.eye.shape) for one in self.photographs)
        step = round(math.sqrt(largest / _SWEPT_PX))
        step = min(step, int(chosen)) if chosen > _CHOSEN else step
        if step < 2:
            return self
        gsd_m = self.gsd_m if chosen > _CHOSEN else _two_digits(step * self.gsd_m)
        return replace(self, photographs=tuple(one.reduced(step) for one in self.photographs), gsd_m=gsd_m)

    def tags(self) -> dict[str, str]:
        """The metadata of map files."""
        return {
            "DAPPLED_FLIGHT": self.flight,
            "DAPPLED_GROUND": self.ground.name,
            "DAPPLED_HEIGHTS": "metres above mean sea level, as the autopilot's",
            "DAPPLED_FRAMES": ",".join(one.name for one in self.photographs),
        }


def survey(
    flight: Path,
    recipe: Recipe,
    options: Options,
    progress: Progress,
    stack: ExitStack,
    *,
    watch: Watch | None = None,
    foresee: Callable[[Survey], None] = lambda _: None,
) -> Survey:
    """Decode and place a flight's frames. Those that can't be decoded or placed are left out and named; `stack` owns
    the pictures' scratch folder; `watch` gets each frame, in this process; without one the frames are made in
    `options.workers`. `foresee` gets the survey without pictures before the first
    one is made, where poses and optics tell it, and raises what needs no picture to be known. Raises DappledError where
    no frame is left, or the options are wrong."""
    stations, left = photographs.stations(flight, options.mounting)
    lens = {"focal_length_mm": options.focal_length_mm, "f_number": options.f_number}
    files = exposures(flight, [(one.frame, one.tag) for one in stations], **lens)
    if options.frames is not None:
        stations = [one for one in stations if one.frame.index in options.frames]
        left = [one for one in left if int(Path(str(one.subject.which)).stem) in options.frames]
    if not stations:
        raise DappledError(f"no frame of {flight} can be put on a map: {text(left[0]) if left else 'it has none'}")
    first = stations[0].camera
    projection = Projection(options.crs or utm(first.latitude_deg, first.longitude_deg))
    projection.at(first.latitude_deg, first.longitude_deg)
    level = level_of(stations, options)
    scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dappled-maps-")))
    decoders = Laboratory(recipe)
    recipe_check.check(recipe)
    if options.terrain is not None:
        check_ground(options.terrain)
    if (planned := _foreseen(flight, decoders, stations, projection, options)) is not None:
        foresee(planned)
    workers = 1 if watch is not None else processes.worth(options.workers, len(stations))
    recipe = recipe.shared_by(workers)
    flown = photographs.flown_nats(flight) if options.as_flown else {}
    taken: list[Photograph] = []
    with processes.Crew(workers) as crew:
        told = _told(recipe, stations, files, crew, progress) if options.view == MEAN else {}
        develop = _Developing(flight, recipe, options, projection.name, scratch, watch, told, flown)
        with closing(crew.in_order(stations, partial(processes.tried, develop), _lost)) as made:
            for number, station in enumerate(stations):
                progress("develop", number, len(stations))
                one = next(made)
                if isinstance(one, DappledError):
                    left.append(photographs.unplaced(station.frame.name, one))
                else:
                    taken.append(_from_shelf(one, scratch))
    progress("develop", len(stations), len(stations))
    return on_ground(flight.name, taken, left, projection=projection, level_m=level, options=options)


def _told(
    recipe: Recipe,
    stations: Sequence[Station],
    files: Mapping[int, LensFrame],
    crew: processes.Crew,
    progress: Progress,
) -> dict[int, tuple[ToldShadow, ...]]:
    """What frames beside each one tell of its mask's shadow, by image index."""
    near = beside(list(files.values()))
    asked = {
        index: tuple(ShadowAsked(recipe, other) for other in near[files[index]])
        for index in (one.frame.index for one in stations)
        if index in files
    }
    every = (one for few in asked.values() for one in few)
    found = shadows(every, crew.in_order, lambda done, of: progress("measure the mask's shadow", done, of))
    return {index: tuple(found[one] for one in few if one in found) for index, few in asked.items()}


@dataclass(frozen=True)
class _Developing:
    """Makes one photograph after the other, in any process; their pictures lie in files of `scratch`."""

    flight: Path
    recipe: Recipe
    options: Options
    projection_name: str
    scratch: Path
    watch: Watch | None
    told: Mapping[int, tuple[ToldShadow, ...]]
    flown: Mapping[int, float]

    @cached_property
    def projection(self) -> Projection:
        """The map's."""
        return Projection(self.projection_name)

    def __call__(self, station: Station) -> Photograph:
        """A photograph without its picture, which lies on the shelf. Raises DappledError."""
        options = self.options
        frame = laboratory(self.recipe).frame(
            self.flight, station.frame, station.tag,
            focal_length_mm=options.focal_length_mm, f_number=options.f_number,
            told=self.told.get(station.frame.index, ()), flown_nats=self.flown.get(station.frame.index),
        )  # fmt: skip
        one = frame.photograph(station, self.projection, view=options.view, focus_m=options.focus_m)
        if self.watch is not None:
            self.watch(one, frame.decoded.light_field)
        one = replace(one, doubts=frame.doubts, mask_nats=frame.mask_nats)
        return _shelved(one, self.scratch)


def _lost(station: Station, why: str) -> DappledError:
    return DappledError(f"{station.frame.name} {why}")


def _foreseen(
    flight: Path,
    decoders: Laboratory,
    stations: Sequence[Station],
    projection: Projection,
    options: Options,
) -> Survey | None:
    """The survey of all that poses and optics tell; None where they don't."""
    try:
        read = reading.read_metadata(FlightFolder(flight).file(stations[0].frame.name))
        profile = decoders.darkroom.camera(read.model or "")
        length = options.focal_length_mm
        photos = [
            photographs.foreseen(
                one, profile, projection, length or one.tag.focal_length_mm or read.focal_length_mm, options.focus_m
            )
            for one in stations
        ]
        level = level_of(stations, options)
        return on_ground(flight.name, photos, [], projection=projection, level_m=level, options=options)
    except DappledError:
        return None


def on_ground(
    flight: str,
    taken: Sequence[Photograph],
    left: Sequence[Finding],
    *,
    projection: Projection,
    level_m: float,
    options: Options,
) -> Survey:
    """The survey of placed photographs; those that miss the ground or look above the horizon are left out and named.

    `level_m` is the height of flat ground, which also says where terrain is needed. Raises DappledError where none is
    left, or the terrain can't be used.
    """
    kept, out = [], list(left)

    def sieve(photos: Sequence[Photograph], ground: Ground) -> list[Photograph]:
        held = []
        for one in photos:
            try:
                one.eye.check_horizon(f"frame {one.name}")
                map_grid.footprint(one.eye, ground)
                held.append(one)
            except EyeError as error:
                out.append(photographs.unplaced(one.name, error))
            except MapError as error:
                out.append(photographs.unplaced(one.name, f"frame {one.name}: {error}"))
        return held

    ground: Ground = Flat(level_m)
    kept = sieve(taken, ground)
    if kept and options.terrain is not None:
        ground = _terrain(options.terrain, kept, projection, level_m, options.terrain_geoid)
        kept = sieve(kept, ground)
    if not kept:
        raise DappledError(f"no frame of {flight} can be put on a map: {text(out[-1]) if out else 'it has none'}")
    gsd_m = options.gsd_m or _two_digits(min(one.eye.gsd_m(level_shown(ground, one.eye)) for one in kept))
    return Survey(flight, tuple(kept), projection, ground, gsd_m, options.focus_m, tuple(out))


def refined(
    made: Survey,
    *,
    base: Path | None = None,
    neighbours: bool = False,
    control: Path | None = None,
    search_m: float = 5.0,
    sigmas: tuple[float, float] | None = None,
    progress: Progress = lambda *_: None,
) -> Survey:
    """The survey with refined poses; the result for each frame is in its facts. Raises DappledError where the base map
    or the control points can't be used."""
    raster = None if base is None else BaseMap(base, made.projection, made.gsd_m)
    if raster is not None:
        raster.check(np.concatenate([map_grid.footprint(one.eye, made.ground)[:, :2] for one in made.photographs]))
    points, unseen = references.control_of(control, made.projection, made.photographs)
    by = RefinedBy(raster, neighbours, points, search_m, sigmas)
    photos, judged = refine.refine(made.photographs, made.ground, by, progress)
    facts = {
        one.name: {**made.facts.get(one.name, {}), **said.facts()} for one, said in zip(photos, judged, strict=True)
    }
    kept = [
        replace(said.why, subject=Subject("frame", one.name))
        for one, said in zip(photos, judged, strict=True)
        if said.why is not None
    ]
    return replace(made, photographs=tuple(photos), facts=facts, notes=(*made.notes, *unseen, *kept))


def with_own_lens(
    made: Survey,
    *,
    control: Path | None = None,
    sigmas: tuple[float, float] | None = None,
    progress: Progress = lambda *_: None,
) -> Survey:
    """The survey with the lens that its own frames tell, and the poses that go with it. Raises DappledError where they
    don't tell it, or the control points can't be used."""
    points, unseen = references.control_of(control, made.projection, made.photographs)
    found = self_calibration.find(made.photographs, made.ground, control=points, sigmas=sigmas, progress=progress)
    photos = self_calibration.with_lens(made.photographs, found)
    return replace(made, photographs=tuple(photos), notes=(*made.notes, *unseen), lens=found)


def _shelved(one: Photograph, scratch: Path) -> Photograph:
    """The photograph with its pictures in files instead: a flight's frames need not fit into memory."""
    nothing = np.empty((0, 0), np.float32)
    np.save(scratch / f"{one.name}.npy", one.image)
    if one.views is not None:
        np.save(scratch / f"{one.name}-views.npy", one.views)
    return replace(one, image=nothing, views=None if one.views is None else nothing)


def _from_shelf(one: Photograph, scratch: Path) -> Photograph:
    """The photograph with its pictures mapped from their files."""
    image = np.load(scratch / f"{one.name}.npy", mmap_mode="r")
    views = None if one.views is None else np.load(scratch / f"{one.name}-views.npy", mmap_mode="r")
    return replace(one, image=image, views=views)


def level_of(stations: Sequence[Station], options: Options) -> float:
    """The height of flat ground above sea level. Raises DappledError where it isn't known."""
    if options.ground_m is not None:
        return options.ground_m
    home = photographs.home_m(stations)
    if home is None and options.terrain is None:
        raise DappledError("the flight has no height above ground: give the ground's height with --ground or --terrain")
    return min(one.camera.altitude_msl_m for one in stations) - 1.0 if home is None else home


def _terrain(
    path: Path, taken: Sequence[Photograph], projection: Projection, level_m: float, geoid: Geoid | None
) -> Raster:
    met = np.concatenate([map_grid.footprint(one.eye, Flat(level_m))[:, :2] for one in taken])
    centres = np.array([one.eye.centre[:2] for one in taken])
    low, high = np.concatenate([met, centres]).min(axis=0), np.concatenate([met, centres]).max(axis=0)
    margin = 0.25 * float(np.max(high - low)) + 5.0  # rays meet hills elsewhere than flat ground
    bounds = (low[0] - margin, low[1] - margin, high[0] + margin, high[1] + margin)
    return load_ground(path, projection, bounds, geoid=geoid)


def _two_digits(value: float) -> float:
    """A length rounded to two digits, so that the map's step is easy to read."""
    return float(f"{value:.1e}")
