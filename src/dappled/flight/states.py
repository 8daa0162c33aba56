"""The life of a shot, as a table.

wished → fired → safe | failed. A file is proof of an exposure: it makes a shot safe even when nobody saw it fire, and
even when it had been given up. What is safe stays safe.
"""

from __future__ import annotations

from dappled.flight.errors import FlightError
from dappled.flight.records import ShotState

TRANSITIONS: dict[ShotState, frozenset[ShotState]] = {
    "wished": frozenset({"fired", "safe", "failed"}),
    "fired": frozenset({"safe", "failed"}),
    "failed": frozenset({"safe"}),
    "safe": frozenset(),
}


class IllegalTransitionError(FlightError):
    """A shot was asked to go where it can't."""


def advance(index: int, old: ShotState, new: ShotState) -> ShotState:
    """`new`, when a shot may go there from `old`. Raises IllegalTransitionError."""
    if new not in TRANSITIONS[old]:
        raise IllegalTransitionError(f"shot {index} is {old}: it can't become {new}")
    return new
