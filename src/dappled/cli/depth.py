"""`dappled depth`: measure disparities, and distances if a calibration allows, each with its uncertainty."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.cli import decode_arguments, georeference
from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.decode_arguments import FieldCallError
from dappled.decode import DecodeError
from dappled.decode.depth import DepthMap, DistanceMap
from dappled.decode.depth import estimate as depths
from dappled.errors import counted
from dappled.findings import to_rows
from dappled.flight import layout
from dappled.products.exports import exports, point_cloud, prints
from dappled.products.maps import photographs, terrain
from dappled.products.maps.georeference import Progress, Survey
from dappled.products.mounting import Mounting
from dappled.products.opened import OpenedLightField, OpenError
from dappled.products.survey import frame_terrain
from dappled.products.survey.frame_depths import FrameDepths

_POINTS = (".ply", ".las", ".laz")
_RASTERS, _PICTURES = (".tif", ".tiff"), (".png", ".jpg", ".jpeg")  # of a flight's heights


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled depth frame.zarr -o depth.png\n"
        "  dappled depth frame.zarr --focus inf -o depth.npz points.ply\n"
        "  dappled depth frame.zarr --calibration c.toml --flight FLIGHT --frame 42 -o points.las\n"
        "  dappled depth --flight FLIGHT --terrain n41_w092_1arc_v3.dt2 -o heights.tif\n"
        "OUT: .png (false colours), .npz (all values), .pfm (disparity), .ply, .las, .laz (points); of a flight .tif."
    )
    decode_arguments.add_field(parser, needed=False)
    parser.add_argument("--method", type=_method, metavar="M", default="combined",
                        help=f"{', '.join(depths.METHODS)} (default: combined)")  # fmt: skip
    decode_arguments.add_between(parser)
    parser.add_argument("--window", type=int, metavar="PX",
                        help="side of the window around a pixel, odd (default: the method's own, 3 to 13)")  # fmt: skip
    parser.add_argument("--most-sigma", type=float, default=0.1, metavar="SHARE",
                        help="omit points with a σ above this share of their distance (default: 0.1)")  # fmt: skip
    parser.add_argument(
        "--flight",
        type=Path,
        metavar="FLIGHT",
        help="with --frame: place the points on the map, using the pose of that frame; without\n"
        "LIGHTFIELD: heights of the ground from its frames, each by itself, fused (a GeoTIFF)",
    )
    parser.add_argument("--frame", type=int, metavar="N",
                        help="number of this frame in the flight; without LIGHTFIELD: use only this one")  # fmt: skip
    decode_arguments.add_flight(parser)
    parser.add_argument("--together", action="store_true",
                        help="of a flight: find heights where all frames agree (a plane sweep over the flight),\n"
                        "not from each frame by itself")  # fmt: skip
    parser.add_argument("-o", "--output", nargs="+", type=Path, default=[], metavar="OUT", help="files to write")
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def _method(text: str) -> str:
    try:
        return depths.known_method(text)
    except DecodeError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run(arguments: argparse.Namespace) -> int:
    refuse_existing(arguments, *arguments.output)
    if arguments.field is None:
        return _heights(arguments)
    decode_arguments.refuse_of_flight(arguments, "together")
    found = decode_arguments.opened_field(arguments)
    between = None if arguments.between is None else (arguments.between[0], arguments.between[1])
    made = found.depth(arguments.method, between=between, window=arguments.window)
    distances = found.distances(made) if found.ranging is not None else None
    report: dict[str, Any] = summary(found, made, distances)
    for path in arguments.output:
        report.setdefault("written", []).append(str(path))
        report |= _write(path, found, made, distances, arguments)
    print(json.dumps(report) if arguments.json else words(report))
    return 0


def _heights(arguments: argparse.Namespace) -> int:
    """Heights of a flight from its single frames."""
    given = decode_arguments.of_flight(arguments)
    wrong = [path for path in arguments.output if path.suffix.lower() not in (*_RASTERS, *_PICTURES)]
    if wrong:
        raise FieldCallError(f"{wrong[0]}: heights of a flight are written as .tif (GeoTIFF) or .png, .jpg (a picture)")
    between = None if arguments.between is None else (arguments.between[0], arguments.between[1])
    given["frames"] = None if arguments.frame is None else str(arguments.frame)
    with ExitStack() as stack:
        progress = stack.enter_context(georeference.Bar())
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dappled-depths-")))
        if arguments.together:
            return _together(arguments, georeference.placed(arguments.flight, given, progress, stack), progress)
        depths = FrameDepths(
            scratch,
            lambda found: found.depth(arguments.method, between=between, window=arguments.window),
            given["focus"],
        )
        made = georeference.placed(arguments.flight, given, progress, stack, watch=depths)
        for _, why in (*made.left, *depths.left):
            print(why, file=sys.stderr)
        found = frame_terrain.of(made, depths.found, progress, cell_m=arguments.cell)
        for path in arguments.output:
            if path.suffix.lower() in _RASTERS:
                frame_terrain.write_raster(made, found, path)
            else:
                prints.save(path, _picture(found.height_m, "m"))
    written = [str(path) for path in arguments.output]
    lines = frame_terrain.words(made, found)
    report = frame_terrain.summary(made, found) | {"notes": lines[1:], "written": written}
    print(json.dumps(report) if arguments.json else "\n".join([*lines, *(f"written: {path}" for path in written)]))
    return 0


def _together(arguments: argparse.Namespace, made: Survey, progress: Progress) -> int:
    """Heights of a flight where all of its frames agree."""
    for _, why in made.left:
        print(why, file=sys.stderr)
    found = terrain.of(made, progress, cell_m=arguments.cell)
    surface = found.surface
    for path in arguments.output:
        if path.suffix.lower() in _RASTERS:
            terrain.write_raster(made, found, path)
        else:
            prints.save(path, _picture(surface.height_m, "m"))
    written = [str(path) for path in arguments.output]
    known, sigma = float(surface.known.mean()), _quartiles(surface.sigma_m)
    report = {"known": known, "height_m": _quartiles(surface.height_m), "sigma_m": sigma, "written": written}
    told = "" if sigma is None else f", to ±{sigma[1]:.2g} m (median)"
    line = f"{counted(len(made.photographs), 'frame')} together: {known:.0%} of the map known{told}"
    print(json.dumps(report) if arguments.json else "\n".join([line, *(f"written: {path}" for path in written)]))
    return 0


def summary(found: OpenedLightField, made: DepthMap, distances: DistanceMap | None) -> dict[str, Any]:
    """A depth map in a few numbers; None where nothing is known."""
    report: dict[str, Any] = {
        "method": made.method,
        "known": made.known_share(),
        "disparity_px": _quartiles(made.disparity),
        "sigma_px": _quartiles(made.sigma),
        "distances_from": None if found.ranging is None else found.ranging.source,
        "doubts": to_rows(found.doubts),
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


def words(report: dict[str, Any]) -> str:
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
    lines += [f"written: {path}" for path in report.get("written", [])]
    return "\n".join(lines)


def _write(
    path: Path,
    found: OpenedLightField,
    made: DepthMap,
    distances: DistanceMap | None,
    arguments: argparse.Namespace,
) -> dict[str, Any]:
    kind = path.suffix.lower()
    if kind == ".npz":
        arrays: dict[str, NDArray[Any]] = {
            "disparity": made.disparity, "sigma": made.sigma, "confidence": made.confidence,
        }  # fmt: skip
        if distances is not None:
            arrays |= {"distance_m": distances.distance_m, "distance_sigma_m": distances.sigma_m}
        _whole(path, lambda part: np.savez_compressed(part, allow_pickle=False, **arrays))
    elif kind == ".pfm":
        _whole(path, lambda part: exports.write_pfm(part, made.disparity))
    elif kind in _POINTS:
        return _points(path, found, distances, arguments)
    elif distances is not None:
        prints.save(path, _picture(distances.distance_m, "m"))
    else:
        prints.save(path, _picture(made.disparity, "px/view"))
    return {}


def _whole(path: Path, write: Callable[[Path], None]) -> None:
    """Write under another name, then rename, so that no half-written file is left. Raises OpenError."""
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        write(part)
        part.replace(path)
    except OSError as error:
        raise OpenError(f"{path} can't be written: {error.strerror or error}; choose another place") from None
    finally:
        part.unlink(missing_ok=True)


def _points(
    path: Path, found: OpenedLightField, distances: DistanceMap | None, arguments: argparse.Namespace
) -> dict[str, Any]:
    if distances is None:
        found.metres()  # raises with what is missing
        raise OpenError("points need distances")
    station = None
    if arguments.flight is not None:
        if arguments.frame is None:
            raise OpenError("--flight needs --frame N: the number of this frame in the flight")
        frames, tags = photographs.recorded(arguments.flight)
        chosen = next((f for f in frames if f.index == arguments.frame), None)
        if chosen is None:
            raise OpenError(f"{arguments.flight} has no frame {arguments.frame}")
        mounting = Mounting.of(layout.read_facts(layout.open_folder(arguments.flight)))
        station = photographs.station(chosen, tags.get(chosen.index), mounting)
    cloud = point_cloud.of(
        found.field, found.refocus(), distances, most_sigma=arguments.most_sigma, station=station, crs=arguments.crs
    )
    point_cloud.write(path, cloud)
    return {"points": len(cloud.points), "withheld": cloud.withheld, "coordinates": cloud.crs or "camera axes"}


def _picture(values: NDArray[np.float32], unit: str) -> prints.Bytes:
    known = values[np.isfinite(values)]
    if known.size == 0:
        raise OpenError("no pixel has a known depth, so there is nothing to draw: the scene may lack texture")
    low, high = (float(x) for x in np.quantile(known, [0.01, 0.99]))
    return prints.with_scale(values, low, high, unit)


def _quartiles(values: NDArray[np.float32]) -> list[float] | None:
    known = values[np.isfinite(values)]
    return None if known.size == 0 else [float(x) for x in np.quantile(known, [0.25, 0.5, 0.75])]
