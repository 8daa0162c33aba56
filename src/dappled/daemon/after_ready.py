"""What a flight needs and READY does not, loaded once READY is told.

On a small computer a page of a module costs more than its code. Who uses one of these modules imports it where it is
used; nothing is left to be read from a disk in the middle of a flight.
"""

from __future__ import annotations

import gc
import importlib

from dappled.workers import Loop

MODULES = ("dappled.drivers.raw.reading", "dappled.drivers.usb_bus")
"""The readers of frames (LibRaw, Pillow, tifffile), and what resets a silent body's port."""


def begin() -> None:
    """Load them in a thread of their own."""
    Loop("after READY", load).start()


def load() -> None:
    """Load them. What is loaded by then stays, and the search for cycles leaves it out."""
    for name in MODULES:
        importlib.import_module(name)
    gc.freeze()
