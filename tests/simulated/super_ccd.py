"""The thesis' FinePix S5200 with a mask inside, simulated: RAF files on the native 45° lattice of its Super CCD."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from dappled.config import profiles
from dappled.decode.array_types import Singles
from dappled.decode.optics.carriers import Lattice, Mask, Sensor
from dappled.mocks.scene import lens, synthesis
from dappled.mocks.scene.bench import Bench, WhiteCard, boards
from dappled.mocks.scene.dng import Exif
from dappled.mocks.scene.lens import Installation, Optics, Rays
from dappled.mocks.scene.synthesis import Grid

BLUE_FIRST: synthesis.Sites = (((0, 0), 2), ((0, 1), 1), ((1, 0), 1), ((1, 1), 1))
RED_FIRST: synthesis.Sites = (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 1))
LEVEL = 0.4
MASK_AT_MM = 1.01


@dataclass(frozen=True, slots=True)
class MaskedFinePix:
    """A body at one focal length. `installation` is drawn from `seed`: rotation ±2°, shift, distance ±10 %."""

    seed: int
    focal_length_mm: float = 33.0
    f_number: float = 11.5
    electrons: float | None = 30_000.0

    @property
    def optics(self) -> Optics:
        """The lens at this focal length; wide open its aperture is the ideal one for the mask."""
        aperture = self.focal_length_mm / (11.38 * MASK_AT_MM)
        return Optics(self.focal_length_mm, 11.5, aperture, Mask(11.38, 2), MASK_AT_MM, law="fd")

    @property
    def chip(self) -> Sensor:
        """The whole file's samples, spread to where they stand."""
        return profiles.camera("fujifilm-s5200").sensor(SHAPE).spread()

    @property
    def installed(self) -> Installation:
        """How the mask really sits."""
        return Installation.drawn(self.seed, self.optics)

    @property
    def lattice(self) -> Lattice:
        """Where the carriers lie, in cycles a row and cycles a half column."""
        return lens.carrier_lattice(self.optics, self.installed, self.chip)

    def expose(self, scene: str, f_number: float, shot_number: int = 0) -> tuple[bytes, Singles]:
        """(RAF, views float32 (5, 5, 3, h, w) at every `Grid.step` rows and half columns) of "white" or "bench"."""
        optics, chip, lattice = self.optics, self.chip, self.lattice
        grid = Grid.of(chip.shape, lattice)
        pitch = chip.row_mm[0]
        finest = synthesis.PASS * min(grid.half_band)
        shown: WhiteCard | Bench = WhiteCard()
        if scene == "bench":
            shown = boards(self.seed, optics, (chip.size_mm[0], chip.size_mm[1]), pitch, pitch / finest)
        points = optics.aperture_points_mm(f_number).reshape(-1, 2)
        places = grid.places()
        y = (places[0] - (chip.shape[0] - 1) / 2) * chip.row_mm[0]
        x = (places[1] - (chip.shape[1] - 1) / 2) * chip.column_mm[1]
        rendering = shown.render(Rays(y, x, points, optics.focal_length_mm, optics.focus_m), None)
        level = min(LEVEL, 0.92 / (lens.peak_over_mean(optics, self.installed, points) * shown.headroom))
        radiance = rendering.radiance * np.float32(level / shown.mean_radiance)
        weights = lens.modulation(optics.mask)
        orders = list(weights)
        k = np.array(orders, dtype=np.float64)
        centre = (np.array(chip.shape) - 1) / 2
        shift = np.array(self.installed.shift_mm) * optics.mask.frequency_per_mm
        frames = [
            synthesis.mosaic(
                radiance,
                grid,
                lattice,
                angular=lens.angular_phases(optics, self.installed, orders, points) / len(points),
                weights=weights,
                origin_phase=2 * np.pi * (k @ shift - k @ lattice.matrix() @ centre),
                sites=sites,
            )
            for sites in (BLUE_FIRST, RED_FIRST)
        ]
        light = _stored(*frames)
        rng = np.random.default_rng([self.seed, 7, shot_number])
        if self.electrons is not None:
            noise = np.sqrt(np.maximum(light, 0) / self.electrons) * rng.standard_normal(light.shape, dtype=np.float32)
            light = light + noise
        raw = np.clip(light * WHITE + 0.5, 0, WHITE).astype(np.uint16)
        exif = Exif("FUJIFILM", "FinePix S5200", "", self.focal_length_mm, f_number, 1e-3, 64, 0)
        views = synthesis.band_limited(radiance, grid).reshape(5, 5, 3, *_inner(grid))
        return encode(raw, exif), views


