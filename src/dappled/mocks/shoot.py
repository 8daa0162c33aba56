"""Write one picture of the simulated reference camera as a file, to try the commands with.

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
    parser.add_argument(
        "--seed", type=int, default=3, help="seed of the scene and of how the mask is installed (default: 3)"
    )
    parser.add_argument("--scale", type=float, default=0.5, help="share of the full sensor's side (default: 0.5)")
    parser.add_argument("--truth", type=Path, metavar="FILE.npz", help="also write what the camera really saw")
    arguments = parser.parse_args(words)
    camera = reference_camera(arguments.seed, scale=arguments.scale, scene=arguments.scene)
    shot = camera.expose(0.0, 0, f_number=arguments.f_number)
    arguments.output.write_bytes(shot.file)
    if arguments.truth is not None:
        shot.truth.save(arguments.truth)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
