"""What was found, as values: code, level, what it is about, and facts; `findings.toml` has the words of each code.

Two findings are of one kind when code and subject are equal, whatever their numbers. Only this module builds their
sentences; no code reads a sentence back.
"""

from __future__ import annotations

import json
import math
import os
import string
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache
from os import PathLike
from types import MappingProxyType
from typing import Any, Self, TypeAlias

from dappled import codec
from dappled.finding_codes import LIST
from dappled.finding_codes import Code as Code  # noqa: PLC0414  they are imported from here


class Text:
    """Words for people. Nothing can compare, search or split them; a face prints them by `str`."""

    __slots__ = ("_words",)

    def __init__(self, words: str) -> None:
        self._words = words

    def __str__(self) -> str:
        return self._words

    def __bool__(self) -> bool:
        return bool(self._words)


# What a result was made with, beside its own frames: its findings are told with its name.
_BESIDE = frozenset({"bare frames", "calibration", "white frame"})
_DEEPEST = 8
_NO_FACTS: Mapping[str, Value] = MappingProxyType({})


class Level(IntEnum):
    """How much a finding weighs. Above `NOTE` nothing is "go", and a result is in doubt."""

    NOTE = 0
    CAUTION = 1
    STOP = 2

    @property
    def word(self) -> str:
        """The level as JSON and people have it."""
        return self.name.lower()


@dataclass(frozen=True, slots=True, order=True)
class Subject:
    """What a finding is about: a kind (flight, frame, shot, picture, file, link, log, argument, service) and which one.

    >>> str(Subject("frame", 42)), str(Subject("flight"))
    ('frame 42', 'flight')
    """

    kind: str
    which: str | int = ""

    def __str__(self) -> str:
        return f"{self.kind} {self.which}" if self.which != "" else self.kind


FRAME = Subject("frame")  # the one whose light field, row or line the finding stands in


@dataclass(frozen=True, slots=True)
class Wording:
    """How a code is told: its sentence with {facts}, what to do, and the page of the documents; how long it stands
    before it is told unasked, because it usually ends by itself."""

    level: Level
    sentence: str
    remedy: str = ""
    page: str = ""
    settles_s: float = 0.0


@cache
def words() -> Mapping[Code, Wording]:
    """How each code is told, in the order of the alphabet."""
    rows = tomllib.loads(LIST).items()
    return MappingProxyType({Code(code): Wording(Level[row.pop("level").upper()], **row) for code, row in rows})


