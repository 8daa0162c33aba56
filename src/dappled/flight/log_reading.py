"""Read the two files of a flight that are only appended to, shots.jsonl and telemetry.tlog, past damage."""

from __future__ import annotations

import hashlib
import io
import mmap
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled import codec, durable
from dappled.bounds.parsing import check_stored, parse_json, read_log
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight.errors import disk_errors
from dappled.flight.logs import MAVLINK_1, MAVLINK_2, TelemetrySummary, packet_length
from dappled.flight.records import Shot

_MOST_LISTED = 1000  # lines that are no shots: a file can have any number of them
_LINE_BYTES = 1 << 16  # of the journal; a shot takes some 200
_LATEST_US = 1 << 53  # stamps beyond (year 2255) are damage


@dataclass(frozen=True, slots=True)
class JournalContents:
    """The shots of a journal in the order of its lines, and the lines that are not shots."""

    shots: tuple[Shot, ...]
    problems: tuple[Finding, ...]


def read_journal(path: Path) -> JournalContents:
    """Read a journal; a missing file counts as empty. A torn or damaged line is reported, the others are kept.

    Raises FlightError when the file can't be read.
    """
    with disk_errors("read the shot journal", path):
        try:
            data = read_log(path)
        except FileNotFoundError:
            return JournalContents((), ())
    tail = data[data.rfind(b"\n") + 1 :]
    shots: dict[int, Shot] = {}
    problems: list[Finding] = []
    about = Subject("file", str(path))
    unlisted = 0
    for number, line in enumerate(io.BytesIO(data[: len(data) - len(tail)]), 1):
        shot = _parse(line.removesuffix(b"\n"))
        if shot is not None and shot.index not in shots:
            shots[shot.index] = shot
        elif len(problems) >= _MOST_LISTED:
            unlisted += 1
        elif shot is None:
            problems.append(finding(Code.JOURNAL_LINE_DAMAGED, about, path=path, line=number))
        else:
            problems.append(finding(Code.JOURNAL_LINE_AGAIN, about, path=path, line=number, shot=shot.index))
    if unlisted:
        problems.append(finding(Code.JOURNAL_MORE_LINES, about, path=path, lines=unlisted))
    if tail:
        problems.append(finding(Code.JOURNAL_TORN, about, path=path, bytes=len(tail)))
    return JournalContents(tuple(shots.values()), tuple(problems))


def _parse(line: bytes) -> Shot | None:
    try:
        shot = codec.read(Shot, parse_json(line, _LINE_BYTES))
    except ValueError:
        return None
    return shot if shot.index >= 0 else None


def read_telemetry(
    path: Path, report: Callable[[Finding], object] = lambda _: None
) -> Iterator[tuple[int, int, bytes]]:
    """(running number, stamp in µs UTC, packet) of a .tlog, in the file's order.

    Bytes that are not a packet are skipped up to the next place where two records follow each other, or one ends the
    file. `report` gets each such gap. Raises FlightError when the file can't be read.
    """
    with disk_errors("read the telemetry", path), open(path, "rb", opener=durable.plain_file) as file:
        size = check_stored(file.fileno())
        data = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) if size else None
    if data is not None:
        with data:
            for number, (stamp_us, raw) in enumerate(split(data, report, path)):
                yield number, stamp_us, raw


def split(
    data: bytes | mmap.mmap, report: Callable[[Finding], object] = lambda _: None, path: Path = Path()
) -> Iterator[tuple[int, bytes]]:
    """(stamp in µs UTC, packet) of each record in a log's bytes; see `read_telemetry`."""
    at, size = 0, len(data)
    while at < size:
        end = _record_end(data, at)
        if end is None:
            found = _resynchronise(data, at + 1)
            skipped = (size if found is None else found) - at
            where = "at the end" if found is None else f"before byte {found}"
            report(finding(Code.LOG_BYTES_SKIPPED, Subject("log", str(path)), bytes=skipped, where=where))
            if found is None:
                return
            at = found
            continue
        yield int.from_bytes(data[at : at + 8], "big"), bytes(data[at + 8 : end])
        at = end


def summarise(path: Path, report: Callable[[Finding], object] = lambda _: None) -> TelemetrySummary:
    """Read a whole log and summarise it. Raises FlightError."""
    packets = sum(1 for _ in read_telemetry(path, report))
    with disk_errors("read the telemetry", path), open(path, "rb", opener=durable.plain_file) as file:
        return TelemetrySummary(
            packets, os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest()
        )


def _record_end(data: bytes | mmap.mmap, at: int) -> int | None:
    length = packet_length(data, at + 8)
    if length is None or int.from_bytes(data[at : at + 8], "big") >= _LATEST_US:
        return None
    return at + 8 + length


def _resynchronise(data: bytes | mmap.mmap, start: int) -> int | None:
    """The first offset at which two complete records follow each other, or one ends the file."""
    for at in range(start, len(data) - 15):
        if data[at + 8] in (MAVLINK_1, MAVLINK_2):
            end = _record_end(data, at)
            if end is not None and (end == len(data) or _record_end(data, end) is not None):
                return at
    return None
