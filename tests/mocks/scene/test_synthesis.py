"""The quick frame against the ray sum it stands for."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from dappled.decode.optics.carriers import Lattice, Mask
from dappled.mocks.autopilot.path import TruePose
from dappled.mocks.scene import lens
from dappled.mocks.scene.lens import Installation, Optics, Rays, Rendering
from dappled.mocks.scene.masked_camera import MaskedCamera, SensorModel
from dappled.mocks.scene.opening import Opening
from dappled.mocks.scene.synthesis import MARGIN, SITES, Grid, band_limited
from tests.mocks.scene import oracles

Array = NDArray[np.floating]
SENSOR = SensorModel((180, 230), 0.01)
INSTALLATION = Installation(math.radians(1.3), (0.011, -0.023), 0.47)
GEOMETRIC = Optics(50.0, 7.4, 6.7, Mask(15.5, 2), 0.48)
# (cycles/pixel along y and x, weight, depth-dependent shift in mm for each mm on the aperture, phase)
WAVES = ((0.010, 0.021, 0.30, 0.010, 0.3), (0.042, -0.030, 0.15, 0.023, 1.0), (-0.020, 0.040, 0.12, -0.015, 2.0))
SHARP_WAVES = ((0.010, 0.021, 0.30, 0.002, 0.3), (0.110, -0.060, 0.15, 0.003, 1.0), (-0.070, 0.130, 0.12, 0.003, 2.0))
CHANNELS = (1.0, 0.8, 0.5)


@dataclass(frozen=True)
class Waves:
    """A light field known in closed form at every place; by default with nothing in it that a slice can't carry."""

    waves: tuple[tuple[float, ...], ...] = WAVES
    mean_radiance: float = 1.0
    headroom: float = 1.0

    def value(self, channel: int, y_mm: Array, x_mm: Array, theta: Array) -> Array:
        total = np.ones(np.broadcast_shapes(y_mm.shape, x_mm.shape))
        for fy, fx, weight, shift, phase in self.waves:
            y, x = (y_mm - shift * theta[0]) / 0.01, (x_mm - shift * theta[1]) / 0.01
            total = total + weight * np.cos(2 * np.pi * (fy * y + fx * x) + phase + 0.5 * channel)
        return CHANNELS[channel] * total

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        views = [
            [self.value(c, rays.y_mm[:, None], rays.x_mm[None, :], theta) for c in range(3)]
            for theta in rays.aperture_mm
        ]
        return Rendering(np.array(views, dtype=np.float32), None)


def ray_sum(optics: Optics, f_number: float, lattice: Lattice | None = None) -> Array:
    """Every ray by itself: mean over the aperture of light times the mask's transmission where the ray crosses it.

    With a lattice, the place on the mask is what the lattice says instead of (1 − α)·R·x.
    """
    points = optics.aperture_points_mm(f_number).reshape(-1, 2)
    return ray_sum_of(Waves(), optics, points, np.full(len(points), 1 / len(points)), lattice=lattice)


def ray_sum_of(
    scene: Waves,
    optics: Optics,
    points: Array,
    shares: Array,
    *,
    lattice: Lattice | None = None,
    band: slice = slice(None),
) -> Array:
    """The same for points of an aperture through which these shares of the light come, and a band of rows."""
    rows, columns = (np.linspace(-1, 1, n) * (n - 1) / 2 for n in SENSOR.shape)
    rows = rows[band]
    y, x = rows[:, None] * SENSOR.pitch_mm, columns[None, :] * SENSOR.pitch_mm
    alpha = INSTALLATION.distance_mm / optics.focal_length_mm
    turn = INSTALLATION.rotation()
    frame = np.zeros((len(rows), SENSOR.shape[1]))
    for theta, share in zip(points, shares, strict=True):
        aside = alpha * turn @ theta + np.array(INSTALLATION.shift_mm)
        if lattice is None:
            at = [(1 - alpha) * (turn[i, 0] * y + turn[i, 1] * x) + aside[i] for i in (0, 1)]
        else:
            matrix = lattice.matrix() / optics.mask.frequency_per_mm
            at = [matrix[i, 0] * rows[:, None] + matrix[i, 1] * columns[None, :] + aside[i] for i in (0, 1)]
        through = oracles.mask_values(optics.mask, at[0], at[1])
        for (top, left), channel in SITES:
            light = scene.value(channel, y[top::2], x[:, left::2], theta)
            frame[top::2, left::2] += share * light * through[top::2, left::2]
    return frame


def quick(optics: Optics, f_number: float) -> tuple[Array, Lattice]:
    return frame_of(
        MaskedCamera(1, Waves(), optics, SENSOR, installation=INSTALLATION),
        Opening.of_beams(optics.aperture_points_mm(f_number)),
    )


def frame_of(camera: MaskedCamera, opening: Opening) -> tuple[Array, Lattice]:
    grid = Grid.of(SENSOR.shape, camera.lattice, sharp=camera.real)
    radiance = camera.scene.render(camera._rays(grid, opening.nodes_mm), None).radiance
    return camera._masked(radiance, grid, camera.lattice, opening).astype(np.float64), camera.lattice


