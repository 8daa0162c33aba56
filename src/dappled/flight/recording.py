"""Record one flight: begin it, make the camera's files safe, end it.

A frame is written into a file without a name, or under a temporary one; it is fsynced, gets its name, and the folder is
fsynced; then the ledger gets its row. Only then does `Recorder.record` return; only then may the frame be announced and
the camera's own copy be deleted.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, TypeVar

from dappled import durable
from dappled.clock import Clock
from dappled.findings import FRAME, Code, Finding, Subject, finding
from dappled.flight import layout, provenance, recovery, seals
from dappled.flight.errors import FlightError, disk_error, disk_errors
from dappled.flight.index import ImageIndex, IndexEntry, open_or_rebuild
from dappled.flight.layout import FlightFolder, FlightsLock
from dappled.flight.ledger import Ledger
from dappled.flight.logs import ShotJournal, TelemetryLog
from dappled.flight.records import Frame, Stray
from dappled.flight.seal_key import SealKey

_RESERVE = 4  # descriptors: a frame takes one at a time, and other threads may take what is given back

T = TypeVar("T")


class FileBytes(Protocol):
    """A file's bytes behind a descriptor; they are read by position, and the descriptor is never closed here."""

    @property
    def fd(self) -> int: ...

    @property
    def size(self) -> int: ...

    @property
    def sha256(self) -> str | None:
        """Where whoever wrote them has hashed them."""


