"""One picture of the simulated reference camera as a file, to try the commands on.

python -m dappled.mocks.shoot frame.dng
python -m dappled.mocks.shoot white.dng --scene white --f-number 59.2
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dappled.mocks.scene.masked_camera import reference_camera


def main(words: list[str] | None = None) -> int:
    """Write the file; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m dappled.mocks.shoot", description="A simulated frame.")
    parser.add_argument("output", type=Path, metavar="FILE.dng")
    parser.add_argument("--scene", default="bench", choices=("bench", "white", "terrain"), help="default: bench")
    parser.add_argument("--f-number", type=float, metavar="N", help="default: open, f/7.4")
    parser.add_argument("--seed", type=int, default=3, help="draws the scene and how the mask sits (default: 3)")
    parser.add_argument("--scale", type=float, default=0.5, help="side of the sensor over the full one (default: 0.5)")
    parser.add_argument("--truth", type=Path, metavar="FILE.npz", help="what the camera really saw")
    told = parser.parse_args(words)
    camera = reference_camera(told.seed, scale=told.scale, scene=told.scene)
    shot = camera.expose(0.0, 0, f_number=told.f_number)
    told.output.write_bytes(shot.file)
    if told.truth is not None:
        shot.truth.save(told.truth)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
