"""What the loop of the camera's process tells its parent: events, each state once, the end of each shot."""

from __future__ import annotations

from collections.abc import Callable

from dappled.drivers.attribution import Claim
from dappled.drivers.camera import BodyState, CameraEvent, ShotFailed, StateChanged
from dappled.drivers.gphoto2.messages import event_message
from dappled.drivers.gphoto2.state import Books
from dappled.drivers.process_channel import ProcessChannel

SEND_S = 5.0


class Telling:
    """Events to the parent, and their notes in the books. All raise ChannelError when the parent is gone."""

    def __init__(self, channel: ProcessChannel, books: Books, clock_ns: Callable[[], int]) -> None:
        self._channel, self._books, self._clock_ns = channel, books, clock_ns

    def tell(self, event: CameraEvent) -> None:
        """As it is."""
        message = event_message(event)
        self._channel.send(message.body, message.fds, timeout_s=SEND_S)

    def state(self, state: BodyState, reason: str = "") -> None:
        """The camera's state, where it is another one than was told last."""
        books = self._books
        if books.state == (state, reason):
            return
        books.state = (state, reason)
        identity = books.session.identity if books.session is not None else None
        self.tell(StateChanged(state, reason, self._clock_ns(), identity))

    def failed(self, shot: int, reason: str) -> None:
        """A shot brings no file."""
        self.tell(ShotFailed(shot, reason, self._clock_ns()))

    def flight_failed(self, reason: str, *, may_come: bool = False) -> None:
        """The shot at the camera brings no file; `may_come`: its file may still come."""
        flight, self._books.flight = self._books.flight, None
        if flight is not None:
            if may_come and flight.fired_ns is not None:
                self._books.late.append(Claim(flight.shot, flight.fired_ns))
            self.failed(flight.shot, reason)
