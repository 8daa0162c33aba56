"""A whole machine as a process of this one: its start, its shell, its plug; and a ground station outside of it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled.drivers.mavlink import mavlink
from dappled.workers import Loop

HERE, THERE = "192.168.77.1", "192.168.77.2"
STATION_PORT = 14550
_CLONE_NEWNET = 0x40000000
_NETWORK = "/proc/thread-self/ns/net"
_LIBC = ctypes.CDLL(None, use_errno=True)
_MARK = b"mark"
_ANSWER_S = 2.0
_AGAIN_S = 0.5
_PAGE = 4096  # what flash writes as a whole, and a block of ext4


class Network:
    """A network of its own, with a wire to the machine; nothing else is touched. Raises OSError, SubprocessError."""

    def __init__(self) -> None:
        before = os.open(_NETWORK, os.O_RDONLY)
        try:
            if _LIBC.unshare(_CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "unshare")
            self._fd = os.open(_NETWORK, os.O_RDONLY)
            for words in (
                "link set lo up", "tuntap add dev tap0 mode tap", f"addr add {HERE}/24 dev tap0", "link set tap0 up",
            ):  # fmt: skip
                subprocess.run(["/usr/sbin/ip", *words.split()], check=True)
        finally:
            _LIBC.setns(before, 0)
            os.close(before)

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """This thread, and what it starts, is in it."""
        before = os.open(_NETWORK, os.O_RDONLY)
        try:
            if _LIBC.setns(self._fd, 0):
                raise OSError(ctypes.get_errno(), "setns")
            yield
        finally:
            _LIBC.setns(before, 0)
            os.close(before)


AWAKE = """
import os
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
begun_by = os.getppid()
while os.getppid() == begun_by:
    pass
