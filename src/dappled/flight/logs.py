"""Write the two files of a flight that are only appended to: shots.jsonl and telemetry.tlog.

Each entry is one write(2), which survives the death of the process at once. A thread brings it to the disk, a shot at
once, telemetry within `DURABLE_S`; after that it survives a power cut. Neither firing nor receiving waits for a frame's
fsync or for a database.

shots.jsonl, the shot journal, has one JSON line for each shot, written before the camera is touched. telemetry.tlog has
every MAVLink packet received and sent, in the ground stations' common format: an 8-byte big-endian count of
microseconds UTC, and the packet. Packets are split by MAVLink's own framing (MAVLink 1: 0xFE, 8 bytes around the
payload; MAVLink 2: 0xFD, 12 bytes, 13 more with a signature) without a dialect.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import threading
from dataclasses import dataclass
from pathlib import Path

from dappled.clock import Clock, SystemClock
from dappled.codec import canonical
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight.errors import FlightError, disk_error, disk_errors
from dappled.flight.records import Shot
from dappled.workers import Loop

DURABLE_S = 1.0


class AppendedFile:
    """A file that is only appended to. Owns its descriptor and its flusher; its owner serialises the calls.

    Writes after `shut` are refused: they could reach another file that was opened since with the same descriptor.
    """

    def __init__(self, path: Path, what: str, flush_interval_s: float, *, new: bool, clock: Clock | None) -> None:
        """Open or make the file. `new`: it must not exist yet. `what` is its name in sentences. Raises FlightError."""
        self.path, self._what = path, what
        doing = f"{'make' if new else 'open'} {what}"
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | (os.O_EXCL if new else 0)
        with disk_errors(doing, path):
            self._fd = os.open(path, flags, 0o644)
        try:
            size = os.fstat(self._fd).st_size
            self.last = os.pread(self._fd, 1, size - 1) if size else b""  # byte, when it was opened
        except OSError as error:
            os.close(self._fd)
            raise disk_error(doing, path, error) from error
        self._flusher = Flusher(self._fd, flush_interval_s, clock)
        self._closed = False

    def append(self, data: bytes, doing: str) -> int:
        """Write once; returns the number of bytes written. Raises FlightError, "cannot `doing` …", when it is 0."""
        self._open_for(doing)
        with disk_errors(doing, self.path):
            written = os.write(self._fd, data)
        self._flusher.poke()
        return written

    def cut(self, size: int, doing: str) -> None:
        """Truncate the file to `size`. Raises FlightError as `append` does."""
        self._open_for(doing)
        with disk_errors(doing, self.path):
            os.ftruncate(self._fd, size)

    @property
    def problem(self) -> Finding | None:
        """Why written bytes may not survive a power cut; None where they do."""
        if self._flusher.error is None:
            return None
        why = disk_error(f"flush {self._what}", self.path, self._flusher.error)
        return finding(Code.LOG_UNWRITTEN, Subject("flight"), why=why)

    @property
    def synced(self) -> int:
        """How many of the file's first bytes survive a power cut; 0 once anything could not be flushed."""
        return 0 if self._flusher.error else self._flusher.synced

    def shut(self) -> bool:
        """Refuse writes from now on. False when they were refused already."""
        was, self._closed = self._closed, True
        return not was

    def close(self) -> None:
        """Flush and close, once, after `shut`. The owner need not hold its lock meanwhile."""
        self._flusher.close()
        os.close(self._fd)

    def _open_for(self, doing: str) -> None:
        if self._closed:
            raise FlightError(f"cannot {doing} {self.path}: the flight is closed")


class Flusher:
    """fdatasync one descriptor, at most `interval_s` after the first `poke`.

    Owns a thread, not the descriptor. What was written before a sync that succeeded is on the disk: the first `synced`
    bytes. A failed one stays in `error`: what was written before it may not survive a power cut.
    """

    def __init__(self, fd: int, interval_s: float = 0.5, clock: Clock | None = None) -> None:
        self._fd = fd
        self._interval_s = interval_s
        self._dirty = threading.Event()
        self.error: OSError | None = None
        self.synced = 0
        self._clock = clock or SystemClock()
        self._loop = Loop("flusher", self._run, clock=self._clock)
        self._loop.start()

    def poke(self) -> None:
        """Say that something was written."""
        if not self._dirty.is_set():
            self._dirty.set()

    def close(self) -> None:
        """Flush what is left and end the thread; the descriptor may be closed afterwards."""
        self._loop.stopping.set()
        self._dirty.set()
        while not self._loop.stop(60.0):
            pass  # a disk that stalls in fdatasync: the descriptor must stay open

    def _run(self) -> None:
        while not self._loop.stopping.is_set():
            self._clock.pause(self._dirty, None)
            self._clock.pause(self._loop.stopping, self._interval_s)
            self._sync()
        if self._dirty.is_set():
            self._sync()  # written, then closed, while the last one ran

    def _sync(self) -> None:
        self._dirty.clear()  # before the sync: a write during the sync needs another one
        try:
            written = os.fstat(self._fd).st_size
            os.fdatasync(self._fd)
        except OSError as error:
            self.error = error
        else:
            self.synced = written


