"""A recording for the Rerun viewer: views, picture, depth and points. Needs the extra `rerun`; nothing is sent."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.depth.depth_map import DepthMap
from dappled.decode.depth.ranging import DistanceMap
from dappled.decode.lightfield import view_stack
from dappled.decode.lightfield.light_field import LightField
from dappled.errors import DappledError
from dappled.products.exports import point_cloud, prints


class RerunError(DappledError):
    """A recording can't be written; one sentence."""


def write(
    path: Path,
    field: LightField,
    picture: NDArray[np.float32],
    depth: DepthMap | None = None,
    distances: DistanceMap | None = None,
) -> None:
    """Write an .rrd file: `view/v/u`, `picture`, `disparity`, `sigma`, and `points` where distances are known.

    Raises RerunError without the extra.
    """
    rr = _rerun()
    if path.suffix != ".rrd":
        raise RerunError(f"{path}: a Rerun recording is written as .rrd; name it so")
    recording = rr.RecordingStream("dappled")
    recording.save(str(path))
    stack = view_stack.of(field)
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


def _rerun() -> Any:
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    try:
        import rerun  # noqa: PLC0415  optional: an extra of 764 MB
    except ImportError as error:
        raise RerunError("a Rerun recording needs its library: pip install 'dappled[rerun]'") from error
    return rerun
