"""Limit the connections of browsers in time and number, also those that send no request or read no answer."""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import Any, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from dappled.findings import Code, Subject, finding
from dappled.refusals import RefusalLog

CONNECTIONS = 64  # with more, an idle one is closed
BACKLOG = 32  # asyncio accepts so many at once, before the limits below see any of them
PER_ADDRESS = 24  # a browser opens at most six; some machines have a few pages open, and a virtual globe
REQUEST_S = 10.0  # from the connection, or the last answer, to a whole request
UNREAD_S = 30.0  # for a page that does not read
_USER_TIMEOUT_MS = 20_000  # for a peer that has vanished, such as a phone out of the Wi-Fi's range


class Connection(H11Protocol):
    """uvicorn's connection with limits: time for a request, time for a reader, and connections for one address.

    Where there are too many, the oldest idle one is closed, so that idle ones can't keep others out.
    """

    request_s = REQUEST_S
    unread_s = UNREAD_S
    refusals = RefusalLog(logging.getLogger(__name__))
    _waiting: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None
    _number = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's own
        super().connection_made(transport)
        self._number = 1 + max((one._number for one in self._others()), default=0)
        given = transport.get_extra_info("socket")
        if given is not None and given.family in (socket.AF_INET, socket.AF_INET6):
            given.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        self._expect()
        neighbours = [one for one in self._others() if one._address() == self._address()]
        if len(neighbours) >= PER_ADDRESS and not _end_oldest_idle(neighbours):
            self._end()
        elif len(self.connections) >= CONNECTIONS:
            _end_oldest_idle(self._others())

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._expect()

    def pause_writing(self) -> None:
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(self.unread_s, self._cut)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def send_400_response(self, msg: str) -> None:
        self._refused(Code.PEER_NOT_HTTP)
        super().send_400_response(msg)

    def _unsupported_upgrade_warning(self) -> None:
        self._refused(Code.PEER_OTHER_PROTOCOL)

    def _refused(self, code: Code) -> None:
        self.refusals.refused(finding(code, Subject("peer", str(self._address() or "a console's peer"))))

    @property
    def idle(self) -> bool:
        """Whether no complete request waits for its answer."""
        return self.conn.their_state in (h11.IDLE, h11.SEND_BODY)

    def _expect(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
        self._waiting = self.loop.call_later(self.request_s, self._late)

    def _late(self) -> None:
        if self.idle:
            self._end()

    def _end(self) -> None:
        """Close in order: a browser that kept the connection notices, and opens another."""
        self._forget()
        self.connections.discard(self)
        self.transport.close()

    def _cut(self) -> None:
        """Abort, with the data that was not read."""
        self._end()
        self.transport.abort()

    def _forget(self) -> None:
        for timer in (self._waiting, self._unread):
            if timer is not None:
                timer.cancel()
        self._waiting = self._unread = None

    def _others(self) -> list[Connection]:
        return [cast("Connection", one) for one in self.connections if one is not self]

    def _address(self) -> Any:
        return self.client[0] if self.client else None


def _end_oldest_idle(among: list[Connection]) -> bool:
    oldest = min((one for one in among if one.idle), key=lambda one: one._number, default=None)
    if oldest is not None:
        oldest._end()
    return oldest is not None
