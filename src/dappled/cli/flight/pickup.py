"""`dappled flight pickup`: fetch the files that stayed in the camera, and add them to the flight."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from dappled import codec, findings
from dappled.cli import sealing
from dappled.cli.flight.arguments import EXAMPLE, FlightArgument
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Report, Verb, flag, option
from dappled.clock import TimeOfDayClock
from dappled.errors import CallError, counted

if not words_only:
    from dappled.daemon.replay import pickup
    from dappled.daemon.replay.pickup import Choice, Picked, Proposal
    from dappled.drivers.wired.ptp_source import PtpSource
    from dappled.drivers.wired.sources import FolderSource, parse_source


def _pair(text: str) -> tuple[int, str]:
    index, equals, name = text.partition("=")
    if not equals or not index.isdecimal() or not name:
        raise ValueError(f"{text!r} is not INDEX=NAME, as in 17=DSCF0042.RAF")
    return int(index), name


@dataclass(frozen=True, kw_only=True)
class PickUpFiles(Doubtable, FlightArgument, Verb):
    """Fetch the files that stayed in the camera."""

    examples = (
        "dappled flight pickup --from /media/card/DCIM --dry-run",
        f"dappled flight pickup {EXAMPLE} --from usb: --pair 17=DSCF0042.RAF",
    )

    source: str = option("--from", "folder, storage, usb: or a libgphoto2 port", metavar="SOURCE")
    offset: float | None = option("--offset", "the camera's clock minus UTC, if you know it", None, unit="s")
    any_clock: bool = flag("--any-clock", "the camera's clock may be off by more than a day")
    by_order: bool = flag("--by-order", "pair files and shots in order, if there are as many of both")
    pair: tuple[tuple[int, str], ...] = option(
        "--pair", "this file belongs to this shot", (), append=True, parse=_pair, metavar="INDEX=NAME",
    )  # fmt: skip
    dry_run: bool = flag("--dry-run", "only say what would be done")

    def check(self) -> None:
        source = parse_source(self.source, PtpSource)
        if isinstance(source, FolderSource) and not source.removable and not source.folder.is_dir():
            raise CallError(f"--from {self.source}: there is no such folder; check the path, or mount the card")
        for index, count in Counter(index for index, _ in self.pair).items():
            if count > 1:
                raise CallError(f"--pair {index}=…: {count} files are named for shot {index}; name one")

    def run(self, output: Output) -> Report:
        flight = self.chosen(output)
        source = parse_source(self.source, PtpSource)
        choice = Choice(dict(self.pair), self.offset, self.any_clock, self.by_order)
        try:
            with output.bar(None, "B", "comparing") as add:
                proposal = pickup.propose(flight, source, choice, add)
            picked = None
            if not self.dry_run:
                total = sum(group.main.size for _, group in proposal.pairs)
                key = sealing.key_of(self.config)
                with output.bar(total, "B") as add:
                    picked = pickup.bring(flight, source, proposal, clock=TimeOfDayClock(), key=key, progress=add)
        finally:
            source.close()
        return Report(
            _values(flight.name, proposal, picked),
            _lines(flight.name, proposal, picked),
            findings=proposal.findings,
            failed=bool(proposal.missing),
        )


def _lines(flight: str, proposal: Proposal, picked: Picked | None) -> list[str]:
    word = "would be" if picked is None else "is"
    lines = []
    for index, group in proposal.pairs:
        others = "".join(f" and {other.base}" for other in group.companions)
        lines.append(f"shot {index:6d}  {word} {group.main.name}{others}  {findings.text(proposal.reasons[index])}")
    lines += [f"shot {index:6d}  has no file" for index in proposal.missing]
    if proposal.strangers:
        count = counted(len(proposal.strangers), "file")
        lines.append(f"{count} without a shot in this flight, the first {proposal.strangers[0]}")
    lines += [f"zoom:        {findings.told(one)}" for one in (picked.zooms if picked else ())]
    done = f"{counted(len(proposal.pairs), 'frame')} {'to bring' if picked is None else 'brought'}"
    lines.append(f"{flight}: {done}, {proposal.there_already} already there, {len(proposal.missing)} missing")
    if proposal.doubts:
        lines.append("resolve what is in doubt with --pair INDEX=NAME, --offset S or --by-order; no file was guessed")
    return lines


def _values(flight: str, proposal: Proposal, picked: Picked | None) -> dict[str, Any]:
    return {
        "flight": flight,
        "dry_run": picked is None,
        "pairs": [
            {
                "index": index,
                "file": group.main.name,
                "companions": [other.name for other in group.companions],
                "reason": codec.plain(proposal.reasons[index]),
            }
            for index, group in proposal.pairs
        ],
        "findings": [codec.plain(one) for one in findings.in_order(proposal.findings)],
        "doubts": codec.plain(findings.in_order(proposal.doubts)),
        "missing": list(proposal.missing),
        "strangers": list(proposal.strangers),
        "there_already": proposal.there_already,
        "camera_clock_minus_utc_s": proposal.offset_s,
        "zooms": codec.plain(picked.zooms) if picked else [],
    }
