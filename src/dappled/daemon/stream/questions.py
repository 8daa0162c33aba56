"""Questions about recorded frames, as they come over the wire."""

from __future__ import annotations

import json
from typing import Any

from dappled.daemon.stream.wire import WireError

KEPT = ("get", "frame", "seq", "flight")
FLIGHT_CHARACTERS = 200


def parse(payload: list[bytes]) -> dict[str, Any]:
    """One JSON object with `get` and, unless it asks for the start, `frame` or `seq`. Raises WireError.

    Only what a question can hold is kept of it, as the answer's header repeats it.
    """
    try:
        request = json.loads(payload[0], parse_constant=_no_number) if len(payload) == 1 else None
    except (ValueError, RecursionError):
        request = None
    topics = ("start", "frame", "slices")
    if not isinstance(request, dict):
        raise WireError('a question is one JSON object such as {"get": "slices", "frame": 42}')
    if request.get("get") not in topics:
        raise WireError(f'a question\'s "get" is one of {", ".join(topics)}')
    if request["get"] != "start":
        number = request.get("frame", request.get("seq"))
        if not isinstance(number, int) or isinstance(number, bool) or number < 0:
            raise WireError("a question names a frame (or, for slices, a seq) by a whole number from 0")
    flight = request.get("flight")
    if flight is not None and not (isinstance(flight, str) and len(flight) <= FLIGHT_CHARACTERS):
        raise WireError("a question's flight is a name")
    return {name: request[name] for name in KEPT if name in request}


def _no_number(text: str) -> object:
    raise ValueError(text)
