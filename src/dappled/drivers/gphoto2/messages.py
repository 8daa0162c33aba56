"""Encode camera events as messages between the driver and its process, and what a dead process leaves to the next.

Both processes import this; it does not load libgphoto2.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

from dappled import codec
from dappled.drivers.attribution import Claim
from dappled.drivers.camera import (
    Arrival,
    BodyState,
    CameraEvent,
    Companion,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.child_process import ChannelError, ChannelMessage, MessageSizeError, ProcessChannel
from dappled.drivers.gphoto2.protocol import CameraFile

LATE_LIMIT = 16
"""How many late shots are remembered."""
SEEN_LIMIT = 512
"""How many files a dead process' successor is told of: all of them are one argument of its command line."""
_SEND_S = 5.0
CUT_OFF = "cut off"


SeenFile = tuple[str, str, int, int | None, str | None]
_KIND = "is"  # beside an event's own values
_EVENTS: Mapping[str, type[CameraEvent]] = {one.__name__: one for one in get_args(CameraEvent)}


@dataclass(frozen=True, slots=True)
class Carryover:
    """What a process that died leaves to the next: the body's serial number, the shots that were fired and have no file
    yet, the offsets of the body's clock, and folder, name, size, time and hash of the files that came last.
    Pictures made after `since_ns` (monotonic; None: unknown) are among these, or were not brought. `cut_off`: folder
    and name of those that were announced, and not brought when the link broke."""

    serial: str | None = None
    late: tuple[Claim, ...] = ()
    offsets_s: tuple[float, ...] = ()
    seen: tuple[SeenFile, ...] = ()
    since_ns: int | None = None
    cut_off: tuple[tuple[str, str], ...] = ()

    def cut(self, body: Mapping[str, Any]) -> Carryover:
        """After the process' word on what was cut off."""
        return replace(self, cut_off=tuple((folder, name) for folder, name in body["files"]))

    def heard(self, event: CameraEvent) -> Carryover:
        """After an event of the process. Another body has another clock and other files."""
        if isinstance(event, StateChanged) and event.identity is not None and event.identity.serial != self.serial:
            return Carryover(
                event.identity.serial, self.late if self.serial is None else (), since_ns=event.monotonic_ns
            )
        if not isinstance(event, Arrival | Companion):
            return self
        facts = event.facts
        named = (str(facts.get("folder")), str(facts.get("name")))
        file = (*named, event.blob.size, facts.get("taken_s"), event.blob.sha256)
        return replace(
            self,
            late=tuple(claim for claim in self.late if claim.shot != event.shot),
            offsets_s=tuple(facts.get("body_offsets_s", self.offsets_s)),
            seen=(*self.seen, file)[-SEEN_LIMIT:],
            since_ns=event.monotonic_ns if len(self.seen) == SEEN_LIMIT else self.since_ns,
        )

    def died(self, fired: Iterable[Claim]) -> Carryover:
        """After the end of the process, which had fired these shots and brought no file of them."""
        return replace(self, late=(*self.late, *fired)[-LATE_LIMIT:])


class EventSender:
    """Send events to the driver, and each state once. All calls raise ChannelError when the driver is gone."""

    def __init__(self, channel: ProcessChannel) -> None:
        self._channel = channel
        self.state: BodyState | None = None
        self.reason = ""

    def send(self, *events: CameraEvent) -> None:
        """Send events in order and close their blobs; skip a state that was sent last.

        A file whose event is too long for a message fails its shot alone.
        """
        for event in events:
            if isinstance(event, StateChanged):
                if (event.state, event.reason) == (self.state, self.reason):
                    continue
                self.state, self.reason = event.state, event.reason
            message = event_message(event)
            try:
                self._channel.send(message.body, message.fds, timeout_s=_SEND_S)
            except MessageSizeError as error:
                self._channel.send(event_message(_instead(event, error)).body, timeout_s=_SEND_S)
            finally:
                for fd in message.fds:
                    os.close(fd)

    def cut_off(self, files: Iterable[CameraFile]) -> None:
        """Say which files were announced and not brought: all of them each time."""
        self._channel.send({"is": CUT_OFF, "files": [(file.folder, file.name) for file in files]}, timeout_s=_SEND_S)

    def pong(self) -> None:
        """Say that this process lives: the answer to a ping, and whenever bytes of a file have come."""
        self._channel.send({"is": "pong"}, timeout_s=_SEND_S)


def _instead(event: CameraEvent, error: MessageSizeError) -> CameraEvent:
    """What is reported instead of an event that is too long. Raises `error` where there is nothing to report."""
    match event:
        case SettingsChanged(_, at_ns):
            return SettingsChanged((), at_ns, f"the camera's settings can't be reported: {error}")
        case Arrival(int(shot), _, _, at_ns):
            return ShotFailed(shot, f"its file can't be reported: {error}", at_ns)
        case _:
            raise error


def event_message(event: CameraEvent) -> ChannelMessage:
    """Encode an event; a file's blob is the message's only descriptor, which the caller still owns."""
    fds = (event.blob.fd,) if isinstance(event, Arrival | Companion) else ()
    return ChannelMessage({_KIND: type(event).__name__, **codec.plain(event)}, fds)


def lost_file(message: ChannelMessage) -> tuple[int | None, str]:
    """For a message whose file could not be received: the shot that fails with it, and a sentence.

    The shot is None where none is known, and for a companion, whose frame is safe. Raises ChannelError.
    """
    try:
        body = message.body
        folder, name = body["facts"].get("folder"), body["facts"].get("name")
        stays = "" if folder in (None, "/") else f"; it stays on the card as {folder}/{name}"
        reason = f"{body['name']} could not be received: {message.lost}{stays}"
        return body["shot"] if body[_KIND] == Arrival.__name__ else None, reason
    except (KeyError, AttributeError) as error:
        raise ChannelError(f"a message could not be understood: {error!r}") from error


def message_event(message: ChannelMessage) -> CameraEvent:
    """Decode an event. Raises ChannelError for anything else, and closes the message's descriptors then."""
    try:
        values = dict(message.body)
        kind = _EVENTS[values.pop(_KIND)]
        if "blob" in values:
            (fd,) = message.fds
            values["blob"] |= {"fd": fd}
        return codec.read(kind, values)
    except (KeyError, TypeError, ValueError) as error:
        for fd in message.fds:
            os.close(fd)
        raise ChannelError(f"a message could not be understood: {error!r}") from error
