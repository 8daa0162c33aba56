"""How near views come to the truth, by family of scenes and seed: python benchmarks/views.py [FAMILY …] [--json].

Frames are simulated ray by ray (`RayCamera`), the camera is calibrated on a stopped-down white frame, and each frame is
decoded twice: with the joint model, and with each spatial frequency alike, as before. "mean" is the mean of the true
views taken for every view. PSNR in dB, 1.0 = sensor white. `--keep FOLDER` keeps frames and truth for the next run.
`--picture FILE` draws an outer view of the last frame: true, before and joint, and below them 10 times the errors.
`--known-depths` adds what the joint model reaches that is told the true disparities (see `known_depths`; not for
clipped frames and turned masks, whose slices it takes as they are).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from known_depths import views_given
from limits import show
from matplotlib import cbook
from numpy.typing import NDArray
from PIL import Image
from scipy import fft, ndimage

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import MaskDecoder
from dappled.decode.joint.clipping import unknown_where_clipped
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.optics import Mask, MaskedOptics, Sensor
from dappled.drivers.raw.raw_file import MOST_CLIPPED, WHITE_SHARE
from dappled.mocks.scene.ray_camera import RayCamera
from dappled.mocks.scene.sharp_boards import SharpBoard
from dappled.products.exports import prints

MASK = Mask(15.5, 2)
PITCH_MM, STOP_MM, FOCAL_MM, DISTANCE_MM = 0.01, 6.72, 50.0, 0.48
F_NUMBER, CALIBRATED_AT = 7.44, 29.76
BAND = 0.063  # cycles/pixel: inside the band of a slice
LARGEST_PX = 5.0  # from view to view
BORDER = 8  # samples of a view
LEAST_TURN = 6e-4  # radians: slices of a mask turned by less may be taken as they are
INSIDE = (..., slice(BORDER, -BORDER), slice(BORDER, -BORDER))
SNR_100, SNR_50 = 28_600.0, 7_150.0  # electrons of a full well, whose 0.35 is the mean


def boards(
    seed: int, *, exponent: float, finest: float | None, largest_px: float = LARGEST_PX, contrast: float = 0.2
) -> tuple[SharpBoard, ...]:
    """A backdrop and three boards at disparities, places and shades that the seed draws; later boards are nearer."""
    chance = np.random.default_rng([seed, 19])
    steps = np.sort(chance.uniform(-largest_px, largest_px, 4)) * PITCH_MM * 5 / STOP_MM
    made = [SharpBoard(steps[0], exponent=exponent, finest=finest, contrast=contrast)]
    for step in steps[1:]:
        top, left = chance.uniform(-0.45, 0.05, 2)
        height, width = chance.uniform(0.25, 0.55, 2)
        shade = float(chance.uniform(0.3, 0.55))
        place = top, min(top + height, 0.48), left, min(left + width, 0.48)
        made.append(SharpBoard(step, place, (shade,) * 3, exponent=exponent, finest=finest, contrast=contrast))
    return tuple(made)


def before_background(seed: int, background_px: float, near_px: float) -> tuple[SharpBoard, ...]:
    """A board before a backdrop, at these disparities from view to view; its place and shade are the seed's."""
    chance = np.random.default_rng([seed, 21])
    far, near = (px * PITCH_MM * 5 / STOP_MM for px in (background_px, near_px))
    top, left = chance.uniform(-0.3, 0.0, 2)
    high, wide = chance.uniform(0.25, 0.45, 2)
    shade = float(chance.uniform(0.3, 0.55))
    board = SharpBoard(
        near, (top, top + high, left, left + wide), (shade,) * 3, exponent=1.3, finest=None, contrast=0.2
    )
    return SharpBoard(far, exponent=1.3, finest=None, contrast=0.2), board


def photographs(
    made: tuple[SharpBoard, ...], chance: np.random.Generator, *, darkest: float, grey: bool
) -> tuple[SharpBoard, ...]:
    """The boards with parts of a photograph on them, each turned or mirrored in another way; `darkest` is added."""
    file = cbook.get_sample_data("grace_hopper.jpg")
    assert not isinstance(file, np.ndarray)
    with file:
        picture = (np.asarray(Image.open(file).convert("RGB"), dtype=np.float32) / 255) ** 2.2
    found = []
    for board in made:
        part = np.rot90(picture, int(chance.integers(4)))[:: int(chance.choice([-1, 1]))]
        if grey:
            part = part.mean(axis=2, keepdims=True).repeat(3, axis=2)
        part = part + np.float32(darkest)
        found.append(replace(board, picture=np.ascontiguousarray(part / part.mean() * board.colour[0])))
    return tuple(found)


