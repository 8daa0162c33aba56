"""The recording of one flight, from its first to its last line: what the daemon opens and closes."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled.flight import durable, layout, provenance, recovery
from dappled.flight.errors import disk_error
from dappled.flight.index import Entry, ImageIndex, open_or_rebuild
from dappled.flight.journal import WishJournal
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger
from dappled.flight.lock import FlightsLock
from dappled.flight.recorder import Recorder
from dappled.flight.telemetry_log import TelemetryLog


@dataclass(frozen=True, slots=True)
class Recording:
    """The open parts of a flight. Each has one owner; `close` ends them all.

    `next_index` is the image index of the first shot. `recovered` says what was put in order in earlier flights.
    """

    folder: FlightFolder
    journal: WishJournal
    ledger: Ledger
    recorder: Recorder
    telemetry: TelemetryLog
    index: ImageIndex
    next_index: int
    recovered: tuple[str, ...]
    _lock: FlightsLock
    _utc_ns: Callable[[], int]
    _ended: threading.Event = field(default_factory=threading.Event)

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._ended.is_set()

    def note_image(self, index: int) -> None:
        """Bring the index over flights up to date for one shot. Raises FlightError."""
        row = self.ledger.shot(index)
        if row is not None:
            frame = self.ledger.frame(index)
            self.index.put(Entry(index, self.folder.name, None if frame is None else frame.name, row.state))

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Add to flight.toml what was learnt since the start, such as the camera's identity. Raises FlightError."""
        provenance.write_facts(self.folder, self.ledger, {**layout.read_facts(self.folder), **facts})

    def note_inputs(self, folder: str) -> None:
        """What stands in this folder of the flight is what frames are decoded with: `flight check` compares it from
        now on. Raises FlightError."""
        provenance.note(self.folder, self.ledger, folder)

    def learn_utc(self, correction_ns: int, sigma_ns: int, source: str) -> None:
        """UTC is known now: this is to be added to every stamp of this flight, those before it too. Nothing is renamed
        or stamped anew; ledger and index say it. Raises FlightError."""
        fact = {"correction_ns": correction_ns, "sigma_ns": sigma_ns, "source": source}
        self.ledger.set_fact("utc_correction", fact)
        self.ledger.add_event("utc", f"UTC is {correction_ns / 1e9:+.3f} s from this machine's, by {source}")
        began_utc_ns = self.ledger.facts()["began_utc_ns"]
        self.index.add_flight(self.folder.name, began_utc_ns + correction_ns, correction_ns)

    def close(self) -> list[str]:
        """End the flight: nobody notes, records or logs any more. Shots still open are failed; returns sentences.

        Raises FlightError when the ledger can't be closed properly; the next flight's recovery does it then.
        """
        self._ended.set()
        with ExitStack() as stack:
            stack.callback(self._lock.close)
            stack.callback(self.index.close)
            stack.callback(self.ledger.close)
            self.journal.close()
            telemetry = self.telemetry.close()
            report = [text for text in (self.journal.problem, self.telemetry.problem) if text is not None]
            recovery.close_ledger(self.folder, self.ledger, self._utc_ns(), telemetry, report)
            report += recovery.recover_flight(self.folder, self._utc_ns)
            report += self.index.take_in(self.folder, seal=True)
        return report


def begin(
    root: Path, utc_ns: Callable[[], int], facts: Mapping[str, Any] | None = None, *, utc_known: bool = True
) -> Recording:
    """Lock the flights folder, put earlier flights in order, and begin a new one.

    `facts` goes to flight.toml. `utc_known` False: `utc_ns` counts from somewhere, the flight is named by boot, and
    `learn_utc` may tell later what to add. Raises FlightError when another daemon records there, or the disk refuses.
    """
    with ExitStack() as stack:
        lock = FlightsLock(root)
        stack.callback(lock.close)
        index, recovered = open_or_rebuild(root)
        stack.callback(index.close)
        recovered += recovery.recover(root, index, utc_ns)
        next_index = index.next_index()
        began_utc_ns = utc_ns()
        start_utc_ns = began_utc_ns if utc_known else None
        folder = layout.create(root, start_utc_ns, facts)
        stack.callback(shutil.rmtree, folder.path, ignore_errors=True)  # a flight that could not begin
        ledger = Ledger(folder.ledger, utc_ns)
        stack.callback(ledger.close)
        ledger.set_fact("began_utc_ns", began_utc_ns)
        ledger.set_fact("utc_known", utc_known)
        provenance.note(folder, ledger, folder.settings.name)
        index.add_flight(folder.name, start_utc_ns)
        journal = WishJournal(folder.journal)
        stack.callback(journal.close)
        telemetry = TelemetryLog(folder.telemetry)
        stack.callback(telemetry.close)
        _make_names_sure(folder)
        for text in recovered:
            ledger.add_event("recovery", text)
        recorder = Recorder(folder, ledger)
        opened = Recording(
            folder, journal, ledger, recorder, telemetry, index, next_index, tuple(recovered), lock, utc_ns
        )
        stack.pop_all()
    return opened


def _make_names_sure(folder: FlightFolder) -> None:
    try:
        durable.sync_folder(folder.path)
    except OSError as error:
        raise disk_error("make the flight folder", folder.path, error) from error
