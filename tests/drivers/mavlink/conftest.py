"""For tests of what logs say: these are read in the test's own process. Those of the reader's process keep it."""

from __future__ import annotations

import pytest

from tests.drivers.mavlink import logs_here


@pytest.fixture
def logs_read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read logs without a process for each, which costs a start of Python."""
    monkeypatch.setattr("dappled.drivers.reader_process.read", logs_here.read)
