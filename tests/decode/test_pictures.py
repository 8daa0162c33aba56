from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.carriers import Lattice
from dappled.decode.masks import Mask
from dappled.decode.peaks import measure
from dappled.decode.pictures import slice_mosaic, spectrum_boxes, view_mosaic
from dappled.decode.spectrum import Spectrum


def test_slices_stand_at_their_orders_with_their_conjugates() -> None:
    orders = Mask(1.0, 1).half_orders()
    slices = np.zeros((len(orders), 6, 8), np.complex64)
    carriers = np.array([(*order, 0.0, 0.0) for order in orders])
    slices[orders.index((1, -1)), :, :4] = 2j
    picture = slice_mosaic(slices, carriers)
    assert picture.shape == (3 * 8, 3 * 10)
    for top, left in ((16, 0), (0, 20)):  # (1, −1) below left, its conjugate (−1, 1) above right
        tile = picture[top + 1 : top + 7, left + 1 : left + 9]
        assert (tile[:, :4] == 255).all()
        assert (tile[:, 4:] == 0).all()
    assert (picture[9:15, 11:19] == 0).all()


def test_views_share_one_scale() -> None:
    views = np.zeros((2, 3, 4, 5), np.float32)
    views[1, 2] = 0.5
    picture = view_mosaic(views)
    assert picture.shape == (8, 15)
    assert (picture[4:, 10:] == 255).all()
    assert picture[:4].max() == 0
    assert view_mosaic(np.zeros((2, 2, 4, 5, 3), np.float32)).shape == (8, 10, 3)


@pytest.mark.parametrize("shape", [(200, 260), (151, 171)])
def test_boxes_and_markers_stand_on_the_carriers(shape: tuple[int, int]) -> None:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    plane = (0.5 + 0.3 * np.cos(2 * np.pi * (0.2 * y + 0.1 * x))).astype(np.float32)
    carriers = Lattice((0.2, 0.1), (0.0, 0.2)).carriers([(1, 0)])
    measured = measure(Spectrum.of(plane), carriers, 2.0)
    bare = spectrum_boxes(plane, [], (0.1, 0.1))
    row, column = round(0.7 * shape[0]), round(0.6 * shape[1])
    brightest = np.unravel_index(np.argmax(bare[shape[0] // 2 + 2 :, :, 0]), bare[shape[0] // 2 + 2 :, :, 0].shape)
    assert abs(brightest[0] + shape[0] // 2 + 2 - row) <= 1
    assert abs(brightest[1] - column) <= 1
    picture = spectrum_boxes(plane, carriers, (0.1, 0.1), measured=measured)
    assert tuple(picture[row, column]) == (250, 220, 40)
    assert tuple(picture[round(0.65 * shape[0]), column]) == (230, 30, 30)
    assert tuple(picture[row - 5, column]) == (60, 220, 60)
    small = spectrum_boxes(plane, carriers, (0.1, 0.1), longest_side=90)
    assert max(small.shape) <= 90
