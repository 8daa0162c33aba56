"""Predict the laser bench: where a mask's impulses land (Eq 14 to 23, Tables 4 to 9), and the picture they make.

A mask g(x, y) in a plane wave has the Fourier transform G(p, q), impulses at p, q in cycles a metre. At distance z and
wavelength λ an impulse lands at x = p·λ·z, y = q·λ·z (Eq 18).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Mask
from dappled.decode.optics.lenses import within

THESIS_WAVELENGTH_NM = 532.0  # the thesis' laser (section on the bench)
THESIS_DISTANCE_M = 0.5842  # from film to wall, the same


@dataclass(frozen=True, slots=True)
class Impulse:
    """One impulse of G(p, q): orders, `p_per_m` and `q_per_m` (x and y, cycles/m), and its weight.

    The weight is that of g as the sum of cosines (Eq 20): 1/4 on a diagonal.
    """

    ky: int
    kx: int
    p_per_m: float
    q_per_m: float
    weight: float

    def landing_mm(self, wavelength_nm: float, distance_m: float) -> tuple[float, float]:
        """(x, y) on the wall from the centre of the pattern, mm (Eq 18)."""
        scale = bench_scale(wavelength_nm, distance_m) * 1e3
        return self.p_per_m * scale, self.q_per_m * scale


def bench_scale(wavelength_nm: float, distance_m: float) -> float:
    """λ·z in m²: metres on the wall for each cycle a metre of the mask."""
    return wavelength_nm * 1e-9 * distance_m


def impulses(mask: Mask) -> list[Impulse]:
    """All impulses of the mask's G(p, q) (Eq 22, 23, 25; Tables 4, 6, 8), the centre first, then rising orders.

    The centre's weight is the constant in print: Fig 14's 4 for a diagonal pattern, Eq 11's 1 + 1 for a full one.
    """
    step = mask.frequency_per_mm * 1e3
    found = []
    for ky, kx in mask.orders():
        if (ky, kx) == (0, 0):
            weight = 4.0 if mask.pattern == "diagonal" else 2.0
        else:
            weight = (0.5 if ky else 1.0) * (0.5 if kx else 1.0)
        found.append(Impulse(ky, kx, kx * step, ky * step, weight))
    return found


# --- propagation -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Screen:
    """A light intensity on a plane: `intensity` (H, W), the axis at (H//2, W//2), `pitch_mm` (y, x)."""

    intensity: NDArray[np.float64]
    pitch_mm: tuple[float, float]


def far_screen(
    field: NDArray[np.floating],
    pitch_mm: tuple[float, float],
    wavelength_nm: float,
    distance_m: float,
    *,
    samples: int | None = None,
) -> Screen:
    """Fresnel diffraction in one Fourier transform (Eq 17), for walls: the pitch on the screen is λ·z / (N·pitch).

    `field` (h, w) is the amplitude behind the mask, zero outside, `pitch_mm` (y, x) its samples. `samples` pads to
    that many a side. The chirp exp(iπ(x² + y²)/λz) is sampled properly only while its steepest part turns by less than
    π a sample: width·pitch ≤ λ·z. Raises DecodeError where it is not: the distance is too short for this width.
    """
    area_mm2 = bench_scale(wavelength_nm, distance_m) * 1e6
    axes = []
    for count, pitch in zip(field.shape, pitch_mm, strict=True):
        within("pitch of the mask", pitch, "mm", 1e-6, 10)
        if count * pitch**2 > area_mm2:
            raise DecodeError(
                f"{count} samples of {pitch:g} mm are too wide for {distance_m:g} m: the Fresnel chirp needs "
                f"width × pitch ≤ λz = {area_mm2:.4g} mm², this is {count * pitch**2:.4g}; "
                f"take {max(1, math.floor(area_mm2 / pitch**2))} samples, or go farther"
            )
        axes.append((np.arange(count) - count // 2) * pitch)
    size = fft.next_fast_len(max(*field.shape, samples or 0))
    chirp = [np.exp(1j * np.pi / area_mm2 * axis**2) for axis in axes]
    padded = np.zeros((size, size), dtype=np.complex128)
    top, left = size // 2 - field.shape[0] // 2, size // 2 - field.shape[1] // 2
    padded[top : top + field.shape[0], left : left + field.shape[1]] = field * chirp[0][:, None] * chirp[1]
    spread = fft.fftshift(fft.fft2(fft.ifftshift(padded), overwrite_x=True))
    gain = pitch_mm[0] * pitch_mm[1] / area_mm2
    return Screen(np.abs(spread * gain) ** 2, (area_mm2 / (size * pitch_mm[0]), area_mm2 / (size * pitch_mm[1])))


def beam(shape: tuple[int, int], pitch_mm: tuple[float, float], diameter_mm: float) -> NDArray[np.float64]:
    """(h, w) amplitude of a round Gaussian beam, `diameter_mm` where its intensity is 1/e²."""
    within("beam diameter", diameter_mm, "mm", 1e-3, 100)
    y, x = ((np.arange(n) - n // 2) * pitch for n, pitch in zip(shape, pitch_mm, strict=True))
    amplitude: NDArray[np.float64] = np.exp(-(y[:, None] ** 2 + x**2) / (diameter_mm / 2) ** 2)
    return amplitude


@dataclass(frozen=True, slots=True)
class BenchVerdict:
    """The result of comparing a measured pattern with a printed mask.

    `kind` is "as designed", "scaled" or "not this mask". `frequency_scale` is measured over expected distance of the
    spots (so the periods on film are 1 / `frequency_scale` of the design's), None where nothing fits. `rms_mm` is left
    over an axis.
    """

    kind: str
    frequency_scale: float | None
    rms_mm: float | None
    matched: int
    text: str


def judge(
    mask: Mask,
    measured_mm: list[tuple[float, float]],
    wavelength_nm: float = THESIS_WAVELENGTH_NM,
    distance_m: float = THESIS_DISTANCE_M,
    *,
    tolerance_mm: float = 0.5,
) -> BenchVerdict:
    """Compare measured spots (x, y), mm from the centre of the pattern, with the mask's impulses.

    A scale fits if each measured spot belongs to a different impulse, no spot inside the outermost measured one is
    missing, the rms over an axis is within `tolerance_mm` and no spot is off by more than twice that. 1 is tried first,
    then 1/2, 2, 1/3, 3, 1/4, 4, then any scale from 0.1 to 10. A scale other than 1 is only accepted with two harmonics
    or more: a single ring of spots fits at some scale always. Raises DecodeError without any spot.
    """
    expected = np.array([i.landing_mm(wavelength_nm, distance_m) for i in impulses(mask)[1:]])
    seen = np.array(measured_mm, dtype=np.float64).reshape(-1, 2)
    if not np.all(np.isfinite(seen)):
        raise DecodeError("a measured place is not a number: leave out the spots that were not seen")
    seen = seen[np.hypot(*seen.T) > tolerance_mm] if len(seen) else seen
    if not len(seen):
        raise DecodeError("no spot beside the centre was measured: at least one is needed to compare")
    nearest_ring = float(np.hypot(*expected.T).min())
    free = np.geomspace(0.1, 10, 400)
    for scale in (1.0, 0.5, 2.0, 1 / 3, 3.0, 0.25, 4.0, *free[np.argsort(np.abs(np.log(free)))]):
        matched = _match(expected * scale, seen, tolerance_mm)
        if matched is None:
            continue
        if scale != 1 and len(np.unique(np.round(np.hypot(*expected[matched].T) / nearest_ring, 6))) < 2:
            continue
        fitted = float((expected[matched] * seen).sum() / (expected[matched] ** 2).sum())
        off = seen - scale * expected[matched]
        rms = float(np.sqrt((off**2).mean()))
        if scale == 1:
            text = f"as designed: {len(seen)} spots within {np.abs(off).max():.2f} mm of where they should be"
            if unseen := len(expected) - len(seen):
                text += f"; {unseen} fainter or farther ones were not seen"
            return BenchVerdict("as designed", fitted, rms, len(seen), text)
        shown = 1 / (scale if scale in (0.5, 2.0, 1 / 3, 3.0, 0.25, 4.0) else fitted)
        text = (
            f"printed {shown:.2g} times as large as designed, or another mask: the spots are at {fitted:.3f} of the "
            f"expected distance, so the periods on film are {1 / fitted:.2f} times the design's"
        )
        return BenchVerdict("scaled", fitted, rms, len(seen), text)
    text = (
        f"not this mask: {len(seen)} measured spots fit its impulses at no scale within {tolerance_mm:g} mm, "
        "or inner spots are missing"
    )
    return BenchVerdict("not this mask", None, None, 0, text)


def _match(expected: NDArray[np.float64], seen: NDArray[np.float64], tolerance_mm: float) -> NDArray[np.intp] | None:
    """For each seen spot its impulse, or None where the two sets don't belong together."""
    apart = np.hypot(*(seen[:, None] - expected[None]).transpose(2, 0, 1))
    matched: NDArray[np.intp] = apart.argmin(axis=1)
    off = np.abs(seen - expected[matched])
    rms = np.sqrt((off**2).mean())
    if off.max() > 2 * tolerance_mm or rms > tolerance_mm or len(set(matched.tolist())) < len(seen):
        return None
    inside = np.hypot(*expected.T) <= np.hypot(*expected[matched].T).max() * (1 + 1e-6)
    missing = int(inside.sum()) - len(seen)
    return None if missing > 0 else matched
