"""What refocusing and depth cost, and how good depth is on scenes with truth.

python benchmarks/products.py [--json]

Times are the least of interleaved rounds beside a plain mean over the same views, measured in the same run; `cpu` is
what all threads together took, which a busy machine changes less.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the painted scenes are the tests' own

from limits import show
from tests.decode.scenes import boards, paint

from dappled.decode.depth import DepthMap, estimate, evidence
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.fourier_refocus import Spectrum4D
from dappled.decode.lightfield.refocus import shift_and_add

ROUNDS, WORKERS = 5, 2
BORDER, BAD = 15, 0.07


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"measurements each (default: {ROUNDS})")
    parser.add_argument("--workers", type=int, default=WORKERS, help=f"threads (default: {WORKERS})")
    arguments = parser.parse_args()
    show("products", figures(arguments.rounds, arguments.workers), as_json=arguments.json)


def figures(rounds: int, workers: int) -> dict[str, float]:
    """All figures by name; seconds, and shares."""
    wide, wide_truth = paint(boards(1, 512, 3.0, 14), (512, 512), 9, seed=1)
    narrow, narrow_truth = paint(boards(2, 572, 0.6, 10), (572, 566), 5, seed=2)
    told_wide, told_narrow = evidence.of_views(wide), evidence.of_views(narrow)
    spectrum = Spectrum4D.of(narrow, most_disparity=0.6, workers=workers)
    works: dict[str, Callable[[], object]] = {
        "plain_mean_81_views_512_s": lambda: wide.views.mean(axis=(0, 1)),
        "refocus_81_views_512_s": lambda: shift_and_add(wide, 0.37, workers=workers),
        "refocus_25_views_572x566_s": lambda: shift_and_add(narrow, 0.37, workers=workers),
        "fourier_slice_25_views_572x566_s": lambda: spectrum.refocused(0.37, workers=workers),
        "depth_combined_81_views_512_s": lambda: estimate.estimate(told_wide, workers=workers),
        "depth_contrast_81_views_512_s": lambda: estimate.estimate(told_wide, "contrast", workers=workers),
        "depth_combined_25_views_572x566_s": lambda: estimate.estimate(told_narrow, workers=workers),
        "depth_contrast_25_views_572x566_s": lambda: estimate.estimate(told_narrow, "contrast", workers=workers),
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            times[name].append(timed(work))
    found = {name: min(wall for wall, _ in taken) for name, taken in times.items()}
    found |= {f"cpu_{name}": min(cpu for _, cpu in taken) for name, taken in times.items()}
    found["refocus_81_views_over_plain_mean"] = found["refocus_81_views_512_s"] / found["plain_mean_81_views_512_s"]
    for method in ("combined", "contrast"):
        found[f"bad_pixels_{method}_81_views"] = bad_share(
            estimate.estimate(told_wide, method, workers=workers), wide_truth
        )
        made = estimate.estimate(told_narrow, method, workers=workers)
        found[f"bad_pixels_{method}_25_views"] = bad_share(made, narrow_truth)
    for rms in (0.01, 0.03, 0.1):
        noise = np.random.default_rng(0).normal(size=wide.views.shape).astype(np.float32)
        noisy = ViewStack(wide.views + np.float32(rms) * noise, wide.row_steps, wide.column_steps)
        made = estimate.estimate(evidence.of_views(noisy), workers=workers)
        found[f"bad_pixels_combined_81_views_noise_{rms:g}"] = bad_share(made, wide_truth)
    return found


def bad_share(made: DepthMap, truth: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
    """The share of pixels off by more than 0.07 px/view or unknown, 15 px at the edges left out."""
    cut = (slice(BORDER, -BORDER),) * 2
    return float(1 - np.mean(np.abs(made.disparity - truth)[cut] <= BAD))


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds that a call took: on the wall, and of all threads together."""
    began, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - began, time.process_time() - cpu


if __name__ == "__main__":
    main()
