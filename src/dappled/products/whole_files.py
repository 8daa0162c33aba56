"""Write a file or folder under another name and give it its own at the end: whole and durable, or not at all."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.errors import DappledError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The name to write under, with the ending of `path`. A folder can't replace one that isn't empty, so an old one is
    moved aside first. Raises OSError; then `path` is as it was."""
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    old = part.with_name(f"{part.name}.old.part")
    try:
        yield part
        _sync(part)
        if path.is_dir():
            path.rename(old)
        try:
            part.replace(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
        durable.sync_folder(path.parent)
    finally:
        _remove(part)
    _remove(old)


@contextmanager
def whole(path: Path, *, fresh: bool = False) -> Iterator[Path]:
    """`replacing`; the disk's refusal is a DappledError, and so is, where it must be `fresh`, what exists at `path`."""
    if fresh and path.exists():
        raise DappledError(f"{path} exists already: move it away, or choose another name")
    try:
        with replacing(path) as part:
            yield part
    except OSError as error:
        raise DappledError(f"{path} can't be written: {error.strerror or error}; choose another place") from None


def write_json(path: Path, value: Any, indent: int | None = 1) -> Path:
    """Write a value as JSON, whole or not at all, and its folder where it is missing; returns the path. Raises OSError,
    and ValueError for a number that JSON hasn't."""
    durable.make_folder(path.absolute().parent)
    durable.write_file(path.absolute(), (json.dumps(value, indent=indent, allow_nan=False) + "\n").encode())
    return path


def _sync(path: Path) -> None:
    """fsync a file, or a folder with its content."""
    if path.is_file():
        with durable.descriptor(path, os.O_RDWR) as fd:  # Windows flushes no file that is open for reading
            os.fsync(fd)
        return
    for inner in path.iterdir():
        _sync(inner)
    durable.sync_folder(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
