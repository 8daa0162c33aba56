"""The rest of a plan, for docs/maps.md: PYTHONPATH=. python tools/rest_picture.py docs/pictures/map-rest.png

Records half of a simulated survey (three of its photographs came to nothing), lets `dappled flight coverage` say what
is left and write its mission, and draws both on one map. Prints what the command prints.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import rasterio
from matplotlib import colors
from matplotlib import pyplot as plt
from tests.flight.makers import deliver, request
from tests.products.flown import START_NS
from tests.products.maps.test_coverage import HOME, PROJECTION, square, survey

from dappled.clock import RecordedClock
from dappled.flight import Tag, recording

HALF_M, LOST, BODY_S = 80.0, (10, 11, 12), 3.0
SEED = 5
WAYPOINT, DISTANCE = 16, 206  # MAV_CMD


def fly(folder: Path) -> tuple[Path, list[tuple[float, float]]]:
    """(flight folder, places of the photographs) of the half that one battery carried."""
    planned = survey(np.random.default_rng(SEED), HALF_M, lost=0.0)
    begun = recording.begin(folder, RecordedClock(START_NS))
    taken = [one for number, one in enumerate(planned[: len(planned) // 2]) if number not in LOST]
    for index, one in enumerate(taken):
        request(begun, index)
        frame = deliver(begun, index, b"a photograph", f"IMG_{index:04d}.CR2")
        at = START_NS + index * round(BODY_S * 1e9)
        begun.ledger.add_tag(recorded(one.tag, index, frame.sha256, at))
    begun.close()
    return begun.folder.path, [metres(one.camera.latitude_deg, one.camera.longitude_deg) for one in taken]


def recorded(tag: Tag, index: int, sha256: str, utc_ns: int) -> Tag:
    """A tag of a frame on disk, with the pose of a fix by RTK."""
    pose = replace(tag.pose, utc_ns=utc_ns, position_sigma_m=0.02, attitude_sigma_rad=0.001, age_ms=1.0)
    return replace(tag, index=index, utc_ns=utc_ns, frame_sha256=sha256, pose=pose)


def metres(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """East and north of home."""
    east, north = PROJECTION.to_map(latitude_deg, longitude_deg)
    return float(east - HOME[0]), float(north - HOME[1])


def main(picture: Path, folder: Path) -> None:
    mpl.use("Agg")
    flight, places = fly(folder / "flights")
    ring = [[longitude, latitude] for latitude, longitude in square(HALF_M).rings[0]]
    (folder / "field.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}))
    words: list[str | Path] = [
        "--area",
        folder / "field.geojson",
        "--refly",
        folder / "rest.plan",
        "-o",
        folder / "seen",
    ]
    command = ["dappled", "flight", "coverage", flight, *words]
    made = subprocess.run(command, check=False, text=True, stdout=subprocess.PIPE)  # 1: there are holes
    print(made.stdout)
    with rasterio.open(folder / "seen" / "coverage.tif") as read:
        frames, _, holes = read.read()
        box = read.bounds
    figure, axes = plt.subplots(figsize=(7.0, 6.2), layout="constrained")
    extent = (box.left - HOME[0], box.right - HOME[0], box.bottom - HOME[1], box.top - HOME[1])
    seen = axes.imshow(np.where(frames > 0, frames, np.nan), cmap="Blues", vmin=0, vmax=8, extent=extent)
    axes.imshow(np.where(holes > 0, 1.0, np.nan), cmap=colors.ListedColormap(["#f4a29a"]), extent=extent)
    figure.colorbar(seen, ax=axes, label="frames that saw the ground", shrink=0.7)
    x, y = np.array([metres(latitude, longitude) for longitude, latitude in [*ring, ring[0]]]).T
    axes.plot(x, y, color="black", lw=1.4, label="the planned area")
    axes.plot(*np.array(places).T, "o", color="#08306b", ms=3.5, label=f"taken: {len(places)} photographs")
    items = json.loads((folder / "rest.plan").read_text())["mission"]["items"]
    way = [metres(*one["params"][4:6]) for one in items if one["command"] == WAYPOINT]
    axes.plot(*np.array(way).T, "-", color="#b30000", lw=1.4, label="left: the mission that was written")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=8, frameon=False)
    axes.set_xlabel("m east of home")
    axes.set_ylabel("m north of home")
    axes.set_xlim(-110, 110)
    axes.set_ylim(-105, 105)
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    with tempfile.TemporaryDirectory() as kept:
        main(Path(sys.argv[1]), Path(kept))
