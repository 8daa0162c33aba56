"""Flights to try things on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.flight import Recording, places, recording


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    """A flights folder that does not exist yet."""
    return tmp_path / "flights"


@pytest.fixture
def flight(flights: Path) -> Iterator[Recording]:
    """A flight being recorded; closed at the end if the test did not."""
    begun = recording.begin(flights, RecordedClock(START_UTC_NS), {"camera": {"driver": "none"}})
    yield begun
    if not begun.closed:
        begun.close()


@pytest.fixture
def on_ext4(monkeypatch: pytest.MonkeyPatch) -> None:
    """The temporary folder is believed to be on ext4, wherever it is: a prune there is trusted."""
    monkeypatch.setattr(places, "file_system", lambda fd: "ext4")


START_UTC_NS = 1_795_256_103_000_000_000  # 2026-11-21T10:15:03Z
