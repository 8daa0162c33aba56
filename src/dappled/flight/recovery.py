"""Repair flights that were not closed, before the next flight begins.

Half-written files are removed, complete files without a row are adopted, shots that only the journal has are added to
the ledger, and shots that were still open become failed, with a reason. Nothing that was acknowledged is touched.
Everything done is reported.
"""

from __future__ import annotations

import os
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from dappled import durable, refusals
from dappled.clock import Clock
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import layout, log_reading, logs, seals
from dappled.flight.errors import disk_errors
from dappled.flight.index import ImageIndex
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, is_closed, moved_aside
from dappled.flight.logs import ShotJournal
from dappled.flight.records import CUT_SHORT, Frame, Stray
from dappled.flight.seal_key import SealKey
from dappled.flight.stored_rows import ledger_damage

FLIGHT = Subject("flight")
_JPEG = (".jpg", ".jpeg")


def recover(root: Path, index: ImageIndex, clock: Clock, key: SealKey | None) -> list[Finding]:
    """Repair all flights that were not closed, and index them. The caller holds the flights' lock.

    A flight that can't be repaired is reported and left as it is; the next flight can begin all the same.
    """
    report: list[Finding] = []
    for path in layout.unmade(root):
        shutil.rmtree(path, ignore_errors=True)
        report.append(finding(Code.FLIGHT_FOLDER_REMOVED, Subject("flights"), folder=path.name))
    sealed = index.sealed()
    for folder in layout.flights(root):
        if folder.name in sealed:
            continue
        try:
            layout.refuse_unfinished(folder)
            cut_short = not _closed(folder)
            signs = key if key is not None and (cut_short or _may_sign(folder, key)) else None
            report += [replace(one, subject=Subject("flight", folder.name)) for one in recover_flight(folder, clock)]
            if not seals.standing(folder).covered:
                seals.seal(folder, clock, seals.Occasion.RECOVERED, signs)
            report += index.take_in(folder, seal=True, cut_short=cut_short)
        except (DappledError, OSError) as error:
            report.append(finding(Code.FLIGHT_UNREPAIRED, Subject("flight", folder.name), why=error))
    return report


def _may_sign(folder: FlightFolder, key: SealKey) -> bool:
    """Whether a closed flight may be signed: it was never sealed, or this key signed all that is there."""
    before = seals.standing(folder)
    return (before.count == 0 and before.last is None) or before.signed_by(key)


def _closed(folder: FlightFolder) -> bool:
    """Whether the ledger says that the flight was closed; False where it can't be read."""
    try:
        return is_closed(folder.ledger)
    except DappledError:
        return False


def recover_flight(folder: FlightFolder, clock: Clock) -> list[Finding]:
    """Repair one flight and close it; a second call finds nothing to do.

    Raises FlightError or OSError when ledger or disk don't allow it, OutsideError when a part of it is a link.
    """
    folder.refuse_links()
    report = [finding(Code.FILE_PART_REMOVED, FLIGHT, file=name) for name in layout.remove_parts(folder)]
    report += _move_damaged_ledger(folder)
    with Ledger(folder.ledger, clock) as ledger:
        report += _add_noted_shots(folder, ledger)
        report += _adopt(folder, ledger)
        for row in ledger.shots():
            if row.state in ("wished", "fired"):
                lost = finding(Code.SHOT_LOST, FLIGHT, shot=row.shot.index, state=row.state)
                ledger.failed(row.shot.index, lost)
                report.append(lost)
        if "closed_utc_ns" not in ledger.facts():
            ledger.set_fact(CUT_SHORT, {"shots_s": logs.DURABLE_S, "refusals_s": refusals.SHOTS_BEHIND_S})
            close_ledger(folder, ledger, clock.utc_ns(), None, report)
            report.append(finding(Code.FLIGHT_PUT_RIGHT, FLIGHT))
        for one in report:
            ledger.add_event("recovery", one)
    return report


