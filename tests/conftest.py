"""Fixtures that every room may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test fails for the speed of the machine it runs on.
settings.register_profile("dappled", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("dappled")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real frames and flights beside the project (or DAPPLED_DATA); skips where there is none."""
    folder = Path(os.environ.get("DAPPLED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder} (set DAPPLED_DATA)")
    return folder
