"""Export light fields in other tools' formats: HCI's folder, ESLF, LFToolbox' .mat, quilts, Rerun recordings.

Views are ordered so that a camera further right sees near things further left, and one further down sees them further
up, as those tools expect. Values become 8 or 16 bits with `white` (a share of the sensor's, 1.0) as the brightest; it
is written beside them.
"""

from __future__ import annotations

import configparser
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import io

from dappled.decode.depth import DepthMap, DistanceMap
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.errors import DappledError
from dappled.products import png_files
from dappled.products.exports import point_cloud, prints
from dappled.products.extras import need
from dappled.products.whole_files import whole

ESLF_LENSLET_PX = 14  # LFToolbox' and LiFF's readers assume this size
_LARGEST_MAT = 2**31 - 1  # bytes of one variable in a version 5 file


def as_cameras(stack: ViewStack) -> NDArray[np.float32]:
    """The views (V, U, h, w(, 3)) in the order of cameras: rows from the top one, columns from the left one."""
    views = stack.views
    if stack.row_steps[-1] > stack.row_steps[0]:
        views = views[::-1]
    if stack.column_steps[-1] > stack.column_steps[0]:
        views = views[:, ::-1]
    return views


def hci(path: Path, field: LightField, depth: DepthMap | None = None) -> None:
    """Write a folder of HCI's 4D light field benchmark: input_Cam000.png …, parameters.cfg and, with a depth map,
    disp_estimate.pfm (NaN where unknown). Raises DappledError."""
    stack = ViewStack.of(field)
    views = as_cameras(stack)
    white = prints.white_of([views])

    with whole(path, fresh=True) as folder:
        folder.mkdir()
        for number, view in enumerate(views.reshape(-1, *views.shape[2:])):
            picture = prints.toned(view, white)
            rgb = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
            Image.fromarray(rgb).save(folder / f"input_Cam{number:03d}.png")
        with (folder / "parameters.cfg").open("w", encoding="utf-8") as file:
            _parameters(field, stack, white, depth).write(file)
        if depth is not None:
            write_pfm(folder / "disp_estimate.pfm", depth.disparity)


def eslf(path: Path, field: LightField, lenslet_px: int = 0) -> None:
    """Write an ESLF image: a 16-bit PNG in which each pixel of the views is a lenslet of `lenslet_px`² pixels.

    0 takes the number of views per axis; more leave black pixels around them. Size and white are written to a .txt of
    the same name. Raises DappledError, also where either file exists.
    """
    views = as_cameras(ViewStack.of(field))
    side = lenslet_px or max(views.shape[:2])
    if side < max(views.shape[:2]):
        raise DappledError(f"{views.shape[0]} × {views.shape[1]} views don't fit into lenslets of {side} px")
    values, white = _sixteen_bits(views)
    count_v, count_u, height, width = values.shape[:4]
    colours = values.shape[4:]
    sheet = np.zeros((height, side, width, side, *colours), dtype=np.uint16)
    top, left = (side - count_v) // 2, (side - count_u) // 2
    order = (2, 0, 3, 1, *range(4, values.ndim))
    sheet[:, top : top + count_v, :, left : left + count_u] = values.transpose(order)
    flat = sheet.reshape(height * side, width * side, *colours)

    beside = path.with_suffix(".txt")
    if beside.exists():
        raise DappledError(f"{beside} exists already; choose another name")
    with whole(path, fresh=True) as part:
        png_files.write(part, (flat.shape[0], flat.shape[1]), 16, [flat], rgb=bool(colours), effort=4)
    note = f"lenslet_px = {side}\nviews = {count_v} x {count_u}\nwhite = {white:.6g}\n"
    with whole(beside, fresh=True) as part:
        part.write_text(note, encoding="utf-8")


def mat(path: Path, field: LightField) -> None:
    """Write a MATLAB version 5 file as LFToolbox' LFUtilDecodeLytroFolder does: `LF` uint16 [t, s, v, u, c], c red,
    green, blue and weight. Raises DappledError."""
    values, white = _sixteen_bits(as_cameras(ViewStack.of(field)))
    rgb = values if values.ndim == 5 else np.repeat(values[..., None], 3, axis=4)
    weight = np.full((*rgb.shape[:4], 1), 65535, dtype=np.uint16)
    lf = np.concatenate([rgb, weight], axis=4)
    if lf.nbytes > _LARGEST_MAT:
        raise DappledError(
            f"{path}: {lf.nbytes / 1e9:.1f} GB don't fit into a version 5 .mat file; export as h5 instead"
        )
    content = {
        "LF": lf,
        "DecodeOptions": {"NColChans": 3, "NWeightChans": 1, "Precision": "single", "White": white},
        "GeneratedByInfo": {"mfilename": "dappled"},
        "LFMetadata": {key: value for key, value in field.attributes.items() if isinstance(value, str | int | float)},
    }
    with whole(path, fresh=True) as part, part.open("wb") as file:
        io.savemat(file, content, format="5", do_compression=True)


