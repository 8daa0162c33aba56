"""`dappled flight list|show|check|report|coverage|gnss|seal|offload|pickup`: work with recorded flights."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dappled import findings
from dappled.cli import sealing
from dappled.cli.arguments import Actions
from dappled.cli.flight import arguments as words
from dappled.cli.flight import lines as flight_lines
from dappled.clock import SystemClock
from dappled.config import settings
from dappled.errors import counted
from dappled.flight import FlightError, flight_report, index, layout, offload, owner_seal, seal_key
from dappled.flight.checks import flight_check
from dappled.shown import printable

_FLIGHT = "~/flights/20261121T101503Z-0a1b2c3d"


class NoKeyError(FlightError):
    """A flight was to be signed, and no key was named."""

    exit_code = 2


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled flight list\n  dappled flight report --config /etc/dappled/dappled.toml\n"
        f"  dappled flight check {_FLIGHT}"
    )
    actions = Actions.of(parser)
    listing = actions.add("list", "list all flights in a folder", "dappled flight list ~/flights")
    show = actions.add("show", "show every shot of a flight", f"dappled flight show {_FLIGHT}")
    intact = actions.add("check", "check that every byte is intact; exits 1 if not", f"dappled flight check {_FLIGHT}")
    report = actions.add(
        "report",
        "count which requests became frames; exits 1 if they don't agree, a frame is in doubt, or no shot was",
        "dappled flight report",
        f"dappled flight report {_FLIGHT} --log 00000012.BIN",
    )
    signing = actions.add(
        "seal",
        "check a flight and sign it as it stands; exits 1 if it is not intact",
        f"dappled flight seal {_FLIGHT} --key ~/seal.key",
    )
    away = actions.add(
        "offload",
        "copy a flight to another disk and prove the copy; remove the frames here on request",
        f"dappled flight offload /media/disk {_FLIGHT}",
        f"dappled flight offload /media/disk {_FLIGHT} --prune",
    )
    seen = actions.add("coverage", words.COVERAGE_HELP, *words.COVERAGE_EXAMPLES)
    receiver = actions.add("gnss", words.GNSS_HELP, *words.GNSS_EXAMPLES)
    bring = actions.add("pickup", words.PICKUP_HELP, *words.PICKUP_EXAMPLES)
    listing.add_argument(
        "folder", nargs="?", type=Path, metavar="FOLDER", help="flights folder (default: record.directory)"
    )
    away.add_argument("destination", type=Path, metavar="DEST", help="folder that will hold the flight's folder")
    away.add_argument("--prune", action="store_true", help="then remove the frames here, each by the proof of its copy")
    away.add_argument("--same-device", action="store_true", help="insist on a DEST that is on the same disk")
    words.configure_report(report)
    words.configure_pickup(bring)
    words.configure_coverage(seen)
    words.configure_gnss(receiver)
    intact.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="insist that this key signed the seals (default: record.seal_key, if any)",
    )
    signing.add_argument(
        "--key", type=Path, metavar="FILE", help="the key that signs (default: record.seal_key); see dappled keys seal"
    )
    for one in (show, intact, report, signing, away, bring, seen, receiver):
        one.add_argument(
            "flight", nargs="?", type=Path, metavar="FLIGHT", help="flight folder (default: the last with shots)"
        )
    for one in actions.all:
        one.add_argument("--config", type=Path, metavar="FILE", help="settings file that names the flights folder")
        one.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.action == "list":
        return _list(arguments.folder or _flights(arguments.config), arguments.json)
    flight = arguments.flight or _last_flight(_flights(arguments.config))
    alone = {"pickup": _pickup, "coverage": _coverage, "gnss": _gnss, "offload": _offload}
    if arguments.action in alone:
        return alone[arguments.action](flight, arguments)
    if arguments.action == "seal":
        return _seal(flight, arguments.config, arguments.key, arguments.json)
    if arguments.action == "check":
        return _check(flight, arguments.config, arguments.key, arguments.json)
    return (
        _report(flight, arguments.log, arguments.json)
        if arguments.action == "report"
        else _show(flight, arguments.json)
    )


def _pickup(flight: Path, arguments: argparse.Namespace) -> int:
    from dappled.cli.flight import pickup  # noqa: PLC0415  the decoder and MAVLink: a second that other verbs are spared

    return pickup.run(flight, arguments)


def _coverage(flight: Path, arguments: argparse.Namespace) -> int:
    from dappled.cli.flight import coverage  # noqa: PLC0415  as above, for SciPy and PROJ

    return coverage.run(flight, arguments)


def _gnss(flight: Path, arguments: argparse.Namespace) -> int:
    from dappled.cli.flight import gnss  # noqa: PLC0415  as above, for MAVLink

    return gnss.run(flight, arguments)


def _last_flight(flights: Path) -> Path:
    """The last flight with shots in a folder; says which. Raises FlightError if there is none."""
    found = index.in_order(flights)
    if not found:
        raise FlightError(f"there is no flight in {flights} yet; name one, or record one with `dappled run`")
    with_shots = [number for number, one in enumerate(found) if not _empty(one)]
    if not with_shots:
        raise FlightError(f"no flight in {flights} has a shot; name one to look at it all the same")
    chosen, skipped = found[with_shots[-1]], len(found) - 1 - with_shots[-1]
    later = f"; {counted(skipped, 'later flight')} without a shot skipped" if skipped else ""
    print(f"flight {chosen.path}, the last with shots{later}", file=sys.stderr)
    return chosen.path


def _empty(flight: layout.FlightFolder) -> bool:
    """Whether no shot was ever noted in a flight. False where that can't be known."""
    try:
        return flight.journal.stat().st_size == 0
    except OSError:
        return False


