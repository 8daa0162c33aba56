"""Any bytes are a question, or a sentence."""

from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.stream import questions, wire
from dappled.daemon.stream.wire import WireError


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
        request = questions.parse([data])
    except WireError:
        return
    assert request["get"] in ("start", "frame", "slices")
    asked = json.loads(data)
    assert request == {name: asked[name] for name in questions.KEPT if name in asked}
    wire.encode(request)  # as the answer's header repeats it
