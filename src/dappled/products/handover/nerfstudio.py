"""Write a flight as nerfstudio's transforms.json, an entry for each view of each frame.

https://docs.nerf.studio/quickstart/data_conventions.html: camera axes right, up, backward; a camera-to-world matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dappled.products.handover import view_cameras, view_files
from dappled.products.handover.view_cameras import FrameCameras
from dappled.products.whole_files import write_json

_TO_OPENGL = np.diag([1.0, -1.0, -1.0])  # right, down, forward → right, up, backward


def write_transforms(folder: Path, frames: Sequence[FrameCameras]) -> list[Path]:
    """Write transforms.json, the world's origin in it; returns its path. Raises OSError."""
    frames = view_cameras.of_one_aperture(frames)
    world = view_cameras.world_of(frames)
    entries: list[dict[str, Any]] = []
    for one in frames:
        to_world, centre = world.place(one)
        k1, k2, p1, p2, k3 = one.distortion
        for view in one.views:
            pose = np.eye(4)
            pose[:3, :3] = to_world @ _TO_OPENGL
            pose[:3, 3] = centre + to_world @ np.array(view.centre_m)
            entries.append(
                {
                    "file_path": view_files.picture(view.name, one.name),
                    "transform_matrix": pose.tolist(),
                    "w": one.shape[1],
                    "h": one.shape[0],
                    "fl_x": view.focal_px[0],
                    "fl_y": view.focal_px[1],
                    "cx": view.principal_px[0],
                    "cy": view.principal_px[1],
                    "k1": k1,
                    "k2": k2,
                    "k3": k3,
                    "k4": 0.0,
                    "p1": p1,
                    "p2": p2,
                }
            )
    origin = {**world.said(), "views": view_cameras.provisos(frames)}
    said = {"camera_model": "OPENCV", "origin": origin, "frames": entries}
    return [write_json(folder / "transforms.json", said)]
