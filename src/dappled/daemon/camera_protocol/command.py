"""A command to the camera, and the answer to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.daemon.pipeline.shutter import ShotDecision
from dappled.drivers.mavlink.links import Message, mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT. Parameters may be NaN. `broadcast`: to all components."""

    name: int
    parameters: tuple[float, ...]
    confirmation: int
    system: int
    component: int
    link: int
    broadcast: bool

    @classmethod
    def of(cls, message: Message, link: int) -> Command:
        """What a COMMAND_LONG or COMMAND_INT says."""
        is_long = message.get_type() == "COMMAND_LONG"
        last = (message.param5, message.param6, message.param7) if is_long else (message.x, message.y, message.z)
        return cls(
            message.command,
            (message.param1, message.param2, message.param3, message.param4, *map(float, last)),
            message.confirmation if is_long else 0,
            message.get_srcSystem(),
            message.get_srcComponent(),
            link,
            message.target_component == 0,
        )

    def number(self, place: int, default: float = 0.0) -> float:
        """Parameter 1 to 7; the default for NaN and infinities."""
        value = self.parameters[place - 1]
        return value if math.isfinite(value) else default

    def whole(self, place: int, default: int = 0) -> int:
        """Parameter 1 to 7 as an integer; the default where it is not finite."""
        return round(self.number(place, float(default)))

    @property
    def source(self) -> str:
        """The sender, as causes name it."""
        return f"mavlink:{self.system}/{self.component}"


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a command, what is to be said after the acknowledgement, and words for the pilot."""

    result: int
    then: tuple[Message, ...] = ()
    words: str | None = None


def judged(decision: ShotDecision) -> Answer:
    """The answer to a wish: accepted means that it will be attempted."""
    if decision.accepted:
        return Answer(ACCEPTED)
    return Answer(REJECTED, words=f"no photo: {decision.reason}")
