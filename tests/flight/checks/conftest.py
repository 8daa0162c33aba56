"""A flight that a module makes once, and each of its tests has a copy of."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.flight import FlightFolder, Recording, recording
from tests.flight.conftest import START_UTC_NS


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """What a module's fixture `made` records and closes."""
    folder = tmp_path_factory.mktemp("made") / "flights"
    return recording.begin(folder, RecordedClock(START_UTC_NS), {"camera": {"driver": "none"}})


@pytest.fixture
def recorded(made: FlightFolder, flights: Path) -> FlightFolder:
    shutil.copytree(made.path, flights / made.name)
    return FlightFolder(flights / made.name)
