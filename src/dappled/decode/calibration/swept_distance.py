"""Measure how far a mask's shadow moves over the stop, from how its carriers fade as the stop opens.

Order k of the mask is averaged over the stop: its amplitude is T_k·S(κ·k), κ = f_m·d/N, and S is the transform of the
stop's shape. T_k (pattern, film, diffraction, pixels) is not known, but it is the same at all stops. So the ratios of
one order's amplitudes at several f-numbers N give f_m·d, the print's frequency times its distance, whatever the focal
length and the exit pupil are: the cone of light that falls on a pixel is N's alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dappled.decode.calibration.calibration import SweptDistance
from dappled.decode.calibration.lattice_fit import FrameLattice
from dappled.decode.optics import MaskedOptics, Order, Sensor
from dappled.decode.optics.carrier_tables import lattice_rotation

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

_SEARCHED = 1.8  # times or a fraction of the stated distance
_STEPS = 241  # of the search: 0.5 % of the distance each
_AMPLITUDE = 1.5e-3  # of the mean: what a wall's own structure and the noise add to a carrier
_EACH_STOP = 0.02  # relative: one stop's diameter against the others (f/22 is f/22.6, f/11 is f/11.3; blades)
_ALL_STOPS = 0.03  # relative: all stops' diameters against what the lens says
_OFF = 3.0  # chi² a degree of freedom: beyond it the frames don't follow any stop
_USEFUL = 0.25  # relative: a distance known worse than this says nothing
# (shape, its effective diameter over f/N, how often): a polygon of 5, 6 or 8 blades acts as a round stop of its area,
# which is smaller than f/N where the lens counts N at the blades' corners.
_SHAPES = (("round", 1.0, 3.0), ("round", 0.95, 1.0), ("round", 0.91, 1.0), ("round", 0.87, 1.0), ("square", 1.0, 3.0))


def swept_distance(frames: Sequence[FrameLattice], optics: MaskedOptics) -> SweptDistance | None:
    """The distance that stopped-down frames of an even wall show by their stops; None where they don't tell.

    Frames of one focal length are compared with each other; all give one distance.
    """
    groups = [[one for one in frames if one.focal_length_mm == f] for f in sorted({o.focal_length_mm for o in frames})]
    groups = [group for group in groups if len({one.f_number for one in group}) > 1]
    if not groups:
        return None
    sensor, mask = optics.sensor, optics.mask
    tried = optics.distance_mm * np.exp(np.linspace(-1, 1, _STEPS) * math.log(_SEARCHED))
    cost = np.zeros((len(_SHAPES), _STEPS))
    freedom = -1
    for group in groups:
        turn = lattice_rotation(group[0].lattice, sensor)
        for order, seen in _amplitudes(group, sensor).items():
            freedom += 2 * (len(seen) - 1)
            for at, (shape, share, _) in enumerate(_SHAPES):
                cost[at] += _costs(order, seen, group, share * mask.frequency_per_mm * tried, shape=shape, turn=turn)
    if freedom < 1 or cost.min() > _OFF * freedom:
        return None
    each = np.exp(-0.5 * (cost - cost.min()) / max(1.0, float(cost.min()) / freedom))
    likely = np.array([often for _, _, often in _SHAPES]) @ each
    likely /= likely.sum()
    mean = float(likely @ np.log(tried))
    spread = math.hypot(math.sqrt(float(likely @ (np.log(tried) - mean) ** 2)), _ALL_STOPS)
    if spread > _USEFUL or likely[[0, -1]].max() > 1e-3 * likely.max():
        return None
    stops = tuple(sorted({one.f_number for group in groups for one in group}))
    return SweptDistance(math.exp(mean), spread * math.exp(mean), stops)


def _amplitudes(group: Sequence[FrameLattice], sensor: Sensor) -> dict[Order, NDArray[np.complex128]]:
    """(frames,) the amplitude of each order that some frame of the group saw, its phase that at the frames' centre."""
    middle = (np.array(sensor.shape) - 1) / 2
    known: list[dict[Order, complex]] = []
    for one in group:
        turns = np.array(one.orders, dtype=np.float64) @ (one.lattice.matrix() @ middle)
        values = one.relative * np.exp(2j * np.pi * turns)
        known.append(dict(zip(one.orders, values.tolist(), strict=True)))
    wanted = {(c.ky, c.kx) for one in group for c, _ in one.found}
    return {order: np.array([values[order] for values in known]) for order in wanted if all(order in v for v in known)}


def _costs(
    order: Order,
    seen: NDArray[np.complex128],
    group: Sequence[FrameLattice],
    swept_per_stop: NDArray[np.float64],
    *,
    shape: str,
    turn: float,
) -> NDArray[np.float64]:
    """(tried,) chi² of one order's amplitudes over the stops of one focal length, its own T_k fitted to them."""
    numbers = np.array([one.f_number for one in group])
    cycles = swept_per_stop[:, None] / numbers
    through = _stop(cycles, order, turn, shape)
    slope = (_stop(cycles * 1.01, order, turn, shape) - through) / 0.01
    variance = np.full_like(through, _AMPLITUDE**2)
    for _ in range(2):  # the second time with what a stop's own error makes of an amplitude so large
        own = (seen * through / variance).sum(axis=1) / np.maximum((through**2 / variance).sum(axis=1), 1e-12)
        variance = _AMPLITUDE**2 + np.abs(own[:, None] * slope * _EACH_STOP) ** 2
    own = (seen * through / variance).sum(axis=1) / np.maximum((through**2 / variance).sum(axis=1), 1e-12)
    left = np.abs(seen - own[:, None] * through) ** 2 / variance + np.log(variance / _AMPLITUDE**2)
    return np.asarray(left.sum(axis=1))


def _stop(cycles: NDArray[np.float64], order: Order, turn: float, shape: str) -> NDArray[np.float64]:
    """S at order · cycles over the stop's diameter; a square stop stands upright, the mask is turned."""
    if shape == "round":
        turns = np.pi * cycles * math.hypot(*order)
        return np.asarray(2 * special.j1(turns) / turns)
    c, s = math.cos(turn), math.sin(turn)
    ky, kx = order[0] * c - order[1] * s, order[0] * s + order[1] * c
    return np.asarray(np.sinc(cycles * ky) * np.sinc(cycles * kx))
