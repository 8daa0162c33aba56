"""The `dappled` command. Each verb has a module here, which is loaded only when the verb is called."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import dappled
from dappled.cli import table
from dappled.cli.table import GROUPS, VERBS
from dappled.shown import say

__all__ = ["VERBS", "main"]


def main(arguments: Sequence[str] | None = None, *, loaded: Callable[[], object] | None = None) -> int:
    """Run the command line; returns the exit code: 0; 1 for a failure or a result in doubt; 2 for a wrong call; 130
    when interrupted.

    `loaded` is called when all modules are there and the verb begins.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        say(f"dappled {dappled.__version__}")
        return 0
    if arguments is None:
        words, helped = _asked_for_help(words)
        table.words_only = helped or words[:1] == ["completion"]
    from dappled.cli import calling  # noqa: PLC0415  # --version waits for nothing

    return calling.run(words, loaded)


def _asked_for_help(words: list[str]) -> tuple[list[str], bool]:
    """The words, of a call that ends in --help without what stands between it and its verb; and whether it is one."""
    *named, last = words or [""]
    if last not in ("--help", "-h") or "--" in named:
        return words, False
    verb = next((named[:n] for n in range(len(named), 0, -1) if " ".join(named[:n]) in VERBS), None)
    if verb is None:
        return words, " ".join(named) in GROUPS
    return [*verb, last], True
