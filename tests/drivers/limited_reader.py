"""A reader that does what a stranger's file would have it do: `python -m tests.drivers.limited_reader`, by the word."""

from __future__ import annotations

import json
import resource
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dappled.drivers.reader_process import ReadArrays, serve

LIMITS = {"cpu": resource.RLIMIT_CPU, "file": resource.RLIMIT_FSIZE, "memory": resource.RLIMIT_AS}


def answer(path: str, words: Sequence[str]) -> ReadArrays:
    """Do it."""
    if words[0] == "tell":
        return [], json.dumps({name: resource.getrlimit(kind)[0] for name, kind in LIMITS.items()})
    if words[0] == "take memory":
        return [("a", np.ones(int(words[1]), np.uint8))], ""
    if words[0] == "fill the disk":
        with Path(path).open("ab") as file:
            while True:
                file.write(bytes(1 << 20))
    if words[0] == "fill the answer":
        return (("a", np.zeros(1 << 20, np.uint8)) for _ in range(1000)), ""
    while True:
        pass


if __name__ == "__main__":
    serve(answer, "json")
