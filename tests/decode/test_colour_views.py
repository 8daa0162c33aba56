"""Views in red, green and blue: the DC bands, and the line of colour over grey, by scenes with known colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode import DecodeError
from dappled.decode.array_types import Floats, Singles
from dappled.decode.colour_views import dc_views, in_colour

BAYER = np.array([[0, 1], [1, 2]])
GRID = np.array([[6.0, 0.0, 0.0], [0.0, 6.0, 0.0]])
SHAPE, SIZE = (288, 336), (48, 56)
INNER = (slice(8, -8), slice(8, -8))


def index_of(shape: tuple[int, int]) -> NDArray[np.int64]:
    return np.tile(BAYER, (shape[0] // 2, shape[1] // 2))


def test_waves_within_the_band_come_out_at_the_samples_of_a_slice() -> None:
    """Each colour its own wave, below half a sample a cycle: 1/20 cycles/pixel at 6 px a sample."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    waves = [
        0.4 + 0.1 * np.cos(2 * np.pi * (fy * y + fx * x) + k)
        for k, (fy, fx) in enumerate([(0.01, 0.05), (0.05, 0.0), (0.03, -0.03)])
    ]
    index = index_of(SHAPE)
    plane = np.choose(index, waves).astype(np.float32)
    made = dc_views(plane, index, (0, 1, 2), SIZE, GRID)
    for colour, wave in enumerate(waves):
        np.testing.assert_allclose(made[colour][INNER], wave[::6, ::6][INNER], atol=2e-3)


def test_detail_beyond_the_band_and_an_origin_between_pixels() -> None:
    y, _ = np.mgrid[: SHAPE[0], : SHAPE[1]]
    plane = (0.3 + 0.001 * y + 0.1 * np.cos(2 * np.pi * 0.15 * y)).astype(np.float32)
    grid = GRID.copy()
    grid[0, 2] = 2.5
    made = dc_views(plane, np.zeros(SHAPE, dtype=np.int64), (0,), SIZE, grid)[0]
    np.testing.assert_allclose(
        made[INNER], (0.3 + 0.001 * (6 * np.arange(48) + 2.5))[:, None].repeat(56, 1)[INNER], atol=5e-4
    )


def test_a_colour_without_pixels_is_refused() -> None:
    with pytest.raises(DecodeError, match="no pixel of colour 3"):
        dc_views(np.ones(SHAPE, dtype=np.float32), index_of(SHAPE), (3,), SIZE, GRID)


