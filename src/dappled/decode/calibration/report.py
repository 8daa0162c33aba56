"""Report a calibration as the thesis does: expected, measured, offset and distance (Tables 12, 13, 15, 16)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dappled import codec
from dappled.decode.calibration.calibration import Calibration, LatticeFit
from dappled.decode.calibration.law_choice import LawFit, judge, steps_bins
from dappled.decode.optics import LAWS, Carrier, MaskedOptics, Order
from dappled.findings import text


@dataclass(frozen=True, slots=True)
class Row:
    """One carrier: where a law expects it and where it is, as (row, column) of the DC-centred DFT of the frame."""

    order: Order
    main: bool
    expected: tuple[float, float]
    measured: tuple[float, float]

    @property
    def offset(self) -> tuple[float, float]:
        """Measured less expected, in bins."""
        return self.measured[0] - self.expected[0], self.measured[1] - self.expected[1]

    @property
    def distance(self) -> float:
        """The offset's length in bins."""
        return math.hypot(*self.offset)


def rows(found: Calibration, fit: LatticeFit, law: str, mask_distance_mm: float) -> list[Row]:
    """The table of one focal length against a law with the stated mask distance, mean first, both half planes."""
    lattice = MaskedOptics(found.sensor, found.mask, law, mask_distance_mm).lattice(fit.focal_length_mm)
    table = []
    for ky, kx, fy, fx, _ in [(0, 0, 0.0, 0.0, 1.0), *fit.seen]:
        for sign in (1,) if (ky, kx) == (0, 0) else (-1, 1):
            order = sign * ky, sign * kx
            (expected,) = lattice.carriers([order])
            seen = Carrier(*order, sign * fy, sign * fx)
            table.append(
                Row(order, abs(ky) == abs(kx), expected.index(found.shape), seen.index(found.shape)),
            )
    return [table[0], *sorted(table[1:], key=lambda row: (not row.main, row.order))]


def law_fits(found: Calibration, mask_distance_mm: float) -> tuple[LawFit, ...]:
    """Both laws, fitted to the calibration's measurements."""
    steps = [(fit.focal_length_mm, steps_bins(fit.lattice, found.sensor)) for fit in found.fits]
    return judge(
        steps,
        MaskedOptics(found.sensor, found.mask, found.law, mask_distance_mm),
        swept=found.swept,
        focal_sigma_mm=found.focal_sigma_mm,
    ).fits


def pupils_mm(found: Calibration, mask_distance_mm: float) -> list[tuple[float, float | None]]:
    """(focal length, v) in mm: the position of the exit pupil for each, if the mask were at its stated distance.

    v = d / (1 − f_sensor/f_m); None where the carriers lie beyond the mask's own frequency, which no position explains.
    """
    found_mm: list[tuple[float, float | None]] = []
    for fit in found.fits:
        own = np.array(steps_bins(LAWS["geometric"](found.mask, found.sensor, 0.0, 1.0), found.sensor))
        alpha = 1 - float(np.mean(np.array(steps_bins(fit.lattice, found.sensor)) / own))
        found_mm.append((fit.focal_length_mm, mask_distance_mm / alpha if alpha > 0 else None))
    return found_mm


