"""Flights that several tests of this room share."""

from __future__ import annotations

import pytest

from tests.products import flown
from tests.products.flown import Flown


@pytest.fixture(scope="session")
def short_flight(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Two overlapping frames with true poses. Not to be written to."""
    return flown.fly(tmp_path_factory.mktemp("short"), times_s=(1.0, 1.7))
