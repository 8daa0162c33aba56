"""The matrix of wirings, faults and rates: counts are exact, and each σ is as large as the errors are."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.benchmarks import program


@pytest.fixture(autouse=True)
def _a_path_for_all() -> Iterator[None]:
    """The flown path is kept for all cells of a run, and not longer."""
    yield
    program("autopilot_cell").sampled.cache_clear()


@pytest.mark.long
@pytest.mark.timeout(900)  # 40 s alone; it only computes, and may share the machine
def test_every_trigger_is_one_shot_and_every_sigma_is_true() -> None:
    matrix, world = program("autopilots"), program("autopilot_cell")
    cells = list(matrix.cells())
    assert len(cells) >= 60
    assert {cell.wiring for cell in cells} == set(world.WIRINGS)
    assert {cell.fault for cell in cells} == set(world.FAULTS)
    missed = {}
    for cell in cells:
        found = world.fly(cell, matrix.bursts(cell))
        if said := matrix.misses(cell, found):
            missed[cell] = said
    assert not missed


def test_a_cell_can_miss() -> None:
    """Few shots of one cell: its counts are judged, and so are errors that are larger than their σ."""
    matrix, world = program("autopilots"), program("autopilot_cell")
    cell = world.Cell("ArduPilot, servo, pin", "contacts doubled", 5.0)
    found = world.fly(cell, 9)
    assert matrix.misses(cell, found) == []
    found.tags = [world.Tagged(3.0, 3.0, 1.0, 1.0, None, False, "hot shoe")] * 40
    found.named += 1
    said = matrix.misses(cell, found)
    assert said == ["tags: 40, not 27", "triggers named as lost: 1, not 0", "time: 3.00 of σ"]
