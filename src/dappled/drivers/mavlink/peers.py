"""Who is at the other end of a UDP port, and what each one is sent: nothing before it has shown who it is.

A peer is *unproven* until a packet of it says something, and costs nothing: its bytes are read and forgotten. It is
*heard* when a packet of it is rightly signed, but is no new one (a clock that is behind, a copy that another link
brought first): it is sent at most as many bytes as it sent, so that a station whose clock is behind learns the time.
It is *proven* by a new packet that is obeyed, and is sent everything: for a minute where the packet was signed, else
for 5 s. At most 16 peers of a port are proven; one that was heard in the last 5 s is never displaced, and a silent one
only by who signs: a script's calls have a port each. Without a signature the last four are for hosts that have none.
Whoever finds no place is only heard: it gets the answer to what it asks, and not what is sent to all. Of those that
are only heard the newest are kept.
Over a serial line the one at the other end can't be another one; a TCP server with a key serves who has proven itself
(`TcpServer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

Source: TypeAlias = tuple[str, int]
Shown = Literal["signed", "sound", "old"]
"""What a packet has shown of its sender: obeyed with a signature, obeyed without one, or rightly signed and not new."""

MOST = 16
_FOR_OTHER_HOSTS = 4
_PROVEN_NS: dict[Shown, int] = {"signed": 60 * 10**9, "sound": 5 * 10**9}
_HEARD_NS = _LIVING_NS = 5 * 10**9
CREDIT_BYTES = 280  # one packet


@dataclass(slots=True)
class Peer:
    """An address of which something was heard. `credit` is how many bytes it may be sent while it is not proven."""

    until_ns: int
    credit: int = 0
    heard_ns: int = 0


class Peers:
    """The peers of one port. Times are monotonic."""

    def __init__(self) -> None:
        self._proven: dict[Source, Peer] = {}
        self._heard: dict[Source, Peer] = {}

    def is_proven(self, source: Source, now_ns: int) -> bool:
        """Whether this address is sent everything."""
        peer = self._proven.get(source)
        return peer is not None and now_ns < peer.until_ns

    def shown(self, source: Source, size: int, evidence: Shown, now_ns: int) -> None:
        """A packet in a datagram of so many bytes was judged."""
        if evidence == "old":
            self._hear(source, size, now_ns)
            return
        until_ns = now_ns + _PROVEN_NS[evidence]
        peer = self._proven.get(source)
        if peer is not None:
            peer.until_ns, peer.heard_ns = max(peer.until_ns, until_ns), now_ns
            return
        if len(self._proven) >= MOST:
            _forget_gone(self._proven, now_ns)
        if len(self._proven) >= MOST and evidence == "signed":
            longest = min(self._proven, key=lambda one: self._proven[one].heard_ns)
            if now_ns - self._proven[longest].heard_ns > _LIVING_NS:
                del self._proven[longest]
        crowded = len(self._proven) >= MOST - _FOR_OTHER_HOSTS and evidence == "sound"
        if len(self._proven) >= MOST or (crowded and any(host == source[0] for host, _ in self._proven)):
            self._hear(source, size, now_ns)  # it is answered, whoever fills the port
            return
        self._proven[source] = Peer(until_ns, heard_ns=now_ns)
        self._heard.pop(source, None)

    def receivers(self, size: int, now_ns: int) -> list[Source]:
        """Whom to send a packet of so many bytes; those that are only heard pay for it."""
        _forget_gone(self._proven, now_ns)
        paying = []
        for source, peer in self._heard.items():
            if now_ns < peer.until_ns and size <= peer.credit:
                peer.credit -= size
                paying.append(source)
        return [*self._proven, *paying]

    def _hear(self, source: Source, size: int, now_ns: int) -> None:
        if source in self._proven:
            return
        if source not in self._heard and len(self._heard) >= MOST:
            _forget_gone(self._heard, now_ns)
            if len(self._heard) >= MOST:  # the newest waits for an answer
                del self._heard[min(self._heard, key=lambda one: self._heard[one].until_ns)]
        peer = self._heard.setdefault(source, Peer(0))
        peer.until_ns, peer.credit = now_ns + _HEARD_NS, min(peer.credit + size, CREDIT_BYTES)


class OnePeer:
    """The part of a `ByteChannel` where one alone can be at the other end, and nothing waits to be written."""

    @property
    def origin(self) -> int:
        return 0

    def ask_proof(self) -> None:
        return

    def shown(self, evidence: Shown) -> None:
        return

    def source(self) -> str:
        return ""

    def wants_write(self) -> bool:
        return False

    def flush(self) -> None:
        return


def _forget_gone(peers: dict[Source, Peer], now_ns: int) -> None:
    for source in [source for source, peer in peers.items() if peer.until_ns <= now_ns]:
        del peers[source]
