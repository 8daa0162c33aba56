"""What a masked camera turned out to be: lattice, mask distance, phases and transfer, fitted to stopped-down frames.

At a mask's ideal frequency and full aperture the carriers of anything flat average out, so calibration takes frames
at a small aperture, where every carrier stands; the frame's f-number says how much of it the aperture took away.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.carriers import LAWS, Carrier, Lattice, Sensor
from dappled.decode.errors import DecodeError
from dappled.decode.lattice import candidates, fit, residual_bins
from dappled.decode.masks import Mask, Order
from dappled.decode.peaks import Measured, measure
from dappled.decode.prediction import lattice_rotation
from dappled.decode.slices import default_size, extract
from dappled.decode.spectrum import Spectrum
from dappled.decode.views import Aperture, angular_frequencies, kappa, transfer

_SEARCH = 0.12  # of a carrier's frequency: 2° of rotation and, under the fd law, 10 % of the mask's distance
_PLAUSIBLE = 0.35  # relative: a fitted mask distance further from the stated one is not believed


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFrame:
    """A stopped-down frame: its plane float32 (H, W), focal length and f-number."""

    plane: NDArray[np.float32]
    focal_length_mm: float
    f_number: float


@dataclass(frozen=True, slots=True)
class LatticeFit:
    """What the frames of one focal length showed.

    `lattice` in cycles/pixel. `origin` is x0 in cycles of ky and kx, at the frame's centre. `transfer` holds M_k, real
    and signed, for each of the mask's half orders (DC first, 1.0), the aperture's own share divided out.
    `residual_bins` is the rms distance of the measured carriers from the lattice in bins of the padded transform,
    `phase_residual_rad` that of their phases from the origin's, `found` how many carriers of the half plane were seen.
    """

    focal_length_mm: float
    f_number: float
    lattice: Lattice
    rotation_rad: float
    mask_distance_mm: float
    distance_fitted: bool
    origin: tuple[float, float]
    transfer: tuple[float, ...]
    residual_bins: float
    phase_residual_rad: float
    found: int


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and mask as fitted; one or more focal lengths, rising. `shape` is the frames'."""

    shape: tuple[int, int]
    law: str
    mask: Mask
    sensor: Sensor
    fits: tuple[LatticeFit, ...]

    def nearest(self, focal_length_mm: float) -> LatticeFit:
        """The fit at the nearest focal length."""
        return min(self.fits, key=lambda f: abs(math.log(f.focal_length_mm / focal_length_mm)))

    def lattice_at(self, focal_length_mm: float) -> Lattice:
        """The lattice at a focal length: the law's, corrected as at the fits (linear between, constant beyond)."""
        lengths = [f.focal_length_mm for f in self.fits]
        corrections = [
            np.linalg.solve(self._law(f.focal_length_mm, f.mask_distance_mm), f.lattice.matrix()) for f in self.fits
        ]
        distances = [f.mask_distance_mm for f in self.fits]
        distance = float(np.interp(focal_length_mm, lengths, distances))
        correction = np.array(
            [[np.interp(focal_length_mm, lengths, [c[i, j] for c in corrections]) for j in (0, 1)] for i in (0, 1)]
        )
        (ay, ax), (by, bx) = self._law(focal_length_mm, distance) @ correction
        return Lattice((float(ay), float(ax)), (float(by), float(bx)))

    def _law(self, focal_length_mm: float, mask_distance_mm: float) -> NDArray[np.float64]:
        return LAWS[self.law](self.mask, self.sensor, mask_distance_mm, focal_length_mm).matrix()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a TOML file."""
        return {
            "kind": "dappled calibration",
            "version": 1,
            "shape": list(self.shape),
            "law": self.law,
            "mask": {
                "frequency_per_mm": self.mask.frequency_per_mm,
                "p": self.mask.p,
                "pattern": self.mask.pattern,
                "harmonics": self.mask.harmonics,
            },
            "sensor": _sensor_values(self.sensor),
            "fits": [
                {
                    "focal_length_mm": f.focal_length_mm,
                    "f_number": f.f_number,
                    "lattice": {"ky": list(f.lattice.ky), "kx": list(f.lattice.kx)},
                    "rotation_rad": f.rotation_rad,
                    "mask_distance_mm": f.mask_distance_mm,
                    "distance_fitted": f.distance_fitted,
                    "origin": list(f.origin),
                    "transfer": list(f.transfer),
                    "residual_bins": f.residual_bins,
                    "phase_residual_rad": f.phase_residual_rad,
                    "found": f.found,
                }
                for f in self.fits
            ],
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Calibration:
        """The inverse of `to_dict`. Raises DecodeError with the name of what is missing or wrong."""
        if values.get("kind") != "dappled calibration" or values.get("version") != 1:
            raise DecodeError("this is no calibration of version 1: make one with `dappled calibrate`")
        try:
            shape = _pair(values["shape"])
            mask = Mask(**values["mask"])
            sensor = _sensor_of({"shape": shape, **values["sensor"]})
            fits = tuple(
                LatticeFit(
                    **{
                        **entry,
                        "lattice": Lattice(_pair(entry["lattice"]["ky"]), _pair(entry["lattice"]["kx"])),
                        "origin": _pair(entry["origin"]),
                        "transfer": tuple(float(m) for m in entry["transfer"]),
                    }
                )
                for entry in values["fits"]
            )
            law = values["law"]
        except (KeyError, TypeError, ValueError) as error:
            raise DecodeError(f"the calibration is incomplete or wrong ({error}): make it anew") from error
        if law not in LAWS:
            raise DecodeError(f"the calibration names the law {law!r}; known are {', '.join(LAWS)}")
        if not fits or any(len(f.transfer) != len(mask.half_orders()) for f in fits):
            raise DecodeError("the calibration's transfer doesn't fit its mask: make it anew")
        return cls((int(shape[0]), int(shape[1])), law, mask, sensor, fits)


def calibrate(
    frames: Sequence[CalibrationFrame],
    *,
    sensor: Sensor,
    mask: Mask,
    law: str,
    mask_distance_mm: float,
    aperture: Aperture | None = None,
    workers: int = 1,
) -> Calibration:
    """The calibration that stopped-down frames show; frames of one focal length are averaged.

    `mask_distance_mm` is the stated one; the fitted one follows from the lattice and the law. Raises DecodeError where
    the carriers can't be found.
    """
    if not frames:
        raise DecodeError("a calibration needs at least one frame")
    if law not in LAWS:
        raise DecodeError(f"unknown law {law!r}; known are {', '.join(LAWS)}")
    aperture = aperture or Aperture(mask.views_per_axis)
    fits = []
    for length in sorted({frame.focal_length_mm for frame in frames}):
        seen = [
            _fit_frame(
                frame,
                sensor=sensor,
                mask=mask,
                law=law,
                mask_distance_mm=mask_distance_mm,
                aperture=aperture,
                workers=workers,
            )
            for frame in frames
            if frame.focal_length_mm == length
        ]
        fits.append(_mean(seen))
    return Calibration(sensor.shape, law, mask, sensor, tuple(fits))


def at_corner(origin: tuple[float, float], lattice: Lattice, shape: tuple[int, int]) -> tuple[float, float]:
    """The origin in cycles at pixel (0, 0) for one at the frame's centre."""
    shift = lattice.matrix() @ ((np.array(shape) - 1) / 2)
    return float(origin[0] - shift[0]), float(origin[1] - shift[1])


