#!/usr/bin/env python3
"""Run a command, and print what it took of what it may take on two calm cores.

    python tools/budget.py NAME WALL_S CPU_S COMMAND…

Ends as the command ends: a busy machine is no failure. CPU time is that of all processes that were waited for.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time


def main() -> int:
    name, wall, cpu, *command = sys.argv[1:]
    began = time.monotonic()
    ended = subprocess.call(command)
    took = time.monotonic() - began
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = used.ru_utime + used.ru_stime
    word = "" if took <= float(wall) and spent <= float(cpu) else ": over its budget"
    print(f"{name}: {took:.0f} s of {wall}, {spent:.0f} CPU-s of {cpu}{word}", file=sys.stderr)
    return ended


if __name__ == "__main__":
    raise SystemExit(main())
