"""The thesis' list of carriers of a Lytro frame, found on a simulated frame of the same lattice."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.lenslets import carriers_within
from dappled.decode.spectrum.lattice import find_lattice
from dappled.decode.spectrum.transform import transform
from tests.decode.thesis_tables import LYTRO

SIDE = 3280
MISPRINT, MEANT = (1639, 2275), (1639, 2775)


def _fitted() -> NDArray[np.float64]:
    """(2, 2) the steps (bins) of the hexagonal lattice that the list lies on, by least squares, the misprint aside."""
    places = np.array([place for place in LYTRO if place != MISPRINT], dtype=np.float64)
    guess = np.array([[327.6, 189.47], [655.2, 0.0]])
    orders = np.round((places - SIDE / 2) @ np.linalg.inv(guess))
    design = np.column_stack([orders, np.ones(len(places))])
    return np.asarray(np.linalg.lstsq(design, places, rcond=None)[0][:2])


def test_one_of_the_list_is_a_misprint() -> None:
    steps = _fitted()
    off = (np.array(LYTRO) - SIDE / 2) @ np.linalg.inv(steps)
    distance = np.hypot(*((off - np.round(off)) @ steps).T)
    assert [place for place, far in zip(LYTRO, distance, strict=True) if far > 3] == [MISPRINT]
    kept = distance[[place != MISPRINT for place in LYTRO]]
    assert np.sqrt(np.mean(kept**2)) < 1
    meant = (np.array(MEANT) - SIDE / 2) @ np.linalg.inv(steps)
    assert np.hypot(*((meant - np.round(meant)) @ steps)) < 3


def _frame(steps_bins: NDArray[np.float64], seed: int) -> NDArray[np.float32]:
    """A textured scene behind round lenslets, their images bright in the middle, noise at a raw signal of 50."""
    rng = np.random.default_rng(seed)
    centres = np.linalg.inv(steps_bins / SIDE)  # columns: steps from lenslet to lenslet
    axis = np.arange(SIDE, dtype=np.float32)
    y, x = axis[:, None], axis[None, :]
    forward = (steps_bins / SIDE).astype(np.float32)
    distance = np.full((SIDE, SIDE), np.inf, dtype=np.float32)
    a = forward[0, 0] * y + forward[0, 1] * x
    b = forward[1, 0] * y + forward[1, 1] * x
    a, b = a - np.floor(a), b - np.floor(b)
    for i in (-1, 0, 1, 2):
        for j in (-1, 0, 1, 2):
            dy = centres[0, 0] * (a - i) + centres[0, 1] * (b - j)
            dx = centres[1, 0] * (a - i) + centres[1, 1] * (b - j)
            np.minimum(distance, np.hypot(dy, dx, dtype=np.float32), out=distance)
    scene = 0.5 + sum(
        0.04 * np.cos(2 * np.pi * (fy * y + fx * x) + phase)
        for fy, fx, phase in zip(*rng.normal(0, 0.008, (2, 10)), rng.uniform(0, 6, 10), strict=True)
    )
    radius = np.float32(4.7)
    image = np.clip(radius + np.float32(0.5) - distance, 0, 1) * (1 - 0.35 * (distance / radius) ** 2)
    frame = scene * image
    return np.asarray(frame + rng.normal(0, frame.mean() / 50, frame.shape), dtype=np.float32)


@pytest.mark.long
def test_every_carrier_of_the_list_is_found_on_a_frame_of_that_lattice() -> None:
    steps = _fitted()
    found = find_lattice(transform(_frame(steps, 1), workers=2))
    places = [(0.0, 0.0)]
    for carrier in found.carriers:
        places += [(carrier.fy * SIDE, carrier.fx * SIDE), (-carrier.fy * SIDE, -carrier.fx * SIDE)]
    verified = np.array(places) + SIDE / 2
    listed = np.array([MEANT if place == MISPRINT else place for place in LYTRO])
    distance = np.hypot(*(listed[:, None] - verified[None]).transpose(2, 0, 1)).min(axis=1)
    assert distance.max() < 3, listed[distance >= 3]  # as near as the list, read by hand, lies to its own lattice
    assert np.hypot(*(np.array(MISPRINT) - verified).T).min() > 50
    exact = [c for c in carriers_within(found.lattice, 0.45) if (c.ky, c.kx) != (0, 0)]
    off = np.array([(c.fy, c.fx) for c in exact]) * SIDE @ np.linalg.inv(steps)
    assert np.abs((off - np.round(off)) @ steps).max() < 0.05
