from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.slices import BandShape, _bands, _cell_weights, _taper_weights, extract
from dappled.decode.spectrum.transform import SpectrumBuffers, transform
from tests.decode.spectrum.equations import slice_at

SHAPE = (200, 250)


def _frame(fy: float, fx: float, factor: complex) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    picture = 0.5 + 0.2 * np.cos(2 * np.pi * (0.011 * y + 0.008 * x))
    carrier = 2 * (factor * np.exp(2j * np.pi * (fy * y + fx * x))).real
    return picture, (picture * (1 + carrier)).astype(np.float32)


@given(fy=st.floats(0.1, 0.4), fx=st.floats(-0.4, 0.4), phase=st.floats(-3, 3))
def test_a_slice_is_the_picture_times_the_carriers_amplitude(fy: float, fx: float, phase: float) -> None:
    factor = 0.3 * np.exp(1j * phase)
    picture, plane = _frame(fy, fx, factor)
    carriers = [Carrier(0, 0, 0.0, 0.0), Carrier(1, 0, fy, fx)]
    found = extract(transform(plane), carriers, BandShape((20, 24)))
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
    weights = _taper_weights(size, 0.5)
    assert weights[20, 24] == 1.0
    assert weights[0, 24] == pytest.approx(0.0, abs=1e-6)
    assert np.all(weights[11:30, 13:36] == 1.0)  # the middle half is left alone
    plane = np.zeros(SHAPE, dtype=np.float32)
    plane[:, SHAPE[1] // 2 :] = 1.0
    mean = [Carrier(0, 0, 0.0, 0.0)]
    sharp, soft = (extract(transform(plane), mean, BandShape(size, taper=taper)) for taper in (0.0, 1.0))
    inner = (slice(8, -8), slice(8, -8))
    assert soft.values[0].real[inner].max() < sharp.values[0].real[inner].max() - 0.05  # Gibbs' overshoot is gone
    assert soft.band == pytest.approx(sharp.band * float(np.mean(_taper_weights(size, 1.0) ** 2)))
    with pytest.raises(DecodeError, match="share of the band"):
        extract(transform(plane), mean, BandShape(size, taper=1.5))


def test_the_largest_boxes_do_not_overlap() -> None:
    for angle in (0.0, 0.02, -0.035):
        lattice = Lattice((0.153, 0.0), (0.0, 0.1535)).rotated(angle)
        height, width = lattice.slice_size((2800, 3750))
        for ky in range(-2, 3):
            for kx in range(-2, 3):
                dy, dx = np.array([ky, kx]) @ lattice.matrix() * (2800, 3750)
                assert (ky, kx) == (0, 0) or abs(dy) >= height or abs(dx) >= width
        assert height > 0.9 * 0.153 * 2800
        assert width > 0.9 * 0.1535 * 3750


@pytest.mark.parametrize("turn_deg", [0.0, 0.5, 1.8, -4.0, 8.0])
def test_a_slice_of_a_fine_lattice_is_no_strip_between_its_rows(turn_deg: float) -> None:
    """Mask 2's carriers on a whole S5200: 49 and 63 bins apart, in a frame of 2940 × 3750."""
    height, width = Lattice((0.0168, 0.0), (0.0, 0.0170)).rotated(np.radians(turn_deg)).slice_size((2940, 3750))
    assert 0.75 * 0.0168 * 2940 < height <= 0.0168 * 2940
    assert 0.75 * 0.0170 * 3750 < width <= 0.0170 * 3750


def test_cells_of_a_hexagonal_lattice_tile_the_plane() -> None:
    lattice = Lattice((0.1154, -0.0002), (0.0578, 0.0999))
    size = lattice.slice_size((600, 750), "cell")
    weights = _cell_weights(lattice, (600, 750), size)
    area = abs(np.linalg.det(lattice.matrix())) * 600 * 750
    assert weights.sum() == pytest.approx(area, rel=0.01)
    assert weights[0].max() < 0.5
    assert weights[:, 0].max() < 0.5


def test_white_noise_fills_a_slice_by_its_band() -> None:
    plane = np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32)
    found = extract(transform(plane), [Carrier(1, 1, 0.21, 0.13)], BandShape((40, 50)))
    assert np.mean(np.abs(found.values) ** 2) == pytest.approx(0.1**2 * found.band, rel=0.1)


