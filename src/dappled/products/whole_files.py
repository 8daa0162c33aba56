"""Write a file or folder under another name and give it its own at the end: whole and durable, or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.errors import DappledError


@contextmanager
def whole(path: Path, *, fresh: bool = False) -> Iterator[Path]:
    """`durable.replacing`; the disk's refusal is a DappledError, and so is, where it must be `fresh`, what exists at
    `path`."""
    if fresh and path.exists():
        raise DappledError(f"{path} exists already: move it away, or choose another name")
    try:
        with durable.replacing(path) as part:
            yield part
    except OSError as error:
        raise DappledError(f"{path} can't be written: {error.strerror or error}; choose another place") from None


def write_json(path: Path, value: Any, indent: int | None = 1) -> Path:
    """Write a value as JSON, whole or not at all, and its folder where it is missing; returns the path. Raises OSError,
    and ValueError for a number that JSON hasn't."""
    durable.make_folder(path.absolute().parent)
    durable.write_file(path.absolute(), (json.dumps(value, indent=indent, allow_nan=False) + "\n").encode())
    return path
