"""Runs: results by another recipe stand beside those of the flight."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.replay import runs
from dappled.daemon.replay.runs import Run, RunWriter
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.flight import FlightsLock, LedgerReader, Recording, Result, offload, recording
from dappled.flight.checks.flight_check import check
from tests.flight.makers import deliver, request, tag

RESULT = Result(0, "a" * 64, 12, 13, "geometric", "calibrated")
NAMES = Names("reference-36mm", "reference-5x5", "geometric")


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Recording]:
    """One decoded frame."""
    begun = recording.begin(tmp_path / "flights", RecordedClock(10**18))
    request(begun, 0)
    begun.ledger.add_tag(tag(deliver(begun, 0, b"raw")))
    begun.ledger.add_result(RESULT)
    yield begun
    if not begun.closed:
        begun.close()


@pytest.fixture
def recipe(tmp_path: Path) -> Recipe:
    white = tmp_path / "white.npy"
    white.write_bytes(b"white")
    return Recipe(camera="reference-36mm", mask="reference-5x5", white=str(white))


def test_a_run_stands_beside_the_flight_and_can_be_had_again(flight: Recording, recipe: Recipe, tmp_path: Path) -> None:
    flight.close()
    folder = flight.folder.path
    with RunWriter(folder, Run("second", recipe, NAMES), RecordedClock(5)) as writer:
        writer.decoded(replace(RESULT, slices_sha256="b" * 64))
        assert writer.run.recipe.white == str(folder / "inputs" / "second" / "white.npy")
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert ledger.runs() == {"live": 1, "second": 1}
        assert ledger.results()[0] == RESULT
        assert ledger.results("second")[0].slices_sha256 == "b" * 64
        assert ledger.results("second")[0].run == "second"
    assert check(folder).problems == ()
    moved = tmp_path / "elsewhere" / folder.name
    shutil.copytree(folder, moved)
    again = runs.of_flight(moved, "second")
    assert again.names == NAMES
    assert again.recipe.mask == str(moved / "inputs" / "second" / "masks" / "reference-5x5.toml")
    assert Path(again.recipe.white).read_bytes() == b"white"
    with pytest.raises(DappledError, match=r"no run 'third'; it has second"):
        runs.of_flight(moved, "third")


def test_one_process_at_a_time_works_in_a_flight(flight: Recording, recipe: Recipe, tmp_path: Path) -> None:
    flight.close()
    folder, run = flight.folder.path, Run("second", recipe, NAMES)
    with (
        FlightsLock(folder.parent, "offloads from"),
        pytest.raises(DappledError, match=r"offloads from .*; wait until"),
    ):
        RunWriter(folder, run, RecordedClock(5))
    with RunWriter(folder, run, RecordedClock(5)), pytest.raises(DappledError, match=r"stores a run in .*; wait until"):
        offload.offload(folder, tmp_path / "disk", prune=False, same_device=True, clock=RecordedClock(5))
    assert not (tmp_path / "disk").exists()


def test_a_run_replaces_nothing(flight: Recording, recipe: Recipe) -> None:
    flight.close()
    with RunWriter(flight.folder.path, Run("second", recipe, NAMES), RecordedClock(5)):
        pass
    with pytest.raises(DappledError, match="has a run 'second' already"):
        RunWriter(flight.folder.path, Run("second", recipe, NAMES), RecordedClock(5))


@pytest.mark.parametrize("name", ["live", "", "../x", "a b", "-x"])
def test_a_name_that_is_none(flight: Recording, recipe: Recipe, name: str) -> None:
    flight.close()
    with pytest.raises(DappledError, match="can't name a run"):
        RunWriter(flight.folder.path, Run(name, recipe, NAMES), RecordedClock(5))


def test_a_flight_that_is_still_recorded_gets_no_run(flight: Recording, recipe: Recipe) -> None:
    with pytest.raises(DappledError, match="still being recorded"):
        RunWriter(flight.folder.path, Run("second", recipe, NAMES), RecordedClock(5))


@pytest.mark.parametrize("fact", [5, {"names": {}}, {"recipe": 1, "names": 1}, {"recipe": {"camera": 5}, "names": {}}])
def test_a_run_that_can_not_be_read_is_told(flight: Recording, fact: object) -> None:
    flight.ledger.set_fact("run:second", fact)
    flight.close()
    with pytest.raises(DappledError, match=r"the run 'second' of .* can't be read"):
        runs.of_flight(flight.folder.path, "second")
