"""Design a mask and its place for a sensor, a lens and an altitude, or say in a sentence why this is impossible.

Both laws are supported, each with its own rules (`DESIGNS`, by the law's name):
  - `geometric`: N = 2p + 1 views are separated at f_m = v / (d·A), A the aperture's diameter, so the ideal f-number
    of a mask is f_m·d, whatever the lens. Three conditions bound d from below: the slices stay under the sensor's
    Nyquist frequency, the film draws the highest harmonic with two pixels, and diffraction stays at
    λ·d·(p·f_m)² ≤ 0.25. The least d that meets them all gives the views the most pixels.
    Cover glass is a fourth: a view has about width·f-number/d pixels, so a mask that is 1 mm away wants a small stop.
  - `fd`: the outer slices reach the edge of the spectrum at f_m·d = side·f / (2p + 1) (Eq 30 with the law's 1 mm²),
    with the same conditions on film and diffraction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carrier_tables import beyond_mask, fresnel_number, lattice_of
from dappled.decode.optics.carriers import Lattice, Mask, MaskedOptics, Sensor
from dappled.decode.optics.film import FILMS, Film
from dappled.decode.optics.lenses import SHIFT_SIGMA_PX, depth_sigma_m, ground_sample_m, image_distance_mm, within
from dappled.findings import Code, Finding, Subject, finding

FRESNEL_LIMIT = 0.25  # of λ·d·(p·f_m)²: diffraction then leaves cos(π/4) = 0.71 of the contrast
LEAST_VIEW_PX, SMALL_VIEW_PX = 16, 64  # a side: below the first a view is no picture, below the second a poor one
_STOPS = (1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0, 32.0)  # whole stops, where a profile names none


@dataclass(frozen=True, slots=True)
class DesignRequirements:
    """What a mask is designed for.

    `shift_sigma_px` is how well a shift from view to view will be known, in pixels of a view (0.02 is a good matcher).
    `mask_distance_mm` is fixed where the camera leaves no choice, None where it may be chosen up to
    `largest_distance_mm`. `views` is N an axis, odd. `least_distance_mm` is how near a mask can be mounted, `f_numbers`
    the widest and the narrowest stop of the lens, None where unknown.
    """

    sensor: Sensor
    focal_length_mm: float
    f_number: float
    altitude_m: float
    film: Film
    views: int = 5
    wavelength_nm: float = 550.0
    shift_sigma_px: float = SHIFT_SIGMA_PX
    mask_distance_mm: float | None = None
    largest_distance_mm: float = 10.0
    least_distance_mm: float = 0.0
    f_numbers: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Raises DecodeError for nonsense in any value."""
        image_distance_mm(self.focal_length_mm, self.altitude_m)
        within("f-number", self.f_number, "", 0.5, 128)
        within("views", self.views, "", 3, 41, hint="an odd number of views an axis")
        if self.views % 2 == 0:
            raise DecodeError(f"views = {self.views} must be odd: a mask of p harmonics makes 2p + 1")
        within("wavelength", self.wavelength_nm, "nm", 200, 2000)
        within("error of a shift", self.shift_sigma_px, "px", 1e-6, 10)
        within("largest mask distance", self.largest_distance_mm, "mm", 1e-3, self.focal_length_mm)
        if self.mask_distance_mm is not None:
            within("mask distance", self.mask_distance_mm, "mm", 1e-3, 0.99 * self.focal_length_mm)

    @property
    def p(self) -> int:
        """Harmonics of the mask."""
        return (self.views - 1) // 2

    @property
    def aperture_mm(self) -> float:
        """Diameter of the aperture, F / N."""
        return self.focal_length_mm / self.f_number

    @property
    def image_mm(self) -> float:
        """v: lens to sensor, focused on the ground (Eq 3)."""
        return image_distance_mm(self.focal_length_mm, self.altitude_m)


