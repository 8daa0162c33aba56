"""Find where a frame's slices place its mask, how strong its shadow is, and the stop that they were taken through.

Each is told by what the others are, so they are fitted in turns until they stand: the stop by the means of the slices,
place and contrast by patches. Where no patches agree on a place near the calibrated one, it is looked for around masks
that were turned or scaled before, as far as hands and lenses go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from dappled.decode.array_types import Floats
from dappled.decode.joint.frame_views import TakenSlices, search_of
from dappled.decode.joint.mask_place import MaskPlace, PlaceSearch
from dappled.decode.lightfield.aperture import ShownContrast, UsedAperture

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_ROUNDS = 6  # of searches where the mask was found, until it stands
_STANDS = 0.02  # of the contrast: a smaller change is none


def placed(
    taken: TakenSlices, changes: Floats, *, distance_known: bool, workers: int = 1
) -> tuple[TakenSlices, UsedAperture, MaskPlace | None]:
    """The slices as a mask in its place would make them, the stop and contrast that they show, and the mask's place;
    None where the joint model is not for them. `changes` as in `PlaceSearch`."""
    search = _Search(taken, changes, distance_known, workers)
    by_means = MaskPlace.at(taken.shift(distance_known=distance_known))  # else the stop is fitted to moved phases
    found = search.settled(by_means)
    if found.place is None or found.place.seen:
        return found.at, found.width, found.place
    at = search.moved(taken, by_means)
    width = at.width(distance_known=distance_known)
    by = search.by(taken, width)
    start = None if by is None else by.farther()
    farther = None if start is None else search.settled(start)
    if farther is not None and farther.place is not None and farther.place.seen:
        return farther.at, farther.width, farther.place
    nowhere = replace(found.place, contrast=None, contrast_sigma=None).nowhere()
    return at, width, nowhere.beyond(by_means.periods)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Slices as a mask in its place would make them, their stop, and the place."""

    at: TakenSlices
    width: UsedAperture
    place: MaskPlace | None


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    taken: TakenSlices
    changes: Floats
    distance_known: bool
    workers: int

    def moved(self, at: TakenSlices, by: MaskPlace) -> TakenSlices:
        """Slices as they would be without this move."""
        back = by.undone(at.values, at.orders, self.changes, at.samples_px)
        return replace(at.moved(by.periods), values=back, rotation_rad=at.rotation_rad + by.turn_rad)

    def by(self, at: TakenSlices, width: UsedAperture) -> PlaceSearch | None:
        """What looks for the mask through a stop."""
        return search_of(at.through(width).used(), self.changes, at.samples_px, workers=self.workers)

    def place(self, at: TakenSlices, width: UsedAperture, *, moved: bool) -> MaskPlace | None:
        by = self.by(at, width)
        return None if by is None else by.near(moved=moved)

    def settled(self, start: MaskPlace) -> _Found:
        """From a place on, again from what was found until it stands."""
        at, place = self.moved(self.taken, start), start
        width = at.width(distance_known=self.distance_known)
        for number in range(_ROUNDS):
            rest = self.place(at, width, moved=place.moved)
            if rest is None:
                return _Found(at, width, None)
            place = rest.beyond(place.periods, place.turn_rad, place.off)
            at = self.moved(at, rest)
            texture, before = self.texture(rest, at, width), width
            if texture is not None:
                place = replace(place, contrast=texture.contrast, contrast_sigma=texture.sigma)
            width = at.width(distance_known=self.distance_known, texture=texture)
            stands = not rest.far().moved and abs(math.log(width.contrast / before.contrast)) < _STANDS
            if stands or (number and not rest.seen):
                break
        return _Found(at, width, place)

    def texture(self, rest: MaskPlace, at: TakenSlices, width: UsedAperture) -> ShownContrast | None:
        """The contrast that patches show, in proportion to what they show through the stop that it would need."""
        shown = _shown(rest, width)
        if shown is None or not shown.doubtful:
            return shown
        other = at.width(distance_known=self.distance_known, texture=shown, faded=(True,))
        there = self.place(at, other, moved=False)
        then = None if there is None else _shown(there, other)
        return shown if then is None else shown.beside(then.kappa, then.contrast)


def _shown(place: MaskPlace, width: UsedAperture) -> ShownContrast | None:
    if place.contrast is None or place.contrast_sigma is None:
        return None
    return ShownContrast(width.kappa, width.contrast * place.contrast, width.contrast * place.contrast_sigma)
