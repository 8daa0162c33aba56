from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.stereo_pair import anaglyph, eyes, side_by_side
from dappled.decode.lightfield.view_stack import ViewStack, from_cameras
from tests.decode.scenes import Board, paint


def column_of_spot(picture: np.ndarray) -> float:
    weight = picture - picture.min()
    return float((weight * np.arange(picture.shape[1])).sum() / weight.sum())


@pytest.mark.parametrize("turned", [False, True])
def test_near_things_are_further_right_for_the_left_eye(turned: bool) -> None:
    stack, _ = paint([Board(0.0, contrast=0.0, mean=0.2), Board(1.0, half=(8, 8), contrast=0.0, mean=0.9)], (48, 64), 5)
    if turned:
        stack = from_cameras(stack.views[::-1, ::-1])
    pair = eyes(stack, separation=0.8)
    assert column_of_spot(pair.left) > column_of_spot(pair.right) + 0.3
    both = anaglyph(pair)
    np.testing.assert_array_equal(both[..., 0], pair.left)
    np.testing.assert_array_equal(both[..., 2], pair.right)
    np.testing.assert_array_equal(side_by_side(pair)[:, :64], pair.left)
    np.testing.assert_array_equal(side_by_side(pair, crossed=True)[:, :64], pair.right)


def test_eyes_that_do_not_fit_are_told() -> None:
    stack, _ = paint([Board(0.0)], (16, 16), 3)
    with pytest.raises(DecodeError, match="don't fit"):
        eyes(stack, separation=1.2)
    with pytest.raises(DecodeError, match="several columns"):
        eyes(ViewStack(stack.views[:, :1], stack.row_steps, np.zeros(1)))
