"""What decoding costs, against the textbook's method and against one real FFT of the frame, in one run.

python benchmarks/decode.py [--json] [--rounds 10] [--workers 2]

Times in milliseconds, medians of rounds in which all take turns; ratios are medians of each round's own ratio, their
spread half of the range between the quartiles. `slices` is from the uint16 mosaic of a colour camera
to complex slices: levels, colours evened out, transform, slices and the frame's noise. `search` looks for the carriers
in the transform, and stands apart: with it, the sum is `decode`. `rfft2` transforms the float32 frame that stands
padded in memory; `rfft2_padding` is the call that pads the frame itself. `textbook` is NumPy in double precision: fft2
of the frame as it is, a crop around every carrier, an inverse FFT of each. Ratios that end in `_cpu` are of the
process' CPU time, which says more than the clock where other programs run. `slices_…_over_rfft2_operations` is counted:
n log₂ n for each transform that slices need (rows, columns up to the outermost carrier, inverse transforms), over the
same for the whole real transform.
"""

from __future__ import annotations

import argparse
import math
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
from limits import show
from numpy.typing import NDArray
from scipy import fft

from dappled.config import profiles
from dappled.decode.decoder import MaskDecoder
from dappled.decode.lenslets import MOSAIC_ROLLOFF, LensletDecoder
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies, transfer
from dappled.decode.lightfield.views import from_slices
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum import Lineariser, Plane, Slices
from dappled.decode.spectrum import plane as planes
from dappled.decode.spectrum.lineariser import lineariser
from dappled.decode.spectrum.plane import coloured, local_colours
from dappled.decode.spectrum.slices import BandShape, extract
from dappled.decode.spectrum.transform import SpectrumBuffers, noise_rms, padded_shape, transform

SHAPE = (2776, 3688)
LENSLETS = (3280, 3280)
LENGTHS_MM = (12, 13, 33)
BAYER = np.array([[0, 1], [1, 2]])
BLACK, WHITE = 1024, 15360
Mosaic = NDArray[np.uint16]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    show("decode", measure(arguments.rounds, arguments.workers), as_json=arguments.json)


def measure(rounds: int, workers: int) -> dict[str, float]:
    """All figures by name; ratios are of times in this run."""
    mosaic = noise(SHAPE)
    linear = lineariser(SHAPE, black=BLACK, white=WHITE, cfa=BAYER, reference=[1])
    decoder = masked(workers)
    frame = linear.apply(mosaic).plane(workers)
    high, wide = padded_shape(SHAPE)
    padded = np.zeros((high, wide), dtype=np.float32)
    padded[: SHAPE[0], : SHAPE[1]] = frame
    work: dict[str, Callable[[], Any]] = {
        "rfft2": lambda: fft.rfft2(padded, workers=workers),
        "rfft2_padding": lambda: fft.rfft2(frame, s=(high, wide), workers=workers),
    }
    buffers = SpectrumBuffers()
    for length in LENGTHS_MM:
        work[f"slices_{length}mm"] = lambda length=length: slices(buffers, linear, decoder, mosaic, length)  # type: ignore[misc]  # a default binds the loop's value
        work[f"search_{length}mm"] = search(decoder, frame, length)
        work[f"decode_{length}mm"] = lambda length=length: decode(linear, decoder, mosaic, length)  # type: ignore[misc]  # the same
    work["views_13mm"] = views(buffers, linear, decoder, mosaic)
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in work}
    for _ in range(rounds):  # in turn, so that a busy moment falls on all
        for name, do in work.items():
            taken[name].append(timed(do))
    pairs = [(timed(lambda: textbook(mosaic, decoder, 13)), timed(work["slices_13mm"])) for _ in range(3)]
    old, new = zip(*pairs, strict=True)
    taken["textbook_13mm"] = list(old)
    figures = {f"{name}_ms": median(wall for wall, _ in times) for name, times in taken.items()}
    for name in [name for name in work if name.startswith(("slices", "decode", "views"))]:
        for whole in ("rfft2", "rfft2_padding"):
            figures |= ratios(f"{name}_over_{whole}", taken[name], taken[whole])
    for length in LENGTHS_MM:
        figures[f"slices_{length}mm_over_rfft2_operations"] = operations(decoder, length)
    figures |= ratios("textbook_over_slices_13mm", old, new)
    figures["peak_memory_over_float32_frame"] = peak_memory(decoder, linear, mosaic)
    figures["lenslet_colour_views_ms"] = lenslet_colour_views(rounds, workers)
    return figures