class Recorder:
    """Writes the frames of one flight. One thread calls it.

    It holds descriptors in reserve until `close`: the file that has come is recorded also where all others are used up.
    """

    def __init__(self, folder: FlightFolder, ledger: Ledger) -> None:
        self._folder = folder
        self._ledger = ledger
        self._reserve: list[int] = []
        self._take_reserve()

    def close(self) -> None:
        """Give the reserve back. A second call does nothing."""
        while self._reserve:
            os.close(self._reserve.pop())

    def record(self, index: int, camera_name: str, blob: FileBytes, *, arrived_utc_ns: int) -> Frame:
        """Make the file of shot `index` safe: on return its bytes, its name and its ledger row are durable.

        The same bytes a second time give the same Frame. Raises FlightError for a second file of a shot or an
        unknown shot, whose bytes are kept as a stray, and when the disk or the blob fails: then no torn file is left
        under a final name, and the shot is noted as failed if the ledger can still be written.
        """
        row = self._ledger.shot(index)
        if row is None:
            why = finding(Code.FILE_UNASKED, Subject("file", camera_name), shot=index)
            self.record_stray(camera_name, blob, why, arrived_utc_ns=arrived_utc_ns)
            raise FlightError(why)
        first = self._ledger.frame(index)
        if first is not None:
            return self._again(first, camera_name, blob, arrived_utc_ns)
        name = layout.frame_name(index, camera_name)
        try:
            frame = Frame(index, name, camera_name, blob.size, self._write(name, camera_name, blob), arrived_utc_ns)
        except FlightError as error:
            if row.state != "failed":
                self._note_failure(index, error)
            raise
        self._ledger.safe(frame)
        return frame

    def record_companion(self, index: int, camera_name: str, blob: FileBytes, *, arrived_utc_ns: int) -> Frame:
        """Make a companion safe: a file of the same number beside the frame of a shot. Raises FlightError where the
        shot has no frame, or has such a file already."""
        if self._ledger.frame(index) is None:
            raise FlightError(f"{camera_name} belongs to shot {index}, which has no frame: it was not recorded")
        name = layout.frame_name(index, camera_name)
        sha256 = self._write(name, camera_name, blob)
        companion = Frame(index, name, camera_name, blob.size, sha256, arrived_utc_ns)
        self._ledger.add_companion(companion)
        return companion

    def record_stray(self, camera_name: str, blob: FileBytes, why: Finding, *, arrived_utc_ns: int) -> Stray:
        """Make a file safe that belongs to no shot: `why`. Raises FlightError."""
        taken = {PurePosixPath(stray.name).stem for stray in self._ledger.strays()}
        with disk_errors("list", self._folder.frames):  # one may have lost its row to a full disk
            taken |= {PurePosixPath(one).stem for one in self._with_reserve(partial(os.listdir, self._folder.frames))}
        number = next(n for n in range(len(taken) + 1) if f"stray-{n:06d}" not in taken)
        name = f"frames/stray-{number:06d}.{layout.extension(camera_name)}"
        sha256 = self._write(name, camera_name, blob)
        stray = Stray(name, camera_name, blob.size, sha256, arrived_utc_ns, why)
        self._ledger.add_stray(stray)
        return stray

    def _again(self, first: Frame, camera_name: str, blob: FileBytes, arrived_utc_ns: int) -> Frame:
        if blob.size == first.size and _sha256(blob) == first.sha256:
            self._ledger.add_event("double", finding(Code.FILE_CAME_AGAIN, FRAME, file=camera_name), first.index)
            return first
        why = finding(Code.FILE_SECOND, Subject("file", camera_name), shot=first.index, frame=first.name)
        self.record_stray(camera_name, blob, why, arrived_utc_ns=arrived_utc_ns)
        raise FlightError(why)

    def _write(self, name: str, camera_name: str, blob: FileBytes) -> str:
        path = self._folder.path / name
        if blob.size <= 0:
            raise FlightError(f"the camera's file {camera_name} is empty: nothing was recorded")
        try:
            return self._with_reserve(partial(self._put, path, blob))
        except OSError as error:
            raise disk_error(f"record {camera_name} as", path, error) from error
        except EOFError as error:
            raise FlightError(f"the camera's file {camera_name} ended early ({error}): it was not recorded") from error

    def _with_reserve(self, work: Callable[[], T]) -> T:
        """Do work that needs descriptors; once more with the reserve's where there were none. Raises what it raises."""
        try:
            return work()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE) or not self._reserve:
                raise
        self.close()
        try:
            return work()
        finally:
            self._take_reserve()

    def _put(self, path: Path, blob: FileBytes) -> str:
        return self._left_over(path, blob) if path.exists() else durable.take_in(blob.fd, blob.size, path, blob.sha256)

    def _take_reserve(self) -> None:
        """Hold a reserve again, as far as there are descriptors for it."""
        with suppress(OSError):
            while len(self._reserve) < _RESERVE:
                self._reserve.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def _left_over(self, path: Path, blob: FileBytes) -> str:
        """The hash of a file without a row, left by an attempt that was cut short: whole, since it has its final name.

        Raises FlightError where it holds other bytes than the camera's file.
        """
        sha256 = _sha256(blob)
        if path.stat().st_size != blob.size or durable.hash_file(path) != sha256:
            raise FlightError(f"{path} already exists without a ledger row; start a new flight to have it adopted")
        durable.sync_file(path)
        return sha256

    def _note_failure(self, index: int, error: FlightError) -> None:
        try:
            self._ledger.failed(index, finding(Code.SHOT_UNRECORDED, Subject("shot", index), reason=error))
        except FlightError as second:
            raise FlightError(f"{error}; and this could not be noted either: {second}") from error


def _sha256(blob: FileBytes) -> str:
    return blob.sha256 or durable.hash_descriptor(blob.fd, blob.size)


