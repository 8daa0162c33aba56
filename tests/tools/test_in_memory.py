"""Files of tests lie in memory where there is room, and are gone at the end."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from tests.tools import tool

WORDS = """
import pathlib, sys
folder = sys.argv[-1].removeprefix("--basetemp=")
print(folder)
if len(sys.argv) > 1:
    pathlib.Path(folder).mkdir()
raise SystemExit(3)
"""


@pytest.mark.parametrize("bytes_free", [0, 10**18])
def test_where_there_is_room_they_lie_there_and_are_removed(
    bytes_free: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    in_memory = tool("in_memory")
    monkeypatch.setattr(in_memory, "MEMORY", tmp_path)
    monkeypatch.setattr(in_memory, "ROOM_BYTES", bytes_free)
    monkeypatch.setattr(sys, "argv", ["in_memory.py", sys.executable, "-c", WORDS])
    ends = signal.getsignal(signal.SIGTERM)
    try:
        assert in_memory.main() == 3
    finally:
        signal.signal(signal.SIGTERM, ends)
    there = bytes_free == 0 and Path("/proc/meminfo").exists()
    assert capfd.readouterr().out.startswith(f"{tmp_path}/" if there else "-c\n")
    assert list(tmp_path.iterdir()) == []