def at_centre(origin: tuple[float, float], lattice: Lattice, shape: tuple[int, int]) -> tuple[float, float]:
    """The inverse of `at_corner`, cycles from −0.5 to 0.5."""
    shift = lattice.matrix() @ ((np.array(shape) - 1) / 2)
    return _turn(origin[0] + shift[0]), _turn(origin[1] + shift[1])


def search(spectrum: Spectrum, predicted: Lattice, orders: Sequence[Order], tolerance: float = _SEARCH) -> Lattice:
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


def origin_of(orders: Sequence[Order], phases: NDArray[np.complex128]) -> tuple[tuple[float, float], float]:
    """(x0, rms phase residual) for complex transfers (K,) that may be negative: phase_k = 2π k·x0, or that plus π.

    Each weighs by its magnitude. Which of the four origins half a period apart is meant is told by the sign of (0, 1)
    and (1, 0), or else of the innermost orders: those are positive.
    """
    k = np.asarray(orders, dtype=np.float64)
    weights = np.abs(phases) ** 2
    squares = phases**2 / np.maximum(np.abs(phases), 1e-30) ** 2
    best, best_score = np.zeros(2), -math.inf
    steps = np.arange(0, 1, 1 / 48)
    inner = np.argsort(np.hypot(*k.T), kind="stable")
    inner = inner[weights[inner] > 1e-4 * weights.max()][:4]
    for y, x in itertools.product(steps, steps):
        turn = np.exp(-2j * np.pi * (k @ (y, x)))
        score = float((weights * (squares * turn**2).real).sum())
        score += 1e-3 * float((weights[inner] * (phases[inner] / np.abs(phases[inner]) * turn[inner]).real).sum())
        if score > best_score:
            best, best_score = np.array([y, x]), score
    for _ in range(20):  # Gauss–Newton on the doubled phases
        residual = np.angle(squares * np.exp(-4j * np.pi * (k @ best))) / (4 * np.pi)
        root = np.sqrt(weights)[:, None]
        best = best + np.linalg.lstsq(k * root, residual[:, None] * root, rcond=None)[0][:, 0]
    residual = np.angle(squares * np.exp(-4j * np.pi * (k @ best))) / 2
    rms = float(np.sqrt((weights * residual**2).sum() / weights.sum()))
    return (float(best[0]), float(best[1])), rms