def as_values(found: Calibration, mask_distance_mm: float) -> dict[str, Any]:
    """All of it in plain values for JSON."""
    return {
        "law": found.law,
        "verdict": codec.plain(found.verdict),
        "doubts": codec.plain(found.doubts),
        "laws": [
            {
                "law": fit.law,
                "mask_distance_mm": fit.mask_distance_mm,
                "mask_distance_sigma_mm": fit.distance_sigma_mm,
                "print_scale": fit.print_scale,
                "print_scale_sigma": fit.print_scale_sigma,
                "anisotropy": fit.anisotropy,
                "offset_bins": None if fit.offset_bins is None else list(fit.offset_bins),
                "pupil_mm": fit.pupil_mm,
                "rms_bins": fit.rms_bins,
                "explains": fit.explains,
            }
            for fit in law_fits(found, mask_distance_mm)
        ],
        "focal_lengths": [
            {
                "focal_length_mm": fit.focal_length_mm,
                "f_number": fit.f_number,
                "rotation_rad": fit.rotation_rad,
                "mask_distance_mm": fit.mask_distance_mm,
                "exit_pupil_mm": pupil,
                "residual_bins": fit.residual_bins,
                "phase_residual_rad": fit.phase_residual_rad,
                "transfer": [
                    {"ky": ky, "kx": kx, "m": m}
                    for (ky, kx), m in zip(found.mask.half_orders(), fit.transfer, strict=True)
                ],
                "carriers": [
                    {
                        "ky": row.order[0],
                        "kx": row.order[1],
                        "main": row.main,
                        "expected": list(row.expected),
                        "measured": list(row.measured),
                        "offset": list(row.offset),
                        "distance": row.distance,
                    }
                    for row in rows(found, fit, found.law, mask_distance_mm)
                ],
            }
            for fit, (_, pupil) in zip(found.fits, pupils_mm(found, mask_distance_mm), strict=True)
        ],
    }


def as_lines(found: Calibration, mask_distance_mm: float) -> list[str]:
    """The tables for a person, one each focal length, and the verdict."""
    lines: list[str] = []
    for fit, (length, pupil) in zip(found.fits, pupils_mm(found, mask_distance_mm), strict=True):
        stands = "" if pupil is None else f", exit pupil {pupil:.2f} mm before the sensor under geometric"
        turned = f"on a lattice turned by {math.degrees(fit.rotation_rad):.3f}°, residual {fit.residual_bins:.3f} bins"
        lines += [
            f"{length:g} mm, f/{fit.f_number:g}: {2 * fit.found - 1} carriers {turned}{stands}",
            *_table(rows(found, fit, found.law, mask_distance_mm)),
            *_transfers(found, fit),
            "",
        ]
    for law in law_fits(found, mask_distance_mm):
        words = (
            f"{law.law}: mask {law.mask_distance_mm:.4f} mm in front of the sensor, "
            f"anisotropy {100 * law.anisotropy:+.2f} %"
        )
        if law.offset_bins is not None:
            words += f", offset {law.offset_bins[0]:+.2f} rows {law.offset_bins[1]:+.2f} columns"
        if law.pupil_mm is not None:
            words += f", exit pupil at the focal length {law.pupil_mm:+.2f} mm"
        lines.append(f"{words}; {law.rms_bins:.2f} bins rms are left")
    return [*lines, *([] if found.verdict is None else [str(text(found.verdict))])]


def _table(table: Sequence[Row]) -> list[str]:
    head = f"{'ky':>3} {'kx':>3}  {'expected':>17}  {'measured':>17}  {'offset':>15} {'distance':>8}"
    return [
        head,
        *(
            f"{r.order[0]:3d} {r.order[1]:3d}  {r.expected[0]:8.2f} {r.expected[1]:8.2f}  "
            f"{r.measured[0]:8.2f} {r.measured[1]:8.2f}  {r.offset[0]:+7.2f} {r.offset[1]:+7.2f} {r.distance:8.2f}"
            for r in table
        ),
    ]


def _transfers(found: Calibration, fit: LatticeFit) -> list[str]:
    """The transfer of each order that was seen, unknown where the stop leaves too little of it; and those that were not
    seen: a mask without them has the same carriers."""
    seen = {(ky, kx) for ky, kx, *_ in fit.seen}
    outer = list(zip(found.mask.half_orders(), fit.transfer, strict=True))[1:]
    lines = ["transfer " + " ".join(f"({ky},{kx}) {_told(m)}" for (ky, kx), m in outer if (ky, kx) in seen)]
    if unseen := [f"({ky},{kx})" for (ky, kx), _ in outer if (ky, kx) not in seen]:
        lines.append(f"not seen: {' '.join(unseen)}; a mask without them has the same carriers at f/{fit.f_number:g}")
    return lines


def _told(transfer: float) -> str:
    return f"{transfer:.3g}" if transfer else "unknown"
