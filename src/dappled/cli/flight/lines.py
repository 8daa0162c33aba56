"""Turn a flight's records into the lines that `dappled flight` prints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from dappled import findings
from dappled.errors import counted
from dappled.flight import LIVE
from dappled.flight.checks.flight_check import CheckReport
from dappled.flight.flight_report import Balance, FlightContents, ListedFlight, ShotLine, SourceReport, StoodFinding
from dappled.flight.offload import Offloaded

_SHOWN = 20  # frames of a verdict


def of_list(one: ListedFlight) -> str:
    """A flight of a list: when it began and what is in it, or why it can't be read."""
    b = one.balance
    if b is None:
        return f"{one.name}  {findings.text(one.problem) if one.problem else ''}"
    state = "" if b.closed else "  (open)"
    began = "UTC not known" if b.began_utc_ns is None else _utc(b.began_utc_ns)[:16].replace("T", " ")
    if not b.wishes:
        return f"{one.name}  {began}  no shot{state}"
    return f"{one.name}  {began}  {counted(b.frames, 'frame')}, {b.failed} failed, {b.size / 1e6:.1f} MB{state}"


def of_flight(found: FlightContents) -> Iterator[str]:
    """A line for each shot, run and stray."""
    yield found.name
    if found.utc_correction_ns is None:
        yield "UTC was never known in this flight: times count from an unknown start"
    for line in found.lines:
        yield _of_shot(line, found.utc_correction_ns or 0)
    for run, count in found.runs.items():
        if run != LIVE:
            yield f"   run  {run}: {counted(count, 'frame')} decoded again"
    for stray in found.strays:
        yield f" stray  {stray.name}  {'' if stray.reason is None else findings.named(stray.reason)}".rstrip()


def _of_shot(line: ShotLine, utc_correction_ns: int) -> str:
    shot = line.row.shot
    words = [
        f"{shot.index:6d}",
        _utc(shot.wished_utc_ns + utc_correction_ns)[11:23],
        shot.cause.source,
        line.row.state,
    ]
    if line.row.reason:
        words.append(str(findings.text(line.row.reason)))
    if line.frame:
        words.append(f"{line.frame.name} {line.frame.size / 1e6:.1f} MB")
    pose = line.tag.pose if line.tag else None
    if pose and pose.latitude_rad is not None and pose.longitude_rad is not None:
        words.append(f"{math.degrees(pose.latitude_rad):.7f} {math.degrees(pose.longitude_rad):.7f}")
        words.append(f"{pose.altitude_msl_m:.1f} m")
    if line.result:
        found = "-" if line.result.carriers_found is None else line.result.carriers_found
        words.append(f"{found}/{line.result.carriers_predicted} carriers")
        if line.result.verdict is not None:
            words.append(line.result.verdict.state)
    return "  ".join(words)


def of_check(found: CheckReport) -> Iterator[str]:
    """The problems, the notes, and the verdict."""
    yield from (f"wrong: {findings.text(one)}" for one in found.problems)
    yield from (f"note:  {findings.text(one)}" for one in found.notes)
    word, rest = "NOT INTACT", ""
    if found.intact:
        words, signed = str(findings.told(found.verdict, found.verdict.subject)), found.vouched == "signed"
        word, rest = (f"intact, {words}", "") if signed else ("consistent", words)
    size = f"{found.size / 1e6:.1f} MB"
    packets = counted(found.telemetry_packets, "telemetry packet")
    if found.offloaded:
        word = f"{word}, of what is still here" if found.intact else word
        packets += f"; {counted(found.offloaded, 'file')} offloaded and not read"
    yield f"{found.flight}: {word}: {counted(found.files, 'file')}, {size}, {packets}{rest and f'; {rest}'}"