def ratios(name: str, above: Sequence[tuple[float, float]], below: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Median ratios of paired (wall, CPU) times, and the spread of the CPU ratio."""
    walls = [a[0] / b[0] for a, b in zip(above, below, strict=True)]
    cpus = [a[1] / b[1] for a, b in zip(above, below, strict=True)]
    low, high = np.quantile(cpus, [0.25, 0.75])
    return {name: median(walls), f"{name}_cpu": median(cpus), f"{name}_cpu_spread": float(high - low) / 2}


def operations(decoder: MaskDecoder, length: float) -> float:
    """Operations of the transforms for slices at a focal length, over those of the padded frame's whole rfft2."""

    def one(n: int) -> float:
        return n * math.log2(n)

    high, wide = padded_shape(SHAPE)
    columns = min(wide // 2 + 1, math.ceil(decoder.largest_fx(length) * wide) + 2)
    rows, whole = SHAPE[0] * one(wide) / 2, high * one(wide) / 2 + (wide // 2 + 1) * one(high)
    tall, broad = decoder.slice_size(decoder.lattice_at(length))
    inverse = len(decoder.predict(length)) * (broad * one(tall) + tall * one(broad))
    return (rows + columns * one(high) + inverse) / whole


def noise(shape: tuple[int, int]) -> Mosaic:
    """A mosaic without structure: what decoding costs doesn't depend on it."""
    return np.random.default_rng(0).integers(BLACK, WHITE - 2000, shape, dtype=np.uint16)


def masked(workers: int) -> MaskDecoder:
    """The S5200 with the full second mask under the law `fd`."""
    camera = profiles.camera("fujifilm-s5200")
    mask = profiles.mask("mask-2-full").mask
    return MaskDecoder(MaskedOptics(camera.sensor(SHAPE), mask, "fd", camera.mask_distance_mm), workers=workers)


def slices(buffers: SpectrumBuffers, linear: Lineariser, decoder: MaskDecoder, mosaic: Mosaic, length: float) -> Slices:
    """The mosaic to slices, at the predicted carriers."""
    lattice, carriers = decoder.lattice_at(length), decoder.predict(length)
    with buffers.lend(SHAPE) as tiles:
        rows, reach = linear.apply(mosaic), decoder.largest_fx(length)
        spectrum = transform(rows, tiles=tiles, workers=decoder.workers, largest_fx=reach)
        cut = extract(spectrum, carriers, BandShape(decoder.slice_size(lattice)), workers=decoder.workers)
        noise_rms(spectrum)
    return cut


def search(decoder: MaskDecoder, frame: Plane, length: float) -> Callable[[], Any]:
    """The search for the carriers in a spectrum that is there."""
    spectrum, predicted = decoder.transform(frame, length), decoder.predict(length)
    return lambda: decoder.locate(spectrum, length, predicted)


def decode(linear: Lineariser, decoder: MaskDecoder, mosaic: Mosaic, length: float) -> Any:
    """The mosaic to slices at the carriers that were searched for, as the daemon does it."""
    rows = linear.apply(mosaic)
    return decoder.decode_reported(rows, focal_length_mm=length, views=False)


def views(buffers: SpectrumBuffers, linear: Lineariser, decoder: MaskDecoder, mosaic: Mosaic) -> Callable[[], Any]:
    """Slices to 5 × 5 views."""
    cut = slices(buffers, linear, decoder, mosaic, 13)
    orders = [(carrier.ky, carrier.kx) for carrier in cut.carriers]
    transfers = transfer(orders, np.where(np.arange(len(orders)) == 0, 1.0, 0.5), (0.1, 0.2))
    return lambda: from_slices(
        cut.values, angular_frequencies(orders, 1.0, 0.0), transfers, aperture=Aperture(5), noise_variance=1e-4
    )


def textbook(mosaic: Mosaic, decoder: MaskDecoder, length: float) -> list[NDArray[np.complex128]]:
    """FFT of the whole frame in double precision, a crop around every carrier's nearest bin, an inverse FFT each.

    The crops are as large as the spacing allows in the frame's own bins.
    """
    spectrum = np.fft.fftshift(np.fft.fft2(mosaic.astype(np.float64)))
    lattice = decoder.lattice_at(length)
    height, width = int(lattice.ky[0] * SHAPE[0]), int(lattice.kx[1] * SHAPE[1])
    made = []
    half = decoder.optics.mask.half_orders()
    for carrier in lattice.carriers([*half, *((-ky, -kx) for ky, kx in half if (ky, kx) != (0, 0))]):
        row = SHAPE[0] // 2 + round(carrier.fy * SHAPE[0]) - height // 2
        column = SHAPE[1] // 2 + round(carrier.fx * SHAPE[1]) - width // 2
        crop = spectrum[max(row, 0) : row + height, max(column, 0) : column + width]
        made.append(np.fft.ifft2(np.fft.ifftshift(crop)))
    return made


def peak_memory(decoder: MaskDecoder, linear: Lineariser, mosaic: Mosaic) -> float:
    """What a warm decoder holds at most, its own buffers included, over the frame as float32; the mosaic left out."""
    tracemalloc.start()
    fresh = replace(decoder, buffers=SpectrumBuffers())
    for _ in range(2):
        decode(linear, fresh, mosaic, 13)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / (4 * mosaic.size)


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

    def plane(mosaic: Mosaic) -> Plane:
        return planes.to_plane(mosaic, black=BLACK, white=WHITE, cfa=BAYER, balance=balance)

    linear = lineariser(LENSLETS, black=BLACK, white=WHITE, cfa=BAYER, balance=balance, reference=[0, 1, 2])
    decoder = LensletDecoder.with_white(plane(white), workers=workers, rolloff=MOSAIC_ROLLOFF)

    def to_views() -> Any:
        chroma = local_colours(plane(frame), BAYER, [0, 1, 2], [0, 1, 2])
        field = decoder.decode(linear.apply(frame))
        return replace(field, views=coloured(field.views, field.grid, chroma, LENSLETS))

    return min(timed(to_views)[0] for _ in range(min(rounds, 3)))


def timed(work: Callable[[], Any]) -> tuple[float, float]:
    """Milliseconds that a call took: on the wall, and CPU time of all threads together."""
    began, cpu = time.perf_counter(), time.process_time()
    work()
    return (time.perf_counter() - began) * 1e3, (time.process_time() - cpu) * 1e3


if __name__ == "__main__":
    main()
