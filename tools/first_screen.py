"""The README's picture, from one simulated frame: python tools/first_screen.py docs/pictures/first-screen.jpg [FOLDER]

A ray-traced masked camera (as `make demo`'s hard frame), focused at 3 m, photographs boards at 10, 3 and 1.2 m. The
verbs of `dappled` do the rest: calibrate, picture, decode, refocus and depth. FOLDER keeps the files between.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rawpy
from PIL import Image, ImageDraw, ImageFont

from dappled.config import profiles
from dappled.decode.array_types import Singles
from dappled.mocks.scene import dng
from dappled.mocks.scene.masked_camera import EXPOSURE_S, ISO, MAKE, MODEL
from dappled.mocks.scene.ray_camera import REAL_COLOURS, WHITE, RayCamera
from dappled.mocks.scene.sharp_boards import SharpBoard

SHAPE = (576, 768)  # of the frame, pixels
FOCUS_M, FAR_M, NEAR_M = 3.0, 10.0, 1.2
F_NUMBER, STOPPED = 7.44, 32.0
CROP = (200, 160, 288, 384)  # first row and column, rows and columns of what is shown at 1:1
PANEL, GAP, CAPTION = (384, 288), 8, 20  # width and height of a large panel; pixels
SEED = 4
FAR_AND_NEAR = (18, 96)  # percentiles of disparity: the backdrop, and the near board, which covers a sixth of the frame
CAMERA = """law = "geometric"
mask_distance_mm = 0.48
[[raw]]
name = "a part of the reference camera's sensor"
shape = [{}, {}]
row_mm = [0.01, 0.0]
column_mm = [0.0, 0.01]
"""


def disparity(camera: RayCamera, distance_m: float) -> float:
    """How far a point moves on the sensor for each mm on the aperture (Eq 5)."""
    return camera.v_mm / 1000 * (1 / distance_m - 1 / FOCUS_M)


def printed(colours: Sequence[tuple[int, int, int]], text: str) -> Singles:
    """What is printed on a board, linear, twice as fine as the frame: words over patches of colour, none repeated."""
    high, wide = 2 * SHAPE[0], 2 * SHAPE[1]
    chance = np.random.default_rng([SEED, len(text)])
    sheet = Image.new("RGB", (wide, high), colours[0])
    pen = ImageDraw.Draw(sheet)
    for size, count in ((220, 200), (60, 900), (18, 2500)):
        for _ in range(count):
            x, y, w, h = (int(n) for n in chance.integers(0, (wide, high, size, size)))
            light = float(chance.uniform(0.5, 1.4))
            fill = tuple(min(255, round(light * c)) for c in colours[int(chance.integers(len(colours)))])
            (pen.rectangle if chance.random() < 0.6 else pen.ellipse)((x, y, x + w + 3, y + h + 3), fill=fill)
    for row in range(0, high, 260):
        for column in range(int(chance.integers(-200, 0)), wide, 520):
            at = column + int(chance.integers(120)), row + int(chance.integers(80))
            pen.text(at, text, fill=(250, 250, 245), font=ImageFont.load_default(72))
            pen.text((at[0], at[1] + 84), "the quick brown fox", fill=(20, 20, 20), font=ImageFont.load_default(32))
            pen.text((at[0], at[1] + 122), "jumps over it", fill=(250, 250, 245), font=ImageFont.load_default(22))
    linear: Singles = np.power(np.asarray(sheet, dtype=np.float32) / np.float32(255), np.float32(2.2))
    return linear


def shoot(folder: Path) -> None:
    """Write the frame and the white card."""
    camera = RayCamera(
        profiles.mask("reference-5x5").mask, shape=SHAPE, seed=SEED, f_number=F_NUMBER, print_scale=1.003,
        turn_rad=0.012, points_per_view=2, colour_filters=REAL_COLOURS, level=0.18,
    )  # fmt: skip
    far = printed(((70, 92, 60), (96, 112, 74), (120, 104, 84), (58, 74, 66)), "10 m")
    middle = printed(((150, 118, 70), (176, 140, 92), (128, 96, 66)), "3 m")
    near = printed(((134, 70, 64), (164, 92, 80), (110, 56, 60)), "1.2 m")
    boards = (
        SharpBoard(disparity(camera, FAR_M), picture=far),
        SharpBoard(0.0, (-0.30, 0.42, -0.34, 0.12), picture=middle),
        SharpBoard(disparity(camera, NEAR_M), (0.02, 0.46, 0.04, 0.46), picture=near),
    )
    white = replace(camera, boards=WHITE, f_number=STOPPED, level=0.15)
    for name, one in (("frame", replace(camera, boards=boards)), ("white", white)):
        exif = dng.Exif(MAKE, MODEL, f"SIM{SEED:08d}", one.focal_length_mm, one.f_number, EXPOSURE_S, ISO, 0)
        (folder / f"{name}.dng").write_bytes(dng.encode(one.expose().raw(), black=1024, white=15360, exif=exif))


def process(folder: Path) -> None:
    """Run the verbs on them."""
    (folder / "camera.toml").write_text(CAMERA.format(*SHAPE), encoding="utf-8")
    optics = ["--camera", "camera.toml", "--mask", "reference-5x5"]
    for words in (
        ["calibrate", "white.dng", *optics, "-o", "calibration.toml", "--overwrite"],
        ["picture", "frame.dng", *optics, "--calibration", "calibration.toml", "-o", "picture.png", "--anyway"],
        [
            "decode",
            "frame.dng",
            *optics,
            "--calibration",
            "calibration.toml",
            "--colour",
            "-o",
            "frame.npz",
            "--overwrite",
        ],
        ["depth", "frame.npz", "--method", "contrast", "-o", "depth.png", "depth.npz", "--overwrite"],
    ):
        run(folder, words)
    with np.load(folder / "depth.npz") as depth:
        far, near = np.nanpercentile(depth["disparity"], FAR_AND_NEAR)
    for name, there in (("near", near), ("far", far)):
        run(folder, ["refocus", "frame.npz", "--disparity", f"{there:.3f}", "-o", f"{name}.png", "--overwrite"])


def run(folder: Path, words: list[str]) -> None:
    """Run a verb in the folder. Raises CalledProcessError."""
    subprocess.run([sys.executable, "-m", "dappled", *words], cwd=folder, check=True)


def draw(folder: Path, to: Path) -> None:
    """One picture of them, with a caption above each."""
    top, left, high, wide = CROP
    with rawpy.imread(str(folder / "frame.dng")) as raw:
        masked = raw.postprocess(use_camera_wb=True, no_auto_bright=True, bright=1.0)
    picture = np.asarray(Image.open(folder / "picture.png").convert("RGB"))
    large = [
        ("the raw frame at 1:1, behind the mask", masked[top : top + high, left : left + wide]),
        ("the picture made of it, at 1:1", picture[top : top + high, left : left + wide]),
    ]
    small = [
        (words, np.asarray(Image.open(folder / name).convert("RGB")))
        for words, name in (
            (f"refocused near, {NEAR_M:g} m", "near.png"),
            (f"far, {FAR_M:g} m", "far.png"),
            ("depth, relative", "depth.png"),
        )
    ]
    width = 2 * PANEL[0] + GAP
    small_wide = (width - 2 * GAP) // 3
    small_high = round(small_wide * SHAPE[0] / SHAPE[1])
    sheet = Image.new("RGB", (width, PANEL[1] + small_high + 2 * CAPTION), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    rows = ((large, PANEL, 0), (small, (small_wide, small_high), PANEL[1] + CAPTION))
    for panels, size, y in rows:
        for place, (words, values) in enumerate(panels):
            x = place * (size[0] + GAP)
            pen.text((x + 2, y + 2), words, fill=(0, 0, 0), font=font)
            sheet.paste(Image.fromarray(values).resize(size, Image.Resampling.BICUBIC), (x, y + CAPTION))
    sheet.save(to, quality=88)


def main(words: list[str]) -> int:
    to = Path(words[0])
    with tempfile.TemporaryDirectory() as made:
        folder = Path(words[1]) if len(words) > 1 else Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        shoot(folder)
        process(folder)
        draw(folder, to)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
