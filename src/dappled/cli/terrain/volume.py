"""`dappled terrain volume`: how much was filled and cut between two flights, each with its uncertainty."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument, option

if not words_only:
    from dappled.decode.geometry import area as areas
    from dappled.products.maps import heights, volumes
    from dappled.products.maps.volumes import Earthwork, VolumeChange

_HEIGHTS = "with maps/terrain.tif of georeference --as terrain, or a raster of heights"


@dataclass(frozen=True, kw_only=True)
class MeasureVolume(Verb):
    """How much was filled and cut."""

    examples = (
        "dappled terrain volume MAY JUNE --area pit.geojson --stable road.geojson",
        "dappled terrain volume dem.tif FLIGHT --sigma 0.1 --json",
    )
    notes = "Of two σ the first is of the cells' own errors, the second of what a flight's poses give all its heights."

    before: Path = argument("BEFORE", f"the earlier flight, {_HEIGHTS}", there=True)
    after: Path = argument("AFTER", "the later one, likewise", there=True)
    area: Path | None = option(
        "--area", "count only what lies in it: GeoJSON, KML, or a QGroundControl .plan", None, there=True,
        otherwise="where either knows heights",
    )  # fmt: skip
    stable: Path | None = option(
        "--stable", "ground that has not changed: the median of its changes is taken off all", None, metavar="AREA",
        there=True,
    )  # fmt: skip
    sigma: float | None = option("--sigma", "σ of a height, where a raster has none", None, unit="m", above=0.0)
    correlated: float | None = option(
        "--correlated", "heights within this distance err alike", None, unit="m", low=0.0,
        otherwise="what the raster says, or a cell",
    )  # fmt: skip

    def run(self, output: Output) -> Report:
        before, after = heights.read(self.before), heights.read(self.after)
        area, stable = (None if one is None else areas.read(one) for one in (self.area, self.stable))
        made = volumes.between(
            before, after, area=area, stable=stable, sigma_m=self.sigma, correlated_m=self.correlated
        )
        named = {"before": before.name, "after": after.name, "crs": before.projection.name}
        values = named | asdict(made) | {"unknown_m2": made.unknown_cells * made.cell_m2}
        return Report(values, words(made, levelled=stable is not None))


def words(made: VolumeChange, *, levelled: bool) -> list[str]:
    """The volumes as lines."""
    lines = [_told("net ", made.net, sign="+"), _told("fill", made.fill), _told("cut ", made.cut)]
    if made.noise_m3 is None:
        lines.append("σ of the heights is not known: give --sigma")
    else:
        lines.append(
            f"errors of the heights alone would make {_number(made.noise_m3)} m³ of fill and as much of cut; cells "
            f"that changed by more than {volumes.SURE_SIGMAS:g} σ: fill {_number(made.sure_fill_m3 or 0.0)} m³, "
            f"cut {_number(made.sure_cut_m3 or 0.0)} m³"
        )
    if levelled:
        lines.append(f"{made.levelled_m:+.3g} m of change on the stable ground was taken off")
    if made.level_sigma_m is None:
        lines.append("the error that all heights have in common is not known: give --stable, ground without change")
    else:
        lines.append(f"all changes have an error of ±{made.level_sigma_m:.2g} m in common")
    share = made.unknown_cells / (made.cells + made.unknown_cells)
    unknown = _number(made.unknown_cells * made.cell_m2)
    lines.append(f"{_number(made.net.area_m2)} m² compared; {unknown} m² ({share:.0%}) unknown, and not counted")
    return lines


def _told(name: str, work: Earthwork, sign: str = "") -> str:
    parts = [(work.cells_sigma_m3, "cells"), (work.level_sigma_m3, "in common")]
    sigmas = "".join(f" ± {_number(sigma)} ({what})" for sigma, what in parts if sigma is not None)
    return f"{name} {_number(work.volume_m3, sign)}{sigmas} m³, over {_number(work.area_m2)} m²"


def _number(value: float, sign: str = "") -> str:
    return f"{value:{sign}.0f}" if abs(value) >= 100 else f"{value:{sign}.3g}"
