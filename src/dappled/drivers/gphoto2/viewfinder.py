"""Read pictures of the viewfinder between shots, in the camera's own process, and end live view before a shot.

libgphoto2 blocks while it reads one, so each picture is asked for, and none is read while a shot is at the camera.
"""

from __future__ import annotations

import os

from dappled.drivers.child_process import ProcessChannel
from dappled.drivers.gphoto2.protocol import BusyError, RefusedError, Session

BUSY = "live view is off while a shot is at the camera"
_ENDS_S = 3.0
_SEND_S = 5.0


class Viewfinder:
    """Live view of the open session. All calls raise ChannelError when the driver is gone, and LostError."""

    def __init__(self, channel: ProcessChannel) -> None:
        self._channel = channel
        self._asked = False
        self._on_until_ns: int | None = None  # None: live view is off

    def ask(self) -> None:
        """A picture is wanted; the next `turn` answers."""
        self._asked = True

    def refuse(self, reason: str) -> None:
        """Say why there is no picture, if one was asked for."""
        if self._asked:
            self._asked = False
            self._channel.send({"is": "live", "refused": reason}, timeout_s=_SEND_S)

    def turn(self, session: Session, now_ns: int) -> None:
        """Read a picture if one was asked for; end live view when none was for 3 s."""
        if self._asked:
            self._read(session, now_ns)
        elif self._on_until_ns is not None and now_ns >= self._on_until_ns:
            self.end(session)

    def end(self, session: Session) -> None:
        """End live view, where it is on: a shot comes first."""
        self.refuse(BUSY)
        if self._on_until_ns is not None:
            self._on_until_ns = None
            session.end_preview()

    def lost(self, reason: str) -> None:
        """The session is gone, and live view with it."""
        self._on_until_ns = None
        self.refuse(reason)

    def _read(self, session: Session, now_ns: int) -> None:
        try:
            picture = session.preview()
        except (BusyError, RefusedError) as error:
            self.refuse(str(error))
            return
        self._asked, self._on_until_ns = False, now_ns + round(_ENDS_S * 1e9)
        try:
            self._channel.send({"is": "live", "size": picture.size}, (picture.fd,), timeout_s=_SEND_S)
        finally:
            os.close(picture.fd)