def relative_transfer(slices: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """(K,) least-squares factor of each slice on the first: the carriers' transfer, a scene's texture taken out."""
    dc = slices[0].astype(np.complex128).ravel()
    products = np.array([np.vdot(dc, s.ravel()) for s in slices], dtype=np.complex128)
    factors: NDArray[np.complex128] = products / np.vdot(dc, dc).real
    return factors


def refine(spectrum: Spectrum, lattice: Lattice, orders: Sequence[Order], workers: int = 1) -> Lattice:
    """The lattice to a hundredth of a bin: what phase ramp is left in each slice against the DC slice is taken off."""
    size = default_size(lattice, spectrum.padded)
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


def _fit_frame(
    frame: CalibrationFrame,
    *,
    sensor: Sensor,
    mask: Mask,
    law: str,
    mask_distance_mm: float,
    aperture: Aperture,
    workers: int,
) -> LatticeFit:
    if frame.plane.shape != sensor.shape:
        raise DecodeError(f"the calibration frame is {frame.plane.shape}, the camera's are {sensor.shape}")
    predicted = LAWS[law](mask, sensor, mask_distance_mm, frame.focal_length_mm)
    orders = [(c.ky, c.kx) for c in predicted.carriers(mask.half_orders()) if c.on_sensor]
    spectrum = Spectrum.of(frame.plane, workers=workers)
    lattice = search(spectrum, predicted, orders)
    found: list[tuple[Carrier, Measured]] = []
    for radius in (4.0, 2.0, 2.0):
        looked = lattice.carriers([order for order in orders if order != (0, 0)])
        peaks = measure(spectrum, looked, radius)
        found = [(c, m) for c, m in zip(looked, peaks, strict=True) if m is not None]
        if len(found) < 2 or np.linalg.matrix_rank([(c.ky, c.kx) for c, _ in found]) < 2:
            raise DecodeError(
                f"only {len(found)} of {len(looked)} carriers show: calibrate on a frame at a small aperture "
                "(an eighth of the widest)"
            )
        lattice = fit(found)
    lattice = refine(spectrum, lattice, orders, workers)
    seen = [m for _, m in found]
    residual = residual_bins(lattice.carriers([(c.ky, c.kx) for c, _ in found]), seen, spectrum)
    distance, fitted, rotation = _distance(
        lattice, frame.focal_length_mm, sensor=sensor, mask=mask, law=law, stated_mm=mask_distance_mm
    )
    carriers = [c for c in lattice.carriers(orders) if c.on_sensor]
    values = extract(spectrum, carriers, lattice=lattice, workers=workers).values
    seen_orders = [(c.ky, c.kx) for c in carriers]
    cycles = kappa(mask.frequency_per_mm, distance, frame.focal_length_mm, frame.f_number)
    through = aperture.transform(angular_frequencies(seen_orders, cycles, rotation)).real
    measured = relative_transfer(values) / np.where(np.abs(through) < 0.05, np.nan, through)
    usable = np.isfinite(measured)
    usable[0] = False
    origin, phase_residual = origin_of([o for o, u in zip(seen_orders, usable, strict=True) if u], measured[usable])
    magnitudes = (measured * np.conj(transfer(seen_orders, np.ones(len(seen_orders)), origin))).real
    known = dict(zip(seen_orders, np.nan_to_num(magnitudes), strict=True))
    return LatticeFit(
        focal_length_mm=frame.focal_length_mm,
        f_number=frame.f_number,
        lattice=lattice,
        rotation_rad=rotation,
        mask_distance_mm=distance,
        distance_fitted=fitted,
        origin=at_centre(origin, lattice, sensor.shape),
        transfer=tuple(float(known.get(order, 0.0)) if order != (0, 0) else 1.0 for order in mask.half_orders()),
        residual_bins=residual,
        phase_residual_rad=phase_residual,
        found=len(found) + 1,
    )


def _distance(
    lattice: Lattice, focal_length_mm: float, *, sensor: Sensor, mask: Mask, law: str, stated_mm: float
) -> tuple[float, bool, float]:
    """(mask distance in mm, whether it was fitted, rotation): from the lattice's size on the chip, by the law.

    A distance far from the stated one means a mask whose printed frequency isn't the stated one: the stated distance
    is kept then.
    """
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])  # (row, column) steps as (y, x) mm
    per_mm = lattice.matrix() @ np.linalg.inv(to_sensor).T  # rows: cycles/mm along y and x
    size = math.sqrt(abs(float(np.linalg.det(per_mm))))
    rotation = lattice_rotation(lattice, sensor)
    if law == "geometric":
        distance = (1 - size / mask.frequency_per_mm) * focal_length_mm
    else:
        expected = LAWS[law](mask, sensor, stated_mm, focal_length_mm).matrix() @ np.linalg.inv(to_sensor).T
        distance = stated_mm * size / math.sqrt(abs(float(np.linalg.det(expected))))
    believed = abs(distance / stated_mm - 1) <= _PLAUSIBLE
    return (distance if believed else stated_mm), believed, rotation