@dataclass(frozen=True, slots=True)
class Condition:
    """One condition on the design: what it needs, what is there, and whether that is enough. `limit` is the most that
    the value may be, or the least."""

    name: str
    value: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether `value` keeps to `limit`."""
        if self.at_least:
            return self.value >= self.limit * (1 - 1e-9)
        return self.value <= self.limit * (1 + 1e-9)

    @property
    def sentence(self) -> str:
        """The condition in words."""
        bound = "least" if self.at_least else "most"
        return f"{self.name}: {self.value:.4g} of at {bound} {self.limit:.4g} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class Design:
    """A mask for the requirements `wanted`. `problem` says why it doesn't meet them; None if it does.

    `view_shape` (rows, columns) of one view, `bandwidth_per_mm` (±, on the sensor) of one view, `spectrum_used` the
    share of the frame's spectrum that slices cover, `baseline_mm` between neighbouring views on the aperture,
    `depth_sigma_m` at the altitude (Eq 5), `ground_sample_m` of a view, `picture_sample_m` of the picture,
    `films` the formats of Table 2 that can print it. `warnings` say what a working design is still bad at.
    """

    wanted: DesignRequirements
    law: str
    mask: Mask
    mask_distance_mm: float
    conditions: tuple[Condition, ...]
    view_shape: tuple[int, int]
    bandwidth_per_mm: float
    spectrum_used: float
    baseline_mm: float
    depth_sigma_m: float
    ground_sample_m: float
    picture_sample_m: float
    film_period_px: float
    films: tuple[str, ...]
    problem: Finding | None
    warnings: tuple[str, ...] = ()

    @property
    def works(self) -> bool:
        """Whether every condition is met."""
        return self.problem is None


def design_geometric(wanted: DesignRequirements) -> Design:
    """The mask at the least distance that meets every condition, or at the wanted's own distance."""
    v, aperture, p = wanted.image_mm, wanted.aperture_mm, wanted.p
    nyquist = min(1 / math.hypot(*wanted.sensor.row_mm), 1 / math.hypot(*wanted.sensor.column_mm)) / 2
    if wanted.mask_distance_mm is None:
        by_sensor = v / (1 + nyquist * aperture / (p + 0.5))  # (p + 1/2)·f_m·(1 − d/v) ≤ nyquist
        by_film = p * v / (aperture * wanted.film.nyquist_per_mm)
        by_light = wanted.wavelength_nm * 1e-6 / FRESNEL_LIMIT * (p * v / aperture) ** 2  # λ·d·(p·f_m)² ≤ 0.25
        distance_mm = max(by_sensor, by_film, by_light, wanted.least_distance_mm)
    else:
        distance_mm = wanted.mask_distance_mm
    if distance_mm > min(wanted.largest_distance_mm, 0.99 * v) and wanted.mask_distance_mm is None:
        distance_mm = min(wanted.largest_distance_mm, 0.99 * v)
    mask = Mask(v / (distance_mm * aperture), p)
    step = mask.frequency_per_mm * (1 - distance_mm / v)
    sensor = Condition("slices under the sensor's Nyquist frequency", (p + 0.5) * step, nyquist, "cycles/mm")
    return _finish(wanted, "geometric", mask, distance_mm, sensor)


def design_fd(wanted: DesignRequirements) -> Design:
    """The mask whose outer slices just reach the edge of the spectrum, as high in frequency as film and light allow."""
    p, (height_mm, width_mm) = wanted.p, wanted.sensor.size_mm
    product = min(height_mm, width_mm) * wanted.focal_length_mm / wanted.views  # f_m·d
    if wanted.mask_distance_mm is None:
        by_film = product * p / wanted.film.nyquist_per_mm
        by_light = wanted.wavelength_nm * 1e-6 / FRESNEL_LIMIT * (product * p) ** 2
        distance_mm = max(by_film, by_light, wanted.least_distance_mm)
        distance_mm = min(distance_mm, wanted.largest_distance_mm, 0.99 * wanted.focal_length_mm)
    else:
        distance_mm = wanted.mask_distance_mm
    mask = Mask(product / distance_mm, p)
    outer = (p + 0.5) * product / wanted.focal_length_mm
    sensor = Condition("outer slices from the middle of the spectrum", outer, min(height_mm, width_mm) / 2, "mm")
    return _finish(wanted, "fd", mask, distance_mm, sensor)


DESIGNS: dict[str, Callable[[DesignRequirements], Design]] = {"fd": design_fd, "geometric": design_geometric}


def buildable(wanted: DesignRequirements, law: str) -> Design | None:
    """A design that works, near the requirements: another distance, then a smaller stop, then fewer views.

    Of several stops the first whose views are no longer small, else the one with the largest views. None where no
    design works.
    """
    widest, narrowest = wanted.f_numbers or (wanted.f_number, wanted.f_number)
    first = min(max(wanted.f_number, widest), narrowest)
    stops = [first, *(n for n in _STOPS if first < n <= narrowest)]
    for views in range(wanted.views, 2, -2):
        tried = [DESIGNS[law](replace(wanted, views=views, f_number=n, mask_distance_mm=None)) for n in stops]
        working = [made for made in tried if made.works]
        if working:
            good = (made for made in working if min(made.view_shape) >= SMALL_VIEW_PX)
            return next(good, max(working, key=lambda made: min(made.view_shape)))
    return None


