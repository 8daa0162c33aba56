"""Light fields for tests of what is made from them."""

from __future__ import annotations

from typing import Any

import numpy as np

from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.lightfield.light_field import LightField
from tests.decode.scenes import Board, paint

ATTRIBUTES: dict[str, Any] = {
    "shape": [1388, 1844],
    "camera": "reference-36mm",
    "focal_length_mm": 50.0,
    "f_number": 7.4,
}
DISPARITY = 0.4


def light_field(
    *, n: int = 5, shape: tuple[int, int] = (60, 80), colour: bool = False, lenslet: bool = False, **attributes: Any
) -> LightField:
    """n × n views of one board at disparity 0.4, behind a mask (or lenslets)."""
    stack, _ = paint([Board(DISPARITY, contrast=0.25)], shape, n)
    views = stack.views[::-1, ::-1] if lenslet else stack.views
    if colour:
        views = np.stack([views, 0.8 * views, 0.6 * views], axis=-1)
    said = {**ATTRIBUTES, **attributes}
    if lenslet:
        said["lenslet_pitch_px"] = [10.0, 10.0]
    return LightField(
        slices=np.ones((3, *shape), dtype=np.complex64),
        carriers=np.array([[0, 0, 0, 0], [0, 1, 0, 0.1], [1, 0, 0.1, 0]], dtype=np.float64),
        views=np.ascontiguousarray(views, dtype=np.float32),
        view_offsets=Aperture(n).offsets(),
        grid=np.array([[10.0, 0, 693.5 - 5 * (shape[0] - 1)], [0, 10.0, 921.5 - 5 * (shape[1] - 1)]]),
        attributes=said,
    )
