"""Predict how strong each carrier of a mask is on the sensor, and what takes the strength of those that are not seen.

The amplitude of order k, as a share of the plane's mean, is the product of what the pattern gives it, what the film
keeps (its pixels' sinc; nothing beyond two pixels a period), what diffraction leaves on the way (Eq 30, at the order's
own frequency, which is √2·k·f_m on a diagonal), the stop's average over κ·k cycles (sinc·sinc of a square one, jinc of
a round one, with nulls and changes of sign), and what the sensor's pixels keep. A stop's shape is rarely known, and an
f-number is rounded. So a strength is a range: over both shapes, and over `_ROUNDING` of the f-number. Where it is
unknown (a manual lens), any order may be averaged out, and none must stand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from dappled.decode.optics.carriers import Lattice, Mask, MaskedOptics, Order

_ROUNDING = 0.12  # relative: an f-number given in third stops, and nulls where only their neighbourhood counts
_WAVELENGTHS_MM = np.array([450e-6, 500e-6, 550e-6, 600e-6, 650e-6])  # of daylight, each with the same weight
COLOURS_MM = (450e-6, 550e-6, 650e-6)  # of sums over all orders, which more would make dear
_BLADES, _SIZES, _POINTS = (5, 6, 7, 8), 15, 24  # of the stops that are tried; points along a side
_LITTLE_LOST = 2  # harmonics up to this one: no frame of one was refused for what film and diffraction take
_ANY_F_NUMBER = (1.2, 64.0)  # where none is told
_LOST = 0.15  # a factor below this is named as the cause why a carrier is not seen


@dataclass(frozen=True, slots=True)
class OrderStrength:
    """What is predicted of one order: where it stands, and how strong it is at least and at most.

    `least` and `most` are shares of the plane's mean, over the stop's possible shapes and the f-number's rounding.
    `pattern`, `film`, `diffraction`, `stop` and `pixels` are the factors whose product `most` is; `film_per_mm` the
    order's frequency on the film, `per_mm` on the sensor.
    """

    order: Order
    fy: float
    fx: float
    least: float
    most: float
    pattern: float
    film: float
    diffraction: float
    stop: float
    pixels: float
    film_per_mm: float
    per_mm: float

    @property
    def on_sensor(self) -> bool:
        """Whether the carrier lies below the Nyquist frequency on both axes."""
        return abs(self.fy) < 0.5 and abs(self.fx) < 0.5

    @property
    def cause(self) -> str | None:
        """What takes this carrier's strength, in a few words; None where nothing takes much of it."""
        if self.film == 0:
            return f"at {self.film_per_mm:.0f} cycles/mm, which the film cannot draw"
        if not self.on_sensor:
            return "beyond the sensor's Nyquist frequency"
        factors = {
            "averaged out over the stop": self.stop,
            "lost to diffraction between mask and sensor": self.diffraction,
            "blurred by the film": self.film,
            "blurred by the pixels": self.pixels,
        }
        worst = min(factors, key=factors.__getitem__)
        return worst if factors[worst] < _LOST else None