def test_places_without_a_sample_count_for_no_colour() -> None:
    """As on a Super CCD's lattice: half of the places are empty."""
    index = index_of(SHAPE)
    index[(np.add(*np.mgrid[: SHAPE[0], : SHAPE[1]]) // 2) % 2 == 1] = -1
    plane = np.where(index >= 0, np.float32(0.3), np.float32(0))
    np.testing.assert_allclose(dc_views(plane, index, (0, 1, 2), SIZE, GRID), 0.3, atol=1e-6)


def test_an_edge_between_two_colours_moves_with_the_parallax() -> None:
    """Two colours blend as their greys do: with exact grey views each view's colour is exact, too."""
    x = np.arange(60)
    edges = np.stack([1 / (1 + np.exp(-(x - 30 - d))) for d in (-2, -1, 0, 1, 2)])
    blend = np.broadcast_to(edges[None, :, None, :], (1, 5, 20, 60)).astype(np.float32)
    left, right = np.array([0.6, 0.1, 0.1]), np.array([0.05, 0.2, 0.5])
    truth = left + (right - left) * blend[..., None]
    views = (blend * 0.3 + 0.1).astype(np.float32)
    colours = np.moveaxis(truth.mean(axis=(0, 1)), -1, 0).astype(np.float32)
    made = in_colour(views, views.mean(axis=(0, 1)), colours)
    off, one_for_all = made - truth, colours.transpose(1, 2, 0) - truth
    assert float(np.mean(off**2)) < 0.05 * float(np.mean(one_for_all**2))


def test_grey_without_texture_gives_a_colour_its_share() -> None:
    views = np.full((3, 3, 12, 12), 0.2, dtype=np.float32)
    views[0] += np.float32(0.01)
    colours = np.stack([np.full((12, 12), value, dtype=np.float32) for value in (0.4, 0.2, 0.1)])
    made = in_colour(views, views[1, 1], colours)
    np.testing.assert_allclose(made[1], np.broadcast_to([0.4, 0.2, 0.1], made[1].shape), rtol=1e-5)
    np.testing.assert_allclose(made[0] - made[1], np.broadcast_to([0.02, 0.01, 0.005], made[0].shape), rtol=1e-3)


def seen(by: Callable[[float, float], Floats], views: int = 5) -> tuple[Singles, Singles]:
    """True views (V, U, h, w, 3) of what is seen `by` a view at (v, u), and their greys, the mean of the colours."""
    steps = np.arange(views) - (views - 1) / 2
    truth = np.asarray([[by(v, u) for u in steps] for v in steps], dtype=np.float32)
    return truth, np.asarray(truth.mean(axis=-1), dtype=np.float32)


def moving(y: Singles, x: Singles, *, down: float, across: float, flat: float = 0.0) -> tuple[Singles, Singles]:
    """Views as `seen` that move by so many samples, of stripes of two colours with the same grey on a texture. Within
    `flat` samples of the middle there is no texture."""

    def by(v: float, u: float) -> Floats:
        at, to = y - down * v, x - across * u
        away = np.hypot(at - y.shape[0] / 2, to - x.shape[1] / 2)
        texture = np.sin(0.9 * at + 0.4 * to) + np.sin(0.3 * at - 0.8 * to) + np.sin(0.5 * to)
        grey = 0.3 + 0.03 * texture / (1 + np.exp(flat - away) * (flat > 0))
        tint = 0.5 * np.tanh(2 * np.sin(0.35 * to + 0.2 * at))
        return np.stack([grey * (1 + tint), grey, grey * (1 - tint)], axis=-1).astype(np.float64)

    return seen(by)


def error(views: Singles, row_over_column: float, truth: Singles, grey: Singles) -> float:
    """The rms of colour views, in shares of that of the DC views taken for every view."""
    dc = truth.mean(axis=(0, 1))
    made = in_colour(
        views, grey.mean(axis=(0, 1)), np.ascontiguousarray(np.moveaxis(dc, -1, 0)), row_over_column=row_over_column
    )
    cut = (..., slice(8, -8), slice(8, -8), slice(None))
    return float(np.sqrt(np.mean((made - truth)[cut] ** 2) / np.mean((dc - truth)[cut] ** 2)))


def test_an_edge_between_colours_of_the_same_grey_moves_as_the_texture_around_does() -> None:
    y, x = np.mgrid[:60, :80].astype(np.float32)
    truth, grey = moving(y, x, down=0.3, across=0.3)
    assert error(grey, 1.0, truth, grey) < 0.3


def test_an_edge_moves_as_the_nearer_thing_and_texture_as_what_it_is_on() -> None:
    """A board and what is behind it, of the same mean grey and of other colours, move in opposite directions."""
    y, x = np.mgrid[:60, :80].astype(np.float32)

    def by(v: float, u: float) -> Floats:
        layers = []
        for tint, move, turn in ((0.5, 0.35, 0.0), (-0.5, -0.35, 2.0)):
            at, to = y - move * v, x - move * u
            grey = 0.3 + 0.03 * (np.sin(0.9 * at + 0.4 * to + turn) + np.sin(0.3 * at - 0.8 * to + turn))
            layers.append(np.stack([grey * (1 + tint), grey, grey * (1 - tint)], axis=-1).astype(np.float64))
        away = np.maximum(np.abs(y - 0.35 * v - 30) - 16, np.abs(x - 0.35 * u - 40) - 20)
        cover = 1 / (1 + np.exp(2 * away))[..., None]
        return np.asarray(cover * layers[0] + (1 - cover) * layers[1])

    truth, grey = seen(by)
    assert error(grey, 1.0, truth, grey) < 0.6


def test_a_sample_that_is_higher_than_wide_moves_by_fewer_rows() -> None:
    y, x = np.mgrid[:60, :80].astype(np.float32)
    truth, grey = moving(y, x, down=0.1, across=0.4)
    assert error(grey, 4.0, truth, grey) < 0.5 * error(grey, 1.0, truth, grey)


def test_what_no_move_explains_counts_less() -> None:
    """Each view has errors of its own, and nothing moves."""
    y, x = np.mgrid[:60, :80].astype(np.float32)
    truth, grey = moving(y, x, down=0.0, across=0.0)
    off = np.random.default_rng(1).normal(0, 0.01, grey.shape).astype(np.float32)
    dc = np.ascontiguousarray(np.moveaxis(truth[0, 0], -1, 0))
    made = in_colour(grey + off, grey[0, 0], dc)
    assert np.std((made - truth)[..., 1]) < 0.5 * np.std(off)


def test_a_move_of_more_than_a_sample_is_followed() -> None:
    """The outer views move by 1.2 samples along each axis: a slope alone leaves twice as much."""
    y, x = np.mgrid[:60, :80].astype(np.float32)
    truth, grey = moving(y, x, down=0.6, across=0.6)
    assert error(grey, 1.0, truth, grey) < 0.18


def test_colours_beside_a_place_of_unknown_depth_move_as_what_is_known_there() -> None:
    """A flat patch has no depth: behind the focus no depth would be the nearest one, and stand still."""
    y, x = np.mgrid[:60, :80].astype(np.float32)
    truth, grey = moving(y, x, down=-0.6, across=-0.6, flat=12)
    noise = np.random.default_rng(3).normal(0, 0.003, grey.shape).astype(np.float32)
    assert error(grey + noise, 1.0, truth, grey) < 0.25


@pytest.mark.parametrize("views", [(5, 5), (2, 2), (1, 1)])
def test_black_is_no_error(views: tuple[int, int]) -> None:
    black = np.zeros((12, 12), dtype=np.float32)
    assert np.isfinite(in_colour(np.zeros((*views, 12, 12), dtype=np.float32), black, np.stack([black] * 3))).all()


def test_without_views_there_are_none_in_colour() -> None:
    black = np.zeros((12, 12), dtype=np.float32)
    made = in_colour(np.zeros((0, 0, 12, 12), dtype=np.float32), black, np.stack([black] * 3))
    assert made.shape == (0, 0, 12, 12, 3)
