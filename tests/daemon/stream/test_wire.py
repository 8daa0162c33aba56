"""Messages from strangers: either they are understood, or one sentence says that they are not."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.stream import wire
from dappled.daemon.stream.wire import Message, WireError

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
ENTRIES = st.fixed_dictionaries(
    {},
    optional={
        "name": st.just("slices") | JSON,
        "dtype": st.sampled_from(["<c8", "<f4", "|u1", "O", "nonsense", "V0"]) | st.integers(),
        "shape": st.lists(st.integers(-3, 4) | st.just(2**70), max_size=3) | JSON,
    },
)


@given(st.lists(st.binary(max_size=30) | JSON.map(lambda value: json.dumps(value).encode()), max_size=4))
def test_any_parts_are_a_message_or_a_sentence(parts: list[bytes]) -> None:
    with contextlib.suppress(WireError):
        assert isinstance(wire.decode(parts).header, dict)


@pytest.mark.parametrize("header", [b"[" * 200_000, b'{"seq": 1' + b"0" * 5000 + b"}", b"\xff", b"[]", b""])
def test_a_header_that_no_parser_likes_is_told_in_a_sentence(header: bytes) -> None:
    with pytest.raises(WireError, match="not a dappled message"):
        wire.decode([b"slices", header])


@given(st.lists(ENTRIES, max_size=3) | JSON, st.binary(max_size=40))
def test_any_arrays_are_those_of_the_body_or_a_sentence(entries: object, body: bytes) -> None:
    with contextlib.suppress(WireError):
        found = Message("slices", {"arrays": entries}, body).arrays()
        assert sum(array.nbytes for array in found.values()) <= len(body)


def test_arrays_come_back_as_they_were_described() -> None:
    a, b = np.arange(6, dtype=np.float32).reshape(2, 3), np.array([1 + 2j], dtype=np.complex64)
    entries = [wire.describe_array("a", a, "px"), wire.describe_array("b", b, "1")]
    found = Message("slices", {"arrays": entries}, a.tobytes() + b.tobytes()).arrays()
    assert (found["a"] == a).all()
    assert (found["b"] == b).all()
    with pytest.raises(WireError, match="ends inside array 'b'"):
        Message("slices", {"arrays": entries}, a.tobytes()).arrays()


@pytest.mark.parametrize(
    "question",
    [
        '{"get": "slices", "frame": ' + "9" * 26 + "}",
        '{"get": "slices", "frame": ' + "9" * 5000 + "}",
        '{"get": "slices", "frame": 2147483648}',
        '{"get": "slices", "frame": 1, "seq": ' + "[" * 500 + "]" * 500 + "}",
        '{"get": "slices", "frame": 1, "seq": [[1]]}',
        '{"get": "slices", "seq": true}',
        "[" * 100_000,
        '{"get": "start", "flight": "' + "a" * 5000 + '"}',
    ],
)
def test_a_question_beyond_the_limits_is_refused(question: str) -> None:
    with pytest.raises(WireError, match="a question"):
        wire.parse_question([question.encode()])


@pytest.mark.parametrize("dtype", ["O", "V0", "V99999999999", "(2,)f4", "f4,f8", "U9", "<c8" * 9999, 5, None])
@pytest.mark.parametrize("shape", [[1], [10**12], [2**63], [-1], "12", 7])
def test_arrays_that_claim_what_is_not_there(dtype: object, shape: object) -> None:
    for entry in ({"name": "a", "dtype": dtype, "shape": [1]}, {"name": "a", "dtype": "<f4", "shape": shape}):
        if entry["dtype"] == "<f4" and shape == [1]:
            continue
        with pytest.raises(WireError, match=r"don't match their description|ends inside array"):
            Message("slices", {"arrays": [entry]}, bytes(100)).arrays()


@given(
    st.binary(max_size=200)
    | st.builds(
        lambda value: json.dumps(value).encode(),
        st.recursive(
            st.none()
            | st.floats()
            | st.booleans()
            | st.integers()
            | st.sampled_from(["start", "frame", "slices", "get"]),
            lambda inner: (
                st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["get", "frame", "seq"]), inner)
            ),
        ),
    )
)
def test_any_question_is_understood_or_refused(data: bytes) -> None:
    try:
        request = wire.parse_question([data])
    except WireError:
        return
    assert request["get"] in ("start", "frame", "slices")
    asked = json.loads(data)
    assert request == {name: asked[name] for name in wire.QUESTION_KEYS if name in asked}
    wire.encode(request)  # as the answer's header repeats it
