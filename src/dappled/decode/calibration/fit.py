"""Calibrate a masked camera: lattice, mask distance, phases and transfer, fitted to stopped-down frames.

At a mask's ideal frequency and full aperture the carriers of anything flat average out, so calibration takes frames
at a small aperture, where every carrier shows; the aperture's share of it is known from the frame's f-number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.decode.calibration.calibration import Calibration, LatticeFit
from dappled.decode.calibration.lattice_fit import FrameLattice, frame_lattice
from dappled.decode.calibration.law_choice import PLAUSIBLE, judge, steps_bins
from dappled.decode.calibration.swept_distance import swept_distance
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies, at_centre, kappa, origin_of, transfer
from dappled.decode.optics import Lattice, MaskedOptics, Sensor
from dappled.decode.optics.carrier_tables import lattice_rotation
from dappled.decode.optics.visibility import pattern_amplitudes

_KNOWN = 0.05  # relative: a distance with a larger standard error is not used
_LEAST_THROUGH = 0.05  # of a carrier: where the stop leaves less, the mask's transfer can't be measured


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFrame:
    """A stopped-down frame: its plane float32 (H, W), focal length with its standard error, f-number,
    and the narrowest stop of its lens (None: unknown)."""

    plane: NDArray[np.float32]
    focal_length_mm: float
    f_number: float
    focal_sigma_mm: float = 0.0
    narrowest_f: float | None = None


def calibrate(
    frames: Sequence[CalibrationFrame],
    optics: MaskedOptics,
    *,
    aperture: Aperture | None = None,
    choose_law: bool = False,
    workers: int = 1,
) -> Calibration:
    """The calibration that stopped-down frames show; frames of one focal length are averaged.

    The fitted distance of the mask follows from the lattice and the law. With `choose_law` frames
    at several focal lengths may show that the other law is right. Raises DecodeError where the carriers can't be found.
    """
    if not frames:
        raise DecodeError("a calibration needs at least one frame")
    lattices = [lattice_of(frame, optics, workers=workers) for frame in frames]
    return from_lattices(lattices, optics, aperture=aperture, choose_law=choose_law)


def from_lattices(
    lattices: Sequence[FrameLattice],
    optics: MaskedOptics,
    *,
    aperture: Aperture | None = None,
    choose_law: bool = False,
) -> Calibration:
    """`calibrate` from the lattices of the frames, which take little memory."""
    aperture = aperture or Aperture(optics.mask.views_per_axis)
    swept = swept_distance(lattices, optics)
    focal_sigma = max(shown.focal_sigma_mm for shown in lattices)
    verdict = judge(_steps(lattices, optics.sensor), optics, swept=swept, focal_sigma_mm=focal_sigma)
    if choose_law and verdict.law is not None:
        optics = optics.by(verdict.law)
    fitted = next(fit for fit in verdict.fits if fit.law == optics.law)
    sigma = fitted.distance_sigma_mm
    several = fitted.explains and (
        fitted.offset_bins is not None
        if optics.law != "geometric"
        else sigma is not None and sigma <= _KNOWN * fitted.mask_distance_mm
    )
    pupil = fitted.pupil_mm or 0.0 if several else 0.0
    print_scale = fitted.print_scale if several and optics.law == "geometric" else 1.0
    fits = []
    for length in sorted({shown.focal_length_mm for shown in lattices}):
        seen = [
            _fit_of(
                shown,
                optics,
                known_mm=fitted.mask_distance_mm if several else None,
                print_scale=print_scale,
                aperture=aperture,
            )
            for shown in lattices
            if shown.focal_length_mm == length
        ]
        fits.append(_mean(seen))
    weak = tuple(shown.weak for shown in lattices if shown.weak is not None)
    sensor, mask = optics.sensor, optics.mask
    return Calibration(
        sensor.shape, optics.law, mask, sensor, tuple(fits), pupil, verdict.finding, swept, focal_sigma, weak
    )


def _steps(lattices: Sequence[FrameLattice], sensor: Sensor) -> list[tuple[float, tuple[float, float]]]:
    """Focal lengths with the mean of their frames' steps: what EXIF rounds off is the same in all of these."""
    found = []
    for length in sorted({shown.focal_length_mm for shown in lattices}):
        steps = [steps_bins(shown.lattice, sensor) for shown in lattices if shown.focal_length_mm == length]
        rows, columns = np.mean(steps, axis=0)
        found.append((length, (float(rows), float(columns))))
    return found


def lattice_of(frame: CalibrationFrame, optics: MaskedOptics, *, workers: int = 1) -> FrameLattice:
    """The lattice that a frame shows. Raises DecodeError where it shows too few carriers."""
    shown = frame_lattice(
        frame.plane,
        optics,
        focal_length_mm=frame.focal_length_mm,
        f_number=frame.f_number,
        workers=workers,
        narrowest_f=frame.narrowest_f,
    )
    return replace(shown, focal_sigma_mm=frame.focal_sigma_mm)


