from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.daemon.pipeline.decode_worker import nearest
from dappled.decode.depth.depth_map import DepthMap
from dappled.decode.depth.ranging import Ranging
from dappled.products.opened import with_ranging
from tests.products.fields import DISPARITY, light_field


@pytest.mark.parametrize(("length_mm", "known"), [(50.0, True), (12.8, False), (None, False)])
def test_no_distance_is_told_of_another_zoom(length_mm: float | None, known: bool) -> None:
    ranging = replace(Ranging.of_lens(50.0, 7.4, 0.01), focal_length_mm=length_mm)
    one = np.ones((60, 80), np.float32)
    found = DepthMap(np.float32(DISPARITY) * one, np.float32(0.01) * one, one, "")
    assert (nearest(with_ranging(light_field(), ranging), found) is not None) is known
    assert nearest(light_field(), found) is None
