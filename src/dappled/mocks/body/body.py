"""A simulated camera body in a process of its own: its options, its pictures, its client and its process.

    python -m dappled.mocks.body.body '{"seed": 1, "scale": 0.25}'

takes `BodyOptions` as JSON and prints `port N` once it listens, then obeys lines on standard input: a fault of `faults`
("busy 2"), "releases", "contact", "card", "move", "change card", or what a hand turns or runs low: "turn dial 2", "turn
clock -3600" (see `eos450d`). It answers every line with one line, `ok …` or `error …`. It ends when its input ends, so
it never outlives the process that started it.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from dappled import codec
from dappled.clock import SystemClock
from dappled.drivers.child_process import end_child
from dappled.drivers.python_command import python_module
from dappled.errors import DappledError
from dappled.mocks.autopilot.shot_times import ShotTimes
from dappled.mocks.body.eos450d import SERIAL, Eos450d, Expose, Properties
from dappled.mocks.body.eos_card import CARD_BYTES
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptpip import Responder

_START_S = 300.0  # a process that emulates another processor takes minutes
_ANSWER_S = 5.0


class BodyError(DappledError):
    """The body's process didn't start or doesn't answer."""


@dataclass(frozen=True, slots=True)
class BodyOptions:
    """What a body is, and what its pictures show.

    `picture`: "simulated" (the reference camera's raw files), "pattern:SIZE:EXTENSION" (bytes that `pattern` makes),
    or a file's path (its bytes, every time). `start_monotonic_ns`: when the simulation's time began (None: when the
    body starts). `scale`: share of the reference sensor that is rendered. `scene`, `law`: as
    `reference_camera` has them. `mask`: the pictures are those of a Canon EOS 450D with this mask (a profile or TOML
    file), not of the reference camera; `scale` and `law` are not used then. `truth`: a folder for
    the simulated camera's truth about each shot (000001.npz, and its times in seconds since the simulation's start in
    000001.json). `delay_s`: how long a pattern or
    file takes to expose. `card_bytes`: the card's size; a full one refuses to shoot. `clock_offset_s`: how far the
    body's own clock is wrong. `pairs`: raw and JPEG of each picture. `addresses`: how many ports it has. `real`: as
    `reference_camera` has it. `speed_m_s`: of the vehicle (None: the path's own). `bind`: where on this
    machine it answers. `faults`: in force from the start.
    """

    picture: str = "simulated"
    seed: int = 1
    scale: float = 1.0
    scene: str = "terrain"
    law: str = "geometric"
    mask: str = ""
    f_number: float | None = None
    start_monotonic_ns: int | None = None
    truth: str = ""
    delay_s: float = 0.0
    serial: str = SERIAL
    card_bytes: int = CARD_BYTES
    clock_offset_s: float = 0.0
    pairs: bool = False
    addresses: int = 1
    real: bool = False
    speed_m_s: float | None = None
    bind: str = "127.0.0.1"
    faults: tuple[str, ...] = ()


class SimulatedBody:
    """A running body. `start` returns once it listens; use it as a context manager or call `stop`."""

    COMMAND: ClassVar = python_module("dappled.mocks.body.body")

    def __init__(self, process: subprocess.Popen[bytes], lines: _Lines, ports: list[int], host: str) -> None:
        self._process = process
        self._host = host
        self._lines = lines
        self.tcp_ports = ports

    @classmethod
    def start(cls, options: BodyOptions | None = None) -> SimulatedBody:
        """Start a body's process. Raises BodyError where it ends, or doesn't listen within five minutes."""
        options = options or BodyOptions()
        command = [*cls.COMMAND, json.dumps(codec.plain(options))]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        assert process.stdout is not None  # asked for above
        lines = _Lines(process.stdout.fileno())
        try:
            ports = [int(word) for word in lines.next(_START_S).removeprefix("port ").split()]
        except (BodyError, ValueError) as error:
            _end(process)
            raise BodyError(f"the simulated body did not start: {error}") from error
        except BaseException:  # interrupted: the process must not be left behind
            _end(process)
            raise
        return cls(process, lines, ports, options.bind)

    @property
    def port(self) -> str:
        """The body's port as libgphoto2 names it; of several addresses all, with commas between."""
        return ",".join(f"ptpip:{self._host}:{port}:{port}" for port in self.tcp_ports)

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
        """Send one line to the body; returns its answer without the "ok". Raises BodyError."""
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

    def __enter__(self) -> SimulatedBody:
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
    end_child(process, 2.0)


