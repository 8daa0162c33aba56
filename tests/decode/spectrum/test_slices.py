from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.padded import Spectrum
from dappled.decode.spectrum.slices import _cell_weights, default_size, extract, taper_weights

SHAPE = (200, 250)


def _frame(fy: float, fx: float, factor: complex) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    picture = 0.5 + 0.2 * np.cos(2 * np.pi * (0.011 * y + 0.008 * x))
    carrier = 2 * (factor * np.exp(2j * np.pi * (fy * y + fx * x))).real
    return picture, (picture * (1 + carrier)).astype(np.float32)


@settings(max_examples=25, deadline=None)
@given(fy=st.floats(0.1, 0.4), fx=st.floats(-0.4, 0.4), phase=st.floats(-3, 3))
def test_a_slice_is_the_picture_times_the_carriers_amplitude(fy: float, fx: float, phase: float) -> None:
    factor = 0.3 * np.exp(1j * phase)
    picture, plane = _frame(fy, fx, factor)
    carriers = [Carrier(0, 0, 0.0, 0.0), Carrier(1, 0, fy, fx)]
    found = extract(Spectrum.of(plane), carriers, (20, 24))
    rows = np.arange(found.values.shape[1]) * found.grid[0, 0]
    columns = np.arange(found.values.shape[2]) * found.grid[1, 1]
    assert rows[-1] <= SHAPE[0] - 1
    assert columns[-1] <= SHAPE[1] - 1
    expected = 0.5 + 0.2 * np.cos(2 * np.pi * (0.011 * rows[:, None] + 0.008 * columns))
    inner = (slice(4, -4), slice(4, -4))  # a frame's edge rings
    np.testing.assert_allclose(found.values[0][inner], expected[inner], atol=0.02)
    np.testing.assert_allclose(found.values[1][inner], (factor * expected)[inner], atol=0.02)
    assert picture.mean() == pytest.approx(found.values[0].real.mean(), abs=0.02)


def test_a_tapered_band_keeps_its_middle_and_rings_less() -> None:
    size = (40, 48)
    weights = taper_weights(size, 0.5)
    assert weights[20, 24] == 1.0
    assert weights[0, 24] == pytest.approx(0.0, abs=1e-6)
    assert np.all(weights[11:30, 13:36] == 1.0)  # the middle half is left alone
    plane = np.zeros(SHAPE, dtype=np.float32)
    plane[:, SHAPE[1] // 2 :] = 1.0
    mean = [Carrier(0, 0, 0.0, 0.0)]
    sharp, soft = (extract(Spectrum.of(plane), mean, size, taper=taper) for taper in (0.0, 1.0))
    inner = (slice(8, -8), slice(8, -8))
    assert soft.values[0].real[inner].max() < sharp.values[0].real[inner].max() - 0.05  # Gibbs' overshoot is gone
    assert soft.band == pytest.approx(sharp.band * float(np.mean(taper_weights(size, 1.0) ** 2)))
    with pytest.raises(DecodeError, match="share of the band"):
        extract(Spectrum.of(plane), mean, size, taper=1.5)


def test_the_largest_boxes_do_not_overlap() -> None:
    for angle in (0.0, 0.02, -0.035):
        lattice = Lattice((0.153, 0.0), (0.0, 0.1535)).rotated(angle)
        height, width = default_size(lattice, (2800, 3750))
        for ky in range(-2, 3):
            for kx in range(-2, 3):
                dy, dx = np.array([ky, kx]) @ lattice.matrix() * (2800, 3750)
                assert (ky, kx) == (0, 0) or abs(dy) >= height or abs(dx) >= width
        assert height > 0.9 * 0.153 * 2800
        assert width > 0.9 * 0.1535 * 3750


def test_cells_of_a_hexagonal_lattice_tile_the_plane() -> None:
    lattice = Lattice((0.1154, -0.0002), (0.0578, 0.0999))
    size = default_size(lattice, (600, 750), "cell")
    weights = _cell_weights(lattice, (600, 750), size)
    area = abs(np.linalg.det(lattice.matrix())) * 600 * 750
    assert weights.sum() == pytest.approx(area, rel=0.01)
    assert weights[0].max() < 0.5
    assert weights[:, 0].max() < 0.5


def test_white_noise_fills_a_slice_by_its_band() -> None:
    plane = np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32)
    found = extract(Spectrum.of(plane), [Carrier(1, 1, 0.21, 0.13)], (40, 50))
    assert np.mean(np.abs(found.values) ** 2) == pytest.approx(0.1**2 * found.band, rel=0.1)


def test_a_band_beyond_nyquist_is_cut_or_goes_round() -> None:
    plane = np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32)
    spectrum = Spectrum.of(plane)
    at_edge = [Carrier(1, 0, 0.49, 0.0)]
    cut, wrapped = (extract(spectrum, at_edge, (40, 40), wrap=wrap).values for wrap in (False, True))
    assert np.mean(np.abs(cut) ** 2) == pytest.approx(0.6 * np.mean(np.abs(wrapped) ** 2), rel=0.15)


def test_any_number_of_workers_gives_the_same_bytes() -> None:
    _, plane = _frame(0.2, 0.15, 0.3)
    carriers = Lattice((0.15, 0.001), (-0.001, 0.15)).carriers([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1)])
    spectrum = Spectrum.of(plane)
    one, three = (extract(spectrum, carriers, (30, 36), workers=w).values for w in (1, 3))
    assert one.tobytes() == three.tobytes()


def test_bad_calls_are_refused_in_words() -> None:
    spectrum = Spectrum.of(_frame(0.2, 0.2, 0.3)[1])
    with pytest.raises(DecodeError, match="no carriers"):
        extract(spectrum, [], (10, 10))
    with pytest.raises(DecodeError, match="size"):
        extract(spectrum, [Carrier(0, 0, 0, 0)])
    with pytest.raises(DecodeError, match="fit"):
        extract(spectrum, [Carrier(0, 0, 0, 0)], (1000, 10))
    with pytest.raises(DecodeError, match="too close"):
        default_size(Lattice((1e-6, 0.0), (0.0, 1e-6)), (600, 750))
