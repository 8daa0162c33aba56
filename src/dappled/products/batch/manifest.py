"""What a batch has done so far: a line of JSON for each job, appended and synced. A batch begun again goes on there."""

from __future__ import annotations

import fcntl
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

from dappled.errors import DappledError
from dappled.flight import durable
from dappled.products.batch.batch import Done, Output

NAME = "manifest.jsonl"


class ManifestError(DappledError):
    """A manifest that can't be used; one sentence."""


class Manifest:
    """The manifest of an output folder, held by one batch at a time. Use as a context manager."""

    def __init__(self, output: Path) -> None:
        """Raises ManifestError where another batch works in this folder, or the disk refuses."""
        self.path = output / NAME
        try:
            durable.make_folder(output)
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(self._fd)
                raise ManifestError(f"another batch works in {output}: wait for it, or choose another -o") from None
        except OSError as error:
            raise ManifestError(f"cannot keep a manifest in {output}: {error.strerror}") from None
        self.done = self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def add(self, done: Done) -> None:
        """Note an answer, durably."""
        os.write(self._fd, json.dumps(asdict(done), sort_keys=True).encode() + b"\n")
        os.fsync(self._fd)
        self.done[done.key] = done

    def holds(self, key: str) -> bool:
        """Whether a job was done before and all that it made is still there."""
        done = self.done.get(key)
        if done is None or done.error is not None:
            return False
        return all(_size(self.path.parent / one.name) == one.size for one in done.outputs)

    def _read(self) -> dict[str, Done]:
        text = b""
        while block := os.read(self._fd, 1 << 20):
            text += block
        whole = text.rfind(b"\n") + 1
        if whole < len(text):  # torn by a power cut: that job is done again
            os.ftruncate(self._fd, whole)
            os.lseek(self._fd, 0, os.SEEK_END)
        known: dict[str, Done] = {}
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                done = _done(json.loads(line))
            except (ValueError, TypeError, KeyError):
                raise ManifestError(
                    f"{self.path}, line {number} is no line of a manifest: move it away, and everything is made anew"
                ) from None
            known[done.key] = done
        return known


def _done(row: dict[str, Any]) -> Done:
    return Done(**{**row, "outputs": tuple(Output(**one) for one in row["outputs"])})


def _size(path: Path) -> int | None:
    if path.is_file():
        return path.stat().st_size
    if path.is_dir():
        return sum(inner.stat().st_size for inner in path.rglob("*") if inner.is_file())
    return None