def pattern(shot_number: int, size: int) -> bytes:
    """Bytes that differ from shot to shot and from page to page, so that lost or swapped pages are noticed."""
    page = bytes(range(256)) * 16
    stamps = (f"shot {shot_number:06d} page {number:08d} ".encode() for number in range(size // len(page) + 1))
    return b"".join(stamp + page[len(stamp) :] for stamp in stamps)[:size]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Where a body's pictures come from, and the exposure time that it meters, in s (None: nothing is metered)."""

    expose: Expose
    exposure_s: float | None = None


def pictures(options: BodyOptions) -> Pictures:
    """The source of pictures that the options name. Raises ValueError for one that isn't there."""
    if options.picture == "simulated":
        return _simulated(options)
    if options.picture.startswith("pattern:"):
        _, size, extension = options.picture.split(":")
        return Pictures(_delayed(options.delay_s, lambda number: pattern(number, int(size)), extension))
    path = Path(options.picture)
    if not path.is_file():
        raise ValueError(f"picture {options.picture!r} is neither simulated, nor pattern:SIZE:EXT, nor a file")
    data = path.read_bytes()
    return Pictures(_delayed(options.delay_s, lambda _number: data, path.suffix[1:]))


def _delayed(delay_s: float, make: Callable[[int], bytes], extension: str) -> Expose:
    def expose(_trigger_monotonic_ns: int, shot_number: int) -> tuple[bytes, str]:
        data = make(shot_number)
        time.sleep(delay_s)
        return data, extension

    return expose


def _simulated(options: BodyOptions) -> Pictures:
    # Imported here: they load NumPy and the whole renderer, which a body that shows patterns doesn't need.
    start_ns = time.monotonic_ns() if options.start_monotonic_ns is None else options.start_monotonic_ns
    epoch_utc_s = time.time() + options.clock_offset_s - (time.monotonic_ns() - start_ns) / 1e9
    from dappled.mocks.autopilot.path import SPEED_M_S, FlightPath  # noqa: PLC0415  # reason above

    path = FlightPath(options.seed, speed_m_s=options.speed_m_s or SPEED_M_S)
    if options.mask:
        from dappled.config import profiles  # noqa: PLC0415  # reason above
        from dappled.mocks.scene.masked_camera import eos450d_camera  # noqa: PLC0415  # reason above

        camera = eos450d_camera(
            options.seed,
            profiles.mask(options.mask).mask,
            scene=options.scene,
            path=path,
            epoch_utc_s=epoch_utc_s,
            real=options.real,
        )
    else:
        from dappled.mocks.scene.masked_camera import reference_camera  # noqa: PLC0415  # reason above

        camera = reference_camera(
            options.seed,
            scale=options.scale,
            scene=options.scene,
            law=options.law,
            path=path,
            epoch_utc_s=epoch_utc_s,
            real=options.real,
        )

    truth = Path(options.truth) if options.truth else None
    exposure_s, _ = camera.metered(camera.optics.f_number if options.f_number is None else options.f_number)

    def expose(trigger_monotonic_ns: int, shot_number: int) -> tuple[bytes, str]:
        trigger_t_s = (trigger_monotonic_ns - start_ns) / 1e9
        if truth is not None:  # told when the shutter opens, as a contact does: making the picture takes longer
            latency_s = camera.latency_s(shot_number)
            # The body's own latency, which the renderer has no need to wait for: no contact closes before it is over.
            time.sleep(max(0.0, latency_s - (time.monotonic_ns() - trigger_monotonic_ns) / 1e9))
            middle_t_s = trigger_t_s + latency_s + exposure_s / 2
            ShotTimes(trigger_t_s, middle_t_s, latency_s).write(truth, shot_number)
        made = camera.expose(trigger_t_s, shot_number, f_number=options.f_number)
        if truth is not None:
            made.truth.save(truth / f"{shot_number:06d}.npz")
        return made.file, made.name_suffix.lstrip(".")

    return Pictures(expose, exposure_s)


class Answering(Protocol):
    """A body's side of the cable. `ports`: of TCP, that it listens on."""

    ports: list[int]

    def move(self) -> None:
        """Go on at the next address."""

    def close(self) -> None:
        """End all links."""


Answerer = Callable[[Eos450d, BodyFaults, BodyOptions], Answering]


def _over_network(eos: Eos450d, faults: BodyFaults, options: BodyOptions) -> Responder:
    return Responder(eos, faults, options.bind, addresses=options.addresses)


def _obey(line: str, eos: Eos450d, responder: Answering, faults: BodyFaults) -> str:
    if line == "releases":
        return f"ok {eos.releases}"
    if line == "contact":
        return f"ok {int(eos.contact())}"
    if line == "card":
        return f"ok {' '.join(eos.names)}"
    try:
        match line.split():
            case ["move"]:
                responder.move()
            case ["change", "card"]:
                eos.change_card()
            case ["turn", what, value]:
                eos.turn(what, int(value, 0))
            case _:
                faults.command(line)
    except ValueError as error:
        return f"error {error}"
    return "ok"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def serve(options: BodyOptions, lines: Iterable[str], answerer: Answerer = _over_network) -> None:
    """Serve a body until the lines end."""
    machine = SystemClock()
    clock = SystemClock(machine.utc_minus_monotonic_ns + round(options.clock_offset_s * 1e9))
    faults = BodyFaults(clock)
    for fault in options.faults:
        faults.command(fault)
    source = pictures(options)
    properties = Properties(
        options.serial, pairs=options.pairs, f_number=options.f_number, exposure_s=source.exposure_s
    )
    eos = Eos450d(source.expose, faults, clock, properties, card_bytes=options.card_bytes)
    responder = answerer(eos, faults, options)
    _say(f"port {' '.join(map(str, responder.ports))}")
    for line in lines:
        _say(_obey(line.strip(), eos, responder, faults))
    responder.close()


def main(answerer: Answerer = _over_network) -> None:
    """The process' entry point."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the starter ends us by our input
    try:
        serve(codec.read_json(BodyOptions, sys.argv[1]), sys.stdin, answerer)
    except ValueError as error:
        sys.exit(f"body: {error}")
    except BrokenPipeError:
        os._exit(0)  # the parent is gone: end without a word


if __name__ == "__main__":
    main()
