"""Arguments that say how a flight's frames are decoded, placed on a map and refined; and doing that."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled.cli import paths
from dappled.cli.field_arguments import FIELD_HELP, RangingArguments
from dappled.cli.frame_arguments import Several
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, argument, flag, of_setting, option
from dappled.config.settings import PoseSettings
from dappled.decode.geometry import Vector3
from dappled.errors import CallError, DappledError
from dappled.findings import Code, Finding, Subject, finding, text

if not words_only:
    from dappled.config import profiles
    from dappled.daemon.pipeline import recipes
    from dappled.decode.geometry import camera_pose
    from dappled.drivers.raw.recipe import Recipe
    from dappled.flight import layout
    from dappled.products.maps import earth, georeference, references, self_calibration
    from dappled.products.maps.earth import EarthError
    from dappled.products.maps.georeference import Options, Survey, Watch
    from dappled.products.maps.references import BaseMapError
    from dappled.products.mounting import Mounting

Matrix9 = tuple[float, float, float, float, float, float, float, float, float]


def numbers(text: str) -> frozenset[int]:
    """Frames named as "0,3-5". Raises ValueError."""
    found: set[int] = set()
    for word in text.split(","):
        first, dash, last = word.partition("-")
        try:
            found.update(range(int(first), int(last if dash else first) + 1))
        except ValueError:
            raise ValueError(f"{text!r}: write numbers as 0,3-5") from None
    return frozenset(found)


def check_geoid(given: str | None) -> None:
    """Refuse a grid that isn't there. Raises CallError."""
    if given is not None:
        try:
            earth.geoid(given)
        except EarthError as error:
            raise CallError(f"--geoid: {error}") from None


@dataclass(frozen=True, kw_only=True)
class Mounted:
    """Where the camera sits, where it isn't as the flight has it."""

    lever_arm: Vector3 | None = option(
        "--lever-arm", of_setting(PoseSettings, "lever_arm_m"), None, metavar=("F", "R", "D"), group="camera",
        otherwise="the flight's",
    )  # fmt: skip
    mount: Matrix9 | None = option(
        "--mount", of_setting(PoseSettings, "mount"), None, metavar="R", group="camera", otherwise="the flight's",
    )  # fmt: skip

    def check_mounted(self) -> None:
        """Refuse a mount that is no rotation. Raises CallError."""
        if self.mount is not None:
            try:
                camera_pose.mount(self.mount)
            except DappledError as error:
                raise CallError(f"--mount: {error}") from None

    def mounting(self, facts: Mapping[str, Any]) -> Mounting:
        """The flight's mounting, with the values that the arguments replace."""
        made = Mounting.of(facts)
        if self.lever_arm is not None:
            made = replace(made, lever_m=self.lever_arm)
        return made if self.mount is None else replace(made, mount=self.mount)


