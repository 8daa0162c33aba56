"""A reflectance panel, for docs/picture.md: python tools/panel_picture.py docs/pictures/panel.webp

A ray-traced masked camera photographs a panel, and then, with half the exposure, patches whose reflectances are known.
`dappled picture --panel` and `--panel-file` do the rest. Prints what they print, and the errors.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import rawpy
import tifffile
from first_screen import CAMERA
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle

from dappled.config import profiles
from dappled.decode.array_types import Floats
from dappled.mocks.scene import dng
from dappled.mocks.scene.masked_camera import MAKE, MODEL
from dappled.mocks.scene.ray_camera import REAL_COLOURS, RayCamera
from dappled.mocks.scene.sharp_boards import SharpBoard
from dappled.products.handover.reflectance import STEPS

SHAPE = (288, 384)  # of a frame, pixels
F_NUMBER, EXPOSURE_S, OF_WHITE = 16.0, 1 / 500, 0.3  # what a reflectance of 1 gives there
PANEL_PX, PANEL = (134, 86, 250, 202), 0.5
GROUND = (0.24, 0.20, 0.15)
FIELDS = (  # reflectances of red, green and blue
    (0.05, 0.12, 0.04), (0.10, 0.30, 0.08), (0.32, 0.26, 0.18), (0.08, 0.08, 0.09),
    (0.85, 0.85, 0.83), (0.55, 0.14, 0.10), (0.12, 0.22, 0.48), (0.60, 0.52, 0.12),
)  # fmt: skip


def field_px(number: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of a patch."""
    row, column = divmod(number, 4)
    return 12 + 92 * column, 20 + 132 * row, 96 + 92 * column, 136 + 132 * row


def board(px: tuple[int, int, int, int], colour: tuple[float, float, float], contrast: float) -> SharpBoard:
    left, top, right, bottom = px
    high, wide = SHAPE
    return SharpBoard(0.0, (top / high - 0.5, bottom / high - 0.5, left / wide - 0.5, right / wide - 0.5), colour,
                      contrast=contrast)  # fmt: skip


def shoot(path: Path, boards: list[SharpBoard], exposure_s: float) -> None:
    """Write a frame of boards whose colours are reflectances."""
    wanted = OF_WHITE * exposure_s / EXPOSURE_S
    camera = RayCamera(
        profiles.mask("reference-5x5").mask, shape=SHAPE, seed=4, f_number=F_NUMBER, print_scale=1.003, turn_rad=0.012,
        colour_filters=REAL_COLOURS, boards=(SharpBoard(colour=GROUND, contrast=0.1), *boards), level=wanted / 4,
    )  # fmt: skip
    views = camera.expose().truth.views  # without the mask: `level` is of the mean behind it, which varies by 1 %
    top, bottom, left, right = boards[-1].extent or (-0.5, 0.5, -0.5, 0.5)
    row, column = round((1 + top + bottom) / 2 * SHAPE[0]), round((1 + left + right) / 2 * SHAPE[1])
    there = views[:, :, row - 20 : row + 20, column - 20 : column + 20, 1]
    given = np.nanmean(there) / float(np.array(REAL_COLOURS[1]) @ boards[-1].colour)
    camera = replace(camera, level=camera.level * wanted / float(given))
    exif = dng.Exif(MAKE, MODEL, "SIM00000004", camera.focal_length_mm, F_NUMBER, exposure_s, 100, 0)
    path.write_bytes(dng.encode(camera.expose().raw(), black=1024, white=15360, exif=exif))


def pictured(folder: Path, name: str, *words: str) -> None:
    (folder / "camera.toml").write_text(CAMERA.format(*SHAPE), encoding="utf-8")
    optics = ["--camera", "camera.toml", "--mask", "reference-5x5"]
    command = [sys.executable, "-m", "dappled", "picture", f"{name}.dng", *optics, "-o", f"{name}.tif", *words]
    subprocess.run(command, cwd=folder, check=True)


def shown(path: Path, bright: float) -> Floats:
    """Colours of a frame for the eye, without its mosaic's own white balance."""
    with rawpy.imread(str(path)) as raw:
        return np.asarray(raw.postprocess(user_wb=[1, 1, 1, 1], no_auto_bright=True, bright=bright)) / 255.0


def draw(folder: Path, to: Path) -> None:
    made = tifffile.imread(folder / "fields.tif") / STEPS
    filters = np.array(REAL_COLOURS)
    true = np.array([filters @ one / filters.sum(axis=1) for one in FIELDS])
    seen = np.array([[made[t + 8 : b - 8, x + 8 : r - 8, c].mean() for c in range(3)]
                     for x, t, r, b in map(field_px, range(len(FIELDS)))])  # fmt: skip
    error = seen / true - 1
    print(f"errors: {np.abs(error).max():.2%} at most, rms {np.sqrt((error**2).mean()):.2%}")
    figure, axes = plt.subplots(2, 2, figsize=(7.6, 6.4), layout="constrained")
    left, top, right, bottom = PANEL_PX
    axes[0, 0].imshow(shown(folder / "panel.dng", 1.6))
    box = Rectangle((left, top), right - left, bottom - top, fill=False, ec="#d00000", lw=1.5)
    axes[0, 0].add_patch(box)
    axes[0, 0].set_title("raw frame of a panel of 50 %, its rectangle", loc="left", fontsize=10)
    axes[0, 1].imshow(shown(folder / "fields.dng", 3.2))
    axes[0, 1].set_title("raw frame of fields, half the exposure", loc="left", fontsize=10)
    axes[1, 0].imshow(np.clip(made, 0, 1) ** (1 / 2.2))
    axes[1, 0].set_title("in reflectances (camera colours)", loc="left", fontsize=10)
    for image in axes.flat[:3]:
        image.set_xticks([])
        image.set_yticks([])
    for channel, colour in enumerate(("#c02020", "#208020", "#2040c0")):
        axes[1, 1].plot(true[:, channel] * 100, seen[:, channel] * 100, "o", ms=5, color=colour, mfc="none")
    axes[1, 1].plot((0, 90), (0, 90), color="0.5", lw=0.8)
    axes[1, 1].set_xlabel("true reflectance, %")
    axes[1, 1].set_ylabel("measured, %")
    axes[1, 1].set_title(f"errors ≤ {np.abs(error).max():.1%} of the value", loc="left", fontsize=10)
    figure.savefig(to, dpi=100, pil_kwargs={"quality": 82, "method": 6})
    plt.close(figure)


def main(to: Path) -> None:
    mpl.use("Agg")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        shoot(folder / "panel.dng", [board((110, 62, 274, 226), (PANEL,) * 3, 0.0)], EXPOSURE_S)
        boards = [board(field_px(number), colour, 0.0) for number, colour in enumerate(FIELDS)]
        shoot(folder / "fields.dng", boards, EXPOSURE_S / 2)
        pictured(folder, "panel", "--panel", ",".join(map(str, PANEL_PX)), "--reflectance", str(PANEL))
        pictured(folder, "fields", "--panel-file", "panel.panel.toml")
        draw(folder, to)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
