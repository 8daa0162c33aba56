"""What the page shows, against what it is made from."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from PIL import Image

from dappled.daemon.console import pictures
from dappled.daemon.console.pictures import Mosaic
from dappled.decode.lightfield.light_field import ViewStack, centred
from dappled.decode.optics.carriers import Lattice
from dappled.decode.spectrum.slices import BandShape, extract
from dappled.decode.spectrum.transform import transform


def test_srgb_bytes_come_back() -> None:
    every = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(pictures.encoded(pictures.decoded(every)), every)


def test_the_bands_go_back_to_their_places() -> None:
    """A plane with one carrier: the brightest points of the picture are the mean's neighbourhood and that carrier."""
    side = 240
    y, x = np.mgrid[:side, :side].astype(np.float32)
    fy, fx = 0.0, 0.25
    plane = (0.5 + 0.3 * np.cos(2 * np.pi * (fy * y + fx * x))).astype(np.float32)
    lattice = Lattice((0.25, 0.0), (0.0, 0.25))
    cut = extract(transform(plane), lattice.carriers([(0, 0), (0, 1), (1, 0)]), BandShape(lattice=lattice))
    rows = [[c.ky, c.kx, c.fy, c.fx] for c in cut.carriers]
    picture = pictures.spectrum(cut.values, rows, cut.grid.tolist(), (side, side))
    at = np.unravel_index(np.argmax(picture), picture.shape)
    assert at[0] == pytest.approx(side / 2, abs=2)
    assert abs(at[1] - side / 2) == pytest.approx(side / 4, abs=2)
    mirrored = picture[::-1, ::-1]
    assert np.mean(picture[1:, 1:] > 0) == pytest.approx(np.mean(mirrored[1:, 1:] > 0), abs=0.02)
    assert picture[2, 2] == 0  # no slice reaches there


def test_a_mosaic_s_tiles_are_whole_blocks_of_a_jpeg() -> None:
    views = np.random.default_rng(1).random((3, 3, 45, 61), dtype=np.float32)
    made = pictures.views_mosaic(ViewStack(views, centred(3), centred(3)))
    assert made.tile == (40, 56)
    assert made.picture.shape == (120, 168)
    assert made.scale == 1


def test_many_views_are_made_smaller() -> None:
    views = np.ones((9, 9, 320, 320), dtype=np.float32)
    made = pictures.views_mosaic(ViewStack(views, centred(9), centred(9)))
    assert max(made.picture.shape) <= pictures.MOSAIC_PX
    assert made.scale == 2


def test_refocusing_brings_a_shifted_point_together() -> None:
    views = np.zeros((3, 3, 48, 48), dtype=np.float32)
    for v in range(3):
        for u in range(3):
            views[v, u, 24 + 2 * (v - 1), 24 + 2 * (u - 1)] = 1.0
    picture = pictures.encoded(views.swapaxes(1, 2).reshape(144, 144))
    made = Mosaic(picture, (48, 48), 1, centred(3), centred(3))
    sharp, flat = pictures.refocused(made, 2.0), pictures.refocused(made, 0.0)
    assert sharp[24, 24] > 250
    assert flat[24, 24] < 130


@given(arrays.arrays(np.float32, (6, 7), elements=st.floats(-10, 10, width=32) | st.just(np.nan)))
def test_any_depth_is_a_picture_and_what_is_unknown_is_grey(disparity: NDArray[np.float32]) -> None:
    picture = pictures.depth_colours(disparity, np.full((6, 7), 1e-6, dtype=np.float32))
    assert picture.shape == (6, 7, 3)
    unknown = picture[~np.isfinite(disparity)]
    assert (unknown == unknown[..., :1]).all()


def test_files_are_what_they_say() -> None:
    grey = np.zeros((8, 9), dtype=np.uint8)
    for data, kind in ((pictures.jpeg(grey), "JPEG"), (pictures.png(grey), "PNG")):
        with Image.open(io.BytesIO(data)) as picture:
            assert (picture.format, picture.size) == (kind, (9, 8))