def close_ledger(
    folder: FlightFolder,
    ledger: Ledger,
    utc_ns: int,
    telemetry: logs.TelemetrySummary | None,
    report: list[Finding],
) -> None:
    """Store in the ledger the telemetry's summary (read from the file when not given) and the flight's end."""
    if telemetry is None and folder.telemetry.exists():
        telemetry = log_reading.summarise(folder.telemetry, report.append)
    if telemetry is not None:
        ledger.set_fact("telemetry_packets", telemetry.packets)
        ledger.set_fact("telemetry_bytes", telemetry.size)
        ledger.set_fact("telemetry_sha256", telemetry.sha256)
    ledger.set_fact("closed_utc_ns", utc_ns)


def _move_damaged_ledger(folder: FlightFolder) -> list[Finding]:
    """Move a damaged ledger aside; journal and frames will fill a new one."""
    damage = ledger_damage(folder.ledger)
    if damage is None:
        return []
    aside = moved_aside(folder.ledger)
    if folder.seals.exists():  # they are about that ledger's chain
        os.replace(folder.seals, folder.seals.with_name(folder.seals.name + ".damaged"))
    durable.sync_folder(folder.path)
    return [finding(Code.LEDGER_REBUILT, FLIGHT, damage=damage, aside=aside.name)]


def _add_noted_shots(folder: FlightFolder, ledger: Ledger) -> list[Finding]:
    journal = log_reading.read_journal(folder.journal)
    report = [*journal.problems]
    for shot in journal.shots:
        if ledger.shot(shot.index) is None:
            ledger.add_shot(shot)
            report.append(finding(Code.SHOT_ENTERED, FLIGHT, shot=shot.index))
    noted = {shot.index for shot in journal.shots}
    missing = [row.shot for row in ledger.shots() if row.shot.index not in noted]
    if missing:
        with closing(ShotJournal(folder.journal)) as writer:
            for shot in missing:
                writer.note(shot)
                report.append(finding(Code.SHOT_NOTED_AGAIN, FLIGHT, shot=shot.index))
    return report


def _adopt(folder: FlightFolder, ledger: Ledger) -> list[Finding]:
    """Adopt files without a row. A file under a final name is complete: the rename came after its fsync."""
    if not folder.frames.is_dir():
        return []
    known = {row.name for row in ledger.files()}
    report = []
    # JPEGs last: beside a raw frame they are companions
    for file_name in sorted(os.listdir(folder.frames), key=lambda one: (one.endswith(_JPEG), one)):
        name = f"frames/{file_name}"
        if name in known or file_name.endswith(layout.SIDECAR):
            continue
        path = folder.frames / file_name
        if path.is_symlink():
            report.append(finding(Code.FILE_NOT_FOLLOWED, FLIGHT, file=name))
            continue
        with disk_errors("adopt", path):
            stat = path.stat()
            held = (name, file_name, stat.st_size, durable.hash_file(path), stat.st_mtime_ns)
        number = layout.index_of(file_name)
        row = None if number is None else ledger.shot(number)
        if number is not None and row is not None and row.state != "safe":
            ledger.safe(Frame(number, *held))
            report.append(finding(Code.FILE_ADOPTED, FLIGHT, file=name, shot=number))
        elif number is not None and file_name.endswith(_JPEG) and _has_raw_frame(ledger, number):
            ledger.add_companion(Frame(number, *held))
            report.append(finding(Code.FILE_ADOPTED_BESIDE, FLIGHT, file=name, shot=number))
        else:
            why = finding(Code.FILE_UNCLAIMED, FLIGHT, file=name)
            ledger.add_stray(Stray(*held, why))
            report.append(why)
    return report


def _has_raw_frame(ledger: Ledger, index: int) -> bool:
    frame = ledger.frame(index)
    return frame is not None and not frame.name.endswith(_JPEG)
