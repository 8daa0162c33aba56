#!/usr/bin/env python3
"""Run pytest with its temporary files in memory where there is room for them, else as it is.

    python tools/in_memory.py PYTEST…

The default tests keep at most 1.5 GB there, and wait for no disk: a fifth of their time. They are removed at the end.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

MEMORY = Path("/dev/shm")  # noqa: S108  # a folder of our own is made in it
ROOM_BYTES = 3_000_000_000


def room() -> bool:
    """Half of the memory that is free stays free."""
    try:
        (free_kib,) = re.findall(r"MemAvailable: +(\d+) kB", Path("/proc/meminfo").read_text())
        return int(free_kib) * 1024 >= 2 * ROOM_BYTES and shutil.disk_usage(MEMORY).free >= ROOM_BYTES
    except (OSError, ValueError):  # another system
        return False


def main() -> int:
    if not room():
        return subprocess.call(sys.argv[1:])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory(prefix="dappled-", dir=MEMORY, ignore_cleanup_errors=True) as folder:
        return subprocess.call([*sys.argv[1:], f"--basetemp={folder}/tests"])


if __name__ == "__main__":
    raise SystemExit(main())
