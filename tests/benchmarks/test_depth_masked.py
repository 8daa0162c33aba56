"""Masked frames of the depth benchmark's scenes: decoded, they give the disparities of the scene."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth import estimate, evidence
from tests.benchmarks import program

scenes, masked = program("depth_scenes"), program("depth_masked")
SIDE = 96


@pytest.mark.long
def test_depth_of_a_masked_frame_of_boards() -> None:
    field, truth = masked.expose(scenes.boards(1, SIDE), SIDE, 1).decoded(0.0)
    found = estimate.estimate(evidence.of_light_field(field))
    bad = float(np.mean(~(np.abs(found.disparity - truth) <= 0.07)))
    print(f"BadPix 0.07 {bad:.1%}")  # noqa: T201  a figure for people who run with -s
    assert bad < 0.16