def mean_transmission(mask: Mask) -> float:
    axis = np.arange(256) / 256 / mask.frequency_per_mm
    return float(oracles.mask_values(mask, axis[:, None], axis[None, :]).mean())


@pytest.mark.parametrize(
    ("optics", "f_number"),
    [
        pytest.param(GEOMETRIC, 7.4, id="full-aperture"),
        pytest.param(GEOMETRIC, 59.2, id="stopped-down"),
        pytest.param(replace(GEOMETRIC, aperture_samples=8), 10.0, id="finer-aperture"),
        pytest.param(replace(GEOMETRIC, mask=Mask(15.5, 2, "diagonal")), 20.0, id="diagonal-mask"),
        pytest.param(replace(GEOMETRIC, mask=Mask(15.5, 2, "full", "octave")), 20.0, id="octave-mask"),
    ],
)
def test_the_quick_frame_is_the_ray_sum(optics: Optics, f_number: float) -> None:
    frame, _ = quick(optics, f_number)
    expected = ray_sum(optics, f_number) / mean_transmission(optics.mask)
    assert np.abs(frame - expected).max() / np.abs(expected).max() < 1e-4


def test_a_real_stop_is_the_ray_sum_over_all_of_it_with_detail_beyond_a_slices_band() -> None:
    camera = MaskedCamera(1, Waves(SHARP_WAVES), GEOMETRIC, SENSOR, installation=INSTALLATION, real=True)
    opening = Opening.round(GEOMETRIC.used_aperture_mm(14.8), 5)
    assert len(opening.points_mm) > 5 * 5 * 12  # 4 x 4 points a view, but for the square's corners
    frame, _ = frame_of(camera, opening)
    band = slice(60, 76)
    expected = ray_sum_of(Waves(SHARP_WAVES), GEOMETRIC, opening.points_mm, opening.shares, band=band)
    expected /= mean_transmission(GEOMETRIC.mask)
    assert np.abs(frame[band] - expected).max() / np.abs(expected).max() < 5e-3
    limited, _ = frame_of(replace(camera, real=False), opening)
    assert (
        np.abs(limited[band] - expected).max() / np.abs(expected).max() > 0.1
    )  # a slice's band alone is not the picture


def test_a_round_stop_takes_from_carriers_what_a_jinc_does() -> None:
    opening = Opening.round(GEOMETRIC.used_aperture_mm(12.0), 5)
    orders = [(0, 0), (0, 1), (1, 1), (1, -2), (2, 2)]
    held = opening.angular(GEOMETRIC, INSTALLATION, orders).sum(axis=1)
    per_mm = 15.5 * INSTALLATION.distance_mm / 50.0 * np.hypot(*np.array(orders).T)
    t = np.pi * per_mm * GEOMETRIC.used_aperture_mm(12.0)
    jinc = np.where(t > 0, 2 * special.j1(t) / np.where(t > 0, t, 1), 1.0)
    np.testing.assert_allclose(held, jinc, atol=0.02)


def test_under_the_fd_law_only_the_carriers_move() -> None:
    optics = replace(GEOMETRIC, law="fd", focal_length_mm=22.0)
    frame, lattice = quick(optics, 7.4)
    assert lattice.ky[0] == pytest.approx(15.5 * 0.47 / 22 / 1.8, rel=1e-2)
    expected = ray_sum(optics, 7.4, lattice) / mean_transmission(optics.mask)
    assert np.abs(frame - expected).max() / np.abs(expected).max() < 1e-4


def test_a_wrong_mask_shift_is_seen() -> None:
    frame, _ = quick(GEOMETRIC, 59.2)
    wrong = np.roll(ray_sum(GEOMETRIC, 59.2), 2, axis=0) / mean_transmission(GEOMETRIC.mask)
    assert np.abs(frame - wrong).max() / wrong.max() > 0.1


def test_views_below_the_band_pass_unchanged() -> None:
    lattice = lens.carrier_lattice(GEOMETRIC, INSTALLATION, SENSOR.chip)
    grid = Grid.of(SENSOR.shape, lattice)
    rows, columns = grid.places()
    theta = np.zeros(2)
    whole = np.stack([Waves().value(c, rows[:, None] * 0.01, columns[None, :] * 0.01, theta) for c in range(3)])
    limited = band_limited(whole[None].astype(np.float32), grid)
    assert grid.places()[0][MARGIN] == 0
    np.testing.assert_allclose(limited[0], whole[:, *grid.inner], atol=5e-4)


def test_what_a_slice_cannot_carry_is_taken_out_of_the_views() -> None:
    lattice = lens.carrier_lattice(GEOMETRIC, INSTALLATION, SENSOR.chip)
    grid = Grid.of(SENSOR.shape, lattice)
    rows, columns = grid.places()
    fine = np.cos(2 * np.pi * grid.half_band[0] * 1.1 * rows)[:, None] + 0 * columns[None, :]
    limited = band_limited(np.stack([fine] * 3)[None].astype(np.float32), grid)
    assert np.abs(limited).max() < 0.01


def test_carriers_that_no_grid_can_hold_are_refused() -> None:
    with pytest.raises(ValueError, match=r"between 0\.00625 and 0\.4"):
        Grid.of((100, 100), Lattice((0.45, 0.0), (0.0, 0.45)))
