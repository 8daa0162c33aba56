"""Fixtures that every room may use."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does; before NumPy is loaded

import pytest
from hypothesis import HealthCheck, settings

# No test fails for the speed of the machine it runs on.
settings.register_profile("dappled", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("dappled")


SLOW_S = 600.0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A slow test that names no limit of its own has a long one: a busy machine takes twice as long."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_S))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real frames and flights beside the project (or DAPPLED_DATA); skips where there is none."""
    folder = Path(os.environ.get("DAPPLED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder} (set DAPPLED_DATA)")
    return folder
