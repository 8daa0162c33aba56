"""Frames of a simulated tabletop, for docs/products.md: python tools/tabletop.py FOLDER

The reference camera, focused at 1.2 m, photographs five boards from 0.8 to 5 m, a stopped-down white card, and a
board at 1 and at 4 m, to calibrate with.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from dappled.mocks.scene.bench import Bench, TexturedPlane
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera
from dappled.mocks.scene.synthesis import PASS, Grid

SEED, SCALE, FOCUS_M = 11, 0.5, 1.2
HALF_MM = 6.94, 9.22  # of the chip, up and sideways
BOARDS = (
    TexturedPlane(5.0, (0.30, 0.36, 0.44)),
    TexturedPlane(2.0, (0.42, 0.34, 0.26), extent_mm=(-5.6, 6.9, -8.6, -2.2)),
    TexturedPlane(1.2, (0.26, 0.42, 0.30), extent_mm=(-2.4, 6.9, -4.2, 2.0)),
    TexturedPlane(1.5, (0.46, 0.40, 0.20), tilt=(0.0, 0.35), extent_mm=(-6.0, 0.4, 0.6, 8.8)),
    TexturedPlane(0.8, (0.48, 0.28, 0.26), extent_mm=(2.2, 6.94, 1.0, 6.6)),
)


def photographed(camera: MaskedCamera, boards: tuple[TexturedPlane, ...]) -> bytes:
    """The raw file of boards."""
    finest = PASS * min(Grid.of(camera.sensor.shape, camera.lattice).half_band)
    return replace(camera, scene=Bench.of(SEED, boards, camera.sensor.pitch_mm / finest)).expose(0.0, 0).file


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    camera = reference_camera(SEED, scale=SCALE, scene="bench")
    camera = replace(camera, optics=replace(camera.optics, focus_m=FOCUS_M))
    (folder / "white.dng").write_bytes(camera.bench_frame().file)
    (folder / "table.dng").write_bytes(photographed(camera, BOARDS))
    for metres in (1, 4):
        (folder / f"target-{metres}m.dng").write_bytes(photographed(camera, (TexturedPlane(float(metres)),)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