def test_a_band_beyond_nyquist_is_cut_or_goes_round() -> None:
    plane = np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32)
    spectrum = transform(plane)
    at_edge = [Carrier(1, 0, 0.49, 0.0)]
    cut, wrapped = (extract(spectrum, at_edge, BandShape((40, 40), wrap=wrap)).values for wrap in (False, True))
    assert np.mean(np.abs(cut) ** 2) == pytest.approx(0.6 * np.mean(np.abs(wrapped) ** 2), rel=0.15)


def test_any_number_of_workers_gives_the_same_bytes() -> None:
    _, plane = _frame(0.2, 0.15, 0.3)
    carriers = Lattice((0.15, 0.001), (-0.001, 0.15)).carriers([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1)])
    spectrum = transform(plane)
    one, three = (extract(spectrum, carriers, BandShape((30, 36)), workers=w).values for w in (1, 3))
    assert one.tobytes() == three.tobytes()


def test_bad_calls_are_refused_in_words() -> None:
    spectrum = transform(_frame(0.2, 0.2, 0.3)[1])
    with pytest.raises(DecodeError, match="no carriers"):
        extract(spectrum, [], BandShape((10, 10)))
    with pytest.raises(DecodeError, match="size"):
        extract(spectrum, [Carrier(0, 0, 0, 0)], BandShape())
    with pytest.raises(DecodeError, match="fit"):
        extract(spectrum, [Carrier(0, 0, 0, 0)], BandShape((1000, 10)))
    with pytest.raises(DecodeError, match="too close"):
        Lattice((1e-6, 0.0), (0.0, 1e-6)).slice_size((600, 750))


UNEVEN = np.random.default_rng(8).random((151, 203)).astype(np.float32)


@given(
    fy=st.floats(-0.49, 0.49),
    fx=st.floats(-0.49, 0.49),
    height=st.integers(2, 80),
    width=st.integers(2, 90),
    wrap=st.booleans(),
    mean=st.booleans(),
)
def test_slices_are_those_of_the_equation(
    *, fy: float, fx: float, height: int, width: int, wrap: bool, mean: bool
) -> None:
    spectrum = transform(UNEVEN)
    carrier = Carrier(0, 0, 0.0, 0.0) if mean else Carrier(1, 2, fy, fx)
    found = extract(spectrum, [carrier], BandShape((height, width), wrap=wrap)).values[0]
    expected = slice_at(UNEVEN, carrier, (height, width), level=spectrum.level, wrap=wrap)
    expected = expected[: found.shape[0], : found.shape[1]]
    assert np.abs(found - expected).max() < 1e-5 * max(np.abs(expected).max(), 1e-2)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("workers", [2, 3])
def test_any_number_of_workers_and_carriers_gives_the_same_bytes(count: int, workers: int) -> None:
    spectrum = transform(UNEVEN)
    carriers = [Carrier(1, k, 0.03 * k, 0.21 - 0.06 * k) for k in range(count)]
    one, many = (extract(spectrum, carriers, BandShape((40, 60)), workers=w).values for w in (1, workers))
    assert one.tobytes() == many.tobytes()


def test_columns_that_were_not_transformed_are_refused_before_anything_is_cut() -> None:
    spectrum = transform(UNEVEN, largest_fx=0.2)
    with pytest.raises(DecodeError, match="not computed"):
        extract(spectrum, [Carrier(0, 0, 0.0, 0.0), Carrier(0, 1, 0.0, 0.3)], BandShape((20, 20)))


def test_bands_laid_out_before_give_the_same_slices_as_new_ones() -> None:
    shape = (150, 210)
    carriers = Lattice((0.15, 0.001), (-0.001, 0.15)).carriers([(0, 0), (0, 1), (1, -1), (1, 0), (1, 1)])
    buffers = SpectrumBuffers()
    for seed in (1, 2, 1):
        frame = np.random.default_rng(seed).random(shape).astype(np.float32)
        for size in ((20, 28), (24, 30)):
            with buffers.lend(shape) as tiles:
                found = extract(transform(frame, tiles=tiles), carriers, BandShape(size), workers=2)
            _bands.cache_clear()
            fresh = extract(transform(frame), carriers, BandShape(size))
            assert found.values.tobytes() == fresh.values.tobytes()
            assert np.array_equal(found.grid, fresh.grid)
            assert found.carriers == fresh.carriers


def test_slices_outlive_the_next_frame() -> None:
    with SpectrumBuffers().lend(UNEVEN.shape) as tiles:
        first = extract(transform(UNEVEN, tiles=tiles), [Carrier(0, 0, 0.0, 0.0)], BandShape((20, 28)))
        before = first.values.copy()
        transform(UNEVEN * 3, tiles=tiles)
    assert np.array_equal(first.values, before)
