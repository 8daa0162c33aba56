"""`dappled terrain contours`: the lines of equal height of a flight's terrain, for GIS and CAD."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, argument, option
from dappled.errors import CallError, counted

if not words_only:
    import numpy as np

    from dappled.products.maps import contours, heights


@dataclass(frozen=True, kw_only=True)
class DrawContours(Overwriting, Verb):
    """Draw lines of equal height."""

    examples = (
        "dappled terrain contours FLIGHT -o contours.geojson",
        "dappled terrain contours dem.tif --interval 0.5 --smooth 1 -o contours.geojson",
    )

    raster: Path = argument("HEIGHTS", "flight with maps/terrain.tif, or a raster of heights", there=True)
    output: Path = option("-o --output", "file to write (.geojson)", metavar="OUT")
    interval: float | None = option(
        "--interval", "between lines", None, unit="m", above=0.0, otherwise="about 20 lines, 2 σ apart or more",
    )  # fmt: skip
    smooth: float = option("--smooth", "smooth the heights by a Gaussian of this σ first", 0.0, unit="m", low=0.0)

    def check(self) -> None:
        if self.output.suffix.lower() not in (".geojson", ".json"):
            raise CallError(f"{self.output}: contours are written as .geojson")
        self.refuse_existing(self.output)

    def run(self, output: Output) -> Report:
        raster = heights.read(self.raster)
        interval = self.interval or contours.interval_of(raster)
        made = contours.of(raster, interval, smooth_m=self.smooth)
        contours.write(made, raster.projection, interval, self.output)
        known = np.isfinite(raster.height_m)
        sigma = None if raster.sigma_m is None else float(np.nanmedian(raster.sigma_m[known]))
        low, high = float(np.nanmin(raster.height_m)), float(np.nanmax(raster.height_m))
        values = {
            "heights": raster.name,
            "interval_m": interval,
            "lowest_m": low,
            "highest_m": high,
            "lines": len(made),
            "length_m": sum(one.length_m for one in made),
            "sigma_m": sigma,
            "known": float(known.mean()),
            "written": str(self.output),
        }
        told = "" if sigma is None else f", known to ±{sigma:.2g} m (median)"
        return Report(
            values,
            [
                f"{counted(len(made), 'line')}, every {interval:g} m; heights from {low:.2f} to {high:.2f} m{told}",
                str(self.output),
            ],
        )
