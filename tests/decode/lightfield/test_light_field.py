from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.lightfield.light_field import LightField, ViewStack, needs_parallax, slice_mosaic
from dappled.decode.optics.carriers import Mask
from tests.decode.scenes import cameras


def light_field(views: np.ndarray, *, lenslet: bool = False, offsets: np.ndarray | None = None) -> LightField:
    return LightField(
        slices=np.zeros((1, *views.shape[2:4]), np.complex64),
        carriers=np.zeros((1, 4)),
        views=views.astype(np.float32),
        view_offsets=Aperture(views.shape[0]).offsets() if offsets is None else offsets,
        grid=np.array([[6.0, 0, 0], [0, 3.0, 0]]),
        attributes={"lenslet_pitch_px": [10, 10]} if lenslet else {},
    )


def test_steps_count_views_in_columns() -> None:
    stack = ViewStack.of(light_field(np.zeros((5, 5, 4, 6))))
    np.testing.assert_allclose(stack.column_steps, [-2, -1, 0, 1, 2])
    np.testing.assert_allclose(stack.row_steps, [-1, -0.5, 0, 0.5, 1])  # a row is as tall as two columns are wide
    assert stack.sensor_px_per_disparity == pytest.approx(15)
    assert stack.reach == 2


def test_lenslets_turn_the_aperture_round() -> None:
    field = light_field(np.zeros((3, 3, 4, 6)), lenslet=True)
    np.testing.assert_allclose(ViewStack.of(field).column_steps, [1, 0, -1])
    np.testing.assert_allclose(cameras(field.views).column_steps, [1, 0, -1])


def test_colours_become_grey() -> None:
    stack = cameras(np.random.default_rng(0).random((3, 3, 4, 6, 3)))
    assert stack.colour
    np.testing.assert_allclose(stack.grey().views, stack.views.mean(axis=4), rtol=1e-6)
    assert stack.middle().shape == (4, 6, 3)


def test_what_is_no_stack_is_told() -> None:
    turned = Aperture(3).offsets() @ np.array([[0.9, 0.1], [-0.1, 0.9]])
    for make, words in (
        (lambda: ViewStack.of(light_field(np.zeros((0, 0, 4, 6)))), "no views"),
        (lambda: ViewStack.of(light_field(np.zeros((3, 3, 4, 6)), offsets=turned)), "rows and columns"),
        (lambda: ViewStack(np.zeros((3, 3, 4), np.float32), np.zeros(3), np.zeros(3)), "must be"),
        (lambda: ViewStack(np.zeros((3, 3, 4, 5), np.float32), np.zeros(2), np.zeros(3)), "places"),
        (lambda: needs_parallax(cameras(np.zeros((1, 1, 4, 4))), "depth"), "several places"),
    ):
        with pytest.raises(DecodeError, match=words):
            make()


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
