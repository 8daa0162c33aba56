"""`dappled mask diffraction`: predict a laser's spots behind a printed mask, and judge the measured ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import codec
from dappled.cli.mask import make
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, option

if not words_only:
    import numpy as np

    from dappled.config import profiles
    from dappled.config.profiles import MaskProfile
    from dappled.decode.optics import laser_bench
    from dappled.decode.optics.film import FILMS, MaskImage
    from dappled.products.exports import mask_files, prints


@dataclass(frozen=True, kw_only=True)
class PredictDiffraction(Overwriting, Verb):
    """Predict a laser's spots."""

    examples = ("dappled mask diffraction --mask mask-1 --measured bench.csv",)

    mask: str = option("--mask", "mask profile or TOML file")
    wavelength: float = option("--wavelength", "wavelength of the laser", 532.0, unit="nm", low=200, high=2000)
    distance: float = option("--distance", "distance from mask to wall", 0.5842, unit="m", low=1e-4, high=100)
    measured: Path | None = option("--measured", "x_mm,y_mm of the measured spots", None, metavar="CSV", there=True)
    tolerance: float = option("--tolerance", "tolerance of the measurement", 0.5, unit="mm", low=1e-3, high=100)
    picture: Path | None = option("--picture", "draw what the wall should show", None, metavar="FILE.png")
    image: Path | None = option(
        "--image", "draw it for this mask image (a positive) instead of the design", None, there=True,
    )  # fmt: skip
    beam: float = option("--beam", "diameter of the laser's beam", 2.0, unit="mm", low=0.01, high=20)

    def check(self) -> None:
        self.refuse_existing(self.picture)
        profiles.mask(self.mask)

    def run(self, output: Output) -> Report:
        known = profiles.mask(self.mask)
        found = [(i, i.landing_mm(self.wavelength, self.distance)) for i in laser_bench.impulses(known.mask)]
        verdict, others = None, list[str]()
        if self.measured:
            seen = mask_files.read_spots(self.measured)
            verdict = self._verdict(known, seen)
            if verdict.kind != "as designed":  # the shipped masks whose own spots these are: Table 5's are Mask 2's
                named = {name: profiles.mask(name) for name in profiles.shipped("masks")}
                others = [name for name, one in named.items() if self._verdict(one, seen).kind == "as designed"]
        if self.picture:
            screen = self._screen(known)
            bright = np.sqrt(screen.intensity / screen.intensity.max())
            prints.save(self.picture, np.rint(255 * np.clip(4 * bright, 0, 1)).astype(np.uint8))
            half = screen.intensity.shape[1] / 2 * screen.pitch_mm[1]
            output.remark(f"{self.picture}: the wall from {-half:.1f} to {half:.1f} mm")
        values = {
            "wavelength_nm": self.wavelength,
            "distance_m": self.distance,
            "impulses": [{**codec.plain(i), "x_mm": x, "y_mm": y} for i, (x, y) in found],
            "verdict": codec.plain(verdict),
            "spots_of": others,
        }
        if verdict:
            lines = [verdict.text]
            if others:
                lines.append(f"these are the spots of {', '.join(others)}: make sure that you hold the right mask")
        else:
            lines = [f"{'ky':>4} {'kx':>4} {'p/m':>9} {'q/m':>9} {'x/mm':>8} {'y/mm':>8}"]
            lines += [f"{i.ky:4d} {i.kx:4d} {i.p_per_m:9.0f} {i.q_per_m:9.0f} {x:8.2f} {y:8.2f}" for i, (x, y) in found]
        return Report(values, lines, failed=verdict is not None and verdict.kind != "as designed")

    def _verdict(self, known: MaskProfile, seen: list[tuple[float, float]]) -> laser_bench.BenchVerdict:
        return laser_bench.judge(known.mask, seen, self.wavelength, self.distance, tolerance_mm=self.tolerance)

    def _screen(self, known: MaskProfile) -> laser_bench.Screen:
        """The wall behind the middle of the mask: of an image file, or of the design drawn on 4k film."""
        if self.image:
            read, density = mask_files.read(self.image)
            values = read.astype(np.float64)
        else:
            chosen = FILMS["4k"]
            image = MaskImage(known.mask, chosen, make.periods_on(known, chosen))
            values = image.transmittance(slice(None), slice(None))
            density = chosen.px_per_mm
        pitch = 1 / density[0], 1 / density[1]
        reach = [min(n, round(3 * self.beam / d)) for n, d in zip(values.shape, pitch, strict=True)]
        top, left = ((n - r) // 2 for n, r in zip(values.shape, reach, strict=True))
        middle = values[top : top + reach[0], left : left + reach[1]]
        lit = middle * laser_bench.beam(middle.shape, pitch, self.beam)
        return laser_bench.far_screen(lit, pitch, self.wavelength, self.distance, samples=2048)
