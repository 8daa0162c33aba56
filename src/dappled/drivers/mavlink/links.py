"""Receive and send MAVLink packets on several links at once, and log each one before it is acted on."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from dappled.clock import Clock
from dappled.drivers.mavlink.channels import Address, ByteChannel, LinkError, MachineTransport, Transport, parse
from dappled.drivers.mavlink.framing import Framed, Framer, MavlinkMessage, is_signed, mavlink, pack
from dappled.drivers.mavlink.log_budget import LogBudget
from dappled.drivers.mavlink.signing import SignatureGuard, Signing, SigningStatistics
from dappled.findings import Finding
from dappled.workers import Loop, renice

log = logging.getLogger(__name__)
_REOPEN_S = 1.0
_FRAMERS = 8  # clients of a TCP server that are read in turn, and some that have gone
_STAMP_BYTES = 8  # before each packet in the telemetry log
_POLL_S = 0.2
_RETURNS_NS = 30 * 10**9  # a radio may hold packets for seconds
_NICENESS = -5  # of who receives, to the process' own: it acknowledges, and the unit allows it (LimitNICE)


# --- one packet


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, received or (`sent`) sent. `number` is its place in the telemetry log, None if it was not logged.

    `trusted`: False for an unsigned packet on a signed link, which may be heard but not obeyed. `exposed`: it came
    unsigned over a network, so anyone there may have sent it. `same_ids`: where a heartbeat of another
    component came from that has our own ids; "" for any other packet.
    """

    number: int | None
    stamp_us: int
    link: int
    message: MavlinkMessage
    raw: bytes
    sent: bool = False
    trusted: bool = True
    exposed: bool = False
    same_ids: str = ""


class PacketLog(Protocol):
    """What takes every packet within the budget, in the thread that received or sent it. Both calls must be quick."""

    def log_packet(self, stamp_us: int, raw: bytes) -> int | None:
        """Write a packet to the telemetry log. Returns its number there, None where there is no log."""

    def on_packet(self, packet: Packet) -> None:
        """Take a packet that was logged, received or sent."""


class PacketReceiver(Protocol):
    """What acts on the packets that were received."""

    def on_packet(self, packet: Packet) -> None:
        """Act on a packet, quickly; may call `PacketSender.send`."""


# --- one link


@dataclass(slots=True)
class LinkStatistics:
    """Counters of a link. `error` says why it is down, None when it is up; `signing` is None without a key.

    `packets_in` counts what was accepted; packets that signing refused are in `signing` alone, and in no log.
    `packets_unrecorded` were too many of one sender and message for the telemetry log (`LogBudget`).
    """

    url: str
    packets_in: int = 0
    packets_out: int = 0
    packets_bad: int = 0
    packets_unsent: int = 0
    packets_unlogged: int = 0
    failures: int = 0
    last_heard_monotonic_ns: int | None = None
    error: str | None = None
    signing: SigningStatistics | None = None
    packets_unrecorded: int = 0


class Link:
    """One link's state. Its receiving thread writes it and, under the order lock, so do the senders."""

    def __init__(self, number: int, address: Address, guard: SignatureGuard | None, transport: Transport) -> None:
        self.number, self._transport = number, transport
        self.address, self.exposed = address, address.exposed
        self.guard = guard
        self.channel: ByteChannel | None = None
        self.error: str | None = None
        self.packer = mavlink.MAVLink(None)
        self.heard_1 = self.heard_2 = False
        self.counts = LinkStatistics(address.url)
        self.budgets = {sent: LogBudget(anybody=self.exposed and guard is None) for sent in (False, True)}

    def packed(self, message: MavlinkMessage, system_id: int, component_id: int) -> bytes:
        """Pack a message from this component: signed where there is a key, else in the version that was heard."""
        self.packer.srcSystem, self.packer.srcComponent = system_id, component_id
        if self.guard is None:
            return pack(message, self.packer, version_1=self.heard_1 and not self.heard_2)
        self.guard.prepare(self.packer)
        return pack(message, self.packer, version_1=False)

    def opened(self) -> ByteChannel:
        """Open another channel. Raises LinkError."""
        channel = self._transport.open(self.address)
        if self.guard is not None:
            channel.ask_proof()
        return channel

    def fail(self, problem: object) -> None:
        """Mark the channel as broken: the receiving thread opens another."""
        self.error = f"MAVLink link {self.address.url}: {problem}"

    def close(self) -> None:
        """Close the channel, where there is one. Under the order lock."""
        channel, self.channel = self.channel, None
        if channel is not None:
            channel.close()

    def statistics(self) -> LinkStatistics:
        """Counters so far."""
        return replace(self.counts, error=self.error, signing=self.guard.statistics() if self.guard else None)


