"""Write a flight as a COLMAP model: a rig of view cameras, a frame for each photograph, poses, and priors.

https://colmap.github.io/format.html and /rigs.html; text files, as COLMAP 3.12 and later read them.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dappled import durable
from dappled.decode.array_types import Floats
from dappled.decode.geometry import field_of_view
from dappled.errors import DappledError
from dappled.products.handover import view_cameras, view_files
from dappled.products.handover.view_cameras import FrameCameras, LocalAxes, ViewCamera

_RIG_COLUMNS = (
    "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, "
    "SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])"
)
_FRAME_COLUMNS = (
    "# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, "
    "DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
)
_FORWARD: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

_Rig = tuple[tuple[int, int], tuple[float, ...], tuple[ViewCamera, ...]]


def write_model(folder: Path, frames: Sequence[FrameCameras]) -> list[Path]:
    """Write sparse/0: rigs, cameras, frames, images, points3D, priors.csv and origin.json; returns their paths.

    It replaces an earlier model as a whole. Raises DappledError where somebody else put files there, and OSError.
    """
    frames = view_cameras.of_one_aperture(frames)
    world = view_cameras.world_of(frames)
    origin = {**world.said(), "views": view_cameras.provisos(frames)}
    rigs: dict[_Rig, int] = {}
    for one in frames:
        rigs.setdefault(_rig(one), len(rigs) + 1)
    texts = {
        "cameras.txt": _cameras(rigs),
        "rigs.txt": _rigs(rigs),
        "frames.txt": _frames(rigs, frames, world),
        "images.txt": _images(rigs, frames, world),
        "points3D.txt": "# No points: triangulate them with colmap point_triangulator\n",
        "priors.csv": priors(frames, world),
        "origin.json": json.dumps(origin, indent=1, allow_nan=False, ensure_ascii=False) + "\n",
    }
    final = folder / "sparse" / "0"
    theirs = sorted(path.name for path in final.iterdir() if path.name not in texts) if final.is_dir() else []
    if theirs:
        raise DappledError(f"{final} holds {theirs[0]}, which no batch wrote: move the folder, and run it again")
    durable.make_folder(final.parent)
    with durable.replacing(final) as part:
        part.mkdir()
        for name, text in texts.items():
            durable.write_file(part / name, text.encode())
    return [final / name for name in texts]


def priors(frames: Sequence[FrameCameras], world: LocalAxes) -> str:
    """CSV: what is known of each frame's pose before any adjustment, in the model's axes (m) and geodetic; σ 1 standard
    deviation, empty where unknown. `sigma_horizontal_m` is of the distance; along east or north alone it is 0.71 times
    that."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(
        ["frame", "east_m", "north_m", "up_m", "sigma_horizontal_m", "sigma_vertical_m", "sigma_attitude_rad",
         "latitude_deg", "longitude_deg", "altitude_m", "aperture_m", "sigma_aperture_m", "aperture_from", "focus_m"]
    )  # fmt: skip
    for one in frames:
        _, centre = world.place(one)
        sigmas = one.position_sigma_m, one.vertical_sigma_m, one.attitude_sigma_rad
        of_aperture = [
            *("" if value is None else f"{value:.9g}" for value in (one.aperture_m, one.aperture_sigma_m)),
            one.aperture_from,
            "infinity" if one.focus_m is None else f"{one.focus_m:g}",
        ]
        known = ["" if value is None else f"{value:g}" for value in sigmas]
        rows.writerow(
            [one.name, *(f"{value:.6f}" for value in centre), *known,
             f"{one.latitude_deg:.11f}", f"{one.longitude_deg:.11f}", f"{one.altitude_m:.6f}", *of_aperture]
        )  # fmt: skip
    return text.getvalue()


def _rig(one: FrameCameras) -> _Rig:
    """What frames must share to be taken by one rig."""
    return one.shape, one.distortion, one.views


def _first_camera(rig: int, rigs: dict[_Rig, int]) -> int:
    """The number of a rig's first camera."""
    return 1 + sum(len(views) for (_, _, views), number in rigs.items() if number < rig)


def _cameras(rigs: dict[_Rig, int]) -> str:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for (shape, distortion, views), rig in rigs.items():
        model, more = camera_model(distortion)
        for number, view in enumerate(views, _first_camera(rig, rigs)):
            numbers = (*view.focal_px, *view.principal_px, *more)
            lines.append(f"{number} {model} {shape[1]} {shape[0]} {_words(numbers)}")
    return "\n".join(lines) + "\n"


def camera_model(distortion: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """The simplest of COLMAP's models that holds OpenCV's k1, k2, p1, p2, k3, and its parameters after the principal
    point: many readers know but the first."""
    k1, k2, p1, p2, k3 = distortion
    if not any(distortion):
        return "PINHOLE", ()
    return ("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)) if k3 else ("OPENCV", (k1, k2, p1, p2))


def _rigs(rigs: dict[_Rig, int]) -> str:
    lines = [_RIG_COLUMNS]
    for (_, _, views), rig in rigs.items():
        first, middle = _first_camera(rig, rigs), view_cameras.middle(views)
        words = [f"{rig} {len(views)} CAMERA {first + middle}"]
        for n, view in enumerate(views):
            if n != middle:
                away = np.array(views[middle].centre_m) - np.array(view.centre_m)
                words.append(f"CAMERA {first + n} 1 {_words((*_FORWARD, *away.tolist()))}")
        lines.append(" ".join(words))
    return "\n".join(lines) + "\n"


def _frames(rigs: dict[_Rig, int], frames: Sequence[FrameCameras], world: LocalAxes) -> str:
    lines = [_FRAME_COLUMNS]
    image = 1
    for number, one in enumerate(frames, 1):
        rig = rigs[_rig(one)]
        first = _first_camera(rig, rigs)
        shown = [f"CAMERA {first + n} {image + n}" for n in range(len(one.views))]
        image += len(one.views)
        pose = _words(_from_world(one, one.views[view_cameras.middle(one.views)], world))
        lines.append(f"{number} {rig} {pose} {len(shown)} {' '.join(shown)}")
    return "\n".join(lines) + "\n"


def _images(rigs: dict[_Rig, int], frames: Sequence[FrameCameras], world: LocalAxes) -> str:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    image = 1
    for one in frames:
        first = _first_camera(rigs[_rig(one)], rigs)
        for n, view in enumerate(one.views):
            name = view_files.picture(view.name, one.name).removeprefix("images/")
            lines += [f"{image} {_words(_from_world(one, view, world))} {first + n} {name}", ""]
            image += 1
    return "\n".join(lines) + "\n"


def _from_world(one: FrameCameras, view: ViewCamera, world: LocalAxes) -> tuple[float, ...]:
    """Quaternion (w, x, y, z) and translation from world to a view's camera axes."""
    to_world, centre = world.place(one)
    place: Floats = centre + to_world @ np.array(view.centre_m)
    return (*field_of_view.quaternion(to_world.tolist()), *(-to_world.T @ place).tolist())


def _words(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in numbers)