def of_report(found: Balance, sources: Sequence[SourceReport]) -> Iterator[str]:
    """The counts by source, their sums, and whether they agree."""
    yield f"{found.flight}{'' if found.closed else ' (still open)'}"
    yield from (f"  {line}" for line in _table(sources))
    if found.refused:
        refused = counted(found.refused, "request", 6)
        yield f"  {refused} refused, each with its reason (dappled flight show --json: events)"
    yield f"  {counted(found.wishes, 'shot', 6)}: {found.safe} safe, {found.failed} failed, {found.open} open"
    frames = counted(found.frames, "frame", 6)
    yield f"  {frames}, {found.size / 1e6:.1f} MB: {found.tagged} tagged, {found.decoded} decoded"
    yield from _of_verdicts(found)
    if found.following:
        yield f"  {found.following:6d} of the failed still have their files in the camera: dappled flight pickup"
    if found.companions:
        yield f"  {counted(found.companions, 'file', 6)} beside frames, such as the JPEG of a raw frame"
    if found.strays:
        yield f"  {counted(found.strays, 'file', 6)} without a shot"
    yield from _first("card", [str(findings.told(one)) for one in found.card])
    yield from _first("stood", [f"{_span(one)}: {findings.told(one.finding)}" for one in found.stood])
    yield from (f"lost: {findings.told(one)}" for one in found.lost_triggers)
    if found.balanced and not found.wishes:
        yield "NO SHOT in this flight: there are no counts to compare"
        return
    if found.lost:
        yield f"THE COUNTS DO NOT AGREE: {counted(found.lost, 'trigger')} of the autopilot became no shot"
        return
    if found.balanced and found.cut_short:
        yield "what is recorded adds up; what came last is not known"
        return
    yield "the counts agree" if found.balanced else "THE COUNTS DO NOT AGREE: run `dappled flight check`"


def _of_verdicts(found: Balance) -> Iterator[str]:
    """How the frames were judged in flight, and in how many of them the mask is seen."""
    if found.judged:
        yield f"  {'judged':>13}: {', '.join(f'{count} {state}' for state, count in found.judged.items())}"
        for state, why in (("bad", found.bad), ("unknown", found.unknown)):
            yield from _first(state, [str(findings.told(one)) for one in why], f" {state} ones")
    if found.mask:
        yield f"  {'mask':>13}: {findings.told(found.mask)}"


def _first(title: str, said: Sequence[str], of: str = "") -> Iterator[str]:
    """The first lines of a list under its title, and how many more there are."""
    yield from (f"  {title:>13}: {one}" for one in said[:_SHOWN])
    if len(said) > _SHOWN:
        yield f"  {'':13}  and {len(said) - _SHOWN} more{of} (--json names all)"


def _span(one: StoodFinding) -> str:
    """From when to when a finding stood, UTC."""
    if one.began_utc_ns is None:
        return "at a time that is not known"
    return (
        f"{_utc(one.began_utc_ns)[11:19]} to {'the end' if one.ended_utc_ns is None else _utc(one.ended_utc_ns)[11:19]}"
    )


def _table(sources: Sequence[SourceReport]) -> Iterator[str]:
    """Headings and a line for each source; nothing for a flight without a request."""
    titles = {"wishes": "requests"}
    names = ("wishes", "refused", "shots", "safe", "failed", "open", "tagged", "decoded")
    if sources:
        yield f"{'source':24}" + "".join(f"{titles.get(name, name):>9}" for name in names)
    for one in sources:
        yield f"{one.source:24}" + "".join(f"{getattr(one, name):9d}" for name in names)


def of_offload(done: Offloaded) -> Iterator[str]:
    """How many files were copied and proved, how, and how many were removed here."""
    counts = f"{counted(done.copied, 'file')} copied and verified, {done.there_already} already there"
    yield f"{done.destination}: {counts}; read back from {done.file_system} by {' and '.join(done.read_back)}"
    if done.brought_home:
        yield f"{counted(done.brought_home, 'row')} that work at the copy had added to the ledger were brought here"
    if done.pruned:
        yield f"{counted(done.pruned, 'file')} removed here; offloaded.jsonl names them, ledger and telemetry stay"


def _utc(utc_ns: int) -> str:
    """2026-11-21T10:15:03.123456"""
    return datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")
