"""Make of a flight's frames what is asked for: pictures at the sensor's own resolution, and light fields.

A picture costs a tenth of the views. What shows a frame as a whole is made of it; views are made where they are named.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dappled.config import profiles
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
from dappled.drivers.raw.picture_maker import LensFrame, PictureMaker, ToldShadow
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Finding
from dappled.flight import FlightFolder, Frame, Tag
from dappled.products.maps import photographs
from dappled.products.maps.earth import Projection
from dappled.products.maps.photographs import Photograph, Station

MEAN = "mean"


class Laboratory:
    """Makes pictures and light fields by one recipe; `pictures` is None behind lenslets, which show none but views."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.darkroom = Darkroom(recipe)
        self.pictures = None if recipe.mask == profiles.LENSLET else PictureMaker(recipe)

    def frame(
        self,
        flight: Path,
        frame: Frame,
        tag: Tag | None,
        *,
        focal_length_mm: float | None = None,
        f_number: float | None = None,
        told: Sequence[ToldShadow] = (),
        flown_nats: float | None = None,
    ) -> FlightFrame:
        """One frame of a flight (see `exposure`), what frames beside it have `told` of the mask's shadow, and what
        decoding in flight told of the mask."""
        one = exposure(flight, frame, tag, focal_length_mm=focal_length_mm, f_number=f_number)
        return FlightFrame(self, one.path, one.focal_length_mm, one.f_number, told, flown_nats)


_here = threading.local()  # a decoder keeps buffers: one for each working thread


def laboratory(recipe: Recipe) -> Laboratory:
    """This thread's laboratory for a recipe, kept from job to job."""
    kept: dict[Recipe, Laboratory] = _here.__dict__.setdefault("laboratories", {})
    if recipe not in kept:
        kept.clear()
        kept[recipe] = Laboratory(recipe)
    return kept[recipe]


@dataclass(frozen=True, slots=True)
class ShadowAsked:
    """A frame that is asked for its shadow, for the pictures of others."""

    recipe: Recipe
    frame: LensFrame


_Answer = tuple[ShadowAsked, ToldShadow | None]
_Asking = Callable[
    [Sequence[ShadowAsked], Callable[[ShadowAsked], _Answer], Callable[[ShadowAsked, str], _Answer]],
    Generator[_Answer],
]
"""As `Crew.in_order`: jobs, what is made of each, and what is told of one that was lost."""


def shadows(
    asked: Iterable[ShadowAsked], ask: _Asking, progress: Callable[[int, int], None] = lambda *_: None
) -> dict[ShadowAsked, ToldShadow]:
    """What frames tell of their shadows, each measured once, in any process; without those that tell nothing."""
    each = list(dict.fromkeys(asked))
    told = {}
    with closing(ask(each, _tell, lambda one, _: (one, None))) as answers:
        for number, (one, shadow) in enumerate(answers):
            progress(number, len(each))
            if shadow is not None:
                told[one] = shadow
    return told


def _tell(asked: ShadowAsked) -> _Answer:
    """One that can't be read tells nothing here: why is told where its own picture is made."""
    with suppress(Exception):
        pictures = laboratory(asked.recipe).pictures
        return asked, None if pictures is None else pictures.tell(asked.frame)
    return asked, None


def exposure(
    flight: Path, frame: Frame, tag: Tag | None, *, focal_length_mm: float | None = None, f_number: float | None = None
) -> LensFrame:
    """A frame's file; lens and stop are those given, else its tag's, else those of its file."""
    return LensFrame(
        FlightFolder(flight).file(frame.name),
        focal_length_mm or (tag.focal_length_mm if tag else None),
        f_number or (tag.f_number if tag else None),
    )


def exposures(
    flight: Path, recorded: Iterable[tuple[Frame, Tag | None]], *, focal_length_mm: float | None, f_number: float | None
) -> dict[int, LensFrame]:
    """The files of a flight's frames by image index (see `exposure`), but those that don't lie in it."""
    made = {}
    for frame, tag in recorded:
        with suppress(DappledError):
            made[frame.index] = exposure(flight, frame, tag, focal_length_mm=focal_length_mm, f_number=f_number)
    return made


@dataclass(frozen=True, eq=False)
class FlightFrame:
    """A frame's picture and light field, each made when it is first asked for. Both raise DappledError."""

    laboratory: Laboratory
    path: Path
    focal_length_mm: float | None
    f_number: float | None
    told: Sequence[ToldShadow] = ()
    flown_nats: float | None = None
    _found: dict[str, tuple[Finding, ...]] = field(default_factory=dict)
    _kept: dict[str, Photograph] = field(default_factory=dict)  # by projection

    @cached_property
    def decoded(self) -> DecodeResult:
        """The light field."""
        made = self.laboratory.darkroom.decode(self.path, focal_length_mm=self.focal_length_mm, f_number=self.f_number)
        self._found["decoded"] = made.doubts
        return made

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """All that is in doubt about what was made so far, each once."""
        return tuple({one.kind: one for found in self._found.values() for one in found}.values())

    @property
    def mask_nats(self) -> float | None:
        """The log odds that the mask is where it was calibrated: by the light field, where one was made and tells, else
        by decoding in flight; None where neither tells."""
        own = self.decoded.report.mask_nats if "decoded" in self._found else None
        return self.flown_nats if own is None else own

    def photograph(self, station: Station, projection: Projection, *, view: str, focus_m: float) -> Photograph:
        """The frame on the map: its picture for `view` "mean", else views, see `photographs.photograph`. Raises
        DappledError."""
        laboratory = self.laboratory
        if view == MEAN and laboratory.pictures is not None:
            if projection.name not in self._kept:
                self._kept[projection.name] = self._pictured(laboratory.pictures, station, projection, focus_m)
            return self._kept[projection.name]
        decoded = self.decoded
        light_field, gains = decoded.light_field, photographs.true_colours(decoded.raw)
        if gains is not None and light_field.views.ndim == 5:
            light_field = replace(light_field, views=light_field.views * gains.astype(np.float32))
        profile = laboratory.darkroom.camera(decoded.raw.model or "")
        return photographs.photograph(station, light_field, profile, projection, view=view, focus_m=focus_m)

    def _pictured(self, maker: PictureMaker, station: Station, projection: Projection, focus_m: float) -> Photograph:
        made = maker.picture(self.path, focal_length_mm=self.focal_length_mm, f_number=self.f_number, told=self.told)
        profile = self.laboratory.darkroom.camera(made.raw.model or "")
        colour = self.laboratory.recipe.colour
        one = photographs.of_picture(station, made, profile, projection, focus_m=focus_m, colour=colour)
        self._found["picture"] = one.doubts
        return one
