"""Heights of simulated flights, for docs/maps.md: PYTHONPATH=. python tools/terrain_pictures.py docs/pictures [FOLDER]

Two flights over one field, in the time of the simulated path; before the second one earth was moved from a pit to a
heap, and more was brought. Recorded poses err by their σ. The verbs of `dappled` do the rest: georeference, terrain
volume and contours. Prints what the verbs print, and the true volumes. FOLDER keeps the files between.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import rasterio
from matplotlib import colors
from matplotlib import pyplot as plt
from PIL import Image
from tests.products import flown

from dappled.clock import RecordedClock
from dappled.decode.array_types import Floats, Singles
from dappled.decode.geometry import camera_pose, from_euler, metres_per_radian
from dappled.flight import recording
from dappled.mocks import simulation
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.flyover import TerrainScene
from dappled.mocks.scene.landscape import EXTENT_M, TEXEL_M
from dappled.products.maps import heights
from dappled.products.maps.earth import Projection

SEED, FRAMES, EVERY_S = 3, 12, 0.39
STARTS_S = 14.3, 14.42  # of the two flights, along the simulated path
POSITION_M, ATTITUDE_RAD = 0.02, 0.001  # σ of what is recorded
HEAP = (-24.6, 0.6, 2.0, 0.9)  # metres north and east of home, radius and height
PIT = (-24.4, -5.2, 1.6, -0.6)
STABLE = ((-26.0, -2.6, -23.2, -1.6), (-26.0, -9.2, -23.0, -7.4))  # south, west, north, east of home
AREA = (-26.8, -7.2, -22.2, 2.9)
INTERVAL_M, SMOOTH_M = 0.25, 0.3
LABELLED_M, LABELS_TO_M = 1.5, 17.5  # shorter lines, and those of the roof farther east, have no room for a height


def earthwork(shape: tuple[int, int]) -> Singles:
    """The change of height between the flights."""
    axis = (np.arange(shape[0]) - shape[0] // 2) * TEXEL_M
    made = np.zeros(shape)
    for north, east, radius, height in (HEAP, PIT):
        away = np.hypot(-axis[:, None] - north, axis[None, :] - east) / radius
        made += np.where(away < 1, height * (1 + np.cos(np.pi * np.minimum(away, 1))) / 2, 0)
    return made.astype(np.float32)


def fly(folder: Path, start_s: float, *, moved: bool) -> list[str]:
    """A flight on disk; the words that `georeference` needs for it."""
    camera = flown.half_camera(SEED, FlightPath(SEED))
    scene = camera.scene
    assert isinstance(scene, TerrainScene)
    if moved:
        ground = replace(scene.ground, relief=scene.ground.relief + earthwork(scene.ground.relief.shape))
        camera = replace(camera, scene=replace(scene, ground=ground))
    chance = np.random.default_rng([SEED, int(moved)])
    begun = recording.begin(folder / "flights", RecordedClock(flown.START_NS))
    for index in range(FRAMES):
        exposure = camera.expose(start_s + index * EVERY_S, index, f_number=flown.F_NUMBER)
        true = exposure.truth.pose
        assert true is not None
        pose = flown.as_recorded(true)
        north, east, up = chance.normal(0, POSITION_M, 3)
        turn = from_euler(*chance.normal(0, ATTITUDE_RAD, 3))
        matrix = camera_pose.matrix_of(turn)
        pose = replace(
            pose,
            latitude_rad=(latitude := math.radians(true.latitude_deg)) + north / 6.37e6,
            longitude_rad=math.radians(true.longitude_deg) + east / 6.37e6 / math.cos(latitude),
            altitude_msl_m=true.altitude_msl_m + up,
            attitude=flown.turned(true.attitude, matrix),
        )
        flown.record(begun, index, exposure.file, flown.F_NUMBER, pose)
    begun.close()
    calibration = simulation.write_calibration(camera, folder)
    recipe = ["--camera", simulation.CAMERA, "--mask", simulation.MASK, "--calibration", str(calibration)]
    return [str(begun.folder.path), *recipe]


def dappled(*words: str | Path) -> str:
    """What a verb prints."""
    made = subprocess.run(["dappled", *map(str, words)], check=True, text=True, stdout=subprocess.PIPE)
    print(made.stdout)
    return made.stdout


def drawn_area(path: Path, boxes: tuple[tuple[float, float, float, float], ...]) -> Path:
    """A GeoJSON of rectangles, metres from home."""
    home = FlightPath(SEED)
    polygons = []
    for south, west, north, east in boxes:
        ring = [(south, west), (south, east), (north, east), (north, west), (south, west)]
        polygons.append([[list(reversed(place(home, *corner))) for corner in ring]])
    path.write_text(json.dumps({"type": "MultiPolygon", "coordinates": polygons}))
    return path


def place(home: FlightPath, north_m: float, east_m: float) -> tuple[float, float]:
    """(latitude, longitude) of metres from home."""
    per_north, per_east = metres_per_radian(math.radians(home.home_latitude_deg), home.home_altitude_msl_m)
    return (
        home.home_latitude_deg + math.degrees(north_m / per_north),
        home.home_longitude_deg + math.degrees(east_m / per_east),
    )


def outline(axes: Any, path: Path, projection: Projection, origin: tuple[float, float], **style: Any) -> None:
    """Draw the rings of a GeoJSON."""
    for polygon in json.loads(path.read_text())["coordinates"]:
        longitude, latitude = np.array(polygon[0]).T
        east, north = projection.to_map(latitude, longitude)
        axes.plot(east - origin[0], north - origin[1], **style)


def shaded(raster: heights.HeightRaster) -> Floats:
    """Heights lit from the north-west."""
    return np.asarray(
        colors.LightSource(315, 40).hillshade(
            np.where(np.isfinite(raster.height_m), raster.height_m, np.nan), vert_exag=1, dx=raster.grid.step_x,
            dy=raster.grid.step_y,
        )
    )  # fmt: skip


def volumes(folder: Path, before: Path, after: Path, picture: Path) -> None:
    """Two hillshades and the change between them."""
    area, stable = drawn_area(folder / "area.geojson", (AREA,)), drawn_area(folder / "stable.geojson", STABLE)
    dappled("terrain", "volume", before, after, "--area", area)
    dappled("terrain", "volume", before, after, "--area", area, "--stable", stable)
    told = json.loads(dappled("terrain", "volume", before, after, "--area", area, "--stable", stable, "--json"))
    one, two = heights.read(before), heights.read(after)
    truth = earthwork((round(EXTENT_M / TEXEL_M),) * 2) * TEXEL_M**2
    print(f"true fill {truth[truth > 0].sum():.2f}, cut {-truth[truth < 0].sum():.2f} m³")
    change = heights.resampled(two.height_m, two.grid, one.grid) - one.height_m - told["levelled_m"]
    figure, all_axes = plt.subplots(3, 1, figsize=(7.6, 8.6), sharex=True, sharey=True, layout="constrained")
    west, south, _, _ = one.grid.bounds
    for axes, raster, name in ((all_axes[0], one, "before"), (all_axes[1], two, "after")):
        box = raster.grid.bounds
        extent = (box[0] - west, box[2] - west, box[1] - south, box[3] - south)
        axes.imshow(shaded(raster), cmap="gray", extent=extent, interpolation="nearest")
        axes.set_title(name, loc="left", fontsize=10)
    box = one.grid.bounds
    shown = all_axes[2].imshow(
        change, cmap="RdBu", vmin=-0.9, vmax=0.9, extent=(0, box[2] - west, 0, box[3] - south), interpolation="nearest"
    )
    parts = "cells_sigma_m3", "level_sigma_m3"
    work = {name: (told[name], math.hypot(*(told[name][part] for part in parts))) for name in ("fill", "cut", "net")}
    words = ", ".join(f"{name} {one['volume_m3']:.2f} ± {sigma:.2f} m³" for name, (one, sigma) in work.items())
    all_axes[2].set_title(f"change: {words}", loc="left", fontsize=10)
    outline(all_axes[2], area, one.projection, (west, south), color="black", lw=1.2)
    outline(all_axes[2], stable, one.projection, (west, south), color="black", lw=1.2, ls=":")
    figure.colorbar(shown, ax=all_axes, label="change of height, m", shrink=0.5)
    all_axes[2].set_xlabel("m to the east")
    all_axes[2].set_xlim(0, 24)
    all_axes[2].set_ylim(0, 11.5)
    figure.savefig(picture, dpi=100)
    plt.close(figure)


def contours(folder: Path, flight: Path, picture: Path) -> None:
    """Lines over the mosaic."""
    lines = folder / "contours.geojson"
    lines.unlink(missing_ok=True)
    dappled("terrain", "contours", flight, "--interval", str(INTERVAL_M), "--smooth", str(SMOOTH_M), "-o", lines)
    raster = heights.read(flight)
    with rasterio.open(flight / "maps" / "mosaic.tif") as read:
        box, bands = read.bounds, read.read()
    picture_bands = np.where(bands[3] > 0, bands[:3], 255).transpose(1, 2, 0).astype(np.uint8)
    figure, axes = plt.subplots(figsize=(7.6, 4.0), layout="constrained")
    axes.imshow(picture_bands, extent=(0, box.right - box.left, 0, box.top - box.bottom))
    labels: list[tuple[float, float]] = []  # each stands where its line is farthest from the others
    for feature in json.loads(lines.read_text())["features"]:
        longitude, latitude = np.array(feature["geometry"]["coordinates"]).T
        east, north = raster.projection.to_map(latitude, longitude)
        major = feature["properties"]["major"]
        x, y = east - box.left, north - box.bottom
        axes.plot(x, y, color="#7a1f00", lw=1.8 if major else 0.8)
        if np.hypot(np.diff(x), np.diff(y)).sum() > LABELLED_M and x.mean() < LABELS_TO_M:
            apart = [min((math.dist(one, at) for at in labels), default=0.0) for one in zip(x, y, strict=True)]
            labels.append(at := (x[best := int(np.argmax(apart))], y[best]))
            axes.text(
                *at, f"{feature['properties']['height_m']:.2f}", color="#7a1f00", fontsize=7, ha="center",
                va="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85},
                weight="bold" if major else "normal",
            )  # fmt: skip
    axes.set_xlabel("m to the east")
    figure.savefig(picture, dpi=100)
    Image.open(picture).convert("RGB").quantize(96).save(picture, optimize=True)
    plt.close(figure)


def main(pictures: Path, folder: Path) -> None:
    mpl.use("Agg")
    flights = []
    for number, start_s in enumerate(STARTS_S):
        begun = folder / str(number)
        if not begun.exists():
            words = fly(begun, start_s, moved=number == 1)
            dappled("georeference", *words, "--as", "cog", "terrain", "--refine", "neighbours", "--gsd", "0.04")
        flights.append(next((begun / "flights").glob("*Z-*")))
    volumes(folder, flights[0], flights[1], pictures / "map-volumes.png")
    contours(folder, flights[1], pictures / "map-contours.png")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    with tempfile.TemporaryDirectory() as kept:
        main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) == 3 else kept))
