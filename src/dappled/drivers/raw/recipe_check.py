"""Whether frames can be decoded by a recipe, told before there are any, and without loading what decodes."""

from __future__ import annotations

from pathlib import Path

from dappled.config import profiles
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError


def check(recipe: Recipe) -> None:
    """Raise DappledError when the recipe names something that is missing, wrong, or for another camera or mask."""
    if recipe.camera != "auto":
        profiles.camera(recipe.camera)
    if recipe.mask != profiles.LENSLET:
        profiles.mask(recipe.mask)
    if (wrong := calibration_files.misfit(recipe)) is not None:
        raise DappledError(wrong)
    if recipe.taper and recipe.mask == profiles.LENSLET:
        raise DappledError("a taper is for the bands of a printed mask; the bands of lenslets fill the whole spectrum")
    if not 0 <= recipe.taper <= 1:
        raise DappledError(f"the taper is {recipe.taper:g}: it must be a share of the band, from 0 to 1")
    for path in (recipe.white, recipe.dark):
        if path:
            from dappled.drivers.raw import reading  # noqa: PLC0415  # see `daemon.after_ready`

            reading.read_metadata(Path(path))