def quilt(path: Path, field: LightField, *, disparity: float = 0.0) -> Path:
    """Write a quilt for a light-field display: the middle row's views from left (bottom left) to right, converging on a
    disparity. Returns the path, whose name ends in `_qs<columns>x<rows>a<aspect>`. Raises DappledError."""
    stack = ViewStack.of(field)
    middle = int(np.argmin(np.abs(stack.row_steps)))
    order = np.argsort(-stack.column_steps)  # the left camera has the largest step
    pictures = []
    for u in order:
        weights = np.zeros(stack.views.shape[:2])
        weights[middle, u] = 1
        pictures.append(np.nan_to_num(shift_and_add(stack, disparity, weights=weights)))
    white = prints.white_of(pictures)
    count = len(pictures)
    rows = max(r for r in range(1, math.isqrt(count) + 1) if count % r == 0)
    columns = count // rows
    eight = [prints.toned(p, white) for p in pictures]
    lines = [np.concatenate(eight[r * columns : (r + 1) * columns], axis=1) for r in range(rows)]
    sheet = np.concatenate(lines[::-1], axis=0)  # the first row is the lowest
    height, width = pictures[0].shape[:2]
    named = path.with_name(f"{path.stem}_qs{columns}x{rows}a{width / height:.3f}.png")
    with whole(named, fresh=True) as part:
        Image.fromarray(sheet).save(part)
    return named


def write_pfm(path: Path, values: NDArray[np.float32]) -> None:
    """Write a PFM of one channel, little endian, rows from the bottom, as HCI's tools do."""
    height, width = values.shape
    with path.open("wb") as file:
        file.write(f"Pf\n{width} {height}\n-1.0\n".encode())
        file.write(np.ascontiguousarray(values[::-1], dtype="<f4").tobytes())


def _parameters(field: LightField, stack: ViewStack, white: float, depth: DepthMap | None) -> configparser.ConfigParser:
    said = field.attributes
    height, width = stack.views.shape[2:4]
    length, stop = said.get("focal_length_mm"), said.get("f_number")
    baseline_mm = length / stop / max(stack.views.shape[:2]) if length and stop else 0.0
    known = depth is not None and depth.known.any()
    low, high = np.nanquantile(depth.disparity, [0, 1]) if known and depth is not None else (0.0, 0.0)
    parser = configparser.ConfigParser()
    parser["intrinsics"] = {
        "focal_length_mm": f"{length or 0:g}",
        "image_resolution_x_px": str(width),
        "image_resolution_y_px": str(height),
        "sensor_size_mm": "0",
        "fstop": f"{stop or 0:g}",
    }
    parser["extrinsics"] = {
        "num_cams_x": str(stack.views.shape[1]),
        "num_cams_y": str(stack.views.shape[0]),
        "baseline_mm": f"{baseline_mm:.6g}",
        "focus_distance_m": "0",
        **{f"center_cam_{axis}_m": "0" for axis in "xyz"},
        **{f"center_cam_r{axis}_rad": "0" for axis in "xyz"},
    }
    parser["meta"] = {
        "scene": str(said.get("source", "dappled")),
        "category": "recorded",
        "disp_min": f"{float(low):.3f}",
        "disp_max": f"{float(high):.3f}",
        "version": "1",
    }
    parser["dappled"] = {"white": f"{white:.6g}", "note": "0 where the light field does not say"}
    return parser


def _sixteen_bits(views: NDArray[np.float32]) -> tuple[NDArray[np.uint16], float]:
    white = prints.white_of([views])
    made = np.rint(65535 * np.clip(np.nan_to_num(views) / white, 0, 1)).astype(np.uint16)
    return made, white


def rerun(
    path: Path,
    field: LightField,
    picture: NDArray[np.float32],
    depth: DepthMap | None = None,
    distances: DistanceMap | None = None,
) -> None:
    """Write a recording (.rrd) for the Rerun viewer: `view/v/u`, `picture`, `disparity`, `sigma`, and `points` where
    distances are known. Nothing is sent anywhere. Raises DappledError without the extra `rerun`.
    """
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    rr = need("rerun")
    if path.suffix != ".rrd":
        raise DappledError(f"{path}: the name of a Rerun recording must end in .rrd")
    with whole(path, fresh=True) as part:
        recording = rr.RecordingStream("dappled")
        recording.save(str(part))
        stack = ViewStack.of(field)
        white = prints.white_of([stack.views])
        for v, line in enumerate(stack.views):
            for u, view in enumerate(line):
                recording.log(f"view/{v}/{u}", rr.Image(prints.toned(view, white)), static=True)
        recording.log("picture", rr.Image(prints.toned(picture, prints.white_of([picture]))), static=True)
        if depth is not None:
            recording.log("disparity", rr.DepthImage(np.nan_to_num(depth.disparity)), static=True)
            recording.log("sigma", rr.DepthImage(np.nan_to_num(depth.sigma)), static=True)
        if distances is not None:
            cloud = point_cloud.of(field, picture, distances)
            colours = (cloud.colours >> 8).astype(np.uint8)
            recording.log("points", rr.Points3D(cloud.points.astype(np.float32), colors=colours), static=True)
        recording.flush()
        recording.disconnect()
