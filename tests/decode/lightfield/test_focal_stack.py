from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.focal_stack import all_in_focus, focal_stack
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.decode.lightfield.view_stack import ViewStack
from tests.decode.scenes import Board, paint

SCENE = [Board(-0.6), Board(0.8, half=(30, 30), texture=1)]


def test_the_sharpest_picture_is_chosen_everywhere() -> None:
    stack, truth = paint(SCENE, (120, 120), 7)
    planes = np.linspace(-0.6, 0.8, 8)
    made = all_in_focus(focal_stack(stack, planes))
    inner = (slice(12, -12), slice(12, -12))
    near_edge = ndimage.maximum_filter(truth, 17) != ndimage.minimum_filter(truth, 17)
    judged = ~near_edge[inner]
    chosen = planes[made.index]
    assert np.mean(np.abs(chosen - truth)[inner][judged] < 0.11) > 0.97
    middle = stack.middle()
    error = np.sqrt(np.mean((made.picture - middle)[inner][judged] ** 2))
    alone = min(np.sqrt(np.mean((shift_and_add(stack, d) - middle)[inner][judged] ** 2)) for d in planes)
    assert error < alone / 3


def test_colour_and_flat_parts() -> None:
    stack, _ = paint(SCENE, (60, 60), 3)
    stack.views[..., :20] = 0.5
    colour = ViewStack(np.repeat(stack.views[..., None], 3, axis=4), stack.row_steps, stack.column_steps)
    made = all_in_focus(focal_stack(colour, [-0.6, 0.0, 0.8]))
    assert made.picture.shape == (60, 60, 3)
    assert (made.index[:, :8] == -1).all()
    assert (made.index[:, 40:] >= 0).all()
    with pytest.raises(DecodeError, match="at least one plane"):
        focal_stack(stack, [])
