"""What the flight verbs say, line by line: from a flight's records to words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from dappled.flight import LIVE
from dappled.flight.check import CheckReport
from dappled.flight.flight_report import Balance, FlightContents, ListedFlight, ShotLine, SourceReport
from dappled.flight.offload import Offloaded


def of_list(one: ListedFlight) -> str:
    """A flight of a list: when it began, what is in it, or why that can't be said."""
    b = one.balance
    if b is None:
        return f"{one.name}  {one.problem}"
    state = "" if b.closed else "  (open)"
    began = "UTC not known" if b.began_utc_ns is None else _utc(b.began_utc_ns)[:16].replace("T", " ")
    return f"{one.name}  {began}  {b.frames} frames, {b.failed} failed, {b.size / 1e6:.1f} MB{state}"


def of_flight(found: FlightContents) -> Iterator[str]:
    """A line for each shot, run and stray."""
    yield found.name
    if found.utc_correction_ns is None:
        yield "UTC was never known in this flight: times count from an unknown moment"
    for line in found.lines:
        yield _of_shot(line, found.utc_correction_ns or 0)
    for run, count in found.runs.items():
        if run != LIVE:
            yield f"   run  {run}: {count} frames decoded again"
    for stray in found.strays:
        yield f" stray  {stray.name}  {stray.reason}"


def _of_shot(line: ShotLine, utc_correction_ns: int) -> str:
    shot = line.row.shot
    words = [
        f"{shot.index:6d}",
        _utc(shot.wished_utc_ns + utc_correction_ns)[11:23],
        shot.cause.source,
        line.row.state,
    ]
    if line.row.reason:
        words.append(line.row.reason)
    if line.frame:
        words.append(f"{line.frame.name} {line.frame.size / 1e6:.1f} MB")
    pose = line.tag.pose if line.tag else None
    if pose and pose.latitude_rad is not None and pose.longitude_rad is not None:
        words.append(f"{math.degrees(pose.latitude_rad):.7f} {math.degrees(pose.longitude_rad):.7f}")
        words.append(f"{pose.altitude_msl_m:.1f} m")
    if line.result:
        words.append(f"{line.result.carriers_found}/{line.result.carriers_predicted} carriers")
    return "  ".join(words)


def of_check(found: CheckReport) -> Iterator[str]:
    """What is wrong, what is worth knowing, and the verdict."""
    yield from (f"wrong: {text}" for text in found.problems)
    yield from (f"note:  {text}" for text in found.notes)
    word = "intact" if found.intact else "NOT INTACT"
    size = f"{found.size / 1e6:.1f} MB"
    yield f"{found.flight}: {word}: {found.files} files, {size}, {found.telemetry_packets} telemetry packets"


def of_report(found: Balance, books: Sequence[SourceReport]) -> Iterator[str]:
    """The books by source, the sums, and whether they balance."""
    yield f"{found.flight}{'' if found.closed else ' (still open)'}"
    yield from (f"  {line}" for line in _table(books))
    if found.refused:
        yield f"  {found.refused:6d} wishes refused, each with its reason (dappled flight show --json: events)"
    yield f"  {found.wishes:6d} shots: {found.safe} safe, {found.failed} failed, {found.open} open"
    yield f"  {found.frames:6d} frames, {found.size / 1e6:.1f} MB: {found.tagged} tagged, {found.decoded} decoded"
    if found.following:
        yield f"  {found.following:6d} of the failed were fired, and their files follow: dappled flight pickup"
    if found.companions:
        yield f"  {found.companions:6d} files beside frames, such as the JPEG of a raw frame"
    if found.strays:
        yield f"  {found.strays:6d} files without a shot of their own"
    yield "the books balance" if found.balanced else "THE BOOKS DO NOT BALANCE: run `dappled flight check`"


def _table(books: Sequence[SourceReport]) -> Iterator[str]:
    """A line for each source, below one of headings; nothing for a flight without a wish."""
    names = ("wishes", "refused", "shots", "safe", "failed", "open", "tagged", "decoded")
    if books:
        yield f"{'source':24}" + "".join(f"{name:>9}" for name in names)
    for one in books:
        yield f"{one.source:24}" + "".join(f"{getattr(one, name):9d}" for name in names)


def of_offload(done: Offloaded) -> Iterator[str]:
    """How many files were copied and verified."""
    yield f"{done.destination}: {done.copied} files copied and verified, {done.there_already} were there already"


def _utc(utc_ns: int) -> str:
    """2026-11-21T10:15:03.123456"""
    return datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")
