from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.padded import Spectrum
from dappled.decode.spectrum.plan import Plan, Plans
from dappled.decode.spectrum.slices import extract

SHAPE = (150, 210)
LATTICE = Lattice((0.15, 0.001), (-0.001, 0.15))
CARRIERS = LATTICE.carriers([(0, 0), (0, 1), (1, -1), (1, 0), (1, 1)])


def _frame(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE).astype(np.float32)


def test_a_plan_gives_each_frame_what_a_fresh_one_gives() -> None:
    plan = Plan(SHAPE)
    for seed in (1, 2, 1):
        for size in ((20, 28), (24, 30)):
            found = plan.cut(plan.spectrum(_frame(seed)), CARRIERS, size, workers=2)
            fresh = extract(Spectrum.of(_frame(seed)), CARRIERS, size)
            assert found.values.tobytes() == fresh.values.tobytes()
            assert np.array_equal(found.grid, fresh.grid)
            assert found.carriers == fresh.carriers


def test_slices_outlive_the_next_frame() -> None:
    plan = Plan(SHAPE)
    first = plan.cut(plan.spectrum(_frame(1)), CARRIERS, (20, 28))
    before = first.values.copy()
    plan.cut(plan.spectrum(_frame(2)), CARRIERS, (20, 28))
    assert np.array_equal(first.values, before)


def test_a_zoom_over_many_lengths_keeps_few_layouts() -> None:
    plan = Plan(SHAPE)
    spectrum = plan.spectrum(_frame(1))
    for step in range(12):
        plan.cut(spectrum, [Carrier(0, 0, 0.0, 0.0), Carrier(1, 0, 0.1 + step / 100, 0.0)], (20, 20))
    assert len(plan._layouts) <= 4


def test_one_plan_is_lent_to_one_frame_at_a_time() -> None:
    plans = Plans()
    with plans.lend(SHAPE) as one, plans.lend(SHAPE) as other:
        assert one is not other
    with plans.lend(SHAPE) as again:
        assert again in (one, other)


def test_a_plan_that_failed_half_way_is_not_lent_again() -> None:
    plans = Plans()
    lent: list[Plan] = []

    def fail() -> None:
        with plans.lend(SHAPE) as plan:
            lent.append(plan)
            raise ValueError("half way")

    with pytest.raises(ValueError, match="half way"):
        fail()
    with plans.lend(SHAPE) as fresh:
        assert fresh is not lent[0]