@dataclass(frozen=True)
class Family:
    """Frames of one kind: the camera's options, and the texture of its boards."""

    text: str
    exponent: float = 1.3
    finest: float | None = BAND
    options: Mapping[str, object] | None = None
    largest_px: float = LARGEST_PX
    photographs: bool = False
    before_background: tuple[float, float] | None = None
    f_number: float = F_NUMBER

    def camera(self, seed: int, shape: tuple[int, int]) -> RayCamera:
        """The camera before the scene of a seed."""
        scene = boards(seed, exponent=self.exponent, finest=self.finest, largest_px=self.largest_px)
        if self.before_background:
            scene = before_background(seed, *self.before_background)
        if self.photographs:
            scene = photographs(scene, np.random.default_rng([seed, 20]), darkest=0.05, grey=True)
        plain = RayCamera(
            MASK, shape=shape, seed=seed, boards=scene, full_well_e=SNR_100, stop="square", f_number=self.f_number
        )
        return replace(plain, **(self.options or {}))  # type: ignore[arg-type]  # names and values of its own fields


POINT = {"points_per_view": 1}
CLEAN = {"full_well_e": 0.0, "read_noise_e": 0.0}
FAMILIES: Mapping[str, Family] = {
    "point-snr100": Family("25 points, in the band, SNR 100", options=POINT),
    "point-snr50": Family("25 points, in the band, SNR 50", options={**POINT, "full_well_e": SNR_50}),
    "point-1.1": Family("25 points, f^-1.1, no noise", 1.1, None, {**POINT, **CLEAN}),
    "point-1.5": Family("25 points, f^-1.5, no noise", 1.5, None, {**POINT, **CLEAN}),
    "point-1.1-snr100": Family("25 points, f^-1.1, SNR 100", 1.1, None, POINT),
    "point-1.5-snr100": Family("25 points, f^-1.5, SNR 100", 1.5, None, POINT),
    "square-snr100": Family("square stop, in the band, SNR 100"),
    "square-1.1": Family("square stop, f^-1.1, no noise", 1.1, None, CLEAN),
    "square-1.5": Family("square stop, f^-1.5, no noise", 1.5, None, CLEAN),
    "round-snr100": Family("round stop, in the band, SNR 100", options={"stop": "round"}),
    "round-1.3-snr100": Family("round stop, f^-1.3, SNR 100", 1.3, None, {"stop": "round"}),
    "photographs": Family(
        "round stop, photographs, SNR 65", options={"stop": "round", "level": 0.15}, photographs=True
    ),
    "terrain": Family("round stop, terrain from the air, SNR 100", 1.3, None, {"stop": "round"}, largest_px=0.1),
    "before-background": Family(
        "square stop, a board before a background near the focus, f^-1.3, SNR 100", before_background=(0.65, 2.3)
    ),
    "half": Family("square stop, half the ideal aperture, SNR 100", f_number=2 * F_NUMBER),
    "vignetting": Family("square stop, 40 % lost at the corners, SNR 100", options={"falloff": 0.4}),
    "clipped": Family("square stop, 5 % clipped", options={"level": 0.73, "full_well_e": SNR_100 * 0.35 / 0.73}),
    "moved": Family("square stop, mask moved 16 µm", options={"moved_mm": (0.016, 0.0)}),
    "turned": Family("square stop, mask turned 0.1°", options={"turned_rad": 0.001745}),
}


@dataclass(frozen=True)
class Frame:
    """A plane, the white frame of its calibration, the true views (V, U, H, W), what lies within reach of a slice."""

    plane: NDArray[np.float32]
    white: NDArray[np.float32]
    truth: NDArray[np.float32]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class Reached:
    """PSNR in dB: joint, before, the mean of the true views, and `told` of the joint and of the mean where a standard
    error is told; the share of errors within 1 σ (NaN where none is told); processor seconds of the joint decode, the
    model that was used, `known_depths` the PSNR of the one that is told them (NaN: not asked for), and `corner`
    (3, h, w): a view at the aperture's edge, true, before and joint."""

    joint: float
    before: float
    mean: float
    told: tuple[float, float]
    within: float
    seconds: float
    model: str
    known_depths: float
    corner: NDArray[np.floating]


def frame_of(camera: RayCamera, kept: Path | None) -> Frame:
    """Expose, or read what was kept."""
    if kept is not None and kept.exists():
        with np.load(kept) as file:
            return Frame(*(file[name] for name in ("plane", "white", "truth", "weights")))
    made = camera.expose()
    white = replace(camera.calibration(CALIBRATED_AT), level=0.2, points_per_view=4, full_well_e=SNR_100).expose()
    frame = Frame(made.plane, white.plane, in_band(made.truth.views[..., 0]), made.truth.view_weights)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(kept, plane=frame.plane, white=frame.white, truth=frame.truth, weights=frame.weights)
    return frame