class ShotJournal:
    """The open journal of one flight; owns its descriptor and its flusher. `note` may be called by any thread."""

    def __init__(self, path: Path, flush_interval_s: float = 0.0, clock: Clock | None = None) -> None:
        """Open or make the journal. After a torn last line the next note begins on a new line. Raises FlightError.

        A note is brought to the disk at once: a shot that was acknowledged, and perhaps fired, must be in the books.
        """
        self.path = path
        self._file = AppendedFile(path, "the shot journal", flush_interval_s, new=False, clock=clock)
        self._lock = threading.Lock()
        self._torn = self._file.last not in (b"", b"\n")  # the last write ended within a line

    def note(self, shot: Shot) -> None:
        """Append one shot. Raises FlightError when it could not be written whole, or the journal is closed: then the
        camera must not be fired."""
        line = canonical(shot) + b"\n"
        with self._lock:
            line = b"\n" + line if self._torn else line
            written = self._file.append(line, f"note shot {shot.index} in")
            self._torn = written != len(line)
        if written != len(line):
            raise FlightError(
                f"cannot note shot {shot.index} in {self.path}: the disk took {written} of {len(line)} bytes; "
                "free some space"
            )

    @property
    def problem(self) -> Finding | None:
        """Why noted shots may not survive a power cut; None where they do."""
        return self._file.problem

    def close(self) -> None:
        """Flush and close."""
        with self._lock:
            first = self._file.shut()
        if first:
            self._file.close()


MAVLINK_1, MAVLINK_2 = 0xFE, 0xFD
_SIGNED = 0x01
_LOGGING = "log telemetry in"
BLOCK_BYTES = 1 << 16  # a block is complete with the record that reaches this
_Bytes = bytes | mmap.mmap | memoryview


@dataclass(frozen=True, slots=True)
class TelemetrySummary:
    """The size and content of a closed telemetry log."""

    packets: int
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class TelemetryBlock:
    """Whole records of a telemetry log: from byte `start` up to `end`, and their SHA-256 (hex)."""

    start: int
    end: int
    sha256: str


def packet_length(data: _Bytes, at: int = 0) -> int | None:
    """Length of the MAVLink packet that begins at `at`; None where none begins or the packet is cut off."""
    left = len(data) - at
    if left >= 8 and data[at] == MAVLINK_1:
        length = data[at + 1] + 8
    elif left >= 12 and data[at] == MAVLINK_2:
        length = data[at + 1] + 12 + (13 if data[at + 2] & _SIGNED else 0)
    else:
        return None
    return length if length <= left else None


class TelemetryLog:
    """The open log of one flight; owns its descriptor and its flusher. Any thread may call `append`."""

    def __init__(self, path: Path, flush_interval_s: float = 0.5, clock: Clock | None = None) -> None:
        """Make the log. Raises FlightError, also when the file exists."""
        self.path = path
        self._lock = threading.Lock()
        self._sha, self._block_sha = hashlib.sha256(), hashlib.sha256()
        self._blocks: list[TelemetryBlock] = []
        self._packets = self._size = self._block_start = 0
        self._torn = False  # the last write ended within a record
        self._file = AppendedFile(path, "the telemetry log", flush_interval_s, new=True, clock=clock)

    def append(self, stamp_us: int, raw: bytes) -> int:
        """Log one packet; returns its running number, from 0. On disk within a second.

        Raises FlightError when the disk doesn't take it (no number is used up) or the log is closed, ValueError when
        `raw` is not exactly one MAVLink packet.
        """
        if packet_length(raw) != len(raw):
            raise ValueError(f"{len(raw)} bytes that are not one MAVLink packet can't be logged")
        record = stamp_us.to_bytes(8, "big") + raw
        with self._lock:
            if self._torn:
                self._cut()
            written = self._file.append(record, _LOGGING)
            if written != len(record):
                self._torn = True
                self._cut()
                raise FlightError(f"cannot {_LOGGING} {self.path}: the disk is full; free some space")
            self._sha.update(record)
            self._block_sha.update(record)
            self._size += written
            if self._size - self._block_start >= BLOCK_BYTES:
                self._blocks.append(TelemetryBlock(self._block_start, self._size, self._block_sha.hexdigest()))
                self._block_start, self._block_sha = self._size, hashlib.sha256()
            number = self._packets
            self._packets += 1
        return number

    def blocks(self, after: int) -> list[TelemetryBlock]:
        """The blocks that are full and on the disk, without the first `after`."""
        with self._lock:
            return [block for block in self._blocks[after:] if block.end <= self._file.synced]

    @property
    def problem(self) -> Finding | None:
        """Why logged packets may not survive a power cut; None where they do."""
        return self._file.problem

    def close(self) -> TelemetrySummary:
        """Flush and close; returns the size and content of the file."""
        with self._lock:
            first = self._file.shut()
        if first:
            self._file.close()
        return TelemetrySummary(self._packets, self._size, self._sha.hexdigest())

    def _cut(self) -> None:
        """Remove a record that was written in part; tried again before the next record."""
        self._file.cut(self._size, _LOGGING)
        self._torn = False
