"""A simulated camera body, as whoever uses one sees it: what it is to be, its process, what it is told and asked."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from dappled.errors import DappledError
from dappled.mocks.body.eos450d import SERIAL
from dappled.mocks.body.eos_card import CARD_BYTES

_START_S = 30.0
_ANSWER_S = 5.0


class BodyError(DappledError):
    """The body's process didn't start or doesn't answer."""


@dataclass(frozen=True, slots=True)
class BodyOptions:
    """What a body is and shows.

    `picture`: "simulated" (the reference camera's raw files), "pattern:SIZE:EXTENSION" (bytes that `pattern` makes),
    or a file's path (its bytes, every time). `start_monotonic_ns`: when the simulation's time began (None: when the
    body starts). `scale`: share of the reference sensor that is rendered. `scene`, `law`: as
    `reference_camera` has them. `truth`: a folder for what the simulated camera knows of each shot (000001.npz, and its
    times in seconds since the simulation's start in 000001.json). `delay_s`: how long a pattern or
    file takes to expose. `card_bytes`: the card's size; a full one refuses to shoot. `clock_offset_s`: how far the
    body's own clock is wrong. `pairs`: raw and JPEG of each picture. `addresses`: how many ports it has.
    """

    picture: str = "simulated"
    seed: int = 1
    scale: float = 1.0
    scene: str = "terrain"
    law: str = "geometric"
    f_number: float | None = None
    start_monotonic_ns: int | None = None
    truth: Path | None = None
    delay_s: float = 0.0
    serial: str = SERIAL
    card_bytes: int = CARD_BYTES
    clock_offset_s: float = 0.0
    pairs: bool = False
    addresses: int = 1
    faults: tuple[str, ...] = ()

    def arguments(self) -> list[str]:
        """These options as command-line arguments."""
        named = {
            "--picture": self.picture,
            "--seed": self.seed,
            "--scale": self.scale,
            "--scene": self.scene,
            "--law": self.law,
            "--f-number": self.f_number,
            "--start-monotonic-ns": self.start_monotonic_ns,
            "--truth": self.truth,
            "--delay": self.delay_s,
            "--serial": self.serial,
            "--card-bytes": self.card_bytes,
            "--clock-offset": self.clock_offset_s,
            "--addresses": self.addresses,
        }
        given = [text for name, value in named.items() if value is not None for text in (name, str(value))]
        given += ["--pairs"] if self.pairs else []
        return [*given, *(text for fault in self.faults for text in ("--fault", fault))]


class Body:
    """A running body. `start` returns once it listens; use it as a context manager or call `stop`."""

    def __init__(self, process: subprocess.Popen[bytes], lines: _Lines, ports: list[int]) -> None:
        self._process = process
        self._lines = lines
        self.tcp_ports = ports

    @classmethod
    def start(cls, options: BodyOptions | None = None) -> Body:
        """Start a body's process. Raises BodyError where it doesn't listen within 30 s."""
        command = [sys.executable, "-m", "dappled.mocks.body.body_process", *(options or BodyOptions()).arguments()]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert process.stdout is not None  # asked for above
        lines = _Lines(process.stdout.fileno())
        try:
            ports = [int(word) for word in lines.next(_START_S).removeprefix("port ").split()]
        except (BodyError, ValueError) as error:
            _end(process)
            raise BodyError(f"the simulated body did not start: {error}") from error
        except BaseException:  # interrupted: it must not be left behind
            _end(process)
            raise
        return cls(process, lines, ports)

    @property
    def port(self) -> str:
        """The body's port as libgphoto2 names it; of several addresses all, with commas between."""
        return ",".join(f"ptpip:127.0.0.1:{port}:{port}" for port in self.tcp_ports)

    @property
    def releases(self) -> int:
        """How many exposures the body has begun."""
        return int(self.ask("releases"))

    def contact(self) -> bool:
        """Close the contact of its remote socket, as a wire does. False where that makes no exposure."""
        return self.ask("contact") == "1"

    @property
    def card(self) -> list[str]:
        """The names of the files on the body's card."""
        return self.ask("card").split()

    def fault(self, line: str) -> None:
        """Put a fault in force ("busy 2", "error", "drop", "clear", …). Raises BodyError for an unknown one."""
        self.ask(line)

    def ask(self, line: str) -> str:
        """One line to the body, its answer without the "ok". Raises BodyError."""
        assert self._process.stdin is not None  # a pipe by construction
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except (OSError, ValueError) as error:  # ValueError: stopped by us
            raise BodyError("the simulated body's process has ended") from error
        state, _, rest = self._lines.next(_ANSWER_S).partition(" ")
        if state != "ok":
            raise BodyError(rest)
        return rest

    def stop(self) -> None:
        """End the process; returns when it is gone."""
        _end(self._process)

    def __enter__(self) -> Body:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.stop()


class _Lines:
    """Lines from a pipe, each with a deadline."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)
        self._buffer = b""

    def next(self, timeout_s: float) -> str:
        deadline = time.monotonic() + timeout_s
        while b"\n" not in self._buffer:
            if not self._poll.poll(max(deadline - time.monotonic(), 0) * 1e3):
                raise BodyError(f"the simulated body said nothing for {timeout_s:.0f} s")
            piece = os.read(self._fd, 65536)
            if not piece:
                raise BodyError("the simulated body's process has ended")
            self._buffer += piece
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode()


def _end(process: subprocess.Popen[bytes]) -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(2)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(5)