def _flights(config: Path | None) -> Path:
    """The settings' folder. Without a file: `flights` here, where `dappled run --simulate` records, if it holds any."""
    if config is None and layout.flights(settings.SIMULATED_FLIGHTS):
        return settings.SIMULATED_FLIGHTS
    return Path(settings.load(config).record.directory)


def _list(folder: Path, as_json: bool) -> int:
    found = flight_report.list_flights(folder)
    if not found and not as_json:
        print(f"no flights in {folder}", file=sys.stderr)
    return _said([_plain(one) for one in found], map(flight_lines.of_list, found), as_json)


def _show(flight: Path, as_json: bool) -> int:
    found = flight_report.show(flight)
    events = [
        {**_plain(one), "text": one.words, "finding": one.finding and one.finding.to_json()} for one in found.events
    ]
    return _said({**_plain(found), "events": events}, flight_lines.of_flight(found), as_json)


def _check(flight: Path, config: Path | None, key: Path | None, as_json: bool) -> int:
    found = flight_check.check(flight, sealing.key_of(config) if key is None else seal_key.load(key))
    _said({**_plain(found), "intact": found.intact}, flight_lines.of_check(found), as_json)
    return 0 if found.intact and (key is None or found.vouched == "signed") else 1


def _seal(flight: Path, config: Path | None, file: Path | None, as_json: bool) -> int:
    key = sealing.key_of(config) if file is None else seal_key.load(file)
    if key is None:
        raise NoKeyError(
            "no key is named to sign with: give --key FILE, or record.seal_key in --config; dappled keys seal makes one"
        )
    found = owner_seal.sign(flight, SystemClock(), key)
    _said({**_plain(found), "intact": found.intact}, flight_lines.of_check(found), as_json)
    return 0 if found.intact and found.vouched == "signed" else 1


def _report(flight: Path, logs: list[Path], as_json: bool) -> int:
    found, by_source = flight_report.balance(flight), flight_report.by_source(flight)
    sources = [asdict(one) for one in by_source]
    values = {**_plain(found), "sources": sources, "balanced": found.balanced if found.wishes else None}
    agree = found.balanced and found.wishes > 0 and not found.doubts
    said = [*flight_lines.of_report(found, by_source)]
    if logs:
        from dappled.cli.flight import books  # noqa: PLC0415  as above

        third = books.compared(flight, logs)
        values["log"], said, agree = third.values, [*said, *third.lines], agree and third.balanced
    _said(values, said, as_json)
    return 0 if agree else 1


def _offload(flight: Path, arguments: argparse.Namespace) -> int:
    total = sum(path.stat().st_size for path in flight.rglob("*") if path.is_file())
    with tqdm(total=total, unit="B", unit_scale=True, disable=None, delay=1.0, file=sys.__stderr__) as bar:
        done = offload.offload(
            flight,
            arguments.destination,
            prune=arguments.prune,
            same_device=arguments.same_device,
            clock=SystemClock(),
            key=sealing.key_of(arguments.config),
            progress=bar.update,
        )
    return _said(_plain(done), flight_lines.of_offload(done), arguments.json)


def _said(values: Any, lines: Iterable[str], as_json: bool) -> int:
    """Print the values as JSON, or the lines. Returns exit code 0."""
    for text in (json.dumps(values, indent=2),) if as_json else map(printable, lines):
        print(text)
    return 0


def _plain(value: Any) -> dict[str, Any]:
    """A record as JSON values, with paths as text."""
    plain: dict[str, Any] = json.loads(json.dumps(findings.plain(value), default=str))
    return plain