def _fit_of(
    shown: FrameLattice,
    optics: MaskedOptics,
    *,
    known_mm: float | None,
    print_scale: float,
    aperture: Aperture,
) -> LatticeFit:
    """`known_mm` is the distance that a law fitted to several focal lengths found, None: this one's own; `print_scale`
    the print's frequency over its design's that it found with it, 1 where it found none."""
    distance, fitted = (
        (known_mm, True) if known_mm is not None else _distance(shown.lattice, shown.focal_length_mm, optics)
    )
    sensor, mask = optics.sensor, optics.mask
    rotation = lattice_rotation(shown.lattice, sensor)
    cycles = kappa(mask.frequency_per_mm * print_scale, distance, shown.focal_length_mm, shown.f_number)
    through = aperture.transform(angular_frequencies(shown.orders, cycles, rotation)).real
    seen = {(c.ky, c.kx) for c, _ in shown.found}
    usable = np.array([order in seen for order in shown.orders]) & (np.abs(through) >= _LEAST_THROUGH)
    orders = [order for order, use in zip(shown.orders, usable, strict=True) if use]
    if orders and np.linalg.matrix_rank(orders) == 2:
        measured = shown.relative / np.where(np.abs(through) < _LEAST_THROUGH, np.inf, through)
        origin, phase_residual = origin_of(orders, measured[usable])
        magnitudes = (measured * np.conj(transfer(shown.orders, np.ones(len(shown.orders)), origin))).real
        known = dict(zip(shown.orders, magnitudes, strict=True))
    else:  # the stop averages the carriers: they show where the mask is, and the pattern says what it passes
        usable = np.array([order in seen for order in shown.orders])
        orders = [order for order in shown.orders if order in seen]
        origin, phase_residual = origin_of(orders, shown.relative[usable])
        known = pattern_amplitudes(mask)
    return LatticeFit(
        focal_length_mm=shown.focal_length_mm,
        f_number=shown.f_number,
        lattice=shown.lattice,
        rotation_rad=rotation,
        mask_distance_mm=distance,
        distance_fitted=fitted,
        origin=at_centre(origin, shown.lattice, sensor.shape),
        transfer=tuple(float(known.get(order, 0.0)) if order != (0, 0) else 1.0 for order in mask.half_orders()),
        residual_bins=shown.residual_bins,
        phase_residual_rad=phase_residual,
        found=len(shown.found) + 1,
        seen=tuple((c.ky, c.kx, m.fy, m.fx, m.strength) for c, m in shown.found),
        print_scale=print_scale,
    )


def _distance(lattice: Lattice, focal_length_mm: float, optics: MaskedOptics) -> tuple[float, bool]:
    """(mask distance in mm, whether it was fitted): from the lattice's size at one focal length, by the law.

    Under `geometric` a print a thousandth off its design looks like a distance far off: the stated one is kept, and
    each frame's aperture is fitted over a wide range instead. Under `fd` a distance far from the stated one means a
    print of another scale: the stated one is kept then, too.
    """
    sensor, stated_mm = optics.sensor, optics.distance_mm
    if optics.law == "geometric":
        return stated_mm, False
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])  # (row, column) steps as (y, x) mm
    per_mm = lattice.matrix() @ np.linalg.inv(to_sensor).T  # rows: cycles/mm along y and x
    size = math.sqrt(abs(float(np.linalg.det(per_mm))))
    expected = optics.lattice(focal_length_mm).matrix() @ np.linalg.inv(to_sensor).T
    distance = stated_mm * size / math.sqrt(abs(float(np.linalg.det(expected))))
    believed = abs(distance / stated_mm - 1) <= PLAUSIBLE
    return (distance if believed else stated_mm), believed


def _mean(fits: list[LatticeFit]) -> LatticeFit:
    """One fit of several at the same focal length; origins are averaged as angles. An order's transfer is the mean of
    those that know it: the stop of another frame may have averaged it out."""
    if len(fits) == 1:
        return fits[0]
    transfers = np.array([f.transfer for f in fits])
    turns = np.exp(2j * np.pi * np.array([f.origin for f in fits])).mean(axis=0)
    return replace(
        fits[0],
        lattice=Lattice.of(np.mean([f.lattice.matrix() for f in fits], axis=0)),
        rotation_rad=float(np.mean([f.rotation_rad for f in fits])),
        mask_distance_mm=float(np.mean([f.mask_distance_mm for f in fits])),
        distance_fitted=all(f.distance_fitted for f in fits),
        origin=(float(np.angle(turns[0]) / (2 * np.pi)), float(np.angle(turns[1]) / (2 * np.pi))),
        transfer=tuple(float(m) for m in transfers.sum(axis=0) / np.maximum(np.count_nonzero(transfers, axis=0), 1)),
        residual_bins=float(np.sqrt(np.mean([f.residual_bins**2 for f in fits]))),
        phase_residual_rad=float(np.sqrt(np.mean([f.phase_residual_rad**2 for f in fits]))),
        found=min(f.found for f in fits),
        seen=max((f.seen for f in fits), key=len),
    )
