"""Decode lenslet frames by the same method: carriers on a lattice that is found, all orders that the frame shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.decoder import DecodeReport, light_field
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.aperture import Aperture, at_centre, at_corner, relative_transfer
from dappled.decode.lightfield.light_field import LightField, no_views
from dappled.decode.lightfield.views import Views, from_lenslet_slices
from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.lattice import FoundLattice, find_lattice
from dappled.decode.spectrum.lineariser import size_text
from dappled.decode.spectrum.slices import BandShape, Slices, extract
from dappled.decode.spectrum.transform import Source, Spectrum, SpectrumBuffers, noise_rms, transform

_MOST_VIEWS = 15  # per axis
# cycles/pixel: the chroma of a Bayer mosaic stands around 0.5, where the information of a pixel ends. Chosen on the
# frames of benchmarks/lenslets.py.
MOSAIC_ROLLOFF = 0.25
_DARKEST = 0.05  # of the white frame's brightest view: darker parts are not brightened further


@dataclass(frozen=True, slots=True, eq=False)
class White:
    """What a white frame shows: its lattice, the lenslets' origin (cycles at the frame's centre), its views."""

    found: FoundLattice
    origin: tuple[float, float]
    views: Views


@dataclass(frozen=True, slots=True, eq=False)
class LensletDecoder:
    """Decodes lenslet frames. With a white frame the lattice, its origin and the vignetting of the views are the
    white frame's; without one, the lattice is found again in each frame (half a second for ten megapixels).

    `rolloff` in cycles/pixel (`MOSAIC_ROLLOFF` for colour mosaics) reduces the noise and chroma of far carriers.
    `views_per_axis` odd; None: as many as the seen orders carry, no more than the pixels under a lenslet, and 15.
    """

    shape: tuple[int, int]
    white: White | None = None
    views_per_axis: int | None = None
    workers: int = 1
    rolloff: float | None = None
    buffers: SpectrumBuffers = field(default_factory=SpectrumBuffers, repr=False)

    @classmethod
    def with_white(cls, white_plane: Source, *, workers: int = 1, rolloff: float | None = None) -> LensletDecoder:
        """A decoder with a white frame (float32 (H, W)). Raises DecodeError where that shows no lenslets."""
        shape = (white_plane.shape[0], white_plane.shape[1])
        spectrum = transform(white_plane, workers=workers)
        found = find_lattice(spectrum)
        slices = _cut(spectrum, found, workers)
        origin = lenslet_origin(slices)
        count = views_carried(found)
        views = from_lenslet_slices(slices.values, slices.carriers, origin, offsets_px(found.lattice, count), rolloff)
        white = White(found, at_centre(origin, found.lattice, shape), views)
        return cls(shape, white, count, workers, rolloff)

    def decode(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None
    ) -> LightField:
        """The light field of a plane float32 (H, W). Raises DecodeError."""
        return self.decode_reported(plane, focal_length_mm=focal_length_mm, f_number=f_number)[0]

    def decode_reported(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None, views: bool = True
    ) -> tuple[LightField, DecodeReport]:
        """`decode`, and which carriers it used; without `views` only the slices.

        Focal length and f-number only go into the attributes.
        """
        if plane.shape != self.shape:
            raise DecodeError(
                f"the frame is {size_text(plane.shape)}, this decoder is made for {size_text(self.shape)}"
            )
        with self.buffers.lend(self.shape) as tiles:
            spectrum = transform(plane, tiles=tiles, workers=self.workers)
            found = self.white.found if self.white is not None else find_lattice(spectrum)
            slices = _cut(spectrum, found, self.workers)
            noise = noise_rms(spectrum)
        if self.white is not None:
            origin = at_corner(self.white.origin, found.lattice, self.shape)
        else:
            origin = lenslet_origin(slices)
        count = self.views_per_axis or views_carried(found)
        if views:
            at = offsets_px(found.lattice, count)
            made = from_lenslet_slices(slices.values, slices.carriers, origin, at, self.rolloff)
            if self.white is not None:
                made = flattened(made, self.white.views)
            offsets = Aperture(count).offsets()
        else:
            made, offsets = no_views(slices.values.shape[1:])
        seen = dict(zip(found.orders, found.measured, strict=True))
        report = DecodeReport(
            predicted=slices.carriers,
            measured=tuple(seen.get((c.ky, c.kx)) for c in slices.carriers),
            used=slices.carriers,
            carriers_from="calibrated" if self.white is not None else "found",
            views_from="none" if not views else "white" if self.white is not None else "frame",
            noise_rms=noise,
        )
        facts: dict[str, Any] = {
            "law": "found",
            "focal_length_mm": focal_length_mm,
            "f_number": f_number,
            "lenslet_pitch_px": list(found.spacing_px),
            "lattice_rotation_rad": found.rotation_rad,
        }
        return light_field(slices, made, offsets, shape=plane.shape, report=report, facts=facts), report


def views_carried(found: FoundLattice) -> int:
    """Views an axis, odd: 2p + 1 of the p orders seen, no more than the pixels under a lenslet, no more than 15."""
    spacing = math.sqrt(found.spacing_px[0] * found.spacing_px[1])
    orders = _reach(found) * spacing
    most = min(2 * round(orders) + 1, int(spacing), _MOST_VIEWS)
    return max(3, most if most % 2 else most - 1)


def offsets_px(lattice: Lattice, count: int) -> NDArray[np.float64]:
    """(N, N, 2) pixels (row, column) from a lenslet's centre to each view's, the pitch divided into `count` steps."""
    pitch = float(np.hypot(*np.linalg.inv(lattice.matrix())).mean())
    return Aperture(count).offsets() * pitch


def lenslet_origin(slices: Slices) -> tuple[float, float]:
    """x0 in cycles at pixel (0, 0): where the lenslets' images are centred.

    Fitted to the phases of all carriers, which are lattice-linear but for a sign: many have a negative transfer. The
    innermost ones are positive, as the images are bright in their middle.
    """
    orders = np.array([(c.ky, c.kx) for c in slices.carriers[1:]], dtype=np.float64)
    seen = relative_transfer(slices.values)[1:]
    radius = np.array([math.hypot(c.fy, c.fx) for c in slices.carriers[1:]])
    inner = radius < 1.2 * radius.min()
    weights = np.abs(seen) ** 2
    steps = np.arange(0, 1, 1 / 32)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    score = (np.exp(-2j * np.pi * grid @ orders[inner].T) @ seen[inner]).real
    best = grid[int(np.argmax(score))]
    for close in (inner, weights > 0.01 * weights.max()):
        for _ in range(20):  # Gauss–Newton on the doubled phases, which know no sign
            aligned = seen[close] * np.exp(-2j * np.pi * (orders[close] @ best))
            residual = np.angle(aligned**2) / (4 * np.pi)
            root = np.sqrt(weights[close])[:, None]
            step = np.linalg.lstsq(orders[close] * root, residual[:, None] * root, rcond=None)[0][:, 0]
            best = best + step
    return float(best[0]), float(best[1])


def flattened(views: Views, white: Views) -> Views:
    """The views over the white frame's, which are 1 at their brightest view's mean."""
    if views.shape != white.shape:
        raise DecodeError(
            f"the white frame's views are {white.shape}, the frame's {views.shape}: use its own white frame"
        )
    top = float(white.mean(axis=(2, 3)).max())
    divided: Views = views / np.maximum(white / np.float32(top), np.float32(_DARKEST))
    return divided


def _reach(found: FoundLattice) -> float:
    """The largest frequency of a verified carrier in cycles/pixel."""
    return max(math.hypot(c.fy, c.fx) for c in found.carriers)


def _cut(spectrum: Spectrum, found: FoundLattice, workers: int) -> Slices:
    """Slices of all carriers of the half plane as far out as any was verified, bands going round at Nyquist."""
    carriers = carriers_within(found.lattice, 1.01 * _reach(found))
    return extract(spectrum, carriers, BandShape(lattice=found.lattice, window="cell", wrap=True), workers=workers)


def carriers_within(lattice: Lattice, reach: float) -> list[Carrier]:
    """(0, 0) and the half plane's lattice points up to `reach` cycles/pixel, none beyond Nyquist, in rising order."""
    inverse = np.hypot(*np.linalg.inv(lattice.matrix()))
    most = [math.ceil(reach * float(side)) for side in inverse]
    orders: Sequence[tuple[int, int]] = [
        (ky, kx) for ky in range(most[0] + 1) for kx in range(-most[1], most[1] + 1) if (ky, kx) >= (0, 0)
    ]
    return [c for c in lattice.carriers(orders) if c.on_sensor and math.hypot(c.fy, c.fx) <= reach]
