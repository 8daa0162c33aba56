"""`reader_process.read` without a process: what a log says is the same, and no Python is started for it."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import stored_size
from dappled.drivers.reader_process import Budget
from dappled.errors import first_line


def read(
    module: str, path: Path, words: Sequence[str], *, library: str, budget: Budget
) -> tuple[dict[str, NDArray[Any]], str]:
    """As `reader_process.read`, without its limits."""
    stored_size(path)  # raises OSError
    try:
        arrays, text = importlib.import_module(module)._answer(str(path), words)
        return dict(arrays), text
    except (ClaimError, KeyError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001  # as the process: these libraries raise anything on damaged bytes
        raise ValueError(first_line(error)) from None
