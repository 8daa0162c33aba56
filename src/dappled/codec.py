"""Convert records to plain values, as JSON and TOML hold them, and back, by the types of their fields.

A dataclass is a table of its fields, a tuple a list, an enum its value (an `IntEnum` its name in lower case), a path
text. An unknown value is None. Reading takes nothing else than the record's own form: the first thing that is wrong is
one clause with its place, what it must be and what it is.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from os import PathLike
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

Record = TypeVar("Record")
_MOST_SHOWN = 80  # characters of a value


class CodecError(ValueError):
    """A value is not what its record holds. `place` is made of keys and numbers: "fits[2].lattice.ky"."""

    def __init__(self, problem: str, place: str = "") -> None:
        super().__init__(f"{place} {problem}" if place else problem)
        self.problem, self.place = problem, place

    def under(self, key: str | int) -> CodecError:
        """The same one level up."""
        outer = f"[{key}]" if isinstance(key, int) else key if key.isidentifier() else shown(key)
        dot = "." if self.place and not self.place.startswith("[") else ""
        return CodecError(self.problem, f"{outer}{dot}{self.place}")


class _Reader(NamedTuple):
    read: Callable[[Any], Any]
    words: str  # of what it takes


def plain(value: Any) -> Any:
    """A record, or anything that holds records, as JSON holds it."""
    if value is None or type(value) in (str, int, float, bool):
        return value
    if isinstance(value, Enum):
        return value.name.lower() if isinstance(value, int) else value.value
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return str(value) if isinstance(value, PathLike) else value


def table(value: Any) -> Any:
    """The same as TOML holds it, which has no null: unknown values are left out."""
    return _known(plain(value))


def canonical(value: Any) -> bytes:
    """Equal values as equal bytes: JSON, sorted keys, no spaces, shortest round-trip floats.

    Raises ValueError for NaN and infinities.
    """
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def read(kind: type[Record], value: Any) -> Record:
    """The record that `plain` or `table` made these values of. Raises CodecError."""
    try:
        made: Record = _reader(kind).read(value)  # type: ignore[arg-type]  # types are hashable
    except RecursionError:
        raise CodecError("it is nested too deep") from None
    return made


def read_json(kind: type[Record], text: str | bytes) -> Record:
    """The record in a JSON text. Raises CodecError."""
    try:
        value = json.loads(text)
    except (ValueError, TypeError, RecursionError) as error:  # a ledger's column may hold what is no text
        raise CodecError(f"it is not JSON: {error}") from None
    return read(kind, value)


def hint(key: str, known: Iterable[str]) -> str:
    """The known key that is next to an unknown one, or all of them."""
    names = list(known)
    near = nearest(key, names)
    return f"did you mean {near!r}?" if near else f"known: {', '.join(names)}"


def nearest(word: str, known: Iterable[str], likeness: float = 0.4) -> str:
    """The known word that is next to an unknown one; "" where none is so like it (0 to 1)."""
    import difflib  # noqa: PLC0415  # a start without a mistake doesn't need it

    return next(iter(difflib.get_close_matches(word, list(known), 1, likeness)), "")


def shown(value: Any) -> str:
    """A value as a sentence shows it: a long one is cut."""
    text = repr(value) if not isinstance(value, int) or value.bit_length() < 300 else "a very large number"
    return text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 1]}…"


def _known(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _known(one) for name, one in value.items() if one is not None}
    return [_known(one) for one in value if one is not None] if isinstance(value, list) else value


@cache
def _reader(kind: Any) -> _Reader:  # noqa: PLR0911  one line a kind
    """How values of a type are read. Raises TypeError for one that no record may have."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind in _PLAIN:
        return _PLAIN[kind]
    if origin in (Union, types.UnionType):
        return _union(inner)
    if origin is Literal:
        return _choice({one: one for one in inner})
    if origin is tuple:
        return _tuple(inner)
    if origin in (list, Sequence):
        return _Reader(lambda value: [*_many(_reader(inner[0]), value)], "a list")
    if origin in (dict, Mapping):
        return _Reader(lambda value: _mapping(_reader(inner[1]), value), "a table")
    if is_dataclass(kind):
        return _record(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _choice({plain(one): one for one in kind})
    raise TypeError(f"{kind!r} is no type of a record's field")


def _refused(value: Any, what: str) -> CodecError:
    return CodecError(f"must be {what}, not {shown(value)}")


def _scalar(kind: type, what: str) -> _Reader:
    def take(value: Any) -> Any:
        if type(value) is not kind:
            raise _refused(value, what)
        return value

    return _Reader(take, what)


def _float(value: Any) -> float:
    if type(value) not in (int, float):
        raise _refused(value, "a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise _refused(value, "a finite number")
    return number


def _choice(known: Mapping[Any, Any]) -> _Reader:
    """One of some words or numbers; 1 and 1.0 are not True."""
    what = f"one of {', '.join(map(str, known))}" if len(known) <= 12 else "one of the known words"

    def take(value: Any) -> Any:
        if not isinstance(value, str | int) or value not in known or isinstance(value, bool):
            raise _refused(value, what)
        return known[value]

    return _Reader(take, what)


def _union(kinds: Sequence[Any]) -> _Reader:
    readers = [_reader(one) for one in kinds if one is not type(None)]
    nullable, what = type(None) in kinds, " or ".join(one.words for one in readers)

    def take(value: Any) -> Any:
        if nullable and value is None:
            return None
        if len(readers) == 1:
            return readers[0].read(value)
        for one in readers:
            try:
                return one.read(value)
            except CodecError:
                continue
        raise _refused(value, what)

    return _Reader(take, what)


def _many(reader: _Reader, value: Any) -> Iterable[Any]:
    if not isinstance(value, list | tuple):
        raise _refused(value, "a list")
    for number, one in enumerate(value):
        try:
            yield reader.read(one)
        except CodecError as error:
            raise error.under(number) from None


def _tuple(inner: tuple[Any, ...]) -> _Reader:
    if inner[-1] is Ellipsis:
        return _Reader(lambda value: tuple(_many(_reader(inner[0]), value)), "a list")
    readers, what = [_reader(one) for one in inner], f"a list of {len(inner)} values"

    def take(value: Any) -> Any:
        if not isinstance(value, list | tuple) or len(value) != len(readers):
            raise _refused(value, what)
        made = []
        for number, (reader, one) in enumerate(zip(readers, value, strict=True)):
            try:
                made.append(reader.read(one))
            except CodecError as error:
                raise error.under(number) from None
        return tuple(made)

    return _Reader(take, what)


def _mapping(reader: _Reader, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise _refused(value, "a table")
    made = {}
    for key, one in value.items():
        try:
            made[key] = reader.read(one)
        except CodecError as error:
            raise error.under(str(key)) from None
    return made


def _record(kind: Any) -> _Reader:
    """A dataclass; its fields' readers are made when the first one is read, because it may hold its own kind."""
    needed = {one.name for one in fields(kind) if one.default is MISSING and one.default_factory is MISSING}

    @cache
    def readers() -> dict[str, Callable[[Any], Any]]:
        hints = get_type_hints(kind)
        return {one.name: _reader(hints[one.name]).read for one in fields(kind)}

    def take(value: Any) -> Any:
        if not isinstance(value, Mapping):
            raise _refused(value, "a table")
        known, made = readers(), {}
        for name, one in value.items():
            if name not in known:
                raise CodecError(f"is not a known key; {hint(str(name), known)}").under(str(name))
            try:
                made[name] = known[name](one)
            except CodecError as error:
                raise error.under(name) from None
        for name in sorted(needed - made.keys()):
            raise CodecError("is missing", name)
        try:
            return kind(**made)
        except (TypeError, ValueError) as error:
            raise CodecError(str(error)) from None

    return _Reader(take, "a table")


_PLAIN = {
    Any: _Reader(lambda value: value, "anything"),
    str: _scalar(str, "text"),
    int: _scalar(int, "a whole number"),
    bool: _scalar(bool, "true or false"),
    float: _Reader(_float, "a number"),
}
