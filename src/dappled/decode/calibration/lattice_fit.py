"""Find the lattice of a mask's carriers in one stopped-down frame, wherever it is, to a hundredth of a bin."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.aperture import relative_transfer
from dappled.decode.optics import LAWS, Carrier, Lattice, Mask, Order, Sensor
from dappled.decode.spectrum import Spectrum
from dappled.decode.spectrum.lattice import candidates, find_lattice
from dappled.decode.spectrum.peaks import FARTHER, Measured, fit, measure, residual_bins
from dappled.decode.spectrum.slices import extract
from dappled.decode.spectrum.transform import transform

_ALIKE_BINS = 0.5  # rms from their lattice: peaks farther off belong to the scene
_ENOUGH = 0.6  # of a mask's carriers: a prediction with so many peaks near it is the right one


@dataclass(frozen=True, slots=True, eq=False)
class FrameLattice:
    """What one calibration frame shows: its lattice, the carriers seen, and each slice's factor on the mean's.

    `relative` complex (K,) belongs to `orders`, DC first.
    """

    focal_length_mm: float
    f_number: float
    lattice: Lattice
    residual_bins: float
    found: tuple[tuple[Carrier, Measured], ...]
    orders: tuple[Order, ...]
    relative: NDArray[np.complex128]


def frame_lattice(
    plane: NDArray[np.float32],
    *,
    focal_length_mm: float,
    f_number: float,
    sensor: Sensor,
    mask: Mask,
    law: str,
    mask_distance_mm: float,
    workers: int = 1,
) -> FrameLattice:
    """Find the mask's carriers in a frame: near the prediction of the law, near that of the other one, or anywhere."""
    if plane.shape != sensor.shape:
        raise DecodeError(f"the calibration frame is {plane.shape}, the camera's are {sensor.shape}")
    spectrum = transform(plane, workers=workers)
    lattice, found = _located(
        spectrum,
        sensor=sensor,
        mask=mask,
        law=law,
        mask_distance_mm=mask_distance_mm,
        focal_length_mm=focal_length_mm,
    )
    orders = [(c.ky, c.kx) for c in lattice.carriers(mask.half_orders()) if c.on_sensor]
    lattice = refine(spectrum, lattice, orders, workers)
    residual = residual_bins(lattice.carriers([(c.ky, c.kx) for c, _ in found]), [m for _, m in found], spectrum)
    carriers = [c for c in lattice.carriers(orders) if c.on_sensor]
    values = extract(spectrum, carriers, lattice=lattice, workers=workers).values
    return FrameLattice(
        focal_length_mm,
        f_number,
        lattice,
        residual,
        tuple(found),
        tuple((c.ky, c.kx) for c in carriers),
        relative_transfer(values),
    )


def _located(
    spectrum: Spectrum, *, sensor: Sensor, mask: Mask, law: str, mask_distance_mm: float, focal_length_mm: float
) -> tuple[Lattice, list[tuple[Carrier, Measured]]]:
    """The lattice on which most of the mask's carriers lie, and those carriers; the law's own prediction is tried
    first."""
    best: tuple[Lattice, list[tuple[Carrier, Measured]]] | None = None
    most = 0.0
    first = ""
    guesses = _guesses(
        spectrum,
        sensor=sensor,
        mask=mask,
        law=law,
        mask_distance_mm=mask_distance_mm,
        focal_length_mm=focal_length_mm,
    )
    for guess in guesses:
        try:
            lattice, found, share = _verified(spectrum, guess(), mask)
        except DecodeError as error:
            first = first or str(error)
            continue
        if share > _ENOUGH:
            return lattice, found
        if share > most:
            best, most = (lattice, found), share
    if best is None:
        raise DecodeError(first)
    return best


def _guesses(
    spectrum: Spectrum, *, sensor: Sensor, mask: Mask, law: str, mask_distance_mm: float, focal_length_mm: float
) -> list[Callable[[], Lattice]]:
    """Where to look for the lattice, the likeliest place first."""

    def near(name: str) -> Lattice:
        predicted = LAWS[name](mask, sensor, mask_distance_mm, focal_length_mm)
        orders = [(c.ky, c.kx) for c in predicted.carriers(mask.half_orders()) if c.on_sensor]
        return search(spectrum, predicted, orders)

    def anywhere() -> Lattice:
        found = find_lattice(spectrum).lattice
        if mask.pattern == "full":
            return found
        (ay, ax), (by, bx) = found.ky, found.kx  # a diagonal mask's shortest steps are (1, 1) and (1, -1)
        sums, differences = ((ay + by) / 2, (ax + bx) / 2), ((ay - by) / 2, (ax - bx) / 2)
        ky, kx = sorted((sums, differences), key=lambda v: -abs(v[0]))
        return Lattice(ky if ky[0] > 0 else (-ky[0], -ky[1]), kx if kx[1] > 0 else (-kx[0], -kx[1]))

    others = [name for name in LAWS if name != law]
    return [*(partial(near, name) for name in (law, *others)), anywhere]


