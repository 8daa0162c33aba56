"""How near views in colour come to the truth, each channel by itself: python benchmarks/colour_views.py [--json].

Frames as in `views.py`, but behind a Bayer pattern of overlapping filters: boards of saturated colours, and boards with
parts of a photograph on them. "shares" are views times the local colours of the frame; "mean"
is the mean of the true views; "limit" is what colours would be if the grey views were the true ones. PSNR in dB of red,
green and blue, 1.0 = sensor white, each channel at its best exposure (a frame without a white frame is grey in its
mean, the truth is not).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from limits import show
from numpy.typing import NDArray
from views import (
    BAND,
    CALIBRATED_AT,
    DISTANCE_MM,
    F_NUMBER,
    FOCAL_MM,
    MASK,
    SNR_100,
    at_samples,
    boards,
    calibrated,
    chosen,
    in_band,
    options,
    photographs,
    psnr,
)
from views import Frame as GreyFrame

from dappled.decode.colour_views import dc_views, in_colour
from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum import plane as planes
from dappled.decode.spectrum.lineariser import lineariser
from dappled.mocks.scene.ray_camera import REAL_COLOURS, RayCamera
from dappled.mocks.scene.sharp_boards import SharpBoard
from dappled.products.exports import prints

CFA = np.array([[0, 1], [1, 2]])
COLOURS = (0, 1, 2)
SATURATED = (
    (0.9, 0.1, 0.08),
    (0.1, 0.75, 0.12),
    (0.1, 0.15, 0.9),
    (0.85, 0.75, 0.08),
    (0.8, 0.1, 0.7),
    (0.1, 0.7, 0.8),
)
FAMILIES = ("saturated", "photographs")
LEVEL = 0.2
Views = NDArray[np.floating]


def main() -> None:
    arguments, families = chosen(options(__doc__ or "", FAMILIES, seeds=2), FAMILIES)
    figures: dict[str, float] = {}
    for family in families:
        least = []
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            truth, views = decoded(family, seed, tuple(arguments.shape))
            found = {name: by_channel(of, truth) for name, of in views.items()}
            least.append(min(a - b for a, b in zip(found["made"], found["mean"], strict=True)))
            if not arguments.json:
                print(family, seed, *(f"{k} {' '.join(f'{x:.1f}' for x in v)}" for k, v in found.items()), flush=True)
        figures[f"{family}_over_mean_db"] = min(least)
    if arguments.picture:
        corner = [one[1, 0] for one in (truth, views["shares"], views["made"])]
        white = prints.white_of(corner[:1])
        prints.save(
            arguments.picture, prints.mosaic([prints.toned(p, white) for p in corner], ["true", "shares", "now"])
        )
    if arguments.json:
        show("colour_views", figures, as_json=True)


def camera(family: str, seed: int, shape: tuple[int, int]) -> RayCamera:
    """The camera before the scene of a seed."""
    plain = boards(seed, exponent=1.3, finest=BAND)
    chance = np.random.default_rng([seed, 77])
    scene = saturated(plain, chance) if family == "saturated" else photographs(plain, chance, darkest=0.03, grey=False)
    return RayCamera(
        MASK, shape=shape, seed=seed, boards=scene, full_well_e=SNR_100, stop="square", f_number=F_NUMBER, level=LEVEL,
        colour_filters=REAL_COLOURS,
    )  # fmt: skip


def saturated(plain: tuple[SharpBoard, ...], chance: np.random.Generator) -> tuple[SharpBoard, ...]:
    """Each board of another colour."""
    chosen = chance.permutation(len(SATURATED))[: len(plain)]
    return tuple(replace(board, colour=SATURATED[k]) for board, k in zip(plain, chosen, strict=True))


def decoded(family: str, seed: int, shape: tuple[int, int]) -> tuple[Views, dict[str, Views]]:
    """The true views (V, U, h, w, 3), and others of this shape: those by DC views ("made"), by "shares" of grey, the
    "mean" of the true ones, and the "limit" of those by DC views."""
    one = camera(family, seed, shape)
    frame = one.expose()
    stopped = replace(one.calibration(CALIBRATED_AT), colour_filters=None, level=LEVEL, full_well_e=SNR_100)
    weights = frame.truth.view_weights
    known = calibrated(GreyFrame(frame.plane, stopped.expose().plane, frame.truth.views[..., 1], weights))
    decoder = MaskDecoder(MaskedOptics(known.sensor, MASK, "geometric", DISTANCE_MM), known, colours=True)
    rows = lineariser(frame.plane.shape, black=0.0, white=1.0, cfa=CFA, reference=[1]).apply(frame.plane)
    field = decoder.decode(rows, focal_length_mm=FOCAL_MM, f_number=F_NUMBER)
    true = [at_samples(in_band(frame.truth.views[..., colour]), field) for colour in COLOURS]
    truth = np.stack(true, axis=-1)
    open_share = weights[:, :, None, None]
    mean = np.broadcast_to(np.nansum(truth * open_share[..., None], axis=(0, 1)), truth.shape)

    even = planes.to_plane(frame.plane, black=0.0, white=1.0, cfa=CFA)
    index = planes.colour_index(shape, CFA)
    size = field.views.shape[2], field.views.shape[3]
    colours = dc_views(even, index, COLOURS, size, field.grid)
    made = in_colour(field.views, field.slices[0].real, colours)
    shares = planes.coloured(field.views, field.grid, planes.local_colours(even, CFA, COLOURS, [1]), shape)
    grey = true_grey(frame.plane, rows.plane(), index, truth, field.grid)
    limit = in_colour(grey, np.nansum(grey * open_share, axis=(0, 1)), colours)
    views = {"made": exposed(made, truth), "shares": exposed(shares, truth), "mean": mean}
    return truth, {**views, "limit": exposed(limit, truth)}


def true_grey(
    plane: NDArray[np.float32],
    evened: NDArray[np.float32],
    index: NDArray[np.integer],
    truth: Views,
    grid: NDArray[np.float64],
) -> NDArray[np.float32]:
    """True views (V, U, h, w) of what the slices are cut from: colours evened locally, each by its share of pixels."""
    size = truth.shape[2], truth.shape[3]
    gains = dc_views(evened, index, COLOURS, size, grid) / dc_views(plane, index, COLOURS, size, grid)
    shares = np.array([np.mean(index == colour) for colour in COLOURS])
    return np.asarray(np.einsum("vuhwc,chw,c->vuhw", truth, gains, shares), dtype=np.float32)


def exposed(made: Views, truth: Views) -> Views:
    """Each channel at the exposure that suits the truth best."""
    known = np.isfinite(truth)
    there = np.where(known, truth, 0)
    gains = np.sum(made * there, axis=(0, 1, 2, 3)) / np.sum(np.where(known, made, 0) ** 2, axis=(0, 1, 2, 3))
    return np.asarray(made * gains)


def by_channel(found: Views, truth: Views) -> list[float]:
    """PSNR of each channel in dB."""
    return [psnr(found[..., colour], truth[..., colour]) for colour in COLOURS]


if __name__ == "__main__":
    main()