def order_strengths(
    optics: MaskedOptics, lattice: Lattice, f_number: float | None, orders: Sequence[Order] | None = None
) -> list[OrderStrength]:
    """The predicted strength of a mask's orders at a lattice, by default the half plane's without the mean; of an
    unknown f-number (None) at most as behind a pinhole, and at least nothing."""
    mask, mask_distance_mm = optics.mask, optics.distance_mm
    wanted = [order for order in (mask.half_orders() if orders is None else orders) if order != (0, 0)]
    k = np.array(wanted, dtype=np.float64).reshape(-1, 2)
    amplitudes = pattern_amplitudes(mask)
    pattern = np.array([abs(amplitudes.get(order, 0.0)) for order in wanted])
    on_film = k * mask.frequency_per_mm
    film, diffraction = _on_the_way(mask, k, mask_distance_mm)
    if f_number is None:
        stop_least, stop_most = np.zeros(len(k)), np.ones(len(k))
    else:
        swept = mask.frequency_per_mm * mask_distance_mm / f_number * k  # κ·k cycles over the stop
        offs = np.linspace(-_ROUNDING, _ROUNDING, 9)
        stops = np.array([shape(swept * (1 + off)) for shape in (round_stop, _square) for off in offs])
        stop_least, stop_most = np.abs(stops).min(axis=0), np.abs(stops).max(axis=0)
        stop_least = np.where((stops.max(axis=0) > 0) & (stops.min(axis=0) < 0), 0.0, stop_least)  # a null in between
    frequencies = k @ lattice.matrix()
    pixels = np.abs(np.sinc(frequencies).prod(axis=1))
    common = pattern * np.abs(film) * diffraction * pixels
    to_mm = np.linalg.inv(np.array([optics.sensor.row_mm, optics.sensor.column_mm])).T
    on_sensor = np.hypot(*(frequencies @ to_mm).T)
    return [
        OrderStrength(
            order=order,
            fy=float(frequencies[i, 0]),
            fx=float(frequencies[i, 1]),
            least=float(common[i] * stop_least[i]),
            most=float(common[i] * stop_most[i]),
            pattern=float(pattern[i]),
            film=float(abs(film[i])),
            diffraction=float(diffraction[i]),
            stop=float(stop_most[i]),
            pixels=float(pixels[i]),
            film_per_mm=float(np.abs(on_film[i]).max()),
            per_mm=float(on_sensor[i]),
        )
        for i, order in enumerate(wanted)
    ]


def designs(
    optics: MaskedOptics, lattice: Lattice, f_number: float, orders: Sequence[Order]
) -> list[NDArray[np.float64]]:
    """(K,) how strong each order, the mean first, is before the stop: as drawn, and less film, diffraction, pixels."""
    made = order_strengths(optics, lattice, f_number, orders)
    drawn = np.array([1.0, *(one.pattern for one in made)])
    left = np.array([1.0, *(one.film * one.diffraction * one.pixels for one in made)])
    return [drawn, drawn * left]


def _on_the_way(
    mask: Mask, k: NDArray[np.float64], mask_distance_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K,) what the film keeps of each order, and what diffraction leaves of it between mask and sensor."""
    numbers = _WAVELENGTHS_MM * mask_distance_mm * ((k * mask.frequency_per_mm) ** 2).sum(axis=1)[:, None]  # λ·d·f²
    return film_transfer(mask, k), np.asarray(np.sqrt((np.cos(np.pi * numbers) ** 2).mean(axis=1)))


def amplitude_orders(mask: Mask, samples: int) -> NDArray[np.float64]:
    """(n, n) the orders of the film's amplitude, the root of its transmittance, as `numpy.fft.fftfreq` numbers them;
    `samples` n of a period. They are real: the pattern is symmetrical."""
    light = np.zeros((samples, samples))
    for order, amplitude in pattern_amplitudes(mask).items():
        light[order] = amplitude * film_transfer(mask, np.array([order], dtype=np.float64))[0]
    drawn = np.maximum(fft.ifft2(light, norm="forward").real, 0)
    return np.asarray(fft.fft2(np.sqrt(drawn), norm="forward").real)


def film_transfer(mask: Mask, k: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) what the film keeps of each order (K, 2)."""
    if mask.film_px_per_mm is None:
        return np.ones(len(k))
    on_film = k * mask.frequency_per_mm
    drawn = np.abs(on_film).max(axis=1) <= mask.film_px_per_mm / 2 * (1 + 1e-9)
    return np.asarray(np.where(drawn, np.sinc(on_film / mask.film_px_per_mm).prod(axis=1), 0.0))


