"""Write and read telemetry.tlog: every MAVLink packet received and sent, in the ground stations' common format.

A record is an 8-byte big-endian count of microseconds UTC and the packet. Packets are split by MAVLink's own framing
(MAVLink 1: 0xFE, 8 bytes around the payload; MAVLink 2: 0xFD, 12 bytes, 13 more with a signature) without a dialect.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled.flight.errors import FlightError, disk_error
from dappled.flight.journal import AppendedFile

_MAVLINK_1, _MAVLINK_2 = 0xFE, 0xFD
_SIGNED = 0x01
_LOGGING = "log telemetry in"
_LATEST_US = 1 << 53  # stamps beyond (year 2255) are damage
_Bytes = bytes | mmap.mmap | memoryview


@dataclass(frozen=True, slots=True)
class TelemetrySummary:
    """The size and content of a closed telemetry log."""

    packets: int
    size: int
    sha256: str


def packet_length(data: _Bytes, at: int = 0) -> int | None:
    """Length of the MAVLink packet that begins at `at`; None where none begins or the packet is cut off."""
    left = len(data) - at
    if left >= 8 and data[at] == _MAVLINK_1:
        length = data[at + 1] + 8
    elif left >= 12 and data[at] == _MAVLINK_2:
        length = data[at + 1] + 12 + (13 if data[at + 2] & _SIGNED else 0)
    else:
        return None
    return length if length <= left else None


class TelemetryLog:
    """The open log of one flight; owns its descriptor and its flusher. Any thread may call `append`."""

    def __init__(self, path: Path, flush_interval_s: float = 0.5) -> None:
        """Make the log. Raises FlightError, also when the file exists."""
        self.path = path
        self._lock = threading.Lock()
        self._sha = hashlib.sha256()
        self._packets = self._size = 0
        self._torn = False  # the last write ended within a record
        self._file = AppendedFile(path, "the telemetry log", flush_interval_s, new=True)

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
            self._size += written
            number = self._packets
            self._packets += 1
        return number

    @property
    def problem(self) -> str | None:
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


def read(path: Path, report: Callable[[str], object] = lambda _: None) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet) of a .tlog, in the file's order.

    Bytes that are not a packet are skipped up to the next place where two records follow each other, or one ends the
    file. `report` gets a sentence for each such gap. Raises FlightError when the file can't be read.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            data = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) if size else None
    except OSError as error:
        raise disk_error("read the telemetry", path, error) from error
    if data is not None:
        with data:
            for number, (stamp_us, raw) in enumerate(split(data, lambda text: report(f"{path}: {text}"))):
                yield number, stamp_us, raw


def split(data: bytes | mmap.mmap, report: Callable[[str], object] = lambda _: None) -> Iterator[tuple[int, bytes]]:
    """(stamp in µs UTC, packet) of each record in a log's bytes; see `read`."""
    at, size = 0, len(data)
    while at < size:
        end = _record_end(data, at)
        if end is None:
            found = _resynchronise(data, at + 1)
            skipped = (size if found is None else found) - at
            where = "at the end" if found is None else f"before byte {found}"
            report(f"{skipped} bytes {where} are not telemetry and were skipped")
            if found is None:
                return
            at = found
            continue
        yield int.from_bytes(data[at : at + 8], "big"), bytes(data[at + 8 : end])
        at = end


def summarise(path: Path, report: Callable[[str], object] = lambda _: None) -> TelemetrySummary:
    """Read a whole log and summarise it. Raises FlightError."""
    packets = sum(1 for _ in read(path, report))
    try:
        with path.open("rb") as file:
            return TelemetrySummary(
                packets, os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest()
            )
    except OSError as error:
        raise disk_error("read the telemetry", path, error) from error


def _record_end(data: bytes | mmap.mmap, at: int) -> int | None:
    length = packet_length(data, at + 8)
    if length is None or int.from_bytes(data[at : at + 8], "big") >= _LATEST_US:
        return None
    return at + 8 + length


def _resynchronise(data: bytes | mmap.mmap, start: int) -> int | None:
    """The first offset at which two complete records follow each other, or one ends the file."""
    for at in range(start, len(data) - 15):
        if data[at + 8] in (_MAVLINK_1, _MAVLINK_2):
            end = _record_end(data, at)
            if end is not None and (end == len(data) or _record_end(data, end) is not None):
                return at
    return None
