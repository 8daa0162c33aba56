"""Flights to try things on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled import durable
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
def synced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, frozenset[str]]]:
    """Each folder that is made sure of from here on, with the names that stood in it then."""
    sync = durable.sync_folder
    done: list[tuple[Path, frozenset[str]]] = []

    def watched(path: Path) -> None:
        sync(path)
        done.append((path, frozenset(os.listdir(path))))

    monkeypatch.setattr(durable, "sync_folder", watched)
    return done


@pytest.fixture
def on_ext4(monkeypatch: pytest.MonkeyPatch) -> None:
    """The temporary folder is believed to be on ext4, wherever it is: a prune there is trusted."""
    monkeypatch.setattr(places, "file_system", lambda fd: "ext4")


START_UTC_NS = 1_795_256_103_000_000_000  # 2026-11-21T10:15:03Z
