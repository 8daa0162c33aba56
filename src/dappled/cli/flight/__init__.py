"""`dappled flight list|show|check|report|seal|offload`: work with recorded flights; further actions beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import codec
from dappled.cli import paths, sealing
from dappled.cli.flight.arguments import EXAMPLE, FlightArgument, folder_of_flights
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, SettingsArgument, Verb, argument, flag, option
from dappled.clock import SystemClock
from dappled.errors import CallError

if not words_only:
    from dappled.cli.flight import lines as flight_lines
    from dappled.flight import flight_report, offload, owner_seal
    from dappled.flight.checks import flight_check
    from dappled.flight.checks.flight_check import CheckReport


@dataclass(frozen=True, kw_only=True)
class ListFlights(SettingsArgument, Verb):
    """List all flights in a folder."""

    examples = ("dappled flight list ~/flights",)

    folder: Path | None = argument(
        "FOLDER", "flights folder (default: record.directory)", default=None, there=paths.folder
    )

    def run(self, output: Output) -> Report:
        folder = self.folder or folder_of_flights(self.config)
        found = flight_report.list_flights(folder)
        if not found and not self.json:
            output.remark(f"no flights in {folder}")
        return Report([codec.plain(one) for one in found], [flight_lines.of_list(one) for one in found])


@dataclass(frozen=True, kw_only=True)
class ShowFlight(FlightArgument, Verb):
    """Show every shot of a flight."""

    examples = (f"dappled flight show {EXAMPLE}",)

    def run(self, output: Output) -> Report:
        found = flight_report.show(self.chosen(output))
        events = [{**codec.plain(one), "text": one.words, "finding": codec.plain(one.finding)} for one in found.events]
        return Report({**codec.plain(found), "events": events}, list(flight_lines.of_flight(found)))


@dataclass(frozen=True, kw_only=True)
class CheckFlight(FlightArgument, Verb):
    """Check that every byte is intact."""

    examples = (f"dappled flight check {EXAMPLE}",)

    key: Path | None = option(
        "--key", "insist that this key signed the seals", None, there=paths.file, otherwise="record.seal_key, if any",
    )  # fmt: skip

    def run(self, output: Output) -> Report:
        key = sealing.key_of(self.config, self.key)
        return _of_check(flight_check.check(self.chosen(output), key), signed=self.key is not None)


@dataclass(frozen=True, kw_only=True)
class SealFlight(FlightArgument, Verb):
    """Check a flight and sign it as it stands."""

    examples = (f"dappled flight seal {EXAMPLE} --key ~/seal.key",)

    key: Path | None = option(
        "--key", "the key that signs; see dappled keys seal", None, there=paths.file, otherwise="record.seal_key",
    )  # fmt: skip

    def run(self, output: Output) -> Report:
        flight = self.chosen(output)
        key = sealing.key_of(self.config, self.key)
        if key is None:
            named = "give --key FILE, or record.seal_key in --config"
            raise CallError(f"no key is named to sign with: {named}; dappled keys seal makes one")
        return _of_check(owner_seal.sign(flight, SystemClock(), key), signed=True)


def _of_check(found: CheckReport, *, signed: bool) -> Report:
    """A report that has failed where the flight isn't intact, or is to be `signed` and isn't."""
    values = {**codec.plain(found), "intact": found.intact}
    good = found.intact and (not signed or found.vouched == "signed")
    return Report(values, list(flight_lines.of_check(found)), failed=not good)


@dataclass(frozen=True, kw_only=True)
class ReportFlight(Overwriting, FlightArgument, Verb):
    """Count which requests became frames."""

    examples = (
        "dappled flight report",
        f"dappled flight report {EXAMPLE} --log 00000012.BIN",
        "dappled flight report --page quality.html --page quality.pdf",
    )

    log: tuple[Path, ...] = option(
        "--log", "compare with the autopilot's own log (.bin, .ulg); again for each of its starts in the flight", (),
        append=True, metavar="FILE", there=True,
    )  # fmt: skip
    page: tuple[Path, ...] = option(
        "--page", "write the flight's quality on a page (.html for a phone, .pdf): counts, coverage, ground "
        "resolution, overlap, blur, poses, doubts; again for both", (), append=True, metavar="FILE",
    )  # fmt: skip

    def check(self) -> None:
        for path in self.page:
            if path.suffix not in (".html", ".pdf"):
                raise CallError(f"--page {path}: a page is .html or .pdf")
        self.refuse_existing(*self.page)

    def run(self, output: Output) -> Report:
        flight = self.chosen(output)
        found, by_source = flight_report.balance(flight), flight_report.by_source(flight)
        sources = codec.plain(by_source)
        known = found.wishes and not (found.balanced and found.cut_short)
        values = {**codec.plain(found), "sources": sources, "balanced": found.balanced if known else None}
        agree = found.balanced and found.wishes > 0
        said = [*flight_lines.of_report(found, by_source)]
        doubts = [*found.doubts, *filter(None, [found.cut_short])]
        if self.log:
            from dappled.cli.flight import books  # noqa: PLC0415  # the logs' readers take a second to load

            third = books.compared(flight, self.log)
            values["log"], said, agree = third.values, [*said, *third.lines], agree and not third.failed
            doubts += third.findings
        if self.page:
            from dappled.products.survey import flight_quality  # noqa: PLC0415  # only pages need the maps' libraries

            made = flight_quality.of_flight(flight)
            for path in self.page:
                flight_quality.write(made, path)
            said, values["pages"] = [*said, *map(str, self.page)], [str(path) for path in self.page]
        return Report(values, said, findings=doubts, failed=not agree)


@dataclass(frozen=True, kw_only=True)
class OffloadFlight(Doubtable, FlightArgument, Verb):
    """Copy a flight to another disk."""

    examples = (
        f"dappled flight offload /media/disk {EXAMPLE}",
        f"dappled flight offload /media/disk {EXAMPLE} --prune",
    )

    destination: Path = argument("DEST", "folder that will hold the flight's folder", first=True)
    prune: bool = flag("--prune", "then remove the frames here, each by the proof of its copy")
    same_device: bool = flag("--same-device", "insist on a DEST that is on the same disk")

    def run(self, output: Output) -> Report:
        flight = self.chosen(output)
        total = sum(path.stat().st_size for path in flight.rglob("*") if path.is_file())
        with output.bar(total, "B") as add:
            done = offload.offload(
                flight,
                self.destination,
                prune=self.prune,
                same_device=self.same_device,
                clock=SystemClock(),
                key=sealing.key_of(self.config),
                progress=add,
            )
        return Report(codec.plain(done), list(flight_lines.of_offload(done)), findings=done.doubts)
