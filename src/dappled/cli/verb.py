"""What a verb of the command line is: a frozen dataclass whose fields are its arguments, run to a report.

`check` refuses what is wrong by itself before work begins; `run` does the work. What a verb prints while it works goes
through the `Output`, what it found is its `Report`: `rendering` prints both, as text or JSON, and gives the exit code.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from dappled.config.schema import Rule
from dappled.errors import CallError, DappledError
from dappled.findings import Finding

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Argument:
    """How a field is given on the command line: its rule (meaning, unit, range, choices; as of a setting) and its form.

    A positional one has no `names`. `above` is an exclusive lower limit. `parse` reads one word, and raises ValueError
    with a sentence. `const` is the value of an option without one. `there`: a file or folder that must exist, and
    be what the function says (see `paths`). `first`: it stands before inherited ones.
    """

    rule: Rule
    metavar: str | tuple[str, ...] | None = None
    names: tuple[str, ...] = ()
    above: float | None = None
    infinite: bool = False
    parse: Callable[[str], Any] | None = None
    const: Any = None
    append: bool = False
    there: Callable[[Path], str] | bool = False
    group: str = ""
    otherwise: str = ""
    alone: str = ""
    first: bool = False


def argument(metavar: str, help: str, default: Any = MISSING, choices: Sequence[str] = (), **form: Any) -> Any:
    """Declare a positional argument."""
    return field(default=default, metadata={"argument": Argument(Rule(help, choices=tuple(choices)), metavar, **form)})


def option(
    names: str,
    meaning: str | Rule,
    default: Any = MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: Sequence[Any] = (),
    **form: Any,
) -> Any:
    """Declare an option by its names, such as "-o --output", and its help, or the rule of a setting that is the same.

    `otherwise` says in --help what holds where it isn't given; by default its default value does. Options with one
    `alone` exclude each other.
    """
    rule = meaning if isinstance(meaning, Rule) else Rule(meaning, unit, low, high, tuple(choices))
    return field(default=default, metadata={"argument": Argument(rule, names=tuple(names.split()), **form)})


def flag(name: str, help: str, group: str = "") -> Any:
    """Declare a switch, off unless it is given."""
    return option(name, help, False, group=group)


def of_setting(table: type, key: str) -> Rule:
    """The rule of a setting that an argument stands for."""
    rule: Rule = table.__dataclass_fields__[key].metadata["rule"]  # type: ignore[attr-defined]  # a dataclass
    return rule


class Output(Protocol):
    """What a verb prints while it works. Bars are drawn on a terminal alone, for work of over a second."""

    def row(self, values: Mapping[str, Any], *lines: str) -> None:
        """Print one result at once: its values as a line of JSON with --json, else its lines."""

    def remark(self, text: str) -> None:
        """Say something beside the results, on standard error."""

    def warn(self, text: str) -> None:
        """Say what went wrong or is in doubt, on standard error, with the verb's name."""

    def each(self, items: Sequence[Item], unit: str = "frame") -> Iterator[Item]:
        """The items, with a bar."""

    def bar(self, total: int | None, unit: str, what: str = "") -> AbstractContextManager[Callable[[int], object]]:
        """A bar of so many units; the function adds to it."""

    def show(self, what: str, done: int, total: int) -> None:
        """So many steps of a stretch of work are done."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a verb did: `values` are printed with --json, `lines` without it.

    The result is in doubt where a finding is above note, and so is its `extent`; `failed` where something was not done.
    """

    values: Any = None
    lines: Sequence[str] = ()
    findings: Sequence[Finding] = ()
    extent: str = ""
    failed: bool = False


@dataclass(frozen=True, kw_only=True)
class Verb(ABC):
    """A verb or an action of one. `examples` stand in --help, below `notes`."""

    examples: ClassVar[Sequence[str]] = ()
    notes: ClassVar[str] = ""

    json: bool = flag("--json", "print JSON")

    def check(self) -> None:  # noqa: B027  # most have nothing to refuse
        """Refuse a call that is wrong by itself. Raises DappledError."""

    @abstractmethod
    def run(self, output: Output) -> Report:
        """Do the work. Raises DappledError."""


@dataclass(frozen=True, kw_only=True)
class Overwriting:
    """--overwrite, for verbs that write what the user named."""

    overwrite: bool = flag("--overwrite", "replace what is there under that name")

    def refuse_existing(self, *outputs: Path | None) -> None:
        """Refuse to replace an output. Raises DappledError."""
        for path in () if self.overwrite else outputs:
            if path is not None and (path.is_symlink() or path.exists()):
                raise DappledError(f"{path} exists already: choose another name, or --overwrite replaces it")


def refuse_no_folder(path: Path) -> None:
    """Refuse to write where there is no folder. Raises CallError."""
    if not path.absolute().parent.is_dir():
        raise CallError(f"{path} can't be written: {path.absolute().parent} is no folder; make it first")


@dataclass(frozen=True, kw_only=True)
class Doubtable:
    """--anyway, for verbs whose result can be in doubt."""

    anyway: bool = flag("--anyway", "exit with 0 although the result is in doubt (otherwise 1)")


@dataclass(frozen=True, kw_only=True)
class SettingsArgument:
    """--config, for verbs that read the settings."""

    config: Path | None = option("--config", "settings file", None, otherwise="the built-in settings")
