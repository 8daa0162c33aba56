"""Calibrations: the measurements at each focal length, and the lattice at any focal length."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.optics import LAWS, Lattice, Mask, Sensor

_MOST_HARMONICS = 20  # as a mask's profile


@dataclass(frozen=True, slots=True)
class LatticeFit:
    """What the frames of one focal length showed.

    `lattice` in cycles/pixel. `origin` is x0 in cycles of ky and kx, at the frame's centre. `transfer` holds M_k, real
    and signed, for each of the mask's half orders (DC first, 1.0), the aperture's own share divided out.
    `residual_bins` is the rms distance of the measured carriers from the lattice in bins of the padded transform,
    `phase_residual_rad` that of their phases from the origin's, `found` how many carriers of the half plane were seen;
    `seen` are those, without the mean: (ky, kx, fy, fx, strength).
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
    seen: tuple[tuple[int, int, float, float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and mask as fitted; one or more focal lengths, rising. `shape` is the frames'.

    `pupil_mm` is the distance of the exit pupil beyond the focal length, v(f) = f + pupil, under `geometric`; `verdict`
    says which law explains the frames.
    """

    shape: tuple[int, int]
    law: str
    mask: Mask
    sensor: Sensor
    fits: tuple[LatticeFit, ...]
    pupil_mm: float = 0.0
    verdict: str = ""

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
        return LAWS[self.law](self.mask, self.sensor, mask_distance_mm, focal_length_mm + self.pupil_mm).matrix()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a TOML file."""
        return {
            "kind": "dappled calibration",
            "version": 1,
            "shape": list(self.shape),
            "law": self.law,
            "pupil_mm": self.pupil_mm,
            "verdict": self.verdict,
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
                    "seen": [list(one) for one in f.seen],
                }
                for f in self.fits
            ],
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Calibration:
        """The inverse of `to_dict`. Raises DecodeError, which names the missing or wrong value."""
        if values.get("kind") != "dappled calibration" or values.get("version") != 1:
            raise DecodeError("this is not a calibration of version 1: make one with `dappled calibrate`")
        try:
            shape = _pair(values["shape"])
            mask = _mask_of(values["mask"])
            sensor = _sensor_of({"shape": shape, **values["sensor"]})
            fits = tuple(
                LatticeFit(
                    **{
                        **entry,
                        "lattice": Lattice(_pair(entry["lattice"]["ky"]), _pair(entry["lattice"]["kx"])),
                        "origin": _pair(entry["origin"]),
                        "transfer": tuple(float(m) for m in entry["transfer"]),
                        "seen": tuple(_carrier(one) for one in entry.get("seen", ())),
                    }
                )
                for entry in values["fits"]
            )
            law, pupil, verdict = values["law"], float(values.get("pupil_mm", 0.0)), str(values.get("verdict", ""))
            known_law = law in LAWS
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DecodeError(f"the calibration is incomplete or wrong ({error}): calibrate again") from error
        if not known_law:
            raise DecodeError(f"the calibration names the law {law!r}; known are {', '.join(LAWS)}")
        if not fits or any(len(f.transfer) != len(mask.half_orders()) for f in fits):
            raise DecodeError("the calibration's transfer doesn't fit its mask: calibrate again")
        return cls((int(shape[0]), int(shape[1])), law, mask, sensor, fits, pupil, verdict)


def _mask_of(values: Mapping[str, Any]) -> Mask:
    """Raises ValueError for a number of harmonics that no mask has: its carriers grow with the square."""
    mask = Mask(**values)
    if type(mask.p) is not int or not 1 <= mask.p <= _MOST_HARMONICS:
        raise ValueError(f"the mask's p is {mask.p!r}, not a whole number from 1 to {_MOST_HARMONICS}")
    return mask


def _sensor_values(sensor: Sensor) -> dict[str, Any]:
    values: dict[str, Any] = {"row_mm": list(sensor.row_mm), "column_mm": list(sensor.column_mm)}
    if sensor.picture is not None:
        values["picture"] = {"shape": list(sensor.picture.shape), **_sensor_values(sensor.picture)}
    return values


def _sensor_of(values: Mapping[str, Any]) -> Sensor:
    height, width = _pair(values["shape"])
    picture = _sensor_of(values["picture"]) if "picture" in values else None
    return Sensor((int(height), int(width)), _pair(values["row_mm"]), _pair(values["column_mm"]), picture)


def _carrier(values: Sequence[float]) -> tuple[int, int, float, float, float]:
    ky, kx, fy, fx, strength = values
    return int(ky), int(kx), float(fy), float(fx), float(strength)


def _pair(values: Sequence[float]) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)