def _finish(wanted: DesignRequirements, law: str, mask: Mask, distance_mm: float, sensor: Condition) -> Design:
    p = wanted.p
    optics = MaskedOptics(wanted.sensor, mask, law, distance_mm)
    lattice = lattice_of(optics, wanted.image_mm if law == "geometric" else wanted.focal_length_mm)
    steps = abs(lattice.ky[0]), abs(lattice.kx[1])
    shape = math.floor(steps[0] * wanted.sensor.shape[0]), math.floor(steps[1] * wanted.sensor.shape[1])
    conditions = (
        sensor,
        Condition("highest harmonic on film", p * mask.frequency_per_mm, wanted.film.nyquist_per_mm, "cycles/mm"),
        Condition(
            "diffraction λ·d·(p·f_m)²",
            fresnel_number(distance_mm, p * mask.frequency_per_mm, wanted.wavelength_nm),
            FRESNEL_LIMIT,
            "",
        ),
        *_of_hardware(wanted, distance_mm),
        Condition("height of the mask on film", wanted.sensor.size_mm[0], wanted.film.vertical.length_mm, "mm"),
        Condition("width of the mask on film", wanted.sensor.size_mm[1], wanted.film.horizontal.length_mm, "mm"),
    )
    failed = [c.sentence for c in conditions if not c.met]
    if min(shape) < LEAST_VIEW_PX:
        failed.append(f"views of {shape[1]} × {shape[0]} px, fewer than {LEAST_VIEW_PX} per side")
    problem = None
    if failed:
        unmet = "; ".join(failed)
        problem = finding(
            Code.MASK_UNMAKABLE, Subject("mask"), views=wanted.views, distance_mm=distance_mm, conditions=unmet
        )
    pitch_mm = wanted.sensor.size_mm[1] / max(shape[1], 1)
    baseline = wanted.aperture_mm / wanted.views
    return Design(
        wanted=wanted,
        law=law,
        mask=mask,
        mask_distance_mm=distance_mm,
        conditions=conditions,
        view_shape=shape,
        bandwidth_per_mm=min(shape[0] / wanted.sensor.size_mm[0], shape[1] / wanted.sensor.size_mm[1]) / 2,
        spectrum_used=min(1.0, steps[0] * wanted.views) * min(1.0, steps[1] * wanted.views),
        baseline_mm=baseline,
        depth_sigma_m=depth_sigma_m(wanted.altitude_m, wanted.image_mm, baseline, wanted.shift_sigma_px * pitch_mm),
        ground_sample_m=ground_sample_m(pitch_mm, wanted.focal_length_mm, wanted.altitude_m),
        picture_sample_m=ground_sample_m(
            wanted.sensor.size_mm[1] / wanted.sensor.shape[1], wanted.focal_length_mm, wanted.altitude_m
        ),
        film_period_px=min(wanted.film.px_per_mm) / mask.frequency_per_mm,
        films=tuple(name for name, film in FILMS.items() if _prints(film, wanted, mask)),
        problem=problem,
        warnings=tuple(_warnings(wanted, mask, lattice, shape)),
    )


def _of_hardware(wanted: DesignRequirements, distance_mm: float) -> list[Condition]:
    """What camera and lens allow, as far as it is known."""
    found = []
    if wanted.least_distance_mm:
        found.append(
            Condition("mask as near as it can be mounted", distance_mm, wanted.least_distance_mm, "mm", at_least=True)
        )
    if wanted.f_numbers is not None:
        widest, narrowest = wanted.f_numbers
        found.append(Condition("f-number as the lens opens", wanted.f_number, widest, "", at_least=True))
        found.append(Condition("f-number as the lens stops down", wanted.f_number, narrowest, ""))
    return found


def _warnings(wanted: DesignRequirements, mask: Mask, lattice: Lattice, shape: tuple[int, int]) -> Iterator[str]:
    if LEAST_VIEW_PX <= min(shape) < SMALL_VIEW_PX:
        yield f"views of {shape[1]} × {shape[0]} px show little more than large shapes: depth will be coarse"
    beyond = beyond_mask(mask, wanted.sensor, lattice)
    if beyond is not None:
        yield beyond


def _prints(film: Film, wanted: DesignRequirements, mask: Mask) -> bool:
    height_mm, width_mm = wanted.sensor.size_mm
    fits = height_mm <= film.vertical.length_mm and width_mm <= film.horizontal.length_mm
    return fits and mask.p * mask.frequency_per_mm <= film.nyquist_per_mm
