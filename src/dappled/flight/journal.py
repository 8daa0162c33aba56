"""The wish journal: every wish to shoot is on file before the camera is touched.

One JSON line a wish, appended by one write(2): it survives the death of the process at once. A flusher brings it to
the disk within a second, which a power cut can't undo. Firing never waits for a frame's fsync or a database.
"""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dappled.flight.durable import AppendedFile
from dappled.flight.errors import FlightError, disk_error
from dappled.flight.records import Cause, Shot, canonical


class ShotJournal:
    """The open journal of one flight; owns its descriptor and its flusher. `note` may be called by any thread."""

    def __init__(self, path: Path, flush_interval_s: float = 0.5) -> None:
        """Open or make the journal. A torn last line of an earlier life is closed off before the next. Raises
        FlightError."""
        self.path = path
        self._file = AppendedFile(path, "the wish journal", flush_interval_s, new=False)
        self._lock = threading.Lock()
        self._torn = self._file.last not in (b"", b"\n")  # the last write ended within a line

    def note(self, shot: Shot) -> None:
        """Append one wish. Raises FlightError when it could not be written whole, or the journal is closed: then don't
        fire."""
        line = canonical(asdict(shot)) + b"\n"
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
    def problem(self) -> str | None:
        """Why noted wishes may not survive a power cut, if so."""
        return self._file.problem

    def close(self) -> None:
        """Flush and close."""
        with self._lock:
            first = self._file.shut()
        if first:
            self._file.close()


@dataclass(frozen=True, slots=True)
class JournalContents:
    """What a journal says: shots in the order of their notes, and a sentence for each line that is no wish."""

    shots: tuple[Shot, ...]
    problems: tuple[str, ...]


def read(path: Path) -> JournalContents:
    """Read a journal; none at all is an empty one. A torn or damaged line is reported, the others are kept.

    Raises FlightError when the file can't be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return JournalContents((), ())
    except OSError as error:
        raise disk_error("read the wish journal", path, error) from error
    lines = data.split(b"\n")
    tail = lines.pop()
    shots: dict[int, Shot] = {}
    problems: list[str] = []
    for number, line in enumerate(lines, 1):
        shot = _parse(line)
        if shot is None:
            problems.append(f"line {number} of {path} is not a wish")
        elif shot.index in shots:
            problems.append(f"line {number} of {path} notes shot {shot.index} again")
        else:
            shots[shot.index] = shot
    if tail:
        problems.append(f"the last line of {path} is torn ({len(tail)} bytes)")
    return JournalContents(tuple(shots.values()), tuple(problems))


def _parse(line: bytes) -> Shot | None:
    try:
        value: Any = json.loads(line)
        shot = Shot(**{**value, "cause": Cause(**value["cause"])})
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    numbers = (shot.index, shot.wished_utc_ns, shot.wished_monotonic_ns)
    words = (shot.cause.source, shot.cause.kind)
    sequence = shot.cause.sequence
    whole = all(type(number) is int for number in numbers) and all(type(word) is str for word in words)
    return shot if whole and shot.index >= 0 and (sequence is None or type(sequence) is int) else None