@dataclass(frozen=True, kw_only=True)
class Placing(Mounted):
    """How frames are decoded and placed."""

    ground: float | None = option(
        "--ground", "height of flat ground above sea level", None, unit="m", group="ground",
        otherwise="home's",
    )  # fmt: skip
    terrain: Path | None = option("--terrain", "terrain raster: DTED, GeoTIFF …", None, group="ground", there=True)
    terrain_heights: str = option(
        "--terrain-heights", "what the raster's heights are measured from", "sea-level",
        choices=("sea-level", "ellipsoid"), group="ground",
    )  # fmt: skip
    geoid: str | None = option(
        "--geoid", "geoid grid (.gtx, .tif), or metres of sea level above the ellipsoid", None, metavar="FILE|M",
        group="ground", otherwise="PROJ's EGM grid, if installed",
    )  # fmt: skip
    camera: str | None = option("--camera", "camera profile", None, group="camera", otherwise="the flight's")
    mask: str | None = option("--mask", "mask profile", None, group="camera", otherwise="the flight's")
    calibration: str | None = option(
        "--calibration", "mask calibration", None, metavar="FILE", group="camera", there=True, otherwise="the flight's",
    )  # fmt: skip
    focal_length: float | None = option(
        "--focal-length", "focal length, if the frames don't say", None, unit="mm", above=0.0, group="camera",
    )  # fmt: skip
    f_number: float | None = option("--f-number", "f-number, if the frames don't say", None, above=0.0, group="camera")
    view: str = option(
        "--view", "mean (the picture with every pixel of the sensor), ground (all views, refocused on it), or the "
        "row,column of one view", "mean", metavar="VIEW",
        group="camera",
    )  # fmt: skip
    grey: bool = flag("--grey", "make grey maps (default: in colour if the frames have colour)", group="camera")
    focus: float = option(
        "--focus", "distance at which the lens was focused", math.inf, unit="m", above=0.0, infinite=True,
        group="camera", otherwise="infinity",
    )  # fmt: skip
    crs: str | None = option(
        "--crs", "projection in metres", None, metavar="EPSG:N", group="map", otherwise="the UTM zone",
    )  # fmt: skip
    gsd: float | None = option(
        "--gsd", "side of a map cell", None, unit="m", above=0.0, group="map",
        otherwise="the ground sample distance of the frames",
    )  # fmt: skip
    frames: frozenset[int] | None = option(
        "--frames", "use only these frames", None, metavar="N,A-B", parse=numbers, group="map",
    )  # fmt: skip

    def check_profiles(self) -> None:
        """Refuse profiles that there are not, and what can't be a mount or a geoid. Raises ConfigError, CallError."""
        self.check_mounted()
        check_geoid(self.geoid)
        if self.camera:
            profiles.camera(self.camera)
        if self.mask and self.mask != profiles.LENSLET:
            profiles.mask(self.mask)

    def recipe(self, flight: Path, facts: Mapping[str, Any]) -> Recipe:
        """The recipe of the flight, changed as the arguments say."""
        given = {"camera": self.camera, "mask": self.mask, "calibration": self.calibration}
        made = recipes.of_flight(flight, facts, given)
        if made is None:
            raise DappledError(f"{flight} names no mask: give --camera and --mask")
        return replace(made, workers=2, colour=not self.grey)

    def options(self, facts: Mapping[str, Any]) -> Options:
        """How the flight is mapped, with its own mounting where the arguments don't give one."""
        return Options(
            mounting=self.mounting(facts),
            ground_m=self.ground,
            terrain=self.terrain,
            terrain_geoid=earth.geoid(self.geoid) if self.terrain_heights == "ellipsoid" else None,
            crs=self.crs,
            gsd_m=self.gsd,
            view=self.view,
            focus_m=self.focus,
            focal_length_mm=self.focal_length,
            f_number=self.f_number,
            frames=self.frames,
            as_flown=not (self.camera or self.mask or self.calibration or self.focal_length),
        )


@dataclass(frozen=True, kw_only=True)
class Refining(Several, Placing):
    """How frames are placed, and their poses refined."""

    refine: tuple[str, ...] = option(
        "--refine", "neighbours (frames against each other), a base map (GeoTIFF …), or both", (), metavar="WITH",
        group="refinement",
    )  # fmt: skip
    gcp: Path | None = option(
        "--gcp", "control points: name, frame, column, row, latitude, longitude, altitude", None, metavar="CSV",
        group="refinement", there=True,
    )  # fmt: skip
    solve_lens: Path | None = option(
        "--solve-lens", "find the lens from the frames' own overlap, telemetry and --gcp, and write a copy of the "
        "camera's profile with it", None, metavar="FILE.toml", group="refinement",
    )  # fmt: skip
    search: float = option("--search", "search radius on the base map", 5.0, unit="m", above=0.0, group="refinement")
    pose_sigma: tuple[float, float] | None = option(
        "--pose-sigma", "σ of the poses", None, metavar=("M", "DEG"), above=0.0, group="refinement",
        otherwise="as recorded",
    )  # fmt: skip

    @property
    def _base_maps(self) -> list[Path]:
        return [Path(word) for word in self.refine if word != "neighbours"]

    def check_refinement(self) -> None:
        """Refuse what can't be refined with. Raises CallError and ConfigError."""
        self.check_profiles()
        if len(self._base_maps) > 1:
            raise CallError(f"--refine takes one base map, not {len(self._base_maps)}")

    def survey(
        self,
        flight: Path,
        output: Output,
        stack: ExitStack,
        missing: list[Finding],
        *,
        watch: Watch | None = None,
        foresee: Callable[[Survey], None] = lambda _: None,
    ) -> Survey:
        """Decode, place and refine a flight; `watch` gets each decoded frame, `foresee` the survey that poses alone
        tell. Adds what could not be done to `missing`. Raises DappledError."""
        facts = layout.read_facts(layout.open_folder(flight))

        def foreseen(planned: Survey) -> None:
            if self.gcp is not None:
                references.read_control_points(self.gcp, planned.projection)
            if self.solve_lens is not None:
                self_calibration.check(planned.photographs, planned.ground)
            foresee(planned)

        recipe, options = self.recipe(flight, facts), replace(self.options(facts), workers=self.workers)
        made = georeference.survey(flight, recipe, options, output.show, stack, watch=watch, foresee=foreseen)
        if self.solve_lens is not None:
            made = georeference.with_own_lens(made, control=self.gcp, sigmas=self._sigmas, progress=output.show)
        for base in self._base_maps:
            try:
                return self._refined(made, base, output)
            except BaseMapError as error:
                missing.append(finding(Code.MAP_UNREFINED, Subject("map"), why=error))
        if "neighbours" in self.refine or self.gcp is not None:
            return self._refined(made, None, output)
        return made

    def placed(
        self,
        flight: Path,
        output: Output,
        stack: ExitStack,
        *,
        watch: Watch | None = None,
        foresee: Callable[[Survey], None] = lambda _: None,
    ) -> Survey:
        """A flight's frames on the map, for verbs that make no map. Raises DappledError."""
        made = self.survey(flight, output, stack, [], watch=watch, foresee=foresee)
        for one in made.left:
            output.remark(str(text(one)))
        return made

    def _refined(self, made: Survey, base: Path | None, output: Output) -> Survey:
        return georeference.refined(
            made,
            base=base,
            neighbours="neighbours" in self.refine,
            control=self.gcp,
            search_m=self.search,
            sigmas=self._sigmas,
            progress=output.show,
        )

    @property
    def _sigmas(self) -> tuple[float, float] | None:
        return None if self.pose_sigma is None else (self.pose_sigma[0], math.radians(self.pose_sigma[1]))


