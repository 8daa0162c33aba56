"""How good depth is beside OpenCV's matcher, on light fields with truth: python benchmarks/depth.py [FOLDER …]

Without a FOLDER: scenes that `depth_scenes.py` renders, 9 × 9 views in 8 bits, one of each family and seed. A FOLDER is
in the HCI benchmark's format: a picture for each view, and a .pfm of the middle view's disparity. --masked: the same
scenes as masked frames, decoded. Nothing is tuned on
the scenes of --held-out: look at them once, when all is done. All pixels count; in `bad` unknown ones are bad.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from depth_masked import SNRS, expose
from depth_scenes import FAMILIES, Floats, Rendered, half_bare, render, step
from limits import show

from dappled.decode.depth import DepthMap, estimate, evidence
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield import ViewStack
from dappled.products.exports import view_folders

LIMITS = (0.07, 0.03, 0.01)
SEEDS, HELD_OUT = (1, 2), (301, 302)
METHODS = {"combined": "combined", "opencv": "stereo"}  # what the figures call a method, and we
PLANES = 200  # disparities among which the best constant plane is looked for


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="light fields in HCI's format")
    parser.add_argument("--held-out", action="store_true", help="other seeds, which nothing was tuned on")
    parser.add_argument("--seeds", type=int, nargs="+", help="of the scenes, instead of either")
    parser.add_argument("--masked", action="store_true", help="the same scenes through a mask, decoded: 5 × 5 views")
    parser.add_argument("--side", type=int, default=256, help="height and width of the scenes, px (default: 256)")
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    arguments = parser.parse_args()
    seeds = arguments.seeds or (HELD_OUT if arguments.held_out else SEEDS)
    if arguments.folders:
        found = {folder.name: scored(*_plain(*of_folder(folder))) for folder in arguments.folders}
    elif arguments.masked:
        found = on_masked(seeds, arguments.side)
    else:
        found = on_scenes(seeds, arguments.side)
    show("depth", found, as_json=arguments.json)


def on_scenes(seeds: Sequence[int], side: int) -> dict[str, dict[str, float]]:
    """Figures of each rendered scene, with the halo of a step's edge and what is claimed of a bare wall."""
    found = {}
    for name, family in FAMILIES.items():
        for seed in seeds:
            found[f"{name}_{seed}"] = scored(*_plain(*_stacked(render(family(seed, side), side, 9))))
    edge, truth = _stacked(render(step(seeds[0], side), side, 9))
    wall, _ = _stacked(render(half_bare(seeds[0], side), side, 9))
    found["step"], found["half_bare"] = {}, {}
    for name, made in estimated(_of_views(edge)):
        found["step"][f"{name}_halo_px"] = halo_px(made.disparity, truth)
    for name, made in estimated(_of_views(wall)):
        found["half_bare"][f"{name}_known_where_bare"] = float(made.known[:, side // 2 + side // 16 :].mean())
        found["half_bare"][f"{name}_known_elsewhere"] = float(made.known[:, : side // 2 - side // 16].mean())
    return found


def on_masked(seeds: Sequence[int], side: int) -> dict[str, dict[str, float]]:
    """Figures of each scene as a masked frame, without noise and at each signal-to-noise ratio; OpenCV matches its
    views."""
    found = {}
    for name, family in FAMILIES.items():
        for seed in seeds:
            frame = expose(family(seed, side), side)
            for noise, snr in SNRS.items():
                field, truth = frame.decoded(snr, seed)
                views = evidence.of_views(ViewStack.of(field))
                told = {"combined": evidence.of_light_field(field), "opencv": views}
                found[f"{name}_{seed}_{noise}"] = scored(told, truth)
    return found


def scored(told: Mapping[str, Evidence], truth: Floats) -> dict[str, float]:
    """The figures of every method on its evidence of one light field, and of the best constant plane."""
    planes = np.linspace(np.nanmin(truth), np.nanmax(truth), PLANES)
    counted = np.isfinite(truth)
    found = {"plane_bad_0.07": min(float(np.mean(np.abs(truth[counted] - at) > LIMITS[0])) for at in planes)}
    began = time.process_time()
    for name, made in estimated(told):
        cpu = time.process_time() - began
        error, sigma = np.abs(made.disparity - truth)[counted], made.sigma[counted]
        known = np.isfinite(error)
        for limit in LIMITS:
            found[f"{name}_bad_{limit:g}"] = float(1 - np.mean(error <= limit))
        found[f"{name}_known"] = float(known.mean())
        if known.any():
            found[f"{name}_wrong_among_known"] = float(np.mean(error[known] > LIMITS[0]))
            found[f"{name}_mse_x100"] = 100 * float(np.mean(error[known].astype(np.float64) ** 2))
            found[f"{name}_within_1_sigma"] = float(np.mean(error[known] <= sigma[known]))
            found[f"{name}_within_2_sigma"] = float(np.mean(error[known] <= 2 * sigma[known]))
        found[f"{name}_cpu_s_per_megapixel"] = cpu / truth.size * 1e6
        began = time.process_time()
    return found


def estimated(told: Mapping[str, Evidence]) -> Iterator[tuple[str, DepthMap]]:
    """The map of each method, made when it is asked for."""
    for name, method in METHODS.items():
        yield name, estimate.estimate(told[name], method)


def _of_views(stack: ViewStack) -> dict[str, Evidence]:
    return dict.fromkeys(METHODS, evidence.of_views(stack))


def _plain(stack: ViewStack, truth: Floats) -> tuple[dict[str, Evidence], Floats]:
    return _of_views(stack), truth


def halo_px(disparity: Floats, truth: Floats) -> float:
    """The mean width of what is wrong beside an upright edge, px a side; unknown is wrong."""
    wrong = ~(np.abs(disparity - truth) <= LIMITS[0])
    edges = np.flatnonzero(np.abs(np.diff(truth[len(truth) // 2])) > 1)
    widths = []
    for at in edges:
        for line in wrong:
            for beside in (line[at::-1], line[at + 1 :]):
                right = np.flatnonzero(~beside)
                widths.append(int(right[0]) if len(right) else len(beside))
    return float(np.mean(widths))


def of_folder(folder: Path) -> tuple[ViewStack, Floats]:
    """Views and true disparity. Raises SystemExit where there is no truth that fits the views."""
    stack = ViewStack.of(view_folders.read(folder))
    shape = stack.views.shape[2:4]
    for path in sorted(folder.glob("*.pfm")):
        truth = read_pfm(path)
        if truth.shape == shape and "disp" in path.name and "estimate" not in path.name:
            return stack, truth
    raise SystemExit(f"{folder} holds no true disparity of {shape[0]} × {shape[1]} px: add one (gt_disp_lowres.pfm)")


def read_pfm(path: Path) -> Floats:
    """A grey .pfm, first row on top. Raises SystemExit for other files."""
    with path.open("rb") as file:
        if file.readline().strip() != b"Pf":
            raise SystemExit(f"{path} is no grey .pfm")
        width, height = map(int, file.readline().split())
        order = "<" if float(file.readline()) < 0 else ">"
        values = np.frombuffer(file.read(), dtype=f"{order}f4", count=width * height)
    return np.flipud(values.reshape(height, width)).astype(np.float32)


def _stacked(rendered: Rendered) -> tuple[ViewStack, Floats]:
    return ViewStack(rendered.views, rendered.steps, rendered.steps), rendered.disparity


if __name__ == "__main__":
    main()
