from __future__ import annotations

import numpy as np

from dappled.decode.lightfield.pictures import slice_mosaic, view_mosaic
from dappled.decode.optics.carriers import Mask


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
