"""Find the lattice of a mask's carriers in one stopped-down frame, wherever it is, to a hundredth of a bin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.calibration.law_search import search_laws
from dappled.decode.errors import DecodeError, NoCarriers
from dappled.decode.lightfield.aperture import relative_transfer
from dappled.decode.optics import Carrier, Lattice, Mask, MaskedOptics, Order
from dappled.decode.spectrum import Spectrum
from dappled.decode.spectrum.mask_lattice import MaskLattice, levels
from dappled.decode.spectrum.peaks import Measured, fit, measure, residual_bins
from dappled.decode.spectrum.slices import BandShape, extract
from dappled.decode.spectrum.transform import transform
from dappled.findings import Code, Finding, Level, Subject

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

_CLEAR = 6.5  # times the level around: noise moves a carrier so strong by less than a tenth of a bin


@dataclass(frozen=True, slots=True, eq=False)
class FrameLattice:
    """What one calibration frame shows: its lattice, the carriers seen, and each slice's factor on the mean's.

    `relative` complex (K,) belongs to `orders`, DC first. `focal_sigma_mm`
    is the standard error of its focal length. `weak` says that its carriers are so weak that noise moves them.
    """

    focal_length_mm: float
    f_number: float
    lattice: Lattice
    residual_bins: float
    found: tuple[tuple[Carrier, Measured], ...]
    orders: tuple[Order, ...]
    relative: NDArray[np.complex128]
    focal_sigma_mm: float = 0.0
    weak: Finding | None = None


def frame_lattice(
    plane: NDArray[np.float32],
    optics: MaskedOptics,
    *,
    focal_length_mm: float,
    f_number: float,
    workers: int = 1,
    narrowest_f: float | None = None,
) -> FrameLattice:
    """Find the mask's carriers in a frame, near the prediction of either law. Raises NoCarriers with the reason, which
    says what a lens can do that ends at the stop `narrowest_f`."""
    sensor, mask = optics.sensor, optics.mask
    if plane.shape != sensor.shape:
        raise DecodeError(f"the calibration frame is {plane.shape}, the camera's are {sensor.shape}")
    spectrum = transform(plane, workers=workers)
    search = search_laws(
        spectrum,
        optics,
        focal_length_mm=focal_length_mm,
        f_number=f_number,
        anywhere=True,
        narrowest_f=narrowest_f,
    )
    if search.found is None:
        assert search.unseen is not None
        raise NoCarriers(search.unseen, expected=search.expected, focal_length_mm=focal_length_mm, f_number=f_number)
    lattice, found = _fitted(spectrum, search.found, mask)
    lattice = refine(spectrum, lattice, [(0, 0), *((c.ky, c.kx) for c, _ in found)], workers)
    residual = residual_bins(lattice.carriers([(c.ky, c.kx) for c, _ in found]), [m for _, m in found], spectrum)
    carriers = [c for c in lattice.carriers(mask.half_orders()) if c.on_sensor]
    values = extract(spectrum, carriers, BandShape(lattice=lattice), workers=workers).values
    return FrameLattice(
        focal_length_mm,
        f_number,
        lattice,
        residual,
        tuple(found),
        tuple((c.ky, c.kx) for c in carriers),
        relative_transfer(values),
        weak=_weak(spectrum, found, focal_length_mm, f_number),
    )


def _weak(
    spectrum: Spectrum, found: Sequence[tuple[Carrier, Measured]], focal_length_mm: float, f_number: float
) -> Finding | None:
    """That the carriers that stand clear of the noise are too few to place a lattice; else None."""
    level = levels(spectrum, [c for c, _ in found])
    clear = [(c.ky, c.kx) for (c, m), one in zip(found, level, strict=True) if m.strength > _CLEAR * one]
    if len(clear) > 1 and np.linalg.matrix_rank(clear) == 2:
        return None
    lens = {"focal_length_mm": focal_length_mm, "f_number": f_number}
    return Finding(Code.LATTICE_WEAK, Subject("calibration"), {**lens, "carriers": 2 * len(clear)}, Level.CAUTION)


def _fitted(spectrum: Spectrum, at: MaskLattice, mask: Mask) -> tuple[Lattice, list[tuple[Carrier, Measured]]]:
    """The lattice fitted to all of the mask's carriers that stand on it, and those."""
    lattice, found = at.lattice, list(at.found)
    for _ in range(2):
        looked = [c for c in lattice.carriers(mask.half_orders()) if c.on_sensor and (c.ky, c.kx) != (0, 0)]
        near = [(c, m) for c, m in zip(looked, measure(spectrum, looked, 1.0), strict=True) if m is not None]
        known = {(c.ky, c.kx) for c, _ in near}
        found = near + [(c, m) for c, m in at.found if (c.ky, c.kx) not in known]
        lattice = fit(found)
    carriers = {(c.ky, c.kx): c for c in lattice.carriers([(c.ky, c.kx) for c, _ in found])}
    return lattice, [(carriers[c.ky, c.kx], m) for c, m in found]


def refine(spectrum: Spectrum, lattice: Lattice, orders: Sequence[Order], workers: int = 1) -> Lattice:
    """The lattice to a hundredth of a bin: what phase ramp is left in each slice against the DC slice is taken off."""
    size = lattice.slice_size(spectrum.padded)
    for _ in range(2):
        carriers = [c for c in lattice.carriers(orders) if c.on_sensor]
        values = extract(spectrum, carriers, BandShape(size), workers=workers)
        k, shifts, weights = [], [], []
        for carrier, image in zip(carriers[1:], values.values[1:], strict=True):
            ramp, weight = _ramp(image * np.conj(values.values[0]))
            k.append((carrier.ky, carrier.kx))
            shifts.append(ramp / (values.grid[0, 0], values.grid[1, 1]))
            weights.append(weight)
        root = np.sqrt(np.array(weights))[:, None]
        correction = np.linalg.lstsq(np.array(k, dtype=np.float64) * root, np.array(shifts) * root, rcond=None)[0]
        lattice = Lattice.of(lattice.matrix() + correction)
    return lattice


def _ramp(product: NDArray[np.complex64], blocks: int = 8) -> tuple[NDArray[np.float64], float]:
    """Phase slope (y, x) in cycles a sample of a product of slices, and a weight; from the phases of block means under
    a Hann window: the frame's ends ring, opposite ones with opposite phases, and turned a white frame's lattice of
    694 × 922 px into one 5e-6 too small."""
    down, across = (np.hanning(side + 2)[1:-1].astype(np.float32) for side in product.shape)
    product = product * down[:, None] * across
    rows = np.array_split(np.arange(product.shape[0]), min(blocks, product.shape[0]))
    columns = np.array_split(np.arange(product.shape[1]), min(blocks, product.shape[1]))
    means = np.array([[product[np.ix_(r, c)].sum() for c in columns] for r in rows])
    middle = np.array([[(r.mean(), c.mean()) for c in columns] for r in rows]).reshape(-1, 2)
    whole = means.sum()
    phase = np.angle(means * np.conj(whole)).ravel() / (2 * np.pi)
    weight = np.sqrt(np.abs(means).ravel())
    design = np.column_stack([middle - middle.mean(axis=0), np.ones(len(middle))])
    slope = np.linalg.lstsq(design * weight[:, None], phase * weight, rcond=None)[0]
    coherence = abs(whole) / max(float(np.abs(means).sum()), 1e-30)
    return slope[:2], float(abs(whole) * coherence**4)
