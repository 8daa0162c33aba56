"""`dappled mask design`: design a mask, its distance and its film for an altitude."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli.mask.arguments import FILM_NAMES, AltitudeArguments, InstallationArguments, out_of_reach
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, option
from dappled.errors import CallError
from dappled.findings import told

if not words_only:
    import numpy as np

    from dappled.config import profiles
    from dappled.decode import DecodeError
    from dappled.decode.optics import MaskedOptics, carrier_tables
    from dappled.decode.optics.film import FILMS
    from dappled.decode.optics.mask_design import DESIGNS, Design, DesignRequirements, buildable
    from dappled.decode.spectrum import pictures
    from dappled.products.exports import prints


@dataclass(frozen=True, kw_only=True)
class DesignMask(Overwriting, AltitudeArguments, InstallationArguments, Verb):
    """Design mask, distance and film."""

    examples = (
        "dappled mask design --altitude 40 --camera fujifilm-s5200 --focal-length 13 --f-number 3.5 --film 16k",
    )

    f_number: float = option("--f-number", "f-number of the lens", 5.6, above=0.0)
    views: int = option("--views", "views per axis, odd", 5, low=1)
    film: str = option("--film", "film to print it on", "4k", choices=FILM_NAMES)
    mask_distance: float | None = option(
        "--mask-distance", "distance from mask to sensor", None, unit="mm",
        otherwise="free; with --mask the camera's",
    )  # fmt: skip
    room: float | None = option(
        "--room", "largest distance of the mask from the sensor", None, unit="mm", otherwise="10",
    )  # fmt: skip
    wavelength: float = option("--wavelength", "wavelength of the light", 550.0, unit="nm")
    shift_error: float = option("--shift-error", "σ of a measured shift between views", 0.02, unit="px")
    mask: str | None = option("--mask", "print the best focal length of this installed mask instead", None)
    picture: Path | None = option("--picture", "draw the carriers on the spectrum", None, metavar="FILE.png")

    def check(self) -> None:
        self.refuse_existing(self.picture)
        profiles.camera(self.camera)
        if self.mask is None:
            try:
                self._wanted()
            except DecodeError as error:
                raise CallError(str(error)) from None

    def _wanted(self) -> DesignRequirements:
        camera, sensor, length = self.camera_set()
        return DesignRequirements(
            sensor=sensor,
            focal_length_mm=length,
            f_number=self.f_number,
            altitude_m=self.altitude,
            film=FILMS[self.film],
            views=self.views,
            wavelength_nm=self.wavelength,
            shift_sigma_px=self.shift_error,
            mask_distance_mm=self.mask_distance,
            largest_distance_mm=min(10.0, length) if self.room is None else self.room,
            least_distance_mm=camera.least_mask_distance_mm or 0.0,
            f_numbers=camera.f_numbers,
        )

    def run(self, output: Output) -> Report:
        if self.mask:
            return self._best(self.mask)
        law, wanted = self.law or profiles.camera(self.camera).law, self._wanted()
        made = DESIGNS[law](wanted)
        instead = None if made.works else buildable(wanted, law)
        if self.picture:
            prints.save(self.picture, _picture(made))
        values = {**_as_json(made), "buildable": None if instead is None else _as_json(instead)}
        return Report(values, _lines(made, instead), failed=not made.works)

    def _best(self, mask: str) -> Report:
        camera, one = self.installed(mask)
        best = carrier_tables.best_focal_length(one)
        lines = [f"law {one.law}: no focal length brings the outer slices of {mask} to the edge of the spectrum"]
        if best.slices_mm is not None and best.carriers_mm is not None:
            alone = f"(carriers alone at {best.carriers_mm:.1f} mm)"
            at = f"{mask} at {one.distance_mm:g} mm fills the spectrum at {best.slices_mm:.1f} mm"
            lines = [f"law {one.law}: {at} {alone}"]
        ideal = one.mask.frequency_per_mm * one.distance_mm
        lines.append(f"by geometry its views are separated at f/{ideal:.3g}, whatever the lens")
        warning = out_of_reach(camera, ideal)
        lines += [] if warning is None else [f"warning: {warning}"]
        return Report({"law": one.law, "mask_distance_mm": one.distance_mm, **codec.plain(best)}, lines)


def _picture(made: Design) -> Any:
    height, width = made.wanted.sensor.shape
    shrink = max(1, max(height, width) // 1200)
    optics = MaskedOptics(made.wanted.sensor, made.mask, made.law, made.mask_distance_mm)
    lattice = carrier_tables.lattice_of(optics, made.wanted.focal_length_mm)
    carriers = [c for c in lattice.carriers(made.mask.half_orders()) if c.on_sensor]
    size = abs(lattice.ky[0]), abs(lattice.kx[1])
    return pictures.spectrum_boxes(np.zeros((height // shrink, width // shrink), np.float32), carriers, size)


def _as_json(made: Design) -> dict[str, Any]:
    report = codec.plain(made)
    wanted = report.pop("wanted")
    return {
        "works": made.works,
        **report,
        "film": wanted["film"]["name"],
        "views": wanted["views"],
        "altitude_m": wanted["altitude_m"],
        "aperture_mm": made.wanted.aperture_mm,
    }


def _lines(made: Design, instead: Design | None) -> list[str]:
    wanted = made.wanted
    rows, columns = made.view_shape
    lines = [
        f"law {made.law}: {wanted.views} × {wanted.views} views of {columns} × {rows} px from {wanted.altitude_m:g} m",
        (
            f"mask       {made.mask.frequency_per_mm:.3f} periods/mm, p = {made.mask.p}, {made.mask.pattern}; "
            f"{made.film_period_px:.2f} px a period on film {wanted.film.name}"
        ),
        f"distance   {made.mask_distance_mm:.3f} mm before the sensor",
        f"aperture   {wanted.aperture_mm:.2f} mm (f/{wanted.f_number:g}), {made.baseline_mm:.2f} mm from view to view",
        f"a view     ±{made.bandwidth_per_mm:.2f} cycles/mm, {made.ground_sample_m * 100:.1f} cm of ground per pixel",
        f"picture    {made.picture_sample_m * 100:.2g} cm of ground per pixel (dappled picture)",
        f"spectrum   {100 * made.spectrum_used:.{0 if made.spectrum_used >= 0.01 else 2}f} % used",
        (
            f"depth      ±{made.depth_sigma_m:.2g} m at {wanted.altitude_m:g} m, "
            f"shifts known to {wanted.shift_sigma_px:g} px per view"
        ),
        *(f"{'ok  ' if c.met else 'FAIL'}       {c.sentence}" for c in made.conditions),
    ]
    lines.append(f"film       {', '.join(made.films) or 'none of Table 2'} can print it")
    lines += [f"warning    {warning}" for warning in made.warnings]
    if made.problem:
        lines.append(str(told(made.problem)))
        lines.append(_instead(instead))
    elif made.depth_sigma_m > wanted.altitude_m / 2:
        lines.append(
            "this depth error is too large to measure depth: fly lower, or use a longer lens with a wider aperture"
        )
    return lines


def _instead(made: Design | None) -> str:
    if made is None:
        return "nothing can be built here with any stop of this lens or fewer views"
    (rows, columns), n, stop = made.view_shape, made.wanted.views, made.wanted.f_number
    return (
        f"buildable: {n} × {n} views of {columns} × {rows} px at f/{stop:g}, a mask of "
        f"{made.mask.frequency_per_mm:.3g} periods/mm {made.mask_distance_mm:.3g} mm before the sensor, depth "
        f"±{made.depth_sigma_m:.2g} m at {made.wanted.altitude_m:g} m (--views {n} --f-number {stop:g})"
    )