@dataclass(frozen=True, slots=True)
class Fault:
    """An error as a fact: its kind (`FlightError`), the number and the file of the system's error that it is, or that
    led to it, and what it says to people. The system's own say it by their number."""

    error: str
    errno: int | None = None
    path: str = ""
    said: str = ""

    @classmethod
    def of(cls, error: BaseException) -> Fault | Finding:
        """An error's own finding, if it carries one, else itself."""
        found = getattr(error, "finding", None)
        if isinstance(found, Finding):
            return found
        system = error if isinstance(error, OSError) else error.__cause__
        number, path = (system.errno, system.filename) if isinstance(system, OSError) else (None, None)
        kind, named = type(error).__name__, path if isinstance(path, str | bytes | PathLike) else ""  # or a number
        said = str(error) if hasattr(error, "finding") else f"{kind}: {error}"  # only our own tell by themselves
        if isinstance(error, OSError) and number:
            said = "" if error.strerror == os.strerror(number) else str(error.strerror)
        return cls(kind, number, os.fsdecode(named), said)

    def words(self, *, named: bool = True) -> Text:
        """What it says, as a clause; of the system's errors with the file's name, where it is to be `named`."""
        if self.said or self.errno is None:
            return Text(self.said or self.error)
        return Text(f"{self.path}: {os.strerror(self.errno)}" if self.path and named else os.strerror(self.errno))


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found. `facts` have their unit in the key (`sigma_ms`) and stand as JSON; one may be what led to it:
    another finding, or an error."""

    code: Code
    subject: Subject
    facts: Mapping[str, Value] = field(default_factory=lambda: _NO_FACTS)
    level: Level = Level.NOTE

    def __post_init__(self) -> None:
        """Raises ValueError for what no part of dappled makes: a file that is damaged, or made to be."""
        if self.depth > _DEEPEST:
            raise ValueError(f"more than {_DEEPEST} findings lead to each other")

    def __hash__(self) -> int:
        return hash((self.code, self.subject))

    @property
    def depth(self) -> int:
        """How many findings led to it, one to the next."""
        return max((1 + one.depth for one in self.facts.values() if isinstance(one, Finding)), default=0)

    def with_facts(self, **more: Evidence) -> Self:
        """It with more facts, or others."""
        return replace(self, facts={**self.facts, **_known(more)})

    def number(self, name: str) -> int:
        """A whole number of its facts; 0 where there is none of this name."""
        value = self.facts.get(name)
        return value if isinstance(value, int) else 0

    @property
    def kind(self) -> tuple[Code, Subject]:
        """What makes two findings the same, whatever their numbers."""
        return self.code, self.subject


Value: TypeAlias = str | int | float | bool | Fault | Finding | None
Evidence: TypeAlias = Value | BaseException | PathLike[str]
"""What facts are made of: an error is its finding or a `Fault`, a path its text."""


def json_text(one: Finding) -> str:
    """A finding as an event of the ledger holds it."""
    return json.dumps(codec.plain(one), ensure_ascii=False)


def of_json_text(words: str) -> Finding | None:
    """The finding that a text holds as JSON, as an event of the ledger does; None for another text."""
    try:
        return codec.read_json(Finding, words)
    except codec.CodecError:
        return None


def finding(code: Code, subject: Subject, level: Level | None = None, **facts: Evidence) -> Finding:
    """A finding with its code's own level, unless another is given. A number that isn't finite is unknown: None."""
    return Finding(code, subject, _known(facts), words()[code].level if level is None else level)


def _known(facts: Mapping[str, Evidence]) -> dict[str, Value]:
    """Facts as JSON has them, and the codec reads them back."""
    return {name: _fact(one) for name, one in facts.items()}


def _fact(one: Evidence) -> Value:
    if isinstance(one, float) and not math.isfinite(one):
        return None
    if isinstance(one, BaseException):
        return Fault.of(one)
    return os.fspath(one) if isinstance(one, PathLike) else one


def worst(found: Iterable[Finding]) -> Level:
    """The highest level among findings; `NOTE` of none."""
    return max((one.level for one in found), default=Level.NOTE)


def first_of_each(found: Iterable[Finding]) -> list[Finding]:
    """Each kind once, as it was found first, in that order."""
    first: dict[tuple[Code, Subject], Finding] = {}
    for one in found:
        first.setdefault(one.kind, one)
    return list(first.values())


def above_note(found: Iterable[Finding]) -> list[Finding]:
    """Those that stand between a result and "go"."""
    return [one for one in found if one.level > Level.NOTE]


def in_order(found: Sequence[Finding]) -> list[Finding]:
    """Worst first, then newest: `found` stands in the order of finding."""
    return sorted(found[::-1], key=lambda one: -one.level)  # noqa: C415  sorted() keeps the order of equals


class _Sentences(string.Formatter):
    """Formats facts as `str.format` does. `{reason:?: }` is empty, or ": " and the reason; behind a stroke the value
    has a format of its own (`{focus_m:?, m: |.3g}`). `{frames:#frame}` is 1 frame, 2 frames; `{why}` of an error or a
    finding is what it says and what to do, `{why:-}` without what to do, and without the name of a file. Facts may come
    from damaged files: one that is missing, or of another type, is shown as it is.
    """

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        return kwargs.get(str(key))

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Fault | Finding):
            whole = not format_spec.startswith(("-", "?"))
            value = str(value.words(named=whole) if isinstance(value, Fault) else _led_by(value, whole=whole))
        format_spec = format_spec.removeprefix("-")
        if format_spec.startswith("?"):
            clause, _, own = format_spec[1:].partition("|")
            return "" if value in (None, "") else clause + self.format_field(value, own)
        if format_spec.startswith("#") and isinstance(value, int):
            return f"{value} {format_spec[1:]}" + ("" if value == 1 else "s")
        try:
            return format(value, format_spec)
        except (ValueError, TypeError, OverflowError):
            return str(value)


def _filled(sentence: str, facts: Mapping[str, Value]) -> str:
    return _Sentences().vformat(sentence, (), facts)


def text(one: Finding) -> Text:
    """What was found, as a clause without its subject and without a full stop."""
    return Text(_filled(words()[one.code].sentence, one.facts))


def _led_by(one: Finding, *, whole: bool) -> Text:
    return told(one, one.subject) if whole else text(one)


def remedy(one: Finding) -> Text:
    """What to do; "" where nothing is to be done, as about a doubt that stands as a note only."""
    usual = words()[one.code]
    settled = one.level is Level.NOTE and usual.level > Level.NOTE
    return Text("" if settled else _filled(usual.remedy, one.facts))


def named(one: Finding, under: Subject | None = None) -> Text:
    """What was found, of what, where there are several such things or the result isn't about it.

    What stands `under` its subject's name needs it not again.
    """
    plain_one = one.subject.which == "" and one.subject.kind not in _BESIDE
    return text(one) if plain_one or one.subject == under else Text(f"{one.subject}: {text(one)}")


def told(one: Finding, under: Subject | None = None) -> Text:
    """What was found, of what, and what to do."""
    todo = remedy(one)
    return Text(f"{named(one, under)}: {todo}" if todo else str(named(one, under)))


def of_subject(found: Iterable[Finding], subject: Subject) -> list[Finding]:
    """What was found of the frame at hand, said of a subject that has a name."""
    return [replace(one, subject=subject) if one.subject == FRAME else one for one in found]


def first_by_name(frames: Iterable[tuple[str, Iterable[Finding]]]) -> list[Finding]:
    """What was found of frames, by their names: each code once, of the first of them.

    >>> clipped = finding(Code.FRAME_CLIPPED, FRAME, share=0.02)
    >>> [str(one.subject) for one in first_by_name([("7", [clipped]), ("8", [clipped])])]
    ['frame 7']
    """
    first: dict[tuple[Code, str], Finding] = {}
    for name, found in frames:
        for one in of_subject(found, Subject("frame", name)):
            first.setdefault((one.code, one.subject.kind), one)
    return list(first.values())
