"""MAVLink links: several at once, one receiving thread each, every packet logged before it is acted on."""

from __future__ import annotations

import logging
import select
import threading
from collections.abc import Callable, Sequence
from functools import reduce
from operator import or_
from typing import Protocol

from dappled.drivers.mavlink.address import LinkError, parse
from dappled.drivers.mavlink.channel import Channel, open_channel
from dappled.drivers.mavlink.framing import Decoder, Framed, Framer, Message, mavlink
from dappled.drivers.mavlink.link import Link, LinkStatistics, Packet
from dappled.drivers.mavlink.signing import Signing, SigningError

__all__ = ["Decoder", "LinkError", "LinkStatistics", "MavlinkLinks", "Message", "Packet", "mavlink"]

log = logging.getLogger(__name__)
_REOPEN_S = 1.0
_LOOK_S = 0.2
_KEEP_S = 1.0


class Clock(Protocol):
    """The two times that a link stamps with."""

    def utc_ns(self) -> int: ...

    def monotonic_ns(self) -> int: ...


class MavlinkLinks:
    """All links of one MAVLink component.

    `tap(stamp_us, raw)` writes a packet to the telemetry log and returns its number there; then `on_packet` is called,
    for received packets and for sent ones, in the order of their numbers over all links (one lock sees to that), in
    the thread that received or sent. It must be quick, and may call `send`. Stamps are UTC microseconds from `clock`.

    `system_id` may be set while running: a camera takes its autopilot's.
    """

    def __init__(
        self,
        urls: Sequence[str],
        *,
        system_id: int,
        component_id: int,
        tap: Callable[[int, bytes], int],
        on_packet: Callable[[Packet], None],
        clock: Clock,
        signing: Signing | None = None,
    ) -> None:
        self.component_id = component_id
        self.system_id = system_id
        self._tap = tap
        self._on_packet = on_packet
        self._clock = clock
        self._order = threading.RLock()
        self._stop = threading.Event()
        self._opened = False
        self._signing_time = signing.time if signing else None
        guards = signing.guards if signing else [None] * len(urls)
        pairs = zip(urls, guards, strict=True)
        self._links = [Link(number, parse(url), guard) for number, (url, guard) in enumerate(pairs)]
        self._threads: list[threading.Thread] = []

    def open(self) -> None:
        """Open all links, without receiving yet. Raises LinkError for what would not get better by waiting: a port in
        use, a missing device. A TCP server that isn't there yet is looked for every second."""
        if self._opened:
            return
        try:
            for link in self._links:
                try:
                    link.channel = open_channel(link.address)
                except LinkError as error:
                    if link.address.kind != "tcp":
                        raise
                    link.error = str(error)
        except LinkError:
            self._close_channels()
            raise
        self._opened = True

    def start(self) -> None:
        """Begin to receive; opens the links if `open` did not. Raises LinkError as `open` does."""
        self.open()
        for link in self._links:
            thread = threading.Thread(target=self._receive, args=(link,), name=f"mavlink {link.number}", daemon=True)
            self._threads.append(thread)
            thread.start()
        if self._signing_time is not None:
            thread = threading.Thread(target=self._keep_signing_time, name="mavlink signing", daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """End the threads (within half a second each) and close the links."""
        self._stop.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2.0)
        with self._order:
            self._close_channels()

    def port(self, link: int) -> int:
        """The local UDP or TCP port of a link: what the system chose where the url said 0."""
        channel = self._links[link].channel
        return channel.port() if channel else 0

    def send(self, message: Message, link: int | None = None) -> bool:
        """Send on one link, or on all. False where no link took it. Never blocks, never raises for a lost link."""
        taken = False
        for each in self._links if link is None else self._links[link : link + 1]:
            with self._order:
                taken = self._send_on(each, message) or taken
        return taken

    def statistics(self) -> tuple[LinkStatistics, ...]:
        """Counters of every link, in the order of the urls."""
        return tuple(link.statistics() for link in self._links)

    def dead_threads(self) -> list[str]:
        """Which receiving threads have ended without being asked to: none, unless there is a bug."""
        if self._stop.is_set():
            return []
        return [thread.name for thread in self._threads if not thread.is_alive()]

    def _send_on(self, link: Link, message: Message) -> bool:
        channel = link.channel
        if channel is None:
            link.packets_unsent += 1
            return False
        raw = link.packed(message, self.system_id, self.component_id)
        stamp_us = self._clock.utc_ns() // 1000
        try:
            taken = channel.write(raw)
        except OSError as error:
            link.fail(error.strerror or error)
            taken = False
        if not taken:
            link.packets_unsent += 1
            return False
        link.packets_out += 1
        self._deliver(link, stamp_us, raw, message, sent=True)
        return True

    def _deliver(
        self, link: Link, stamp_us: int, raw: bytes, message: Message, *, sent: bool, trusted: bool = True
    ) -> None:
        number: int | None = None
        try:
            number = self._tap(stamp_us, raw)
        except Exception:  # a full disk must not stop the commands of a flying machine
            if link.packets_unlogged == 0:
                log.exception("A MAVLink packet could not be written to the telemetry log")
            link.packets_unlogged += 1
        try:
            self._on_packet(Packet(number, stamp_us, link.number, message, raw, sent, trusted))
        except Exception:  # one packet that nobody foresaw must not end the link
            link.failures += 1
            log.exception("A MAVLink packet (%s) could not be handled", message.get_type())

    def _receive(self, link: Link) -> None:
        framer = Framer()
        while not self._stop.is_set():
            channel = link.channel
            if channel is None or link.error is not None:
                self._reopen(link)
                framer = Framer()
                continue
            try:
                if not self._wait(channel):
                    continue
                data = channel.read()
                stamp_us = self._clock.utc_ns() // 1000
            except (OSError, ValueError) as error:  # ValueError: a descriptor that another thread closed
                link.fail(error)
                continue
            if data is None:
                link.fail("the other side closed it")
                continue
            if not data:
                continue
            bad = framer.bad
            packets = framer.datagram(data) if channel.datagrams else framer.feed(data)
            for framed in packets:
                self._received(link, stamp_us, framed)
            link.packets_bad += framer.bad - bad

    def _wait(self, channel: Channel) -> bool:
        """Whether there is something to read; sends what waits. poll knows descriptors above 1023, select does not."""
        poll = select.poll()
        for descriptor in channel.descriptors():
            poll.register(descriptor, select.POLLIN | (select.POLLOUT if channel.wants_write() else 0))
        ready = reduce(or_, (events for _, events in poll.poll(_LOOK_S * 1e3)), 0)
        if ready & select.POLLOUT:
            with self._order:
                channel.flush()
        return bool(ready & ~select.POLLOUT)

    def _received(self, link: Link, stamp_us: int, framed: Framed) -> None:
        with self._order:
            message = framed.message
            trusted = True
            if link.guard is not None:
                source = (message.get_srcSystem(), message.get_srcComponent())
                trust = link.guard.judge(framed.raw, *source, message.get_msgId())
                if trust == "refuse":
                    return
                trusted = trust == "obey"
            link.packets_in += 1
            link.last_heard_monotonic_ns = self._clock.monotonic_ns()
            link.heard_1 |= framed.version == 1
            link.heard_2 |= framed.version == 2
            self._deliver(link, stamp_us, framed.raw, message, sent=False, trusted=trusted)

    def _reopen(self, link: Link) -> None:
        with self._order:
            link.close()
        if self._stop.wait(_REOPEN_S):
            return
        try:
            channel = open_channel(link.address)
        except LinkError as error:
            link.error = str(error)
            return
        with self._order:
            link.channel, link.error = channel, None
            if self._stop.is_set():  # it was opened too late for `stop` to close it
                link.close()

    def _keep_signing_time(self) -> None:
        assert self._signing_time is not None
        failed = False
        while True:
            ending = self._stop.wait(_KEEP_S)
            try:
                self._signing_time.keep(ending=ending)
                failed = False
            except SigningError as error:  # the links go on; said once
                if not failed:
                    log.warning("%s", error)
                failed = True
            if ending:
                return

    def _close_channels(self) -> None:
        for link in self._links:
            link.close()
