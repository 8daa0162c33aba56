"""`dappled mask make`: write the image that goes on film, or a step wedge."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dappled import codec
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, argument, flag, option
from dappled.errors import CallError

if not words_only:
    import numpy as np

    from dappled.config import profiles
    from dappled.config.profiles import MaskProfile
    from dappled.decode.optics import Mask, film
    from dappled.decode.optics.film import FILMS, Film, MaskImage, period_on
    from dappled.products.exports import mask_files


@dataclass(frozen=True, kw_only=True)
class MakeMask(Overwriting, Verb):
    """Write the image that goes on film."""

    examples = ("dappled mask make mask-2 --negative -o mask-2.png",)

    mask: str | None = argument("P", "mask profile or TOML file (or --period/--frequency)", default=None)
    output: Path = option("-o --output", "image to write, .png or .tif")
    film: str = option("--film", "4k, 8k, 16k, or WIDTHxHEIGHT in pixels", "4k", metavar="F")
    density: float | None = option("--density", "pixel density of a film given as WIDTHxHEIGHT", None, unit="px/mm")
    size_mm: tuple[float, float] | None = option(
        "--size-mm", "size of the mask, in the middle of the film", None, metavar=("H", "W"),
        otherwise="the whole film",
    )  # fmt: skip
    period: float | None = option(
        "--period", "longest period, of the film", None, unit="px", low=1e-2, high=1e6,
    )  # fmt: skip
    frequency: float | None = option(
        "--frequency", "fundamental frequency, instead of --period", None, unit="1/mm", low=1e-3, high=1e5,
    )  # fmt: skip
    p: int | None = option("--p", "number of harmonics", None, low=1, high=20, otherwise="the profile's, else 2")
    pattern: Literal["full", "diagonal"] | None = option(
        "--pattern", "Eq 11's product, or Fig 14's diagonals", None, choices=("full", "diagonal"),
        otherwise="the profile's, else full",
    )  # fmt: skip
    harmonics: Literal["linear", "octave"] | None = option(
        "--harmonics", "1, 2, 3 … or 1, 2, 4 …", None, choices=("linear", "octave"),
        otherwise="the profile's, else linear",
    )  # fmt: skip
    negative: bool = flag("--negative", "write the negative (Eq 13), for black-and-white negative film")
    bits: int = option("--bits", "bits per pixel", 8, choices=(8, 16))
    curve: Path | None = option(
        "--curve", "level,density measured on this film's wedge; the image compensates for it", None, metavar="CSV",
        there=True,
    )  # fmt: skip
    drawable_only: bool = flag("--drawable-only", "leave out harmonics finer than two pixels")
    wedge: int | None = option(
        "--wedge", "write a step wedge instead, of 21 steps or so many", None, const=21, metavar="STEPS",
    )  # fmt: skip

    def check(self) -> None:
        self.refuse_existing(self.output)
        self._film()
        if self.wedge is None:
            self._mask_given()

    def run(self, output: Output) -> Report:
        chosen = self._film()
        if self.size_mm:
            chosen = chosen.cut_to(*self.size_mm)
        if self.wedge is not None:
            levels = np.rint(film.wedge((1, chosen.shape[1]), self.wedge) * (2**self.bits - 1))
            levels = levels.astype(np.uint8 if self.bits == 8 else np.uint16)

            def tile(rows: slice, columns: slice) -> mask_files.Levels:
                return np.repeat(levels[:, columns], rows.stop - rows.start, axis=0)

            report: dict[str, Any] = {"wedge_steps": self.wedge, "warnings": []}
        else:
            image = self._image(chosen)
            tile = image.levels
            report = {
                "carriers": len(image.orders_drawn()),
                "period_px": list(image.period_px),
                "harmonics": [{**codec.plain(h), "drawable": h.drawable} for h in image.harmonics()],
                "warnings": image.warnings(),
            }
        for text in report["warnings"]:
            output.warn(f"warning: {text}")
        with output.bar(chosen.shape[0], "row") as add:
            mask_files.write(self.output, chosen.shape, self.bits, chosen.px_per_mm, tile, progress=add)
        high, wide = chosen.vertical.length_mm, chosen.horizontal.length_mm
        size = f"{chosen.shape[1]} × {chosen.shape[0]} px, {self.bits} bits, {wide:.4g} × {high:.4g} mm"
        named = {"file": str(self.output), "shape": list(chosen.shape), "px_per_mm": list(chosen.px_per_mm)}
        return Report({**named, **report}, [f"{self.output}: {size}"])

    def _film(self) -> Film:
        if self.film in FILMS:
            if self.density is not None:
                raise CallError(f"film {self.film} has its own density; --density is for --film WIDTHxHEIGHT")
            return FILMS[self.film]
        size = re.fullmatch(r"(\d+)x(\d+)", self.film)
        if size is None:
            raise CallError(f"no film {self.film!r}; known are {', '.join(FILMS)}, or WIDTHxHEIGHT with --density")
        if self.density is None:
            raise CallError(f"--film {self.film} needs --density in px/mm")
        return film.film_of(int(size[1]), int(size[2]), self.density)

    def _mask_given(self) -> MaskProfile | None:
        known = profiles.mask(self.mask) if self.mask else None
        if known is None and self.period is None and self.frequency is None:
            raise CallError("name a mask profile, or give --period in px or --frequency in 1/mm")
        if self.period is not None and self.frequency is not None:
            raise CallError("--period and --frequency set the same thing: give only one of them")
        return known

    def _image(self, chosen: Film) -> MaskImage:
        known = self._mask_given()
        if self.period is not None:
            mask = Mask(chosen.px_per_mm[1] / self.period, 2)
            periods = (self.period, self.period * chosen.px_per_mm[0] / chosen.px_per_mm[1])
            if math.isclose(*chosen.px_per_mm, rel_tol=1e-3):
                periods = (self.period, self.period)
        elif self.frequency is not None:
            mask = Mask(self.frequency, 2)
            periods = period_on(chosen, mask)
        else:
            assert known is not None
            mask, periods = known.mask, periods_on(known, chosen)
        base = known.mask if known else mask
        mask = Mask(
            mask.frequency_per_mm,
            self.p or base.p,
            self.pattern or base.pattern,
            self.harmonics or base.harmonics,
        )
        curve = mask_files.read_density_curve(self.curve) if self.curve else None
        return MaskImage(mask, chosen, periods, self.negative, self.bits, curve, self.drawable_only)


def periods_on(known: MaskProfile, chosen: Film) -> tuple[float, float]:
    """The periods (y, x): whole pixels if the mask was designed for this film, else by its frequency."""
    own = known.film_px_per_mm
    if own is not None and known.period_px is not None and np.allclose(chosen.px_per_mm, own, rtol=1e-3):
        return known.period_px, known.period_px
    return period_on(chosen, known.mask)