def under_stops(
    optics: MaskedOptics, lattice: Lattice, orders: Sequence[Order], f_number: float | None
) -> NDArray[np.float64]:
    """(stops, orders) how strong each order is behind stops of many shapes and sizes, as shares of the plane's mean.

    Round and square ones, and polygons of 5 to 8 blades in two directions; each as the f-number has it, and up to a
    third wider or narrower, as f-number and mask distance may be off; of any size where it is unknown (None). Each once
    with nothing lost on film and to diffraction, once with what they take of higher harmonics: neither is known well.
    """
    mask, mask_distance_mm = optics.mask, optics.distance_mm
    k = np.array(orders, dtype=np.float64).reshape(-1, 2)
    amplitudes = pattern_amplitudes(mask)
    pattern = np.array([abs(amplitudes.get(order, 0.0)) for order in orders])
    pixels = np.abs(np.sinc(k @ lattice.matrix()).prod(axis=1))
    sizes = np.geomspace(0.7, 1.4, _SIZES)
    if f_number is None:
        f_number, sizes = 1.0, np.geomspace(1 / _ANY_F_NUMBER[1], 1 / _ANY_F_NUMBER[0], 4 * _SIZES)
    swept = mask.frequency_per_mm * mask_distance_mm / f_number * k
    shapes = [round_stop, _square, *(_polygon(blades, turn) for blades in _BLADES for turn in (0.0, 0.5))]
    stops = np.array([np.abs(shape(swept * size)) for shape in shapes for size in sizes]) * pattern * pixels
    film, diffraction = _on_the_way(mask, k, mask_distance_mm)
    lost = np.where(np.abs(k).max(axis=1) > _LITTLE_LOST, np.abs(film) * diffraction, 1.0)
    return np.concatenate([stops, stops * lost])


def pattern_amplitudes(mask: Mask) -> dict[Order, float]:
    """Amplitude of each order as a share of the mean, for a film that is black where the pattern is lowest.

    Harmonics that the film can't draw are left out of the pattern, as they come out as other frequencies.
    """
    drawn = [m for m in mask.multiples if _drawable(mask, m)] or list(mask.multiples[:1])
    turns = 2 * np.pi * np.arange(2048) / 2048
    axis = np.array([np.cos(m * turns) for m in drawn])
    if mask.pattern == "full":
        along = 1 + axis.sum(axis=0)
        lowest = min(float(along.min() * along.max()), float(along.min() ** 2), float(along.max() ** 2))
        mean = 1.0
    else:
        coarse = axis[:, ::4]
        lowest, mean = float((coarse.T @ coarse).min()), 0.0
    clear = mean - lowest
    found = {(0, 0): 1.0}
    for ky, kx in mask.orders():
        if (ky, kx) == (0, 0) or not all(abs(n) in (0, *drawn) for n in (ky, kx)):
            continue
        found[ky, kx] = (0.5 if ky else 1.0) * (0.5 if kx else 1.0) / clear
    return found


def _drawable(mask: Mask, multiple: int) -> bool:
    limit = math.inf if mask.film_px_per_mm is None else mask.film_px_per_mm / 2
    return multiple * mask.frequency_per_mm <= limit * (1 + 1e-9)


def round_stop(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform of a disc of diameter 1, 1 at 0, at places (n, 2) in cycles over it."""
    turns = np.pi * np.hypot(*cycles.T)
    return np.asarray(np.where(turns > 0, 2 * special.j1(turns) / np.where(turns > 0, turns, 1.0), 1.0))


def _polygon(blades: int, turn: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The transform of a regular polygon of the circle's diameter, turned by a share of a blade: a sum over points."""
    axis = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    edges = 2 * np.pi * (np.arange(blades) + turn) / blades
    reach = 0.5 * math.cos(math.pi / blades)
    across = np.sin(edges)[:, None, None] * axis[:, None] + np.cos(edges)[:, None, None] * axis
    inside = np.all(across <= reach, axis=0)
    shares = inside / np.count_nonzero(inside)

    def transform(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
        along_y, along_x = np.exp(2j * np.pi * cycles.T[:, :, None] * axis)
        return np.asarray(np.abs(((along_y @ shares) * along_x).sum(axis=1)))

    return transform


def _square(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sinc(cycles).prod(axis=1))
