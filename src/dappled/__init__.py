"""dappled: acquisition daemon for masked light-field cameras that fly.

`dappled.open(path)` gives what a path holds: a light field, a raw frame, or a flight. See `dappled.products.opened`.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`open`, loaded when it is asked for: the daemon does without."""
    if name == "open":
        return import_module("dappled.products.opened").open
    raise AttributeError(f"module 'dappled' has no attribute {name!r}")
