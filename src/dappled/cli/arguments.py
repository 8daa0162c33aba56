"""Parse what any verb may take: checked numbers, and actions such as `show` in `dappled flight show`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from dappled.cli.verb import OutputExistsError


def whole(text: str) -> int:
    """Parse a whole number from 1."""
    if not (text.isdecimal() and int(text) >= 1):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1")
    return int(text)


def system_id(text: str) -> int:
    """Parse a MAVLink system id."""
    if not (text.isdecimal() and 1 <= int(text) <= 255):
        raise argparse.ArgumentTypeError(f"{text!r} is not a system id from 1 to 255")
    return int(text)


def seconds(text: str) -> float:
    """Parse a time of 0 s or more."""
    number = _number(text)
    if number is None or not (math.isfinite(number) and number >= 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a time of 0 s or more")
    return number


def positive(text: str) -> float:
    """Parse a number above 0."""
    number = _number(text)
    if number is None or not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return number


def metres(text: str) -> float:
    """Parse a distance above 0 m, or inf."""
    number = float(text)
    if not number > 0 or math.isnan(number):
        raise argparse.ArgumentTypeError(f"{text} is not a distance above 0 m")
    return number


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add --overwrite, for verbs that write what the user named: see `refuse_existing`."""
    parser.add_argument("--overwrite", action="store_true", help="replace what is there under that name")


def refuse_existing(arguments: argparse.Namespace, *outputs: Path) -> None:
    """Refuse to replace an output. Call it before the work is done. Raises OutputExistsError."""
    if arguments.overwrite:
        return
    for path in outputs:
        if path.is_symlink() or path.exists():
            raise OutputExistsError(f"{path} exists already: choose another name, or --overwrite replaces it")


@dataclass(frozen=True, slots=True)
class Actions:
    """The actions of one verb. The call must name one; `arguments.action` holds it."""

    among: argparse._SubParsersAction[argparse.ArgumentParser]

    @classmethod
    def of(cls, parser: argparse.ArgumentParser) -> Actions:
        """No actions yet, for the parser of a verb."""
        return cls(parser.add_subparsers(dest="action", required=True, metavar="ACTION"))

    @property
    def all(self) -> Collection[argparse.ArgumentParser]:
        """The parsers of all actions, to add what all of them take."""
        return self.among.choices.values()

    def add(self, name: str, line: str, *examples: str) -> argparse.ArgumentParser:
        """Add an action: its line in --help, and example calls. Returns its parser."""
        head = "example" if len(examples) == 1 else "examples"
        made: argparse.ArgumentParser = self.among.add_parser(
            name,
            help=line,
            description=line[0].upper() + line[1:] + ("" if line.endswith("?") else "."),
            epilog="\n  ".join((f"{head}:", *examples)),
            formatter_class=argparse.RawTextHelpFormatter,
        )
        return made
