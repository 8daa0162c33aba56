"""`dappled depth`: measure disparities, and distances if a calibration allows, each with its uncertainty."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli import paths
from dappled.cli.field_arguments import doubts, opened_field
from dappled.cli.placing import FieldOrFlight
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, flag, option
from dappled.decode import DecodeError
from dappled.errors import CallError, counted
from dappled.findings import named, text

if not words_only:
    import numpy as np
    from numpy.typing import NDArray

    from dappled.decode.depth import DepthMap, DistanceMap
    from dappled.decode.depth import estimate as depths
    from dappled.flight import layout
    from dappled.products.exports import exports, point_cloud, prints
    from dappled.products.maps import photographs, terrain
    from dappled.products.maps.georeference import Survey
    from dappled.products.mounting import Mounting
    from dappled.products.opened import OpenedLightField, OpenError
    from dappled.products.survey import flight_sweep, frame_terrain
    from dappled.products.survey.frame_depths import FrameDepths
    from dappled.products.whole_files import whole

_POINTS = (".ply", ".las", ".laz")
_RASTERS, _PICTURES = (".tif", ".tiff"), (".png", ".jpg", ".jpeg")  # of a flight's heights


@dataclass(frozen=True, kw_only=True)
class MeasureDepth(Overwriting, FieldOrFlight, Verb):
    """Measure disparities and distances."""

    examples = (
        "dappled depth frame.zarr -o depth.png",
        "dappled depth frame.zarr --focus inf -o depth.npz points.ply",
        "dappled depth frame.zarr --calibration c.toml --flight FLIGHT --frame 42 -o points.las",
        "dappled depth --flight FLIGHT --terrain n41_w092_1arc_v3.dt2 -o heights.tif",
    )
    notes = (
        "OUT: .png (false colours), .npz (all values), .pfm (disparity), .ply, .las, .laz (points); of a flight .tif."
    )

    method: str = option(
        "--method", "combined, contrast, stereo", "combined", metavar="M",
        parse=lambda name: depths.known_method(name),  # noqa: PLW0108  # --help doesn't load it
    )  # fmt: skip
    between: tuple[float, float] | None = option(
        "--between", "range of disparities to search, px/view", None, metavar=("LOW", "HIGH"), otherwise="the scene's",
    )  # fmt: skip
    window: int | None = option(
        "--window", "side of the window around a pixel, odd", None, unit="px", low=1,
        otherwise="the method's own, 3 to 13",
    )  # fmt: skip
    most_sigma: float = option(
        "--most-sigma", "omit points with a σ above this share of their distance", 0.1, metavar="SHARE", above=0.0,
    )  # fmt: skip
    flight: Path | None = option(
        "--flight", "with --frame: place the points on the map, using the pose of that frame; without LIGHTFIELD: "
        "heights of the ground from its frames, each by itself, fused (a GeoTIFF)", None, metavar="FLIGHT",
        there=paths.flight,
    )  # fmt: skip
    frame: int | None = option(
        "--frame", "number of this frame in the flight; without LIGHTFIELD: use only this one", None, low=0,
    )  # fmt: skip
    together: bool = flag(
        "--together",
        "of a flight: find heights where all frames agree (a plane sweep over the flight), not from each by itself",
    )
    output: tuple[Path, ...] = option("-o --output", "files to write", (), metavar="OUT")

    def check(self) -> None:
        self.check_source("together")
        if self.window is not None and self.window % 2 == 0:
            raise CallError(f"a window of {self.window} px has no middle: give an odd --window")
        if self.between is not None and not self.between[0] < self.between[1]:
            raise CallError("--between: the lower disparity comes first")
        kinds = [path.suffix.lower() for path in self.output]
        if self.field is not None and self.flight is not None and self.frame is None:
            raise CallError("--flight needs --frame N: the number of this frame in the flight")
        for path, kind in zip(self.output, kinds, strict=True):
            if self.field is None and kind not in (*_RASTERS, *_PICTURES):
                raise CallError(f"{path}: heights of a flight are written as .tif (GeoTIFF) or .png, .jpg (a picture)")
        self.refuse_existing(*self.output)

    def run(self, output: Output) -> Report:
        if self.field is None:
            return self._heights(output)
        found = opened_field(self.field, self)
        made = found.depth(self.method, between=self.between, window=self.window)
        distances = found.distances(made) if found.ranging is not None else None
        report: dict[str, Any] = summary(found, made, distances)
        for path in self.output:
            report.setdefault("written", []).append(str(path))
            report |= self._write(path, found, made, distances)
        return Report(report, words(report), findings=doubts(found))

    def _heights(self, output: Output) -> Report:
        """Heights of a flight."""
        assert self.flight is not None
        placing = self.placing(None if self.frame is None else frozenset([self.frame]))
        written = [str(path) for path in self.output]
        with ExitStack() as stack:
            if self.together:
                return self._together(placing.placed(self.flight, output, stack, foresee=flight_sweep.check), output)
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dappled-depths-")))
            seen = FrameDepths(
                scratch,
                lambda found: found.depth(self.method, between=self.between, window=self.window),
                placing.focus,
            )
            made = placing.placed(self.flight, output, stack, watch=seen.measure)
            for one in seen.left:
                output.remark(str(named(one)))
            found = frame_terrain.of(made, seen.found, output.show, cell_m=self.cell)
            for path in self.output:
                if path.suffix.lower() in _RASTERS:
                    frame_terrain.write_raster(made, found, path)
                else:
                    prints.save(path, _picture(found.height_m, "m"))
        told = frame_terrain.told(made, found)
        values = frame_terrain.summary(made, found) | {"notes": codec.plain(told[1:]), "written": written}
        lines = [*(str(text(one)) for one in told), *(f"written: {path}" for path in written)]
        return Report(values, lines, findings=made.doubts)

    def _together(self, made: Survey, output: Output) -> Report:
        """Heights of a flight where all of its frames agree."""
        surface = flight_sweep.surface(made, output.show, cell_m=self.cell)
        found = terrain.over(made, surface)
        for path in self.output:
            if path.suffix.lower() in _RASTERS:
                terrain.write_raster(made, found, path)
            else:
                prints.save(path, _picture(surface.height_m, "m"))
        written = [str(path) for path in self.output]
        known, sigma = float(surface.known.mean()), _quartiles(surface.sigma_m)
        values = {"known": known, "height_m": _quartiles(surface.height_m), "sigma_m": sigma, "written": written}
        told = "" if sigma is None else f", to ±{sigma[1]:.2g} m (median)"
        line = f"{counted(len(made.photographs), 'frame')} together: {known:.0%} of the map known{told}"
        return Report(values, [line, *(f"written: {path}" for path in written)], findings=made.doubts)

    def _write(
        self, path: Path, found: OpenedLightField, made: DepthMap, distances: DistanceMap | None
    ) -> dict[str, Any]:
        kind = path.suffix.lower()
        if kind == ".npz":
            arrays: dict[str, NDArray[Any]] = {
                "disparity": made.disparity, "sigma": made.sigma, "confidence": made.confidence,
            }  # fmt: skip
            if distances is not None:
                arrays |= {"distance_m": distances.distance_m, "distance_sigma_m": distances.sigma_m}
            with whole(path) as part:
                np.savez_compressed(part, allow_pickle=False, **arrays)
        elif kind == ".pfm":
            with whole(path) as part:
                exports.write_pfm(part, made.disparity)
        elif kind in _POINTS:
            return self._points(path, found, distances)
        elif distances is not None:
            prints.save(path, _picture(distances.distance_m, "m"))
        else:
            prints.save(path, _picture(made.disparity, "px/view"))
        return {}

    def _points(self, path: Path, found: OpenedLightField, distances: DistanceMap | None) -> dict[str, Any]:
        if distances is None:
            found.metres()  # raises with what is missing
            raise OpenError("points need distances")
        station = None
        if self.flight is not None:
            frames, tags = photographs.recorded(self.flight)
            chosen = next((f for f in frames if f.index == self.frame), None)
            if chosen is None:
                raise OpenError(f"{self.flight} has no frame {self.frame}")
            mounting = Mounting.of(layout.read_facts(layout.open_folder(self.flight)))
            station = photographs.station(chosen, tags.get(chosen.index), mounting)
        cloud = point_cloud.of(
            found.field, found.refocus(), distances, most_sigma=self.most_sigma, station=station, crs=self.crs
        )
        point_cloud.write(path, cloud)
        return {"points": len(cloud.points), "withheld": cloud.withheld, "coordinates": cloud.crs or "camera axes"}


def summary(found: OpenedLightField, made: DepthMap, distances: DistanceMap | None) -> dict[str, Any]:
    """A depth map in a few numbers; None where nothing is known."""
    report: dict[str, Any] = {
        "method": made.method,
        "known": made.known_share(),
        "disparity_px": _quartiles(made.disparity),
        "sigma_px": _quartiles(made.sigma),
        "distances_from": None if found.ranging is None else found.ranging.source,
        "doubts": codec.plain(found.doubts),
    }
    if distances is not None:
        report["distance_known"] = float(np.isfinite(distances.distance_m).mean())
        report["distance_m"] = _quartiles(distances.distance_m)
        report["distance_sigma_m"] = _quartiles(distances.sigma_m)
        nearest = distances.nearest()
        report["nearest_m"] = None if nearest is None else nearest[0]
    else:
        report["no_distances"] = _why_not(found)
    return report


def _why_not(found: OpenedLightField) -> str:
    try:
        found.metres()
    except DecodeError as error:  # the calibration is for another frame
        return str(error)
    except OpenError:
        pass
    return "distances need --focus, or a calibration with targets (--calibration)"


def words(report: dict[str, Any]) -> list[str]:
    """The summary as lines."""

    def three(values: list[float] | None, unit: str) -> str:
        return "unknown" if values is None else " / ".join(f"{v:.3g}" for v in values) + f" {unit}"

    lines = [
        f"{report['method']}: {report['known']:.0%} of the pixels known",
        f"disparity (quartiles): {three(report['disparity_px'], 'px/view')}, σ {three(report['sigma_px'], 'px/view')}",
    ]
    spread, sigma = report["disparity_px"], report["sigma_px"]
    if spread is not None and sigma is not None and sigma[1] > spread[2] - spread[0]:
        lines.append(
            "no relief is told: σ is larger than the spread of the disparities (a flat scene, noise, few carriers)"
        )
    if "distance_m" in report:
        lines.append(
            f"distance (quartiles): {three(report['distance_m'], 'm')}, σ {three(report['distance_sigma_m'], 'm')}, "
            f"{report['distance_known']:.0%} known; by {report['distances_from']}"
        )
    else:
        lines.append(f"relative depth only: {report['no_distances']}")
    if "withheld" in report:
        lines.append(
            f"{counted(report['points'], 'point')}, {report['withheld']} omitted for their σ ({report['coordinates']})"
        )
    return lines + [f"written: {path}" for path in report.get("written", [])]


def _picture(values: NDArray[np.float32], unit: str) -> prints.Bytes:
    known = values[np.isfinite(values)]
    if known.size == 0:
        raise OpenError("no pixel has a known depth, so there is nothing to draw: the scene may lack texture")
    low, high = (float(x) for x in np.quantile(known, [0.01, 0.99]))
    return prints.with_scale(values, low, high, unit)


def _quartiles(values: NDArray[np.float32]) -> list[float] | None:
    known = values[np.isfinite(values)]
    return None if known.size == 0 else [float(x) for x in np.quantile(known, [0.25, 0.5, 0.75])]
