"""JSON and TOML that are small to send and dear to parse."""

from __future__ import annotations

import json
import time
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.bounds import parsing
from dappled.bounds.claims import ClaimError

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=40,
)  # fmt: skip


@given(ANYTHING)
def test_honest_json_comes_back(value: object) -> None:
    assert parsing.parse_json(json.dumps(value)) == value
    assert parsing.parse_json(json.dumps(value, ensure_ascii=False).encode("utf-16", "surrogatepass")) == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nests more than 64 deep"),
        ("[" * 65 + "]" * 65, "nests more than 64 deep"),
        ('{"a":' * 100_000, "nests more than 64 deep"),
        ("1" * 5000, "whole number beyond 64 bits"),
        (f"[{2**63}]", "whole number beyond 64 bits"),
        (f"[{-(2**63) - 1}]", "whole number beyond 64 bits"),
        ("1e999", "beyond what a float holds"),
        ("[" + "[]," * 100_000 + "[]]", "more than 100000 brackets"),
        ("[NaN]", "NaN, which is not JSON"),
        ("[-Infinity]", "-Infinity, which is not JSON"),
        ('"' + "a" * parsing.MOST_BYTES + '"', "longer than 4.19 MB"),
    ],
)
def test_json_beyond_the_limits_is_refused(text: str, words: str) -> None:
    for data in (text, text.encode()):
        with pytest.raises(ClaimError, match=words):
            parsing.parse_json(data)


def test_brackets_in_a_text_are_no_nesting() -> None:
    deep = "[" * 1000
    assert parsing.parse_json(json.dumps([deep, f'\\"{deep}'])) == [deep, f'\\"{deep}']
    assert parsing.parse_toml(f"a = '{deep}'  # {deep}\nb = \"\"\"\n{deep}\\\" \"\"\"\nc = '''{deep}'''") == {
        "a": deep, "b": f'{deep}" ', "c": deep,
    }  # fmt: skip
    assert parsing.parse_json("[" * 64 + "]" * 64) == json.loads("[" * 64 + "]" * 64)
    assert len(parsing.parse_json(json.dumps([[]] * 1000))) == 1000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 100_000, "nests more than 64 deep"),
        ("a = " + "{b=" * 100_000, "nests more than 64 deep"),
        ("a" + ".a" * 100_000 + " = 1", "nests more than 64 deep"),
        ("[a" + " . a" * 100_000 + "]", "nests more than 64 deep"),
        ("a = " + "1" * 5000, "more than 20 digits"),
        ("a = 0x" + "f" * 5000, "whole number beyond 64 bits"),
        ("a = [[9223372036854775808]]", "whole number beyond 64 bits"),
        ("a = [" + "{}," * 100_000 + "]", "more than 100000 brackets"),
        ("a" * 1001 + " = 1", "key of more than 1000 characters"),
        ("# " + "a" * parsing.MOST_BYTES, "longer than 4.19 MB"),
    ],
)
def test_toml_beyond_the_limits_is_refused(text: str, words: str) -> None:
    started = time.process_time()
    with pytest.raises(ClaimError, match=words):
        parsing.parse_toml(text)
    assert time.process_time() - started < 5  # dotted keys take tomllib the square of their number


def test_shipped_profiles_pass() -> None:
    for path in (Path(parsing.__file__).parents[1] / "config" / "profiles").rglob("*.toml"):
        text = path.read_text(encoding="utf-8")
        assert parsing.parse_toml(text) == tomllib.loads(text)


def test_no_more_of_a_file_is_read_than_allowed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(1001))
    with pytest.raises(ClaimError, match="longer than 1 kB"):
        parsing.read_bytes(tmp_path / "a", 1000)
    with pytest.raises(OSError, match="no plain file"):
        parsing.read_bytes(Path("/dev/zero"), 1000)
