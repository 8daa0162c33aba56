"""What a process prints and logs, whoever wrote it, moves no cursor of a terminal."""

from __future__ import annotations

import subprocess
import sys

HOSTILE = "a\x1b]0;title\x07\x9b2J\u202e\u2028\udcff\rb"
PRINTS = f"""
import logging, sys
from dappled import shown
from dappled.daemon.health import systemd
shown.guard_output()
shown.guard_output()
logging.basicConfig(handlers=[systemd.handler({{}})])
print({HOSTILE!r}, "second", sep="\\n")
logging.getLogger("camera").warning("model %s", {HOSTILE + chr(10)!r})
shown.say({HOSTILE + chr(10)!r})
logging.root.handlers.clear()
logging.getLogger("child").warning("model %s", {HOSTILE + chr(10)!r})
sys.__stderr__.write("bar\\r")
raise ValueError({HOSTILE!r})
"""
SHOWN = r"a\x1b]0;title\x07\x9b2J\u202e\u2028\udcff\rb"


def test_prints_logs_and_tracebacks_are_shown_with_escapes() -> None:
    done = subprocess.run([sys.executable, "-c", PRINTS], capture_output=True, check=False)
    assert done.stdout.decode() == f"{SHOWN}\nsecond\n{SHOWN}\\n\n"
    told = done.stderr.decode("utf-8").split("\n")
    assert told[:2] == [f"WARNING camera: model {SHOWN}\\n", f"model {SHOWN}\\n"]
    assert told[2].startswith("bar\rTraceback")  # a progress bar's own
    assert told[-2] == f"ValueError: {SHOWN}"
    assert all(line.isprintable() for line in told[3:])
