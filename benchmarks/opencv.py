"""What depth and maps cost beside OpenCV, in one run. A pair is two views of the 81 or 25: it shows the least that a
depth map can cost, and the bad pixels (more than 0.07 px/view off, or unknown) what the other views are good for.

python benchmarks/opencv.py [--json] [--rounds 5] [--workers 2]

Depth of a grey light field, from views to the map, the search for the range in it, against StereoSGBM on one rectified
pair of the same size: the middle view and the leftmost, 8-bit pictures made before, the true range told, five paths.
`pairs` is OpenCV's matcher on light fields as `dappled depth --method stereo` uses it: the middle view against the four
outer ones, enlarged for disparities of less than a pixel. `bad_pixels` counts the pixels that a bare pair can know: the
left margin of its search and 15 px at the edges are left out. A map is that of one view of 1388 × 1844 px, drawn tile
by tile at its own ground sample distance on flat ground, against warpPerspective onto the same grid with the same
interpolation; `map_differs_rms` is how far the two pictures are apart where both show the view (1 = white). CPU times
are of all threads together; ratios are medians of paired rounds.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the painted scenes are the tests' own

from limits import show
from tests.decode.scenes import boards, noise, paint

from dappled.decode.array_types import Floats, Singles
from dappled.decode.depth import estimate, evidence
from dappled.decode.depth.stereo import opencv
from dappled.decode.lightfield import ViewStack
from dappled.products.maps import map_grid
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.eye import Eye, turn
from dappled.products.maps.ground import Flat
from dappled.products.maps.photographs import Photograph
from decode import ratios, timed

cv2 = opencv()
ROUNDS, WORKERS = 5, 2
BORDER, BAD = 15, 0.07
BLOCK, SIXTEENTHS = 5, 16
VIEW, FOCAL_PX, HEIGHT_M, TILT_RAD = (1388, 1844), 2500.0, 40.0, (0.05, -0.03, 0.4)
PLACE_DEG = (47.4, 8.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"measurements each (default: {ROUNDS})")
    parser.add_argument("--workers", type=int, default=WORKERS, help=f"threads of each (default: {WORKERS})")
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.workers)
    wide = paint(boards(1, 512, 3.0, 14), (512, 512), 9, seed=1)
    narrow = paint(boards(2, 572, 0.6, 10), (572, 566), 5, seed=2)
    figures = {
        **depth("81_views_512", *wide, arguments.rounds, arguments.workers),
        **depth("25_views_572x566", *narrow, arguments.rounds, arguments.workers),
        **one_map(arguments.rounds),
    }
    show("opencv", figures, as_json=arguments.json)


def depth(name: str, stack: ViewStack, truth: Singles, rounds: int, workers: int) -> dict[str, float]:
    """Figures of one light field."""
    left, right, between, baseline = pair(stack, truth)
    matcher, margin = sgbm(*between)
    works: dict[str, Callable[[], Any]] = {
        "depth": lambda: estimate.estimate(evidence.of_views(stack), workers=workers).disparity,
        "pairs": lambda: estimate.estimate(evidence.of_views(stack), "stereo", workers=workers).disparity,
        "sgbm": lambda: matcher.compute(left, right),
    }
    taken = in_turn(works, rounds)
    figures = {f"{work}_{name}_cpu_ms": median(cpu for _, cpu in times) for work, times in taken.items()}
    figures |= ratios(f"depth_{name}_over_sgbm", taken["depth"], taken["sgbm"])
    figures |= ratios(f"depth_{name}_over_pairs", taken["depth"], taken["pairs"])
    found = works["sgbm"]()
    matched = np.where(found < between[0] * SIXTEENTHS, np.nan, found / (SIXTEENTHS * baseline))
    cut = slice(BORDER, -BORDER), slice(max(BORDER, margin), -BORDER)
    for work, disparity in (("depth", works["depth"]()), ("pairs", works["pairs"]()), ("sgbm", matched)):
        figures[f"bad_pixels_{work}_{name}"] = float(1 - np.mean(np.abs(disparity - truth)[cut] <= BAD))
    bad = {work: figures[f"bad_pixels_{work}_{name}"] for work in works}
    figures[f"bad_pixels_{name}_over_sgbm"] = bad["depth"] / bad["sgbm"]
    return figures


def pair(stack: ViewStack, truth: Singles) -> tuple[Any, Any, tuple[int, int], float]:
    """(left, right, disparities in px, steps apart): 8-bit pictures, the middle view first, and the true range."""
    v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
    first = int(np.argmin(stack.column_steps))
    low, high = (float(np.quantile(stack.views[v0, u0], q)) for q in (0.001, 0.999))
    eight = [
        np.rint(255 * np.clip((stack.views[v0, u] - low) / (high - low), 0, 1)).astype(np.uint8) for u in (u0, first)
    ]
    baseline = float(stack.column_steps[u0] - stack.column_steps[first])
    between = math.floor(baseline * float(truth.min())) - 1, math.ceil(baseline * float(truth.max())) + 1
    return eight[0], eight[1], between, baseline


def sgbm(low: int, high: int) -> tuple[Any, int]:
    """(the matcher, columns at the left that it can't know) for disparities in px, by OpenCV's advice."""
    count = -(-(high - low + 1) // SIXTEENTHS) * SIXTEENTHS
    matcher = cv2.StereoSGBM_create(
        minDisparity=low, numDisparities=count, blockSize=BLOCK, P1=8 * BLOCK**2, P2=32 * BLOCK**2,
        disp12MaxDiff=2, uniquenessRatio=5, mode=cv2.STEREO_SGBM_MODE_SGBM,
    )  # fmt: skip
    return matcher, count + low + BLOCK


def one_map(rounds: int) -> dict[str, float]:
    """Figures of one view on the map."""
    latitude, longitude = PLACE_DEG
    projection = Projection(utm(latitude, longitude))
    at = projection.at(latitude, longitude)
    rows, columns = VIEW
    matrix = np.array([[FOCAL_PX, 0, (columns - 1) / 2], [0, FOCAL_PX, (rows - 1) / 2], [0, 0, 1]])
    eye = Eye(
        matrix,
        (0.0, 0.0, 0.0, 0.0, 0.0),
        turn(np.array(TILT_RAD)) @ np.diag([1.0, -1.0, -1.0]),
        np.array([at.east, at.north, HEIGHT_M]),
        at.scale,
        VIEW,
    )
    texture = noise(3, 2048)[:rows, :columns]
    image = np.clip(0.5 + 0.15 * texture, 0, 1).astype(np.float32)
    one = Photograph("0000", 0, image, eye, 0.02, 0.001, np.eye(3)[:2])
    ground = Flat(0.0)
    grid = map_grid.grid_of([one], ground, projection, eye.gsd_m(0.0))
    cells = to_pixels(eye, grid)
    size = grid.shape[1], grid.shape[0]

    def ours() -> Singles:
        drawn = np.empty(grid.shape, dtype=np.float32)
        for down, aside, tile in map_grid.pieces([one], grid, ground, projection):
            drawn[down, aside] = tile[..., 0]
        return drawn

    def theirs() -> Any:
        return cv2.warpPerspective(
            image, cells, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderValue=math.nan
        )

    taken = in_turn({"map": ours, "warp": theirs}, rounds)
    figures = {f"{work}_cpu_ms": median(cpu for _, cpu in times) for work, times in taken.items()}
    figures |= ratios("map_over_warp_perspective", taken["map"], taken["warp"])
    figures["map_megapixels"] = grid.shape[0] * grid.shape[1] / 1e6
    difference = ours() - theirs()
    figures["map_known_by_both"] = float(np.isfinite(difference).mean())
    figures["map_differs_rms"] = float(np.sqrt(np.nanmean(difference**2)))
    return figures


def to_pixels(eye: Eye, grid: map_grid.MapGrid) -> Floats:
    """(3, 3) from a cell (column, row, 1) on the ground at height 0 to the view's pixel."""
    across = np.array(
        [
            [grid.step_x, 0, grid.west + 0.5 * grid.step_x - eye.centre[0]],
            [0, -grid.step_y, grid.north - 0.5 * grid.step_y - eye.centre[1]],
            [0, 0, 1],
        ]
    )
    return np.asarray(eye.homography(0.0) @ across)


def in_turn(works: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Each work's (wall, CPU) times, in rounds in which all take turns; a first round is not counted."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for number in range(rounds + 1):
        for name, work in works.items():
            measured = timed(work)
            if number:
                taken[name].append(measured)
    return taken


if __name__ == "__main__":
    main()