def in_band(views: NDArray[np.float32]) -> NDArray[np.float32]:
    """Views (..., H, W) without what a slice can't hold: half the carriers' distance, with a soft edge."""
    half = MASK.frequency_per_mm * (1 - DISTANCE_MM / FOCAL_MM) * PITCH_MM / 2
    shape = views.shape[-2:]

    def kept(frequencies: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.5 + 0.5 * np.cos(np.pi * np.clip((np.abs(frequencies) / half - 0.87) / 0.13, 0, 1))

    window = kept(fft.fftfreq(shape[0]))[:, None] * kept(fft.rfftfreq(shape[1]))
    return np.asarray(fft.irfft2(fft.rfft2(views) * window, s=shape), dtype=np.float32)


def calibrated(frame: Frame) -> Calibration:
    """The calibration of a frame's camera, by its white frame."""
    sensor = Sensor((frame.plane.shape[0], frame.plane.shape[1]), (PITCH_MM, 0.0), (0.0, PITCH_MM))
    shot = CalibrationFrame(frame.white, FOCAL_MM, CALIBRATED_AT)
    return calibrate([shot], MaskedOptics(sensor, MASK, "geometric", DISTANCE_MM))


def at_samples(views: NDArray[np.float32], field: LightField) -> NDArray[np.float32]:
    """True views (V, U, H, W) at the samples of a light field."""
    rows, columns = field.views.shape[2:4]
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    at = np.array([field.grid[0, 0] * y + field.grid[0, 2], field.grid[1, 1] * x + field.grid[1, 2]])
    made = [[ndimage.map_coordinates(view, at, order=3, mode="nearest") for view in line] for line in views]
    return np.asarray(made, dtype=np.float32)


def psnr(found: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """In dB, range 1, without the border and what has no truth (NaN)."""
    return float(-10 * np.log10(np.nanmean((found - truth)[INSIDE] ** 2)))


def at_every_sample(sigma: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """`view_sigma` (V, U, m, n) at the samples of views (V, U, h, w): linear between the patches' middles, NaN beside
    one that is."""
    rows, columns = ((np.arange(side) + 0.5) / 12 for side in shape[2:4])
    down, across = (
        np.maximum(0, 1 - np.abs(at[:, None] - np.arange(n)))
        for at, n in zip((rows, columns), sigma.shape[2:], strict=True)
    )
    told = np.isfinite(sigma)
    variance = down @ np.where(told, sigma.astype(np.float64) ** 2, 0) @ across.T
    return np.asarray(np.where(down @ ~told @ across.T > 0, np.nan, np.sqrt(variance)), dtype=np.float32)


def reached(frame: Frame, f_number: float, disparity: NDArray[np.float32] | None = None) -> Reached:
    """Decode a frame both ways, and told its true `disparity` (H, W), dx/dθ, if that is given."""
    calibration = calibrated(frame)
    clipped = (frame.plane >= WHITE_SHARE).astype(np.float32)
    decoder = MaskDecoder(
        MaskedOptics(calibration.sensor, MASK, "geometric", DISTANCE_MM), calibration, clipped=clipped
    )
    began = time.process_time()
    joint = decoder.decode(frame.plane, focal_length_mm=FOCAL_MM, f_number=f_number)
    took = time.process_time() - began
    before = replace(decoder, joint_views=False).decode(frame.plane, focal_length_mm=FOCAL_MM, f_number=f_number)
    truth = at_samples(frame.truth, joint)
    mean = np.broadcast_to(np.nansum(truth * frame.weights[:, :, None, None], axis=(0, 1)), truth.shape)
    sigma = unknown_where_clipped(joint, clipped, MOST_CLIPPED).view_sigma
    told, within = np.ones(truth.shape, dtype=bool), float("nan")
    if sigma is not None:
        there = at_every_sample(sigma, joint.views.shape)
        told = np.isfinite(there)
        known = (told & np.isfinite(truth))[INSIDE]
        within = float((np.abs(joint.views - truth) < there)[INSIDE][known].mean())
    given, place = float("nan"), joint.attributes["mask_place"]
    if disparity is not None and not clipped.any() and not (place and abs(place["turn_rad"]) > LEAST_TURN):
        reach = FOCAL_MM / f_number / PITCH_MM  # columns of the sensor over the aperture
        given = psnr(views_given(joint, disparity * reach), truth)
    where_told = np.where(told, truth, np.float32(np.nan))
    return Reached(
        psnr(joint.views, truth),
        psnr(before.views, truth),
        psnr(mean, truth),
        (psnr(joint.views, where_told), psnr(mean, where_told)),
        within,
        took,
        str(joint.attributes["views_model"]),
        given,
        np.stack([truth[1, 0], before.views[1, 0], joint.views[1, 0]]),
    )


def options(text: str, families: Collection[str], *, seeds: int) -> argparse.ArgumentParser:
    """The options of a benchmark of frames, `seeds` of each family by default."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("families", nargs="*", metavar="FAMILY", help=f"of {', '.join(families)} (default: all)")
    parser.add_argument("--seeds", type=int, default=seeds, help=f"frames of each family (default: {seeds})")
    parser.add_argument("--first", type=int, default=0, help="the first seed (default: 0)")
    parser.add_argument("--shape", type=int, nargs=2, default=(560, 740), metavar=("H", "W"), help="of a frame in px")
    parser.add_argument("--picture", type=Path, help="draw a view of the last frame, true and made")
    parser.add_argument("--json", action="store_true", help="figures as JSON: the least of the seeds")
    return parser


def chosen(parser: argparse.ArgumentParser, families: Collection[str]) -> tuple[argparse.Namespace, list[str]]:
    """What the command line says, and the families it names; all where it names none."""
    arguments = parser.parse_args()
    if unknown := set(arguments.families) - set(families):
        parser.error(f"no family of these names: {', '.join(sorted(unknown))}")
    return arguments, arguments.families or list(families)


def main() -> None:
    parser = options(__doc__ or "", FAMILIES, seeds=1)
    parser.add_argument("--keep", type=Path, help="folder of simulated frames, used again if they are there")
    parser.add_argument("--known-depths", action="store_true", help="also with the true disparities (slow)")
    arguments, families = chosen(parser, FAMILIES)
    high, wide = arguments.shape
    figures: dict[str, float] = {}
    for name in families:
        rows = []
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            kept = arguments.keep and arguments.keep / f"{name}-{seed}-{high}x{wide}.npz"
            camera = FAMILIES[name].camera(seed, (high, wide))
            disparity = camera.disparity() if arguments.known_depths else None
            rows.append(reached(frame_of(camera, kept), camera.f_number, disparity))
            if not arguments.json:
                print(f"{name} {seed}: {line(rows[-1])}", flush=True)
        if not arguments.json:
            print(f"| {FAMILIES[name].text} | {table_row(rows)} |", flush=True)
        figures[f"{name}_db"] = min(row.joint for row in rows)
        figures[f"{name}_over_before_db"] = min(row.joint - row.before for row in rows)
    if arguments.picture:
        draw(rows[-1].corner, arguments.picture)
    if arguments.json:
        show("views", figures, as_json=True)


def draw(corner: NDArray[np.floating], path: Path) -> None:
    """The three pictures, and 10 times their errors about grey."""
    white = prints.white_of([corner[0]])
    above = [prints.toned(picture, white) for picture in corner]
    below = [prints.toned(0.2 * white + 10 * (picture - corner[0]), white) for picture in corner]
    captions = ["true", "before", "joint", "", "10 times its error", "10 times its error"]
    larger = [np.kron(picture, np.ones((3, 3), dtype=np.uint8)) for picture in (*above, *below)]
    prints.save(path, prints.mosaic(larger, captions, columns=3))


def line(row: Reached) -> str:
    """One frame in words."""
    return (
        f"joint {row.joint:.1f}, before {row.before:.1f}, mean {row.mean:.1f} dB; told: joint {row.told[0]:.1f}, "
        f"mean {row.told[1]:.1f} dB; {row.within:.0%} within 1 σ, {row.seconds:.1f} CPU-s, {row.model}"
        + ("" if np.isnan(row.known_depths) else f"; depths known {row.known_depths:.1f} dB")
    )


def table_row(rows: list[Reached]) -> str:
    """The range over the seeds, as cells of a table."""

    def between(values: Callable[[Reached], float]) -> str:
        found = [values(row) for row in rows]
        return f"{min(found):.1f} to {max(found):.1f}"

    within = f"{100 * min(r.within for r in rows):.0f} to {100 * max(r.within for r in rows):.0f} %"
    figures = [lambda r: r.joint, lambda r: r.before, lambda r: r.mean, lambda r: r.told[0], lambda r: r.told[1]]
    return " | ".join([*(between(one) for one in figures), within])


if __name__ == "__main__":
    main()
