"""Write which modules of dappled run, in this process and its children, to a file for each process.

Python imports this module at start where its folder stands on PYTHONPATH. With DAPPLED_TRACE=DIR each line of
DIR/<process id> is "<monotonic ns> <thread> <module> <function>", one line whenever a thread enters another module than
the one it was in, and "<monotonic ns> <thread> - <wait>" whenever it begins to wait.
"""

from __future__ import annotations

import inspect
import os
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

_WAITS = frozenset({"poll", "select", "recvmsg", "recv"})


def _install(folder: str) -> None:
    root = str(Path(_source()).resolve()) + os.sep
    lines = open(Path(folder) / str(os.getpid()), "w", buffering=1 << 16, encoding="utf-8")  # noqa: SIM115  # kept for life
    names: dict[str, str] = {}
    state = threading.local()
    lock = threading.Lock()

    def module(file: str) -> str:
        known = names.get(file)
        if known is None:
            known = names[file] = file[len(root) : -3].replace(os.sep, ".") if file.startswith(root) else ""
        return known

    def write(what: str, flush: bool) -> None:
        with lock:
            lines.write(f"{time.monotonic_ns()} {threading.current_thread().name.replace(' ', '_')} {what}\n")
            if flush:
                lines.flush()

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            code = frame.f_code
            here = module(code.co_filename)
            if here and code.co_flags & inspect.CO_OPTIMIZED:  # a function: no module's or class' body
                if here != getattr(state, "module", None):
                    state.module = here
                    write(f"{here} {code.co_qualname}", flush=False)
            elif code.co_name == "wait" and code.co_filename.endswith("threading.py"):
                state.module = None
                write("- wait", flush=True)
        elif event == "c_call" and argument.__name__ in _WAITS:
            state.module = None
            write(f"- {argument.__name__}", flush=True)

    threading.setprofile(profile)
    sys.setprofile(profile)


def _source() -> str:
    """Where the package stands, without importing it."""
    for place in sys.path:
        if (Path(place or ".") / "dappled" / "__init__.py").exists():
            return str(Path(place or ".") / "dappled")
    return ""


if "DAPPLED_TRACE" in os.environ:
    _install(os.environ["DAPPLED_TRACE"])
