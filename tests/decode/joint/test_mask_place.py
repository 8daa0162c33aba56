"""Where slices place a mask that moved or turned, on slices made by the physics: s(x − D·θ) through a square stop."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.array_types import Complexes
from dappled.decode.calibration.calibration import moved
from dappled.decode.joint.mask_place import MaskPlace, PlaceSearch, carrier_changes
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies
from dappled.decode.optics import Lattice, Sensor
from dappled.findings import Code

ORDERS = [(y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) >= (0, 0)]
SHAPE, SAMPLE_PX = (120, 132), 6.5
SENSOR = Sensor((780, 858), (0.01, 0.0), (0.0, 0.01))
LATTICE = Lattice((0.1535, 0.0), (0.0, 0.1535))
CHANGES = carrier_changes(LATTICE, SENSOR)
MAGNITUDES = np.array([1.0 if order == (0, 0) else 0.3 for order in ORDERS], dtype=np.complex128)
ANGULAR = angular_frequencies(ORDERS, 1.0, 0.0)  # the ideal aperture: the means of all carriers are 0


def _slices(seed: int, *, disparities: tuple[float, float] = (-4.0, 6.0), kappa: float = 1.0) -> Complexes:
    """Left and right halves at two disparities (sensor columns over the aperture), and noise, through an aperture of so
    many periods of the mask."""
    chance = np.random.default_rng(seed)
    made = np.zeros((len(ORDERS), *SHAPE), dtype=np.complex128)
    f = np.stack(np.meshgrid(*(np.fft.fftfreq(side, SAMPLE_PX) for side in SHAPE), indexing="ij"), axis=-1)
    radius = np.maximum(np.hypot(f[..., 0], f[..., 1]), 1 / 400)
    for half, disparity in enumerate(disparities):
        scene = np.fft.fft2(chance.normal(size=SHAPE)) * radius**-1.3
        scene *= 0.06 / np.fft.ifft2(scene).real.std()
        scene[0, 0] = 0.3 * scene.size
        part = slice(66 * half, 66 * (half + 1))
        for n, (angular, size) in enumerate(zip(kappa * ANGULAR, MAGNITUDES, strict=True)):
            through = np.sinc(angular - disparity * f).prod(axis=-1)
            made[n, :, part] = np.fft.ifft2(size * through * scene)[:, part]
    noise = chance.normal(size=(2, *made.shape))
    return np.asarray(made + 2e-4 * (noise[0] + 1j * noise[1]), dtype=np.complex64)


def _moved(slices: Complexes, periods: tuple[float, float], turn_rad: float, off: float = 0.0) -> Complexes:
    """As a mask elsewhere makes them: a turn moves its waves in proportion to the distance from the middle, another
    scale, too."""
    rows, columns = ((np.arange(side) - (side - 1) / 2) * SAMPLE_PX for side in SHAPE)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    waves = np.array(ORDERS) @ LATTICE.matrix()
    moved = (1 + off) * waves @ np.array([[c, s], [-s, c]]) - waves
    cycles = moved[:, :1, None] * y + moved[:, 1:, None] * x + (np.array(ORDERS) @ periods)[:, None, None]
    return np.asarray(slices * np.exp(2j * np.pi * cycles), dtype=np.complex64)


def _blending(seed: int) -> Complexes:
    """Boards at two disparities that blend into each other from left to right, through a smaller stop."""
    chance = np.random.default_rng(seed)
    made = np.zeros((len(ORDERS), *SHAPE), dtype=np.complex128)
    f = np.stack(np.meshgrid(*(np.fft.fftfreq(side, SAMPLE_PX) for side in SHAPE), indexing="ij"), axis=-1)
    radius = np.maximum(np.hypot(f[..., 0], f[..., 1]), 1 / 400)
    for number, disparity in enumerate((-6.0, 8.0)):
        texture = np.fft.ifft2(np.fft.fft2(chance.normal(size=SHAPE)) * radius**-1.3 * (radius > 1 / 400)).real
        share = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(SHAPE[1]) / SHAPE[1] - number / 2))
        scene = np.fft.fft2(0.3 * (1 + 0.2 * texture / texture.std()) * share)
        for n, (angular, size) in enumerate(zip(0.85 * ANGULAR, MAGNITUDES, strict=True)):
            made[n] += np.fft.ifft2(size * np.sinc(angular - disparity * f).prod(axis=-1) * scene)
    noise = chance.normal(size=(2, *made.shape))
    return np.asarray(made + 2e-4 * (noise[0] + 1j * noise[1]), dtype=np.complex64)


def _place(slices: Complexes, kappa: float = 1.0, *, moved: bool = False) -> MaskPlace:
    carriers = np.array(ORDERS) @ LATTICE.matrix()
    found = PlaceSearch(
        slices,
        SliceModel.of_half(ORDERS, MAGNITUDES, kappa * ANGULAR, carriers, Aperture(5, "filled")),
        samples_px=(SAMPLE_PX, SAMPLE_PX),
        noise=np.full(len(ORDERS), 8e-8),
        reach=5 * SAMPLE_PX,
        changes=CHANGES,
        steps_px=(SAMPLE_PX, SAMPLE_PX),
    ).near(moved=moved)
    assert found is not None
    return found


def test_a_mask_that_moved_and_turned_is_placed_where_its_carriers_average_out() -> None:
    slices = _slices(1)
    away = _moved(slices, (0.24, -0.11), 0.002)
    found = _place(away)
    assert found.periods == pytest.approx((0.24, -0.11), abs=0.01)
    assert found.turn_rad == pytest.approx(0.002, abs=2e-4)
    assert max(found.periods_sigma) < 0.01
    back = found.undone(away, ORDERS, CHANGES, (SAMPLE_PX, SAMPLE_PX))
    turned_back = _moved(slices, found.periods, 0.0)
    assert np.abs(back - turned_back)[1:].mean() < 0.1 * np.abs(away - turned_back)[1:].mean()
    shifted, turned = moved(found.periods, found.turn_rad, 15.5)
    assert shifted.code is Code.MASK_SHIFTED
    assert shifted.facts["by_um"] == pytest.approx(17, abs=0.5)
    assert turned.code is Code.MASK_TURNED
    assert turned.facts["by_deg"] == pytest.approx(0.11, abs=0.01)


@pytest.mark.parametrize("turn", [0.0, 0.004])
def test_another_scale_is_found_where_no_carrier_is_seen(turn: float) -> None:
    away = _moved(_slices(4), (0.2, 0.1), turn, -0.003)
    found = _place(away)
    assert found.off == pytest.approx(-0.003, abs=4 * found.off_sigma)
    assert found.off_sigma < 1e-4
    assert found.turn_rad == pytest.approx(turn, abs=2e-4)
    assert found.periods == pytest.approx((0.2, 0.1), abs=0.01)
    back = found.undone(away, ORDERS, CHANGES, (SAMPLE_PX, SAMPLE_PX))
    right = _moved(_slices(4), found.periods, 0.0)
    assert np.abs(back - right)[1:].mean() < 0.1 * np.abs(away - right)[1:].mean()


@pytest.mark.parametrize("periods", [(-0.008, 0.03), (0.06, -0.02)])
def test_means_of_patches_place_a_mask_that_has_hardly_moved(periods: tuple[float, float]) -> None:
    """Their light is much brighter than texture: that of a mask elsewhere is no texture, but is at once its place."""
    found = _place(_moved(_slices(6, kappa=0.9), periods, 0.0), kappa=0.9)
    assert found.periods == pytest.approx(periods, abs=0.002)
    assert max(found.periods_sigma) < 0.002


@pytest.mark.slow
def test_what_light_of_several_disparities_adds_to_a_scale_is_in_its_standard_error() -> None:
    found = [_place(_blending(seed), 0.85, moved=True) for seed in range(6)]
    assert np.sqrt(np.mean([(one.off / one.off_sigma) ** 2 for one in found])) < 2
    assert max(abs(one.off) / one.off_sigma for one in found) < 4
    assert not any(_place(_blending(seed), 0.85).moved for seed in range(6))


def test_a_mask_in_its_place_is_left_there() -> None:
    found = _place(_slices(2))
    assert not found.far().moved
    assert found.seen
    assert found.nats > 2 * found.patches
    assert moved(found.periods, found.turn_rad, 15.5) == ()


def test_a_scene_alone_shows_no_mask() -> None:
    chance = np.random.default_rng(5)
    alone = np.fft.ifft2(np.fft.fft2(chance.normal(size=(len(ORDERS), *SHAPE))) * 0.01)
    without = _slices(2)
    without[1:] = alone[1:]  # each a part of the scene's spectrum of its own
    place = _place(without)
    assert (place.seen, place.moved) == (False, False)
    assert place.nats < 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3, 11))
def test_no_scene_moves_a_mask(seed: int) -> None:
    chance = np.random.default_rng(seed)
    near, far = (float(one) for one in chance.uniform(-25, 25, 2))
    assert not _place(_slices(seed, disparities=(near, far))).far().moved


def test_small_slices_tell_nothing() -> None:
    carriers = np.array(ORDERS) @ LATTICE.matrix()
    small = PlaceSearch(
        _slices(2)[:, :40, :40],
        SliceModel.of_half(ORDERS, MAGNITUDES, ANGULAR, carriers, Aperture(5)),
        samples_px=(SAMPLE_PX, SAMPLE_PX),
        noise=np.full(len(ORDERS), 8e-8),
        reach=5 * SAMPLE_PX,
        changes=CHANGES,
        steps_px=(SAMPLE_PX, SAMPLE_PX),
    ).near()
    assert small is None
