"""The command that runs a module of ours in a process of its own."""

from __future__ import annotations

import sys


def python_module(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module with this Python. `-P`: Python would look for modules in the current folder
    first, and that may be a stranger's."""
    return [sys.executable, "-P", "-m", module, *arguments]