@dataclass(frozen=True, slots=True)
class Recording:
    """A flight that is being recorded, with its open parts; `close` ends them all.

    `next_index` is the image index of the first shot. `recovered` says what was repaired in earlier flights,
    `before` is the name of the last one that is there.
    """

    folder: FlightFolder
    journal: ShotJournal
    ledger: Ledger
    recorder: Recorder
    telemetry: TelemetryLog
    index: ImageIndex
    next_index: int
    recovered: tuple[Finding, ...]
    before: str | None
    _lock: FlightsLock
    _clock: Clock
    _key: SealKey | None
    _ended: threading.Event = field(default_factory=threading.Event)
    _facts: threading.Lock = field(default_factory=threading.Lock)

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._ended.is_set()

    def note_image(self, index: int) -> None:
        """Update the index over all flights for one shot. Raises FlightError."""
        row = self.ledger.shot(index)
        if row is not None:
            frame = self.ledger.frame(index)
            self.index.put(IndexEntry(index, self.folder.name, None if frame is None else frame.name, row.state))

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Add to flight.toml what became known since the start, such as the camera's identity. Any thread may; they
        take turns. Raises FlightError."""
        with self._facts:
            provenance.write_facts(self.folder, self.ledger, {**layout.read_facts(self.folder), **facts})

    def note_inputs(self, folder: str) -> None:
        """Store the hashes of the files in this folder of the flight, which frames are decoded with: `flight check`
        compares them. Raises FlightError."""
        provenance.note(self.folder, self.ledger, folder)

    def learn_utc(self, correction_ns: int, sigma_ns: int, source: str) -> None:
        """Store what is to be added to every stamp of this flight, earlier ones too, now that UTC is known. Stamps and
        names stay as they are: the ledger holds the correction. Raises FlightError."""
        fact = {"correction_ns": correction_ns, "sigma_ns": sigma_ns, "source": source}
        self.ledger.set_fact("utc_correction", fact)
        learned = finding(Code.CLOCK_UTC_LEARNED, Subject("clock"), correction_s=correction_ns / 1e9, source=source)
        self.ledger.add_event("utc", learned)
        began_utc_ns = self.ledger.facts()["began_utc_ns"]
        self.index.add_flight(self.folder.name, began_utc_ns + correction_ns)

    def close(self) -> list[Finding]:
        """End the flight. Shots still open become failed. Returns what was found.

        Raises FlightError when the ledger can't be closed properly; the recovery of the next flight closes it then.
        """
        self._ended.set()
        with ExitStack() as stack:
            stack.callback(self._lock.close)
            stack.callback(self.index.close)
            stack.callback(self.ledger.close)
            stack.callback(self.recorder.close)
            self.journal.close()
            telemetry = self.telemetry.close()
            report = [one for one in (self.journal.problem, self.telemetry.problem) if one is not None]
            recovery.close_ledger(self.folder, self.ledger, self._clock.utc_ns(), telemetry, report)
            report += recovery.recover_flight(self.folder, self._clock)
            self.ledger.close()
            seals.seal(self.folder, self._clock, seals.Occasion.CLOSED, self._key)
            report += self.index.take_in(self.folder, seal=True)
        return report


def begin(
    root: Path,
    clock: Clock,
    facts: Mapping[str, Any] | None = None,
    *,
    utc_known: bool = True,
    seal_key: SealKey | None = None,
) -> Recording:
    """Lock the flights folder, repair earlier flights, and begin a new one.

    `clock` stamps the events. `facts` goes to flight.toml. With `utc_known` False, its UTC counts from an arbitrary
    time, the flight is named by boot, and `learn_utc` may give the correction later. `seal_key` signs the seals of this
    flight and of those that are repaired. Raises FlightError when another daemon records there, or the disk refuses.
    """
    with ExitStack() as stack:
        lock = FlightsLock(root)
        stack.callback(lock.close)
        index, recovered = open_or_rebuild(root)
        stack.callback(index.close)
        recovered += recovery.recover(root, index, clock, seal_key)
        next_index = index.next_index()
        began_utc_ns = clock.utc_ns()
        start_utc_ns = began_utc_ns if utc_known else None
        before = next((name for name in reversed(index.flights()) if (root / name).is_dir()), None)
        folder = layout.create(root, start_utc_ns, facts)
        stack.callback(shutil.rmtree, folder.path, ignore_errors=True)  # a flight that could not begin
        telemetry = TelemetryLog(folder.telemetry, clock=clock)
        stack.callback(telemetry.close)
        ledger = Ledger(folder.ledger, clock, telemetry)
        stack.callback(ledger.close)
        ledger.set_fact("began_utc_ns", began_utc_ns)
        ledger.set_fact("utc_known", utc_known)
        provenance.note(folder, ledger, folder.settings.name)
        index.add_flight(folder.name, start_utc_ns)
        journal = ShotJournal(folder.journal, clock=clock)
        stack.callback(journal.close)
        _sync_names(folder)
        for one in recovered:
            ledger.add_event("recovery", one)
        recorder = Recorder(folder, ledger)
        opened = Recording(
            folder,
            journal,
            ledger,
            recorder,
            telemetry,
            index,
            next_index,
            tuple(recovered),
            before,
            lock,
            clock,
            seal_key,
        )
        stack.pop_all()
    return opened


def _sync_names(folder: FlightFolder) -> None:
    with disk_errors("make the flight folder", folder.path):
        durable.sync_folder(folder.path)