"""


class Machine:
    """One machine. `built` is the folder that tools/machine/build.py made; `disks` are /dev/ubda, /dev/ubdb …: files,
    or "WRITTEN,FILE" where FILE is not to be changed. The second one has a volatile write cache."""

    def __init__(
        self,
        built: Path,
        disks: Sequence[str | Path],
        log: Path,
        memory_mb: int = 1024,
        usb: Path | None = None,
    ) -> None:
        self._built, self._disks, self._log, self._memory_mb = built, disks, log, memory_mb
        self._kernel = (usb or built) / "linux"
        self._process: subprocess.Popen[bytes] | None = None
        # One connection that all commands share: to make one takes the machine longer than most commands.
        self._wire: subprocess.Popen[bytes] | None = None
        self._socket = log.with_name("wire")
        self._awake: list[subprocess.Popen[bytes]] = []  # keep the cores awake

    def start(self, within_s: float = 240.0) -> None:
        """Switch it on; return when its shell answers. Raises TimeoutError."""
        assert self._process is None or self._process.poll() is not None, "it is on, and holds its disk"
        began = time.monotonic()
        words = f"mem={self._memory_mb}M root=/dev/ubda rw con=null con0=null,fd:1 ssl=null eth0=tuntap,tap0"
        disks = [f"ubd{number}={disk}" for number, disk in enumerate(self._disks)]
        here = {"LD_PRELOAD": str(self._built / "before_libc.so"), "TMPDIR": "/dev/shm"}
        if len(self._disks) > 1:
            here["CACHED"] = str(self._disks[1])
        with open(self._log, "ab") as log:
            self._process = subprocess.Popen(
                [self._kernel, *words.split(), *disks],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, env={**os.environ, **here},
            )  # fmt: skip
        # Its processes wait for each other thousands of times a second: each time behind what else runs on this host,
        # and where nothing does, for a core that sleeps: a virtual one takes its time to wake. On one and the same core
        # none has to be woken: READY after 1.1 s instead of 5.1.
        with contextlib.suppress(OSError):
            os.sched_setaffinity(self._process.pid, {max(os.sched_getaffinity(0))})
            os.sched_setscheduler(self._process.pid, os.SCHED_RR, os.sched_param(1))
        self._awake = [subprocess.Popen([sys.executable, "-c", AWAKE]) for _ in range(os.cpu_count() or 1)]
        while time.monotonic() < began + within_s:
            wire = subprocess.Popen(self._shell("", "-M", "-N"), stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            while wire.poll() is None and time.monotonic() < began + within_s:
                if self._socket.exists():  # made when it is let in
                    self._wire = wire
                    return
                time.sleep(0.1)  # a machine that boots has nothing to wait on
            wire.kill()
            wire.wait()
            assert self._process.poll() is None, self._log.read_text(errors="replace")[-2000:]
            time.sleep(0.5)  # each try is a process
        raise TimeoutError(self._log.read_text(errors="replace")[-2000:])

    def run(self, command: str, *, timeout_s: float = 120, check: bool = True) -> str:
        """What a command prints there, as root. Raises subprocess.SubprocessError."""
        done = subprocess.run(self._shell(command), capture_output=True, text=True, timeout=timeout_s, check=False)
        if check and done.returncode:
            error = subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
            error.add_note(done.stderr + done.stdout)
            raise error
        return done.stdout

    def put(self, path: str, data: bytes) -> None:
        """Write a file there."""
        subprocess.run(self._shell(f"cat >{path}"), input=data, check=True, timeout=120)

    def _shell(self, command: str, *more: str) -> list[str]:
        options = ["StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "LogLevel=ERROR", "ConnectTimeout=30"]
        options.append(f"ControlPath={self._socket}")
        there = ["-i", str(self._built / "key"), *(word for one in options for word in ("-o", one)), f"root@{THERE}"]
        return ["ssh", *more, *there, *([command] if command else [])]

    def cut(self) -> None:
        """Pull its plug. What was in its root disk's cache is not lost."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait(30)
        for process in self._awake:
            process.kill()
            process.wait()
        self._awake = []
        if self._wire is not None:
            self._wire.kill()
            self._wire.wait()
            self._wire = None
        self._socket.unlink(missing_ok=True)

    @contextlib.contextmanager
    def halted(self, *, disks_only: bool = False) -> Iterator[None]:
        """Not one step of it and none of its disks is done meanwhile; or only its disks stand still."""
        assert self._process is not None
        # The kernel, and its thread for disks, which is a process; those of the guest are traced by it, and wait.
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        own = [int(pid) for pid in children if "TracerPid:\t0\n" in Path(f"/proc/{pid}/status").read_text()]
        stopped = own if disks_only else [self._process.pid, *own]
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        try:
            while not all(
                Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T" for pid in stopped
            ):
                time.sleep(0.001)  # a call of the kernel is finished first
            yield
        finally:
            for pid in stopped:
                with contextlib.suppress(ProcessLookupError):  # its plug was pulled
                    os.kill(pid, signal.SIGCONT)

    def as_cut(self, to: Path, chance: random.Random) -> None:
        """Copy the second disk as it would be had the plug been pulled now: of each page that its cache holds it
        depends on chance whether it is written."""
        disk = Path(self._disks[1])
        copy(disk, to)
        earlier = disk.with_name(disk.name + ".before").read_bytes()
        lost = chance.choice((0.0, 0.5, 1.0))
        done: dict[int, bool] = {}
        with open(to, "r+b") as file:
            at = 0
            while at < len(earlier):  # the first record about a page is what a flush had brought to the disk
                offset, size = struct.unpack_from("<QQ", earlier, at)
                at += 16
                for page in range(offset, offset + size, _PAGE):
                    if page not in done:
                        done[page] = chance.random() < lost
                        if done[page]:
                            file.seek(page)
                            file.write(earlier[at + page - offset : at + min(page - offset + _PAGE, size)])
                at += size

    def off(self) -> None:
        """Switch it off in order."""
        assert self._process is not None
        self.run("systemctl poweroff", check=False)
        self._process.wait(120)
        self.cut()


def copy(disk: Path, to: Path) -> Path:
    """Copy a disk without its holes."""
    subprocess.run(["/bin/cp", "--sparse=always", disk, to], check=True)
    return to


