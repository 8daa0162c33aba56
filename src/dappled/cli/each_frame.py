"""Make something of each frame that a call names: one that fails is told, and the others go on."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from dappled.errors import DappledError, counted
from dappled.shown import printable


def each_frame(
    verb: str,
    frames: Sequence[Path],
    arguments: argparse.Namespace,
    make: Callable[[Path], bool],
    *,
    into_folder: bool,
    failure: str,
) -> int:
    """Return the exit code: 1 where a frame failed, or where `make` says of one that it is in doubt, without --anyway.

    `failure` says what became of the frames that failed. Raises the DappledError of a frame that goes to no folder.
    """
    bad = doubted = 0
    for frame in tqdm(frames, unit="frame", disable=len(frames) < 2 or not sys.stderr.isatty(), file=sys.__stderr__):
        try:
            doubted += make(frame)
        except DappledError as error:
            if not into_folder:
                raise
            bad += 1
            print(printable(f"dappled {verb}: {error}"), file=sys.stderr)
            if arguments.json:
                print(json.dumps({"frame": str(frame), "error": str(error)}))
    of_all = counted(len(frames), "frame")
    if bad:
        print(f"{bad} of {of_all} {failure}", file=sys.stderr)
    if doubted and not arguments.anyway:
        which = f", {doubted} of {of_all}" if into_folder else ""
        print(f"dappled {verb}: written, but in doubt{which}: see above; --anyway accepts that", file=sys.stderr)
        return 1
    return 1 if bad else 0
