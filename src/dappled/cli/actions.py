"""Verbs that are said with an action, as `dappled flight show`: each action has a help page with an example."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Actions:
    """The actions of one verb; one must be named, and stands in `arguments.action`."""

    among: argparse._SubParsersAction[argparse.ArgumentParser]

    @classmethod
    def of(cls, parser: argparse.ArgumentParser) -> Actions:
        """A verb's actions: none yet."""
        return cls(parser.add_subparsers(dest="action", required=True, metavar="ACTION"))

    @property
    def all(self) -> Collection[argparse.ArgumentParser]:
        """Their parsers, for what all of them take."""
        return self.among.choices.values()

    def add(self, name: str, line: str, *examples: str) -> argparse.ArgumentParser:
        """The parser of an action that `line` explains, and calls of it that work."""
        head = "example" if len(examples) == 1 else "examples"
        made: argparse.ArgumentParser = self.among.add_parser(
            name,
            help=line,
            description=line[0].upper() + line[1:] + ("" if line.endswith("?") else "."),
            epilog="\n  ".join((f"{head}:", *examples)),
            formatter_class=argparse.RawTextHelpFormatter,
        )
        return made
