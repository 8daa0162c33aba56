"""Parse JSON and TOML that others wrote: limits of size, nesting and digits hold before Python's parsers see the text.

Without them 100 000 brackets end in a RecursionError, and a number of 5 000 digits in a sentence about the interpreter.
"""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sized
from pathlib import Path
from typing import Any, NoReturn

from dappled import durable
from dappled.bounds.claims import ClaimError, check_size, in_words

MOST_BYTES = 4 << 20
"""Of one text. Python's objects take up to forty times as much."""
MOST_DEPTH = 64
_MOST_BRACKETS = 100_000
_LEAST, _MOST = -(1 << 63), (1 << 63) - 1  # what TOML, SQLite and the wire's readers hold
_MOST_DIGITS = 20
_NAME_CHARACTERS = 1000  # of a TOML key

_JSON_TOKEN = re.compile(r'"(?:[^"\\]++|\\.)*+"?|([\[{])|([\]}])', re.DOTALL)
_TOML_TOKEN = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!""))*+(?:""")?'
    r"|'''(?:[^']++|'(?!''))*+(?:''')?"
    r'|"(?:[^"\\\n]++|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+"
    r"|([\[{])|([\]}])|(\.)|([=,\n])",
    re.DOTALL,
)


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a file of at most `most` bytes. Raises OSError, and ClaimError for a larger one."""
    with open(path, "rb", opener=durable.plain_file) as file:
        data = file.read(most + 1)
    _check_length(data, most)
    return data


def read_log(path: Path) -> bytes:
    """Read a file that is only appended to, of any length that its disk bears out: one with holes can claim any. Raises
    OSError, and ClaimError."""
    with open(path, "rb", opener=durable.plain_file) as file:
        check_stored(file.fileno())
        return file.read()


def stored_size(path: Path) -> int:
    """Return the bytes of a plain file that its disk bears out. Raises OSError and ClaimError like `read_log`."""
    with open(path, "rb", opener=durable.plain_file) as file:
        return check_stored(file.fileno())


def check_stored(fd: int) -> int:
    """Return the size of an open plain file, where its disk bears that out. Raises ClaimError, OSError."""
    size = os.fstat(fd).st_size
    check_size(size, durable.stored_bytes(fd), "content")
    return size


def parse_json(data: bytes | memoryview | str, most: int = MOST_BYTES) -> Any:
    """Parse JSON without NaN and infinities, whose whole numbers have 64 bits.

    Raises ValueError; ClaimError, which is one, where a limit is passed.
    """
    _check_length(data, most)
    if not isinstance(data, str):
        data = bytes(data)
        data = data.decode(json.detect_encoding(data))
    if _brackets(data) > MOST_DEPTH:
        _check_json_depth(data)
    return json.loads(data, parse_int=_integer, parse_float=_real, parse_constant=_constant)


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML whose whole numbers have 64 bits. Raises ValueError; ClaimError where a limit is passed."""
    _check_length(text, MOST_BYTES)
    _brackets(text)
    _check_toml_depth(text)
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except (ValueError, RecursionError):  # Python's own limit of digits
        raise ClaimError(f"it has a number of more than {_MOST_DIGITS} digits: correct it") from None
    for value in _values(tables):
        if isinstance(value, int) and not _LEAST <= value <= _MOST:
            raise ClaimError("it has a whole number beyond 64 bits: correct it")
    return tables


def _check_length(data: Sized, most: int) -> None:
    if len(data) > most:
        raise ClaimError(f"it is longer than {in_words(most)}, the most that is read: check what it holds")


def _brackets(text: str) -> int:
    """Count opening brackets. Raises ClaimError where there are too many: each is an object of Python's."""
    count = text.count("[") + text.count("{")
    if count > _MOST_BRACKETS:
        raise ClaimError(f"it has more than {_MOST_BRACKETS} brackets, the most that is read: check what it holds")
    return count


def _check_json_depth(text: str) -> None:
    depth = 0
    for token in _JSON_TOKEN.finditer(text):
        if token.lastindex == 1:
            depth += 1
            _check_depth(depth)
        elif token.lastindex == 2:
            depth -= 1


def _check_toml_depth(text: str) -> None:
    """Count brackets that are open, and the dots of one key: tomllib takes the square of their number as time."""
    depth = dots = 0
    for token in _TOML_TOKEN.finditer(text):
        kind = token.lastindex
        if kind in (1, 2):
            depth += 1 if kind == 1 else -1
        dots = dots + 1 if kind == 3 else 0 if kind == 4 else dots
        _check_depth(max(depth, dots))


def _check_depth(depth: int) -> None:
    if depth > MOST_DEPTH:
        raise ClaimError(f"it nests more than {MOST_DEPTH} deep, the most that is read: check what it holds")


def _integer(digits: str) -> int:
    if len(digits) > _MOST_DIGITS or not _LEAST <= (value := int(digits)) <= _MOST:
        raise ClaimError(f"it has a whole number beyond 64 bits ({len(digits)} digits): correct it")
    return value


def _real(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ClaimError("it has a number beyond what a float holds: correct it")
    return value


def _constant(name: str) -> NoReturn:
    raise ClaimError(f"it has {name}, which is not JSON: write null for an unknown value")


def _values(tables: Mapping[str, Any]) -> Iterator[Any]:
    """Yield all values that are neither tables nor lists. Raises ClaimError for a key that is too long."""
    waiting: list[Any] = [tables]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            if any(len(key) > _NAME_CHARACTERS for key in one):
                raise ClaimError(f"it has a key of more than {_NAME_CHARACTERS} characters: correct it")
            waiting.extend(one.values())
        elif isinstance(one, list):
            waiting.extend(one)
        else:
            yield one