_OF_FLIGHT = "of a flight (--flight without LIGHTFIELD)"


@dataclass(frozen=True, kw_only=True)
class FieldOrFlight(RangingArguments, Doubtable):
    """A light field, or a flight and how its frames are decoded and placed."""

    field: Path | None = argument("LIGHTFIELD", FIELD_HELP, default=None, there=paths.light_field)
    flight: Path | None = option("--flight", "a flight", None, metavar="FLIGHT", there=paths.flight)
    terrain: Path | None = option("--terrain", "given terrain: DTED, GeoTIFF …", None, group=_OF_FLIGHT, there=True)
    ground: float | None = option(
        "--ground", "height of flat ground above sea level", None, unit="m", group=_OF_FLIGHT,
        otherwise="home's",
    )  # fmt: skip
    camera: str | None = option("--camera", "camera profile", None, group=_OF_FLIGHT, otherwise="the flight's")
    mask: str | None = option("--mask", "mask profile", None, group=_OF_FLIGHT, otherwise="the flight's")
    refine: bool = flag("--refine", "fit the frames' poses to each other first", group=_OF_FLIGHT)
    cell: float | None = option("--cell", "side of a cell of the map", None, unit="m", above=0.0, group=_OF_FLIGHT)
    crs: str = option("--crs", "projection in metres", "", metavar="EPSG:N", group=_OF_FLIGHT, otherwise="the UTM zone")

    def check_source(self, *more: str) -> None:
        """Refuse a call without light field and flight, and what only goes with a flight (`more`, too) beside a light
        field. Raises CallError."""
        if self.field is None and self.flight is None:
            raise CallError("name a decoded light field, or a flight with --flight")
        if self.field is None:
            self.placing().check_refinement()
        for name in () if self.field is None else ("terrain", "ground", "camera", "mask", "refine", "cell", *more):
            if getattr(self, name) not in (None, False, ()):
                raise CallError(f"--{name} goes with --flight FLIGHT and no light field: leave it or {self.field} out")

    def placing(self, frames: frozenset[int] | None = None) -> Refining:
        """How the frames of the flight are placed; `frames` are the only ones used."""
        return Refining(
            focus=math.inf if self.focus is None else self.focus,
            calibration=None if self.calibration is None else str(self.calibration),
            crs=self.crs or None,
            refine=("neighbours",) if self.refine else (),
            terrain=self.terrain,
            ground=self.ground,
            camera=self.camera,
            mask=self.mask,
            frames=frames,
        )
