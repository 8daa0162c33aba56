"""Say on standard error what a command waits for, once it has waited for two seconds."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SILENCE_S = 2.0


@contextmanager
def waiting_for(what: str, silence_s: float = SILENCE_S) -> Iterator[None]:
    """Context that prints "waiting for WHAT" if it takes longer than `silence_s`."""
    timer = threading.Timer(silence_s, lambda: print(f"waiting for {what}", file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
