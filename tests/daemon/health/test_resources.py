"""What is left for one more photograph."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from dappled.daemon.health.resources import ResourcesLeft, look, shortage
from dappled.findings import text


def test_this_machine_has_enough() -> None:
    left = look()
    assert left.memory_bytes is not None
    assert left.memory_bytes > 0
    assert shortage(ResourcesLeft(1000, 10**9)) is None


def test_descriptors_are_counted() -> None:
    before = look().descriptors
    assert before is not None
    fd = os.open("/dev/null", os.O_RDONLY)
    try:
        assert look().descriptors == before - 1
    finally:
        os.close(fd)


@pytest.mark.parametrize(
    ("left", "words"),
    [(ResourcesLeft(15, 10**9), "too few file descriptors"), (ResourcesLeft(None, 47_999_999), "too little memory")],
)
def test_a_shortage_is_a_sentence(left: ResourcesLeft, words: str) -> None:
    found = shortage(left)
    assert found is not None
    assert words in str(text(found))


def test_unknown_is_not_zero(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert look(tmp_path) == ResourcesLeft(None, None)
    assert shortage(ResourcesLeft(None, None)) is None
    (tmp_path / "meminfo").write_text("MemAvailable: many kB\n")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert look().descriptors is None
    assert look(tmp_path).memory_bytes is None
