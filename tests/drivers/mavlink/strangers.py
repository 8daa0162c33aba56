"""What people without the key send to a signed port: random bytes, mutated, recorded, foreign and unsigned packets.

As a program: strangers.py PORT FILE RATE SECONDS sends so many a second from 100 sources. FILE has recorded packets, a
line of hexadecimal digits each. Prints how many were sent.
"""

from __future__ import annotations

import contextlib
import random
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from dappled.drivers.mavlink import mavlink, pack

SOURCES = 100


class Strangers:
    """A source of datagrams, the same ones for a seed. `recorded` were sent by stations that have the key."""

    def __init__(self, recorded: Sequence[bytes], seed: int) -> None:
        self._recorded, self._dice = recorded, random.Random(seed)  # noqa: S311  # a test's dice
        self._foreign = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._foreign.signing.secret_key, self._foreign.signing.sign_outgoing = bytes(32), True
        self._foreign.signing.timestamp = 2**47
        self._plain = mavlink.MAVLink(None)

    def datagram(self) -> bytes:
        """The next one."""
        make = (self._random, self._mutated, self._replayed, self._signed_by_others, self._unsigned, self._radio)
        return self._dice.choice(make)()

    def _random(self) -> bytes:
        return self._dice.choice([b"", b"\xfd", b"\xfe"]) + self._dice.randbytes(self._dice.randrange(1, 300))

    def _mutated(self) -> bytes:
        raw = bytearray(self._replayed())
        for _ in range(self._dice.randrange(1, 4)):
            raw[self._dice.randrange(len(raw))] ^= self._dice.randrange(1, 256)
        return bytes(raw[: self._dice.randrange(1, len(raw) + 1)] if self._dice.random() < 0.2 else raw)

    def _replayed(self) -> bytes:
        return self._dice.choice(self._recorded)

    def _signed_by_others(self) -> bytes:
        return pack(self._command(), self._foreign, version_1=False)

    def _unsigned(self) -> bytes:
        return pack(self._command(), self._anybody(), version_1=self._dice.random() < 0.5)

    def _radio(self) -> bytes:
        message = mavlink.MAVLink_radio_status_message(*[self._dice.randrange(250) for _ in range(7)])
        return pack(message, self._anybody(), version_1=False)

    def _command(self) -> object:
        name = self._dice.choice([2000, 203, 512, 530])
        return mavlink.MAVLink_command_long_message(1, 100, name, 0, 0, 0, 1, self._dice.randrange(1000), 1, 0, 0)

    def _anybody(self) -> object:
        self._plain.srcSystem, self._plain.srcComponent = self._dice.randrange(1, 256), self._dice.randrange(1, 256)
        return self._plain


def main(port: int, file: str, rate: int, seconds: float) -> None:
    strangers = Strangers([bytes.fromhex(line) for line in Path(file).read_text("ascii").split()], 7)
    datagrams = [strangers.datagram() for _ in range(20_000)]
    sources = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(SOURCES)]
    for one in sources:
        one.setblocking(False)
    sent, began = 0, time.monotonic()
    while (passed := time.monotonic() - began) < seconds:
        for _ in range(min(500, int(rate * passed) - sent)):
            with contextlib.suppress(BlockingIOError):
                sources[sent % SOURCES].sendto(datagrams[sent % len(datagrams)], ("127.0.0.1", port))
            sent += 1
        time.sleep(0.002)
    print(sent)  # noqa: T201  # the program's answer


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
