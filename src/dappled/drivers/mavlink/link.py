"""One MAVLink link: what is known of it, how it packs, and what is counted."""

from __future__ import annotations

from dataclasses import dataclass

from dappled.drivers.mavlink.address import Address
from dappled.drivers.mavlink.channel import Channel
from dappled.drivers.mavlink.framing import Message, mavlink, pack
from dappled.drivers.mavlink.signing import Guard, SigningStatistics


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, in or (`sent`) out. `number` is its place in the telemetry log, None if it could not be logged.

    `trusted`: False for an unsigned packet on a signed link that may be heard, but not obeyed.
    """

    number: int | None
    stamp_us: int
    link: int
    message: Message
    raw: bytes
    sent: bool = False
    trusted: bool = True


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """What went over a link so far. `error` says why it is down, None when it is up; `signing` is None without a key.

    `packets_in` counts what was taken; packets that signing refused stand in `signing` alone, and in no log.
    """

    url: str
    packets_in: int
    packets_out: int
    packets_bad: int
    packets_unsent: int
    packets_unlogged: int
    failures: int
    last_heard_monotonic_ns: int | None
    error: str | None
    signing: SigningStatistics | None = None


class Link:
    """One link's state; its receiving thread and, under the order lock, the senders write it."""

    def __init__(self, number: int, address: Address, guard: Guard | None) -> None:
        self.number = number
        self.address = address
        self.guard = guard
        self.channel: Channel | None = None
        self.error: str | None = None
        self.packer = mavlink.MAVLink(None)
        self.heard_1 = self.heard_2 = False
        self.packets_in = self.packets_out = self.packets_bad = 0
        self.packets_unsent = self.packets_unlogged = self.failures = 0
        self.last_heard_monotonic_ns: int | None = None

    def packed(self, message: Message, system_id: int, component_id: int) -> bytes:
        """A message as bytes from this component: signed where there is a key, else in the version that is heard."""
        self.packer.srcSystem, self.packer.srcComponent = system_id, component_id
        if self.guard is None:
            return pack(message, self.packer, version_1=self.heard_1 and not self.heard_2)
        return self.guard.sign(lambda: pack(message, self.packer, version_1=False), self.packer)

    def fail(self, problem: object) -> None:
        """The channel is broken: the receiving thread makes it anew."""
        self.error = f"MAVLink link {self.address.url}: {problem}"

    def close(self) -> None:
        """Close the channel, where there is one. Under the order lock."""
        channel, self.channel = self.channel, None
        if channel is not None:
            channel.close()

    def statistics(self) -> LinkStatistics:
        """What went over it so far."""
        return LinkStatistics(
            self.address.url,
            self.packets_in,
            self.packets_out,
            self.packets_bad,
            self.packets_unsent,
            self.packets_unlogged,
            self.failures,
            self.last_heard_monotonic_ns,
            self.error,
            self.guard.statistics() if self.guard else None,
        )
