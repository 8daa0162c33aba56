"""What decoding costs, against the textbook's method and against one real FFT of the frame, in one run.

python benchmarks/decode.py [--json] [--rounds 5] [--workers 2]

Times in milliseconds, the least of the rounds. `ours` is from the uint16 mosaic of a colour camera to complex slices,
everything on the way included: levels, colours, transform, search, noise, slices.
"""

from __future__ import annotations

import argparse
import json
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.config import profiles
from dappled.decode import plane as planes
from dappled.decode.decoder import MaskDecoder
from dappled.decode.exposure import developer
from dappled.decode.lenslets import MOSAIC_ROLLOFF, LensletDecoder
from dappled.decode.spectrum import padded_shape
from dappled.decode.views import Aperture, from_slices, transfer

SHAPE = (2776, 3688)
LENSLETS = (3280, 3280)
BAYER = np.array([[0, 1], [1, 2]])
BLACK, WHITE = 1024, 15360
Mosaic = NDArray[np.uint16]
DEVELOPER = developer(SHAPE, black=BLACK, white=WHITE, cfa=BAYER, reference=[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    figures = measure(arguments.rounds, arguments.workers)
    if arguments.json:
        print(json.dumps(figures, indent=2))
    else:
        for name, value in figures.items():
            print(f"{name:36} {value:10.2f}")


def measure(rounds: int, workers: int) -> dict[str, float]:
    """All figures by name; ratios are of times in this run."""
    mosaic = noise(SHAPE)
    padded = np.zeros(padded_shape(SHAPE), dtype=np.float32)
    padded[: SHAPE[0], : SHAPE[1]] = planes.to_plane(mosaic, black=BLACK, white=WHITE, cfa=BAYER)
    decoders = masked(workers)
    work: dict[str, Callable[[], Any]] = {"rfft2_ms": lambda: fft.rfft2(padded, workers=workers)}
    for length in (12, 13, 33):
        work[f"slices_{length}mm_ms"] = lambda length=length: slices(decoders, mosaic, length, workers)  # type: ignore[misc]  # a default binds the loop's value
    work["views_13mm_ms"] = views(decoders, mosaic, workers)
    took = dict.fromkeys(work, np.inf)
    for _ in range(rounds):  # in turn, so that a busy moment falls on all
        for name, do in work.items():
            took[name] = min(took[name], timed(do))
    textbook_ms = min(timed(lambda: textbook(mosaic, decoders)) for _ in range(2))
    figures = {name: float(ms) for name, ms in took.items()}
    figures["textbook_13mm_ms"] = textbook_ms
    figures["slices_13mm_over_rfft2"] = took["slices_13mm_ms"] / took["rfft2_ms"]
    figures["slices_33mm_over_rfft2"] = took["slices_33mm_ms"] / took["rfft2_ms"]
    figures["views_13mm_over_rfft2"] = took["views_13mm_ms"] / took["rfft2_ms"]
    figures["textbook_over_slices_13mm"] = textbook_ms / took["slices_13mm_ms"]
    tracemalloc.start()
    slices(decoders, mosaic, 13, workers)
    figures["peak_memory_over_float32_frame"] = tracemalloc.get_traced_memory()[1] / (4 * mosaic.size)
    tracemalloc.stop()
    figures["lenslet_colour_views_ms"] = lenslet_colour_views(rounds, workers)
    return figures


def noise(shape: tuple[int, int]) -> Mosaic:
    """A mosaic without structure: what decoding costs doesn't depend on it."""
    return np.random.default_rng(0).integers(BLACK, WHITE - 2000, shape, dtype=np.uint16)


def masked(workers: int) -> MaskDecoder:
    """The S5200 with the full second mask under the law `fd`."""
    camera = profiles.camera("fujifilm-s5200")
    mask = profiles.mask("mask-2-full").mask
    return MaskDecoder(camera.sensor(SHAPE), mask, "fd", camera.mask_distance_mm, workers=workers)


def slices(decoder: MaskDecoder, mosaic: Mosaic, length: float, workers: int) -> Any:
    """The mosaic to slices."""
    exposure = DEVELOPER.expose(mosaic, workers=workers)
    return decoder.decode_reported(exposure, focal_length_mm=length, views=False)


def views(decoder: MaskDecoder, mosaic: Mosaic, workers: int) -> Callable[[], Any]:
    """Slices to 5 × 5 views."""
    cut, _ = slices(decoder, mosaic, 13, workers)
    orders = [(int(ky), int(kx)) for ky, kx, _, _ in cut.carriers]
    transfers = transfer(orders, np.where(np.arange(len(orders)) == 0, 1.0, 0.5), (0.1, 0.2))
    return lambda: from_slices(
        cut.slices, orders, transfers, kappa_cycles=1.0, rotation_rad=0.0, aperture=Aperture(5), noise_variance=1e-4
    )


def textbook(mosaic: Mosaic, decoder: MaskDecoder) -> list[NDArray[np.complex128]]:
    """FFT of the whole frame in double precision, a crop around every carrier's nearest bin, an inverse FFT each."""
    spectrum = np.fft.fftshift(np.fft.fft2(mosaic.astype(np.float64)))
    lattice = decoder.lattice_at(13)
    height, width = decoder.slice_size(lattice)
    made = []
    half = decoder.mask.half_orders()
    for carrier in lattice.carriers([*half, *((-ky, -kx) for ky, kx in half if (ky, kx) != (0, 0))]):
        row = SHAPE[0] // 2 + round(carrier.fy * SHAPE[0]) - height // 2
        column = SHAPE[1] // 2 + round(carrier.fx * SHAPE[1]) - width // 2
        crop = spectrum[max(row, 0) : row + height, max(column, 0) : column + width]
        made.append(np.fft.ifft2(np.fft.ifftshift(crop)))
    return made


def lenslet_colour_views(rounds: int, workers: int) -> float:
    """A hexagonal Bayer raw of 3280² to colour views, its white frame known."""
    y, x = np.mgrid[0 : LENSLETS[0], 0 : LENSLETS[1]].astype(np.float32)
    light = np.zeros(LENSLETS, dtype=np.float32)
    for angle in (0.0009, np.pi / 3, 2 * np.pi / 3):
        light += np.cos(2 * np.pi * 0.1155 * (np.cos(angle) * y + np.sin(angle) * x))
    white = (BLACK + 3000 * np.exp(0.8 * light / 3)).astype(np.uint16)
    scene = 0.7 + 0.2 * np.sin(x / 57) * np.cos(y / 43)
    scene[0::2, 0::2] *= 0.6
    frame = (BLACK + (white - BLACK) * scene).astype(np.uint16)
    balance = planes.estimate_balance(white, black=BLACK, cfa=BAYER)

    def plane(mosaic: Mosaic) -> planes.Plane:
        return planes.to_plane(mosaic, black=BLACK, white=WHITE, cfa=BAYER, balance=balance, workers=workers)

    decoder = LensletDecoder.with_white(plane(white), workers=workers, rolloff=MOSAIC_ROLLOFF)

    def decode() -> Any:
        made = plane(frame)
        chroma = planes.local_colours(made, BAYER, [0, 1, 2], [0, 1, 2])
        planes.even_colours(made, BAYER, [0, 1, 2], workers=workers)
        field = decoder.decode(made)
        return replace(field, views=planes.coloured(field.views, field.grid, chroma, LENSLETS))

    return min(timed(decode) for _ in range(min(rounds, 3)))


def timed(work: Callable[[], Any]) -> float:
    """Milliseconds that a call took."""
    began = time.perf_counter()
    work()
    return (time.perf_counter() - began) * 1e3


if __name__ == "__main__":
    main()
