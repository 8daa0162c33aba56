"""What a frame costs on the ground, and how that grows with its size: the commands as a user gives them.

python benchmarks/ground.py [--json] [--scales 0.5 1 1.53] [--repeats 2]

Frames of the reference camera, of 2.5, 10 and 24 MP (`scale` is the sensor's side over 2776 × 3688), over terrain, with
a calibration of a white frame of the same size; `calibrate_lens` has eight pictures of a chessboard of that size. Each
command runs in a process of its own, on the threads that it takes by itself; CPU time is that of the process and its
children, less that of `dappled --version`; the shortest of the repeats counts. `cpu_s` and `memory_mb` are those of the
frame of 10 MP, `cpu_s_a_mp` those by its size, `growth` is the CPU time of a megapixel in the largest frame over that
in the 10 MP frame: 1 is linear. Memory is the largest of the process itself. `decode` has the views by the joint model
in it.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from growth import CAMERA, F_NUMBER, MASK, fly, run
from limits import show
from PIL import Image
from tests.simulated.profiles import raw_table

from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.masked_camera import reference_camera

SEED, EXPOSED_T_S = 5, 1.0
TILTS = ((0, 0), (0.5, 0), (-0.5, 0.1), (0, 0.55), (0.1, -0.5), (0.4, 0.4), (-0.4, -0.4), (0.3, -0.3))


def prepared(folder: Path, scale: float) -> tuple[Path, Path, tuple[int, int]]:
    """(flight of one frame, white frame, rows and columns of a frame) of a camera of this scale, in `folder`."""
    camera = reference_camera(SEED, scale=scale, path=FlightPath(SEED))
    exposure = camera.expose(EXPOSED_T_S, 0, f_number=F_NUMBER)
    white = folder / "white.dng"
    white.write_bytes(reference_camera(SEED, scale=scale, scene="white").bench_frame().file)
    height, width = camera.sensor.shape
    shipped = resources.files("dappled.config").joinpath("profiles", "cameras", f"{CAMERA}.toml").read_text("utf-8")
    (folder / "camera.toml").write_text(
        shipped if f"[{height}, {width}]" in shipped else f"{shipped}\n{raw_table(height, width)}",
        encoding="utf-8",
    )
    return fly(folder, 1, exposure.file), white, (height, width)


def boards(folder: Path, shape: tuple[int, int]) -> list[str]:
    """Eight pictures of a tilted chessboard of 9 × 6 inner corners, as a pinhole of 50 mm shows it on a frame of this
    shape."""
    rows, columns = shape
    away = 22 * 3688 / columns  # squares
    x, y = ((np.arange(n) - n / 2) * 0.01 / 50 for n in (columns, rows))
    rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones(shape)], axis=-1)
    files = []
    for number, (across, along) in enumerate(TILTS):
        right = np.array([math.cos(across), 0.0, math.sin(across)])
        down = np.array([-math.sin(across) * math.sin(along), math.cos(along), math.cos(across) * math.sin(along)])
        normal = np.cross(right, down)
        middle = np.array([0.3 * number - 1, 0.2 * number - 0.5, away])
        reached = (middle @ normal / (rays @ normal))[..., None] * rays - middle
        u, v = reached @ right + 5, reached @ down + 3.5
        inside = (u > 0) & (u < 10) & (v > 0) & (v < 7)
        wave = np.sin(np.pi * u) * np.sin(np.pi * v) / (np.pi * away * 0.01 / 50)  # edges a pixel wide
        light = np.where(inside, 0.5 - 0.4 * np.clip(wave, -1, 1), 0.9)
        files.append(str(folder / f"board-{number}.png"))
        Image.fromarray(np.round(65535 * light).astype(np.uint16)).save(files[-1], compress_level=1)
    return files


def commands(folder: Path, flight: Path, white: Path, shape: tuple[int, int]) -> Mapping[str, Sequence[str]]:
    """The commands by name, in the order in which they need each other's files."""
    frame = next((flight / "frames").iterdir())
    camera = ["--camera", str(folder / "camera.toml"), "--mask", MASK]
    known = [*camera, "--calibration", str(folder / "c.toml")]
    field = str(folder / "field.npz")
    return {
        "calibrate": ["calibrate", str(white), *camera, "-o", str(folder / "c.toml"), "--overwrite"],
        "calibrate_lens": ["calibrate", "--lens", *boards(folder, shape), "--camera", str(folder / "camera.toml"),
                           "--focal-length", "50", "-o", str(folder / "lens.toml"), "--overwrite"],
        "carriers": ["carriers", str(frame), *known],
        "decode": ["decode", str(frame), *known, "-o", field, "--overwrite"],
        "refocus": ["refocus", field, "--disparity", "0", "-o", str(folder / "refocused.png"), "--overwrite"],
        "depth": ["depth", field, "-o", str(folder / "depth.tif"), "--overwrite"],
        "georeference": ["georeference", str(flight), *known, "--as", "kmz", "cog", "-o", str(folder / "maps"),
                         "--overwrite"],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--scales", type=float, nargs=3, default=(0.5, 1.0, 1.53), help="of the three sensors")
    parser.add_argument("--repeats", type=int, default=2, help="runs of a command, of which the shortest counts")
    arguments = parser.parse_args()
    started = min(run(["--version"])[0] for _ in range(3))
    used: dict[str, list[tuple[float, float, float]]] = {}
    for scale in arguments.scales:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            flight, white, shape = prepared(folder, scale)
            megapixels = math.prod(shape) / 1e6
            for command, words in commands(folder, flight, white, shape).items():
                runs = [run(words) for _ in range(arguments.repeats)]
                cpu_s = min(cpu for cpu, _ in runs) - started
                used.setdefault(command, []).append((megapixels, cpu_s, max(peak for _, peak in runs)))
                print(f"{command}, {megapixels:.1f} MP: {cpu_s:.2f} CPU-s, {runs[0][1]:.0f} MB", file=sys.stderr)
    figures = {}
    for command, (_, (size, cpu_s, memory_mb), (largest, most_s, most_mb)) in used.items():
        figures[command] = {
            "cpu_s": cpu_s,
            "cpu_s_a_mp": cpu_s / size,
            "growth": most_s / largest / (cpu_s / size),
            "memory_mb": memory_mb,
            "memory_growth": most_mb / largest / (memory_mb / size),
        }
    show("ground", {"start_cpu_s": started, **figures}, as_json=arguments.json)


if __name__ == "__main__":
    main()