def _verified(
    spectrum: Spectrum, lattice: Lattice, mask: Mask
) -> tuple[Lattice, list[tuple[Carrier, Measured]], float]:
    """A lattice fitted to the carriers near it, those carriers, and their share of all."""
    found: list[tuple[Carrier, Measured]] = []
    looked: list[Carrier] = []
    for radius in (4.0, 2.0, 2.0):
        looked = [c for c in lattice.carriers(mask.half_orders()) if c.on_sensor and (c.ky, c.kx) != (0, 0)]
        peaks = measure(spectrum, looked, radius)
        found = [(c, m) for c, m in zip(looked, peaks, strict=True) if m is not None]
        if len(found) < min(3, len(looked)) or np.linalg.matrix_rank([(c.ky, c.kx) for c, _ in found]) < 2:
            raise DecodeError(
                f"only {len(found)} of {len(looked)} carriers are visible: calibrate on a frame at a small aperture "
                "(an eighth of the widest)"
            )
        lattice = fit(found)
    carriers = lattice.carriers([(c.ky, c.kx) for c, _ in found])
    if residual_bins(carriers, [m for _, m in found], spectrum) > _ALIKE_BINS:
        raise DecodeError(
            f"{len(found)} peaks lie near the prediction, but not on a common lattice: calibrate on a frame at a small "
            "aperture (an eighth of the widest), and check mask, camera and focal length"
        )
    return lattice, found, len(found) / len(looked)


def search(spectrum: Spectrum, predicted: Lattice, orders: Sequence[Order], tolerance: float = FARTHER) -> Lattice:
    """The lattice near a predicted one that most of a frame's peaks lie on: any small rotation, scale and shear.

    Tries each pair of peaks near (0, 1) and (1, 0). Raises DecodeError where no such pair explains other orders.
    """
    peaks = candidates(spectrum, spacing_bins=11)[:400]
    points = np.array([(c.row, c.column) for c in peaks] + [(-c.row, -c.column) for c in peaks]).reshape(-1, 2)
    weights = np.array([c.prominence for c in peaks] * 2)
    bins = np.array(spectrum.padded)
    basis = predicted.matrix() * bins
    around = [points[np.hypot(*(points - vector).T) < max(tolerance * math.hypot(*vector), 3.0)] for vector in basis]
    wanted = np.array([order for order in orders if order != (0, 0)], dtype=np.float64)
    best, best_score = None, 0.0
    for a, b in itertools.product(*around):
        expected = wanted @ np.array([a, b])
        distance = np.hypot(*np.moveaxis(points[None, :, :] - expected[:, None, :], 2, 0))
        allowed = 1.5 + 0.5 * np.abs(wanted).max(axis=1, keepdims=True)
        score = float(np.where(distance < allowed, weights, 0.0).max(axis=1).sum())
        if score > best_score:
            best, best_score = np.array([a, b]) / bins, score
    if best is None:
        raise DecodeError(
            "no carriers near the prediction: calibrate on a frame at a small aperture (an eighth of the widest), "
            "and check mask, camera and focal length"
        )
    (ay, ax), (by, bx) = best
    return Lattice((float(ay), float(ax)), (float(by), float(bx)))


def refine(spectrum: Spectrum, lattice: Lattice, orders: Sequence[Order], workers: int = 1) -> Lattice:
    """The lattice to a hundredth of a bin: what phase ramp is left in each slice against the DC slice is taken off."""
    size = lattice.slice_size(spectrum.padded)
    for _ in range(2):
        carriers = [c for c in lattice.carriers(orders) if c.on_sensor]
        values = extract(spectrum, carriers, size, workers=workers)
        k, shifts, weights = [], [], []
        for carrier, image in zip(carriers[1:], values.values[1:], strict=True):
            ramp, weight = _ramp(image * np.conj(values.values[0]))
            k.append((carrier.ky, carrier.kx))
            shifts.append(ramp / (values.grid[0, 0], values.grid[1, 1]))
            weights.append(weight)
        root = np.sqrt(np.array(weights))[:, None]
        correction = np.linalg.lstsq(np.array(k, dtype=np.float64) * root, np.array(shifts) * root, rcond=None)[0]
        (ay, ax), (by, bx) = lattice.matrix() + correction
        lattice = Lattice((float(ay), float(ax)), (float(by), float(bx)))
    return lattice


def _ramp(product: NDArray[np.complex64], blocks: int = 8) -> tuple[NDArray[np.float64], float]:
    """Phase slope (y, x) in cycles a sample of a product of slices, and a weight; from the phases of block means."""
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