def _mean(fits: list[LatticeFit]) -> LatticeFit:
    """One fit of several at the same focal length; origins are averaged as angles."""
    if len(fits) == 1:
        return fits[0]
    matrix = np.mean([f.lattice.matrix() for f in fits], axis=0)
    (ay, ax), (by, bx) = matrix
    turns = np.exp(2j * np.pi * np.array([f.origin for f in fits])).mean(axis=0)
    return replace(
        fits[0],
        lattice=Lattice((float(ay), float(ax)), (float(by), float(bx))),
        rotation_rad=float(np.mean([f.rotation_rad for f in fits])),
        mask_distance_mm=float(np.mean([f.mask_distance_mm for f in fits])),
        distance_fitted=all(f.distance_fitted for f in fits),
        origin=(float(np.angle(turns[0]) / (2 * np.pi)), float(np.angle(turns[1]) / (2 * np.pi))),
        transfer=tuple(float(m) for m in np.mean([f.transfer for f in fits], axis=0)),
        residual_bins=float(np.sqrt(np.mean([f.residual_bins**2 for f in fits]))),
        phase_residual_rad=float(np.sqrt(np.mean([f.phase_residual_rad**2 for f in fits]))),
        found=min(f.found for f in fits),
    )


def _sensor_values(sensor: Sensor) -> dict[str, Any]:
    values: dict[str, Any] = {"row_mm": list(sensor.row_mm), "column_mm": list(sensor.column_mm)}
    if sensor.picture is not None:
        values["picture"] = {"shape": list(sensor.picture.shape), **_sensor_values(sensor.picture)}
    return values


def _sensor_of(values: Mapping[str, Any]) -> Sensor:
    height, width = _pair(values["shape"])
    picture = _sensor_of(values["picture"]) if "picture" in values else None
    return Sensor((int(height), int(width)), _pair(values["row_mm"]), _pair(values["column_mm"]), picture)


def _pair(values: Sequence[float]) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)


def _turn(cycles: float) -> float:
    return float(cycles - round(cycles))
