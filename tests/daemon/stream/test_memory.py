"""Large blocks are used again: seen by the page faults of a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
from dappled.large_blocks import reuse_large_blocks
if sys.argv[1] == "reuse" and not reuse_large_blocks():
    sys.exit("no mallopt")
bytearray(48 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    bytearray(48 << 20)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=False, timeout=60)
    if "no mallopt" in done.stderr:
        pytest.skip("this libc has no mallopt")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_a_block_that_was_freed_is_had_again_without_page_faults() -> None:
    assert faults("reuse") * 10 < faults("plain")