def _inner(grid: Grid) -> tuple[int, int]:
    rows, columns = grid.inner
    return rows.stop - rows.start, columns.stop - columns.start


def _stored(blue: Singles, red: Singles) -> NDArray[np.float32]:
    """(2948, 1856) the samples that exist, row by row as in the file, in the colours of `PATTERN`."""
    out = np.empty((blue.shape[0], blue.shape[1] // 2), dtype=np.float32)
    out[1::2] = blue[1::2, 1::2]
    for first, (even, odd) in ((0, (blue, red)), (2, (red, blue))):
        out[first::4, 0::2] = even[first::4, 0::4]
        out[first::4, 1::2] = odd[first::4, 2::4]
    return out


SHAPE = (2948, 1856)
WHITE = 15_564
PATTERN = np.array([[2, 0, 2, 0], [1, 1, 1, 1], [0, 2, 0, 2], [1, 1, 1, 1]])  # red 0, green 1, blue 2
_HEAD = 148
_EXIF_IFD = 0x8769


def encode(raw: NDArray[np.uint16], exif: Exif) -> bytes:
    """The file of a mosaic (2948, 1856) in `PATTERN`'s colours. Raises ValueError for another shape."""
    if raw.shape != SHAPE:
        raise ValueError(f"a FinePix S5200 has {SHAPE[0]} × {SHAPE[1]} samples, not {raw.shape}")
    jpeg = _jpeg(exif)
    tags = [
        (0x100, struct.pack(">HH", *SHAPE)),
        (0x121, struct.pack(">HH", 1444, 3696)),
        (0x130, bytes((0x8C, 0, 0, 0))),  # the lattice's direction
        (0x2FF0, struct.pack(">4H", 320, 521, 320, 379)),  # white balance: green, red, green, blue
    ]
    table = struct.pack(">I", len(tags)) + b"".join(struct.pack(">HH", tag, len(v)) + v for tag, v in tags)
    samples = raw.astype("<u2").tobytes()
    at_table = _HEAD + len(jpeg)
    at_samples = at_table + len(table)
    places = (_HEAD, len(jpeg), at_table, len(table), at_samples, len(samples))
    head = b"FUJIFILMCCD-RAW 0201FF389501" + b"FinePix S5200".ljust(32, b"\0") + b"0100"
    head = head.ljust(84, b"\0") + struct.pack(">6I", *places)
    return head.ljust(_HEAD, b"\0") + jpeg + table + samples


def _jpeg(exif: Exif) -> bytes:
    taken = datetime.fromtimestamp(exif.taken_utc_ns // 1_000_000_000, UTC).strftime("%Y:%m:%d %H:%M:%S")
    told = Image.Exif()
    told.endian = "<"  # LibRaw reads the samples in this order, too
    told[0x010F], told[0x0110], told[0x0132] = exif.make, exif.model, taken
    detail = told.get_ifd(_EXIF_IFD)
    detail[0x829A] = IFDRational(round(exif.exposure_s * 1e6), 1_000_000)
    detail[0x829D] = IFDRational(round(exif.f_number * 10), 10)
    detail[0x8827] = exif.iso
    detail[0x9003] = taken
    detail[0x920A] = IFDRational(round(exif.focal_length_mm * 10), 10)
    body = told.tobytes()
    file = io.BytesIO()
    Image.new("RGB", (64, 48), (90, 100, 90)).save(file, "JPEG")
    # LibRaw looks for the EXIF twelve bytes on: before the JFIF segment that Pillow begins with.
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(body) + 2) + body + file.getvalue()[2:]