@dataclass
class Station:
    """Hears on the wire's outer end, and writes down what it heard: acknowledgements by result, and images."""

    accepted_s: list[float] = field(default_factory=list)
    refused_s: list[float] = field(default_factory=list)
    captured: dict[int, Any] = field(default_factory=dict)
    camera: tuple[int, int] | None = None
    heartbeats: int = 0
    texts: list[str] = field(default_factory=list)
    place: tuple[str, int] = HERE, STATION_PORT

    def __post_init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(self.place)
        self._socket.settimeout(0.2)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._mav.robust_parsing = True
        self._peer: tuple[str, int] | None = None
        self._lock = threading.Condition()
        self._sequence = self._marks = 0
        self._ended = threading.Event()
        self._loop = Loop("station", self._hear, self._ended)
        self._loop.start()

    def close(self) -> None:
        self._ended.set()
        self._loop.stop(5)
        self._socket.close()

    def _hear(self) -> None:
        while not self._ended.is_set():
            try:
                data, peer = self._socket.recvfrom(2048)
            except TimeoutError:
                continue
            with self._lock:
                if data == _MARK:
                    self._marks += 1
                else:
                    self._peer = peer
                    for message in self._mav.parse_buffer(data) or ():
                        self._take(message)
                self._lock.notify_all()

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self.camera = message.get_srcSystem(), message.get_srcComponent()
            self.heartbeats += 1
        elif kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            taken = message.result == mavlink.MAV_RESULT_ACCEPTED
            (self.accepted_s if taken else self.refused_s).append(time.monotonic())
        elif kind == "CAMERA_IMAGE_CAPTURED":
            if message.capture_result == 1:
                self.captured[message.image_index] = message
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)

    def until(self, found: Any, what: str, timeout_s: float = 120) -> None:
        with self._lock:
            assert self._lock.wait_for(lambda: found(self), timeout_s), f"{what}: {self}"

    def catch_up(self) -> None:
        """Return when all that was sent by now has been heard."""
        marks = self._marks
        self._socket.sendto(_MARK, self.place)
        self.until(lambda it: it._marks > marks, "its own mark")

    def request(self, *, every_s: float = 0, count: int = 1, repeat: int = 0) -> None:
        """Ask for one photograph, or for one every so often (`count` 0: without an end), and don't wait. `repeat`: how
        often this was asked for before."""
        self.until(lambda it: it.camera is not None, "a camera's heartbeat")
        assert self.camera is not None
        assert self._peer is not None
        self._sequence += not repeat
        name = mavlink.MAV_CMD_IMAGE_START_CAPTURE
        asked = mavlink.MAVLink_command_long_message(
            *self.camera, name, repeat, 0, every_s, count, self._sequence, 0, 0, 0
        )
        self._socket.sendto(asked.pack(self._mav), self._peer)

    def accepted(self) -> float:
        """From its next heartbeat on, ask for photographs until one is accepted. Returns when that was heard
        (monotonic, s)."""
        heard, known = self.heartbeats, len(self.accepted_s)
        self.until(lambda it: it.heartbeats > heard, "a camera's heartbeat")
        for _ in range(240):
            answers = self._answers()
            self.request()
            with self._lock:
                self._lock.wait_for(lambda: self._answers() > answers, _ANSWER_S)  # noqa: B023 (asked in this turn)
                if self._lock.wait_for(lambda: len(self.accepted_s) > known, _AGAIN_S):
                    return self.accepted_s[known]
        raise AssertionError(self)

    def _answers(self) -> int:
        return len(self.accepted_s) + len(self.refused_s)

    def shoot(self) -> None:
        """One photograph, to its announcement. A request that is not answered is repeated, for less than the 10 s in
        which a repeated one is no new one."""
        known, answers = len(self.captured), self._answers()
        for repeat in range(4):
            self.request(repeat=repeat)
            with self._lock:
                if self._lock.wait_for(lambda: self._answers() > answers, _ANSWER_S):
                    break
        self.until(lambda it: len(it.captured) > known, "an announced image")


@contextlib.contextmanager
def station(place: tuple[str, int] = (HERE, STATION_PORT)) -> Iterator[Station]:
    """A ground station."""
    made = Station(place=place)
    try:
        yield made
    finally:
        made.close()
