"""`dappled flight list|show|check|report|offload|pickup`: recorded flights."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dappled.cli import flight_pickup
from dappled.config import settings
from dappled.flight import accounts, check, index, offload, summary
from dappled.flight.accounts import Account
from dappled.flight.errors import FlightError
from dappled.flight.ledger import LIVE


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled flight list\n  dappled flight report --config /etc/dappled/dappled.toml\n"
        "  dappled flight check ~/flights/20261121T101503Z-0a1b2c3d"
    )
    actions = parser.add_subparsers(dest="action", required=True)
    listing = actions.add_parser("list", help="all flights in a folder")
    listing.add_argument("folder", nargs="?", type=Path, help="flights folder (default: record.directory)")
    for name, line in (
        ("show", "every shot of a flight"),
        ("check", "is every byte intact? exits 1 if not"),
        ("report", "which wishes became frames; exits 1 if the books don't balance"),
    ):
        one = actions.add_parser(name, help=line)
        one.add_argument("flight", nargs="?", type=Path, help="flight folder (default: the last one)")
    away = actions.add_parser("offload", help="copy a flight to another disk and verify it by hash; prune on request")
    away.add_argument("destination", type=Path, metavar="DEST", help="folder that will hold the flight's folder")
    away.add_argument("flight", nargs="?", type=Path, help="flight folder (default: the last one)")
    away.add_argument("--prune", action="store_true", help="afterwards remove the frames here; the ledger stays")
    flight_pickup.configure(actions.add_parser("pickup", help=flight_pickup.HELP))
    for one in actions.choices.values():
        one.add_argument("--config", type=Path, metavar="FILE", help="settings that say where flights are")
        one.add_argument("--json", action="store_true", help="as JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.action == "list":
        return _list(arguments.folder or _flights(arguments.config), arguments.json)
    flight = arguments.flight or _last_flight(_flights(arguments.config))
    if arguments.action == "pickup":
        return flight_pickup.run(flight, arguments)
    if arguments.action == "offload":
        return _offload(flight, arguments.destination, arguments.prune, arguments.json)
    return {"show": _show, "check": _check, "report": _report}[arguments.action](flight, arguments.json)


def _last_flight(flights: Path) -> Path:
    """The newest flight in a folder. Raises FlightError when there is none."""
    found = index.in_order(flights)
    if not found:
        raise FlightError(f"there is no flight in {flights} yet; name one, or record one with `dappled run`")
    return found[-1].path


def _flights(config: Path | None) -> Path:
    return Path(settings.load(config).record.directory)


def _list(folder: Path, as_json: bool) -> int:
    found = summary.list_flights(folder)
    if as_json:
        print(json.dumps([_plain(one) for one in found], indent=2))
        return 0
    for one in found:
        if one.balance is None:
            print(f"{one.name}  {one.problem}")
        else:
            b = one.balance
            state = "" if b.closed else "  (open)"
            began = "UTC not known" if b.began_utc_ns is None else _utc(b.began_utc_ns)[:16].replace("T", " ")
            print(f"{one.name}  {began}  {b.frames} frames, {b.failed} failed, {b.size / 1e6:.1f} MB{state}")
    if not found:
        print(f"no flights in {folder}", file=sys.stderr)
    return 0


def _show(flight: Path, as_json: bool) -> int:
    found = summary.show(flight)
    if as_json:
        print(json.dumps(_plain(found), indent=2))
        return 0
    print(f"{found.name}")
    if found.utc_correction_ns is None:
        print("UTC was never known in this flight: times count from an unknown moment")
    for line in found.lines:
        shot = line.row.shot
        words = [
            f"{shot.index:6d}",
            _utc(shot.wished_utc_ns + (found.utc_correction_ns or 0))[11:23],
            shot.cause.source,
            line.row.state,
        ]
        if line.row.reason:
            words.append(line.row.reason)
        if line.frame:
            words.append(f"{line.frame.name} {line.frame.size / 1e6:.1f} MB")
        if line.tag and line.tag.pose.latitude_rad is not None and line.tag.pose.longitude_rad is not None:
            pose = line.tag.pose
            words.append(
                f"{math.degrees(line.tag.pose.latitude_rad):.7f} {math.degrees(line.tag.pose.longitude_rad):.7f}"
            )
            words.append(f"{pose.altitude_msl_m:.1f} m")
        if line.result:
            words.append(f"{line.result.carriers_found}/{line.result.carriers_predicted} carriers")
        print("  ".join(words))
    for run, count in found.runs.items():
        if run != LIVE:
            print(f"   run  {run}: {count} frames decoded again")
    for stray in found.strays:
        print(f" stray  {stray.name}  {stray.reason}")
    return 0


def _check(flight: Path, as_json: bool) -> int:
    found = check.check(flight)
    if as_json:
        print(json.dumps({**_plain(found), "intact": found.intact}, indent=2))
    else:
        for text in found.problems:
            print(f"wrong: {text}")
        for text in found.notes:
            print(f"note:  {text}")
        word = "intact" if found.intact else "NOT INTACT"
        size = f"{found.size / 1e6:.1f} MB"
        print(f"{found.flight}: {word}: {found.files} files, {size}, {found.telemetry_packets} telemetry packets")
    return 0 if found.intact else 1


def _report(flight: Path, as_json: bool) -> int:
    found, books = summary.report(flight), accounts.accounts(flight)
    if as_json:
        sources = [asdict(one) for one in books]
        print(json.dumps({**_plain(found), "sources": sources, "balanced": found.balanced}, indent=2))
    else:
        print(f"{found.flight}{'' if found.closed else ' (still open)'}")
        for line in _table(books):
            print(f"  {line}")
        if found.refused:
            print(f"  {found.refused:6d} wishes refused, each with its reason (dappled flight show --json: events)")
        print(f"  {found.wishes:6d} shots: {found.safe} safe, {found.failed} failed, {found.open} open")
        print(f"  {found.frames:6d} frames, {found.size / 1e6:.1f} MB: {found.tagged} tagged, {found.decoded} decoded")
        if found.following:
            print(f"  {found.following:6d} of the failed were fired, and their files follow: dappled flight pickup")
        if found.companions:
            print(f"  {found.companions:6d} files beside frames, such as the JPEG of a raw frame")
        if found.strays:
            print(f"  {found.strays:6d} files without a shot of their own")
        print("the books balance" if found.balanced else "THE BOOKS DO NOT BALANCE: run `dappled flight check`")
    return 0 if found.balanced else 1


def _table(books: Sequence[Account]) -> Iterator[str]:
    """A line for each source, below one of headings; nothing for a flight without a wish."""
    names = ("wishes", "refused", "shots", "safe", "failed", "open", "tagged", "decoded")
    if books:
        yield f"{'source':24}" + "".join(f"{name:>9}" for name in names)
    for one in books:
        yield f"{one.source:24}" + "".join(f"{getattr(one, name):9d}" for name in names)


def _offload(flight: Path, destination: Path, prune: bool, as_json: bool) -> int:
    total = sum(path.stat().st_size for path in flight.rglob("*") if path.is_file())
    with tqdm(total=total, unit="B", unit_scale=True, disable=None, delay=1.0) as bar:
        done = offload.offload(flight, destination, prune=prune, utc_ns=time.time_ns, progress=bar.update)
    if as_json:
        print(json.dumps(_plain(done), indent=2))
    else:
        print(f"{done.destination}: {done.copied} files copied and verified, {done.there_already} were there already")
        if done.pruned:
            print(f"{done.pruned} frames removed from {flight}; its ledger stays")
    return 0


def _utc(utc_ns: int) -> str:
    """2026-11-21T10:15:03.123456"""
    return datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")


def _plain(value: Any) -> dict[str, Any]:
    """A record as JSON values; paths become text."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(value), default=str))
    return plain
