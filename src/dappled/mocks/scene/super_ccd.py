"""The thesis' FinePix S5200 with a mask inside, simulated: RAF files on the native 45° lattice of its Super CCD."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.decode.optics.carriers import Lattice, Sensor
from dappled.decode.optics.masks import Mask
from dappled.decode.spectrum.stagger import spread_sensor
from dappled.mocks.body import super_ccd_file
from dappled.mocks.body.dng import Exif
from dappled.mocks.scene import lens, synthesis
from dappled.mocks.scene.bench import Bench, WhiteCard, boards
from dappled.mocks.scene.lens import Floats, Installation, Optics, Rays
from dappled.mocks.scene.synthesis import Grid

BLUE_FIRST: synthesis.Sites = (((0, 0), 2), ((0, 1), 1), ((1, 0), 1), ((1, 1), 1))
RED_FIRST: synthesis.Sites = (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 1))
LEVEL = 0.4
MASK_AT_MM = 1.01


@dataclass(frozen=True, slots=True)
class Finepix:
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
        return spread_sensor(profiles.camera("fujifilm-s5200").sensor(super_ccd_file.SHAPE))

    @property
    def installed(self) -> Installation:
        """How the mask really sits."""
        return Installation.drawn(self.seed, self.optics)

    @property
    def lattice(self) -> Lattice:
        """Where the carriers lie, in cycles a row and cycles a half column."""
        return lens.carrier_lattice(self.optics, self.installed, self.chip)

    def expose(self, scene: str, f_number: float, shot_number: int = 0) -> tuple[bytes, Floats]:
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
                angular=lens.angular_phases(optics, self.installed, orders, points),
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
        raw = np.clip(light * super_ccd_file.WHITE + 0.5, 0, super_ccd_file.WHITE).astype(np.uint16)
        exif = Exif("FUJIFILM", "FinePix S5200", "", self.focal_length_mm, f_number, 1e-3, 64, 0)
        views = synthesis.band_limited(radiance, grid).reshape(5, 5, 3, *_inner(grid))
        return super_ccd_file.encode(raw, exif), views


def _inner(grid: Grid) -> tuple[int, int]:
    rows, columns = grid.inner
    return rows.stop - rows.start, columns.stop - columns.start


def _stored(blue: Floats, red: Floats) -> NDArray[np.float32]:
    """(2948, 1856) the samples that exist, row by row as in the file, in the colours of `super_ccd_file.PATTERN`."""
    out = np.empty((blue.shape[0], blue.shape[1] // 2), dtype=np.float32)
    out[1::2] = blue[1::2, 1::2]
    for first, (even, odd) in ((0, (blue, red)), (2, (red, blue))):
        out[first::4, 0::2] = even[first::4, 0::4]
        out[first::4, 1::2] = odd[first::4, 2::4]
    return out