# --- all links


class _OwnHeartbeats:
    """The heartbeats that were sent lately: one of them that comes back was forwarded by a router, and any other one
    with our ids is another component's. Of 256 of those, one for each second and link is taken for ours."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._sent: dict[tuple[int, bytes], int] = {}

    def add(self, framed: Framed) -> None:
        """One is sent."""
        now_ns = self._clock.monotonic_ns()
        while self._sent and now_ns - self._sent[next(iter(self._sent))] > _RETURNS_NS:
            del self._sent[next(iter(self._sent))]
        self._sent.pop(framed.numbered(), None)
        self._sent[framed.numbered()] = now_ns

    def __contains__(self, framed: Framed) -> bool:
        sent_ns = self._sent.get(framed.numbered())
        return sent_ns is not None and self._clock.monotonic_ns() - sent_ns <= _RETURNS_NS


class PacketSender:
    """Send messages on the links, and pass each packet, received or sent, to the log, in the order of its number.

    One lock over all links sees to that. Stamps are UTC microseconds of `clock`. Before `start` nothing can be sent.
    `system_id` may be set while running: a camera takes its autopilot's.
    """

    def __init__(self, links: Sequence[Link], clock: Clock, *, system_id: int, component_id: int) -> None:
        self.order = threading.RLock()
        self.system_id, self.component_id = system_id, component_id
        self._links, self._clock = links, clock
        self._log: PacketLog | None = None
        self._own_heartbeats = _OwnHeartbeats(clock)

    def start(self, packet_log: PacketLog) -> None:
        """Send from now on."""
        self._log = packet_log

    def send(self, message: MavlinkMessage, link: int | None = None, *, without: int | None = None) -> bool:
        """Send on one link, or on all, perhaps `without` one. False where no link took it. Never blocks, never raises
        for a lost link."""
        taken = False
        for each in self._links if link is None else self._links[link : link + 1]:
            if each.number == without:
                continue
            with self.order:
                taken = self._send_on(each, message) or taken
        return taken

    def logged(
        self,
        link: Link,
        stamp_us: int,
        framed: Framed,
        *,
        sent: bool = False,
        trusted: bool = True,
        exposed: bool = False,
    ) -> Packet:
        """Log a packet, and return it with its number; one beyond the log's budget is only counted. Under the order
        lock, after `start`."""
        packet_log, number, message = self._log, None, framed.message
        assert packet_log is not None, "packets come and go after `start`"
        source, size = (message.get_srcSystem(), message.get_srcComponent()), _STAMP_BYTES + len(framed.raw)
        address = link.channel.source() if link.channel and not sent else ""
        if not link.budgets[sent].takes(source, message.get_msgId(), size, self._clock.monotonic_ns(), address):
            link.counts.packets_unrecorded += 1
            return Packet(None, stamp_us, link.number, message, framed.raw, sent, trusted, exposed)
        try:
            number = packet_log.log_packet(stamp_us, framed.raw)
        except Exception:  # a full disk must not stop the commands of a flying machine
            if link.counts.packets_unlogged == 0:
                log.exception("A MAVLink packet could not be written to the telemetry log")
            link.counts.packets_unlogged += 1
        packet = Packet(number, stamp_us, link.number, message, framed.raw, sent, trusted, exposed)
        self.hand(link, packet, packet_log)
        return packet

    def has_same_ids(self, framed: Framed) -> bool:
        """Whether it is a heartbeat of another component with our own ids, and not one of ours that came back."""
        message = framed.message
        ours = (message.get_srcSystem(), message.get_srcComponent()) == (self.system_id, self.component_id)
        return ours and message.get_msgId() == mavlink.MAVLINK_MSG_ID_HEARTBEAT and framed not in self._own_heartbeats

    def hand(self, link: Link, packet: Packet, receiver: PacketReceiver) -> None:
        """Hand a packet to a receiver. An exception is logged and counted: one packet must not end the link."""
        try:
            receiver.on_packet(packet)
        except Exception:  # whatever the receiver raises, the next packet is handled
            link.counts.failures += 1
            log.exception("A MAVLink packet (%s) could not be handled", packet.message.get_type())

    def _send_on(self, link: Link, message: MavlinkMessage) -> bool:
        channel = link.channel
        if channel is None or self._log is None:
            link.counts.packets_unsent += 1
            return False
        raw = link.packed(message, self.system_id, self.component_id)
        stamp_us = self._clock.utc_ns() // 1000
        try:
            taken = channel.write(raw)
        except OSError as error:
            link.fail(error.strerror or error)
            taken = False
        if not taken:
            link.counts.packets_unsent += 1
            return False
        link.counts.packets_out += 1
        framed = Framed(raw, message)
        if message.get_msgId() == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._own_heartbeats.add(framed)
        self.logged(link, stamp_us, framed, sent=True)
        return True


class MavlinkLinks:
    """All links of one MAVLink component, with a receiving thread each. `sender` sends on them.

    Every packet is logged before it is acted on. Between `open` and `start` nothing is received or sent.
    """

    def __init__(
        self,
        urls: Sequence[str],
        *,
        system_id: int,
        component_id: int,
        clock: Clock,
        signing: Signing | None = None,
        transport: Transport | None = None,
    ) -> None:
        self._clock, self._transport = clock, transport or MachineTransport(clock)
        self._stop = threading.Event()
        self._opened = False
        self._signing_time = signing.time if signing else None
        guards = signing.guards if signing else [None] * len(urls)
        pairs = zip(urls, guards, strict=True)
        self._links = [Link(number, parse(url), guard, self._transport) for number, (url, guard) in enumerate(pairs)]
        self.sender = PacketSender(self._links, clock, system_id=system_id, component_id=component_id)
        self._order = self.sender.order
        self._loops: list[Loop] = []

    def open(self) -> None:
        """Open all links, without receiving yet.

        Raises LinkError for what waiting would not mend: a port in use, a file that is no device. A device, an address
        or a TCP server that isn't there yet is tried again every second.
        """
        if self._opened:
            return
        try:
            for link in self._links:
                try:
                    link.channel = link.opened()
                except LinkError as error:
                    if not error.may_come:
                        raise
                    link.error = str(error)
        except LinkError:
            self._close_channels()
            raise
        self._opened = True

    def start(self, packet_log: PacketLog, receiver: PacketReceiver | None = None) -> None:
        """Begin to send and to receive; opens the links if `open` did not. Raises LinkError as `open` does.

        `packet_log` takes every packet; `receiver` acts on those that were received.
        """
        self.open()
        self.sender.start(packet_log)
        for link in self._links:
            receive = partial(self._receive, link, receiver)
            self._loops.append(Loop(f"mavlink {link.number}", receive, self._stop, self._clock))
        if self._signing_time is not None:
            run = partial(self._signing_time.run, self._stop)
            self._loops.append(Loop("mavlink signing", run, self._stop, self._clock))
        for loop in self._loops:
            loop.start()

    def stop(self) -> None:
        """End the threads (within half a second each) and close the links."""
        self._stop.set()
        for loop in self._loops:
            loop.stop(2.0)
        with self._order:
            self._close_channels()

    def port(self, link: int) -> int:
        """Return the local UDP or TCP port of a link: the one that the system chose where the url said 0."""
        channel = self._links[link].channel
        return channel.port() if channel else 0

    def clock_known(self, correction_ns: int = 0) -> None:
        """This machine's clock is right, or so much behind UTC, from now on: signed packets don't move the time."""
        if self._signing_time is not None:
            self._signing_time.clock_known(correction_ns)

    def findings(self) -> list[Finding]:
        """Whose signed packets show a wrong clock."""
        return [] if self._signing_time is None else self._signing_time.findings()

    def statistics(self) -> tuple[LinkStatistics, ...]:
        """Counters of every link, in the order of the urls."""
        return tuple(link.statistics() for link in self._links)

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        return [name for loop in self._loops for name in loop.dead_threads()]

    # --- the receiving threads

    def _receive(self, link: Link, receiver: PacketReceiver | None) -> None:
        with contextlib.suppress(OSError):  # as far as this user may
            renice(_NICENESS)
        framers = dict[int, Framer]()  # by origin
        while not self._stop.is_set():
            channel = link.channel
            if channel is None or link.error is not None:
                self._reopen(link)
                framers.clear()
                continue
            try:
                if not self._wait(channel):
                    continue
                while (data := channel.read()) and not self._stop.is_set():
                    framer = framers[channel.origin] = framers.pop(channel.origin, Framer())
                    if len(framers) > _FRAMERS:
                        del framers[next(iter(framers))]
                    self._take(link, channel, framer, data, receiver)
                    if not channel.datagrams:  # a stream that never ends must not keep its own output waiting
                        break
            except (OSError, ValueError) as error:  # ValueError: a descriptor that another thread closed
                link.fail(error)
                continue
            if data is None:
                link.fail("the other side closed it")

    def _take(
        self, link: Link, channel: ByteChannel, framer: Framer, data: bytes, receiver: PacketReceiver | None
    ) -> None:
        """Cut what was read into packets. On a signed port strangers' datagrams are dropped before they are parsed."""
        stamp_us = self._clock.utc_ns() // 1000
        bad = framer.bad
        if not channel.datagrams:
            packets = framer.feed(data)
        elif link.guard is None:
            packets = framer.datagram(data)
        else:
            sifted = link.guard.sift(data)
            packets = framer.datagram(sifted.sound)
            link.counts.packets_bad += sifted.bad
        for framed in packets:
            self._received(link, channel, stamp_us, framed, receiver)
        link.counts.packets_bad += framer.bad - bad

    def _wait(self, channel: ByteChannel) -> bool:
        """Wait until there is something to read, and flush meanwhile."""
        readable, writable = self._transport.wait(channel, _POLL_S)
        if writable:
            with self._order:
                channel.flush()
        return readable

    def _received(
        self, link: Link, channel: ByteChannel, stamp_us: int, framed: Framed, receiver: PacketReceiver | None
    ) -> None:
        with self._order:
            message = framed.message
            trusted, trust = True, "obey"
            if link.guard is not None:
                source = (message.get_srcSystem(), message.get_srcComponent())
                trust = link.guard.judge(framed.raw, *source, message.get_msgId())
                if trust == "refuse":
                    if is_signed(framed.raw) and link.guard.rightly_signed(framed.raw):
                        channel.shown("old")
                    return
                trusted = trust != "hear"
            signed = link.guard is not None and is_signed(framed.raw)
            if trust == "copy":
                channel.shown("old")  # another link brought it first: this proves nobody here
            elif trusted:
                channel.shown("signed" if signed else "sound")
            link.counts.packets_in += 1
            if trusted or message.get_msgId() != mavlink.MAVLINK_MSG_ID_RADIO_STATUS:  # a radio alone is no peer
                link.counts.last_heard_monotonic_ns = self._clock.monotonic_ns()
            link.heard_1 |= framed.version == 1
            link.heard_2 |= framed.version == 2
            exposed = link.exposed and not signed
            packet = self.sender.logged(link, stamp_us, framed, trusted=trusted, exposed=exposed)
            if self.sender.has_same_ids(framed):
                packet = replace(packet, same_ids=f"{channel.source() or 'the other end'} of {link.address.url}")
            if receiver is not None:
                self.sender.hand(link, packet, receiver)

    def _reopen(self, link: Link) -> None:
        with self._order:
            link.close()
        if self._clock.pause(self._stop, _REOPEN_S):
            return
        try:
            channel = link.opened()
        except LinkError as error:
            link.error = str(error)
            return
        with self._order:
            link.channel, link.error = channel, None
            if self._stop.is_set():  # it was opened too late for `stop` to close it
                link.close()

    def _close_channels(self) -> None:
        for link in self._links:
            link.close()
