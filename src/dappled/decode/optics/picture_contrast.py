"""Predict what a mask leaves of the contrast of the picture at the sensor's own resolution.

A wave that a lens focuses on a point of the sensor passes the mask at d, whose amplitude t moves part of it to the
side. Detail of the frequency ν comes as t(x + λdν/2) · t(x − λdν/2) of its light, each order of that averaged over the
part of the stop that passes ν at all; over the mask's shadow, which is the same at ν = 0, its mean is what is left.
(Fresnel diffraction, exact for a wave that converges; points of the scene don't interfere.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from dappled.decode.array_types import Floats
from dappled.decode.optics.carriers import MaskedOptics
from dappled.decode.optics.visibility import COLOURS_MM, amplitude_orders, pattern_amplitudes

_DIRECTIONS = 4  # of the detail, over half a turn
_SAMPLES, _MOST_SAMPLES = 16, 1024  # of the mask's amplitude in a period of its highest harmonic, and in all
_LEAST_W = 0.01  # as the picture has it


@dataclass(frozen=True, slots=True)
class PictureContrast:
    """`left` is the share of the contrast that is left of detail in focus at `cycles_per_px`, against the same camera
    without its mask: the mean over directions, behind a square stop. Above 1 it is exaggerated."""

    f_number: float
    cycles_per_px: tuple[float, ...]
    left: tuple[float, ...]


def picture_contrast(optics: MaskedOptics, f_number: float, cycles_per_px: Sequence[float]) -> PictureContrast:
    """The contrast at these frequencies, along a row of pixels."""
    mask, distance_mm = optics.mask, optics.distance_mm
    n = min(_SAMPLES * max(abs(one) for order in pattern_amplitudes(mask) for one in order), _MOST_SAMPLES)
    waves = amplitude_orders(mask, n)
    k = fft.fftfreq(n, 1 / n) * mask.frequency_per_mm  # cycles/mm
    pitch_mm = math.hypot(*optics.sensor.row_mm), math.hypot(*optics.sensor.column_mm)
    pixels = np.outer(*(np.sinc(k * one) for one in pitch_mm))

    def through(nu: Floats) -> Floats:
        """(n, n) over a period: the light of detail of the frequency (2,), cycles/mm, but for the lens' own loss."""
        total = np.zeros((n, n))
        for wavelength_mm in COLOURS_MM:
            half = np.exp(1j * np.pi * wavelength_mm * distance_mm * np.add.outer(k * nu[0], k * nu[1]))
            both = fft.ifft2(waves * half, norm="forward") * fft.ifft2(waves * half.conj(), norm="forward")
            passed = np.maximum(1 - np.abs(nu) * wavelength_mm * f_number, 0)
            stop = np.outer(*(np.sinc(k * distance_mm / f_number * one) for one in passed))
            total += fft.ifft2(fft.fft2(both) * stop * pixels).real
        return np.asarray(total / len(COLOURS_MM))

    shadow = through(np.zeros(2))
    known = np.maximum(shadow, _LEAST_W * shadow.mean())
    left = []
    for frequency in cycles_per_px:
        turns = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
        each = [frequency / pitch_mm[1] * np.array([math.sin(turn), math.cos(turn)]) for turn in turns]
        left.append(float(np.mean([through(nu) / known for nu in each])))
    return PictureContrast(f_number, tuple(cycles_per_px), tuple(left))
