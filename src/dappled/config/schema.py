"""Build typed, frozen records from TOML tables, with errors that name file, line, key and remedy."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from dappled import codec
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import parse_toml, read_bytes
from dappled.errors import DappledError

Record = TypeVar("Record")


class ConfigError(DappledError):
    """Settings or a profile are wrong: a sentence for each thing, on a line of its own, with the place, the value, and
    what to do."""

    exit_code = 2

    def __init__(self, *sentences: str, setting: str = "") -> None:
        super().__init__("\n".join(sentences), setting=setting)
        self._sentences = list(sentences)  # a name in one may hold a line break

    @property
    def sentences(self) -> list[str]:
        """One for each setting that is wrong."""
        return self._sentences


@dataclasses.dataclass(frozen=True, slots=True)
class BadSetting:
    """One thing that is wrong in a file: a sentence with the place, and the table and key that it is about."""

    table: str
    key: str
    text: str


def refuse(findings: Sequence[BadSetting]) -> None:
    """Raise ConfigError with all sentences where there are any."""
    if findings:
        raise ConfigError(*(finding.text for finding in findings))


@dataclasses.dataclass(frozen=True, slots=True)
class Rule:
    """A setting's meaning and the values it takes. `low` and `high` are inclusive."""

    text: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()


def setting(
    default: Any,
    text: str,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a dataclass field with its meaning and range."""
    return dataclasses.field(default=default, metadata={"rule": Rule(text, unit, low, high, choices)})


@dataclasses.dataclass(frozen=True, slots=True)
class TomlSource:
    """The file that a table was read from, for error sentences."""

    name: str
    text: str = ""

    def where(self, table: str, key: str) -> str:
        """The place of a key, as exactly as it is known: "flight.toml, line 7: [camera] port"."""
        line = self._line(table, key)
        place = f"{self.name}, line {line}" if line else self.name
        return f"{place}: [{table}] {key}" if table else f"{place}: {key}"

    def has(self, table: str, key: str) -> bool:
        """Whether the key stands in the file on a line of its own."""
        return self._line(table, key) is not None

    def _line(self, table: str, key: str) -> int | None:
        inside = ""
        for number, line in enumerate(self.text.splitlines(), 1):
            if header := re.match(r"\s*\[+\s*([^\]]+?)\s*\]+", line):
                inside = header[1]
                if not table and inside == key:
                    return number
            elif inside == table and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", line):
                return number
        return None


def read_toml(path: Path) -> tuple[dict[str, Any], TomlSource]:
    """Read a TOML file: its tables and its source. Raises ConfigError when it can't be read or isn't TOML."""
    try:
        words = read_bytes(path).decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror or error}") from None
    except ValueError as error:
        raise ConfigError(f"{path} can't be read: {error}") from None
    try:
        return parse_toml(words), TomlSource(str(path), words)
    except ClaimError as error:
        raise ConfigError(f"{path} can't be read: {error}") from None
    except ValueError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None


_hints = cache(get_type_hints)  # to evaluate them takes half of the time in which a profile is read


def build(cls: type[Record], table: Mapping[str, Any], source: TomlSource, name: str) -> Record:
    """Build the record `cls` from a table. Raises ConfigError, for an unknown key with the nearest known one."""
    record, findings = examine(cls, table, source, name)
    refuse(findings)
    return record


def examine(
    cls: type[Record], table: Mapping[str, Any], source: TomlSource, name: str
) -> tuple[Record, list[BadSetting]]:
    """Build the record `cls` from what is right in a table, and say what is wrong: there the default stands.

    Raises ConfigError where a key is missing that has no default.
    """
    hints = _hints(cls)  # type: ignore[arg-type]  # a class is hashable
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]  # cls is a dataclass
    findings = []
    for key in table:
        if key not in fields:
            text = f"{source.where(name, key)} is not a known key; {codec.hint(key, fields)}"
            findings.append(BadSetting(name, key, text))
    values = {}
    for key, field in fields.items():
        if key not in table:
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise ConfigError(f"{source.where(name, key)} is missing; it has no default")
            continue
        rule = field.metadata.get("rule", Rule(""))
        try:
            values[key] = _read(table[key], hints[key], rule, source.where(name, key))
        except ConfigError as error:
            findings.append(BadSetting(name, key, str(error)))
    return cls(**values), findings


def _read(value: Any, wanted: Any, rule: Rule, where: str) -> Any:
    """A setting's value; one that may be a list may stand alone. Raises ConfigError."""
    if not isinstance(value, list) and any(get_origin(one) is tuple for one in (wanted, *get_args(wanted))):
        value = [value]
    try:
        made = codec.read(wanted, value)
    except codec.CodecError as error:
        raise ConfigError(f"{where}{error}" if error.place.startswith("[") else f"{where} {error}") from None
    for one in made if isinstance(made, tuple) else (made,):
        if isinstance(one, int | float) and not isinstance(one, bool) and not rule.low <= one <= rule.high:
            unit = f" {rule.unit}" if rule.unit else ""
            raise ConfigError(f"{where} = {one} must lie between {rule.low:g} and {rule.high:g}{unit}")
        if rule.choices and one not in rule.choices:
            raise ConfigError(f"{where} = {codec.shown(one)} must be one of {', '.join(rule.choices)}")
    return made
