"""How much of a planned area frames have seen: by hand, on squares and an area with a gap."""

from __future__ import annotations

import io

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.daemon.console.seen_ground import SeenGround
from dappled.decode.geometry.area import PlannedArea

SIDE = 0.001  # degrees


def square(south: float, west: float, side: float = SIDE) -> tuple[tuple[float, float], ...]:
    return ((south, west), (south, west + side), (south + side, west + side), (south + side, west))


def holes(ground: SeenGround) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(ground.holes_png())))


@pytest.mark.parametrize("south", [0.0, 47.0, -33.0])
@pytest.mark.parametrize("west", [8.0, -179.9999, 179.9995])
def test_a_frame_over_a_quarter_of_the_area_sees_a_quarter_however_often(south: float, west: float) -> None:
    ground = SeenGround(PlannedArea("field", ((square(south, west),),)))
    assert ground.facts() == {"share": 0.0, "frames": 0, "version": 0}
    for frame in range(3):
        ground.put(frame, square(south + SIDE / 2, west, SIDE / 2))
        assert ground.share == pytest.approx(0.25, abs=0.005)
    ground.put(3, square(south, west))
    assert ground.facts() == {"share": 1.0, "frames": 4, "version": 4}


def test_a_frame_that_turns_out_bad_counts_no_more_and_one_that_is_placed_again_counts_once() -> None:
    ground = SeenGround(PlannedArea("field", ((square(47.0, 8.0),),)))
    ground.put(0, square(47.0, 8.0, SIDE / 2))
    ground.put(0, square(47.0, 8.0, SIDE / 2))
    assert ground.version == 1
    ground.put(0, square(47.0 + SIDE / 2, 8.0, SIDE / 2))
    assert ground.share == pytest.approx(0.25, abs=0.005)
    ground.put(1, square(47.0 + SIDE / 2, 8.0, SIDE / 2))
    ground.put(0, None)
    assert ground.share == pytest.approx(0.25, abs=0.005)
    ground.put(1, None)
    assert ground.facts()["share"] == 0.0
    assert ground.facts()["frames"] == 0


def test_a_gap_in_the_area_and_ground_beyond_it_are_no_holes() -> None:
    outer, inner = square(47.0, 8.0), square(47.0 + SIDE / 4, 8.0 + SIDE / 4, SIDE / 2)
    ground = SeenGround(PlannedArea("ring", ((outer, inner),)))
    ground.put(0, square(47.0 + SIDE / 4, 8.0 + SIDE / 4, SIDE / 2))
    ground.put(1, square(48.0, 9.0))
    assert ground.share == 0.0
    hatched = holes(ground)[..., 3] > 0
    rows, columns = hatched.shape
    assert not hatched[rows // 3 : rows // 2, columns // 3 : columns // 2].any()
    assert hatched[: rows // 5].mean() == pytest.approx(0.5, abs=0.02)


def test_an_area_across_the_180th_meridian_is_no_belt_around_the_earth() -> None:
    ground = SeenGround(PlannedArea("Fiji", ((((-17.0, 179.9995), (-17.0, -179.9995), (-16.999, 180.0)),),)))
    assert ground.bounds["east"] - ground.bounds["west"] == pytest.approx(0.001)
    ground.put(0, square(-17.0, 179.9995))
    assert ground.share == 1.0


def test_north_is_up() -> None:
    ground = SeenGround(PlannedArea("field", ((square(47.0, 8.0),),)))
    ground.put(0, ((47.0, 8.0), (47.0, 8.001), (47.0005, 8.001), (47.0005, 8.0)))
    hatched = holes(ground)[..., 3] > 0
    middle = hatched.shape[0] // 2
    assert hatched[: middle - 1].any()
    assert not hatched[middle + 1 :].any()


def test_an_area_without_extent_has_no_share() -> None:
    line = ((47.0, 8.0), (47.0, 8.001), (47.0, 8.0005))
    assert SeenGround(PlannedArea("line", ((line,),))).share is None
