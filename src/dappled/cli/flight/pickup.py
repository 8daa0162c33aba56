"""`dappled flight pickup`: fetch the files that stayed in the camera, and add them to the flight."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tqdm import tqdm

from dappled import findings
from dappled.cli import sealing
from dappled.clock import TimeOfDayClock
from dappled.daemon.replay import pickup
from dappled.daemon.replay.pickup import Choice, Picked, Proposal
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.sources import parse_source
from dappled.errors import counted
from dappled.findings import Level


def run(flight: Path, arguments: argparse.Namespace) -> int:
    source = parse_source(arguments.source, PtpSource)
    choice = Choice(dict(arguments.pair), arguments.offset, arguments.any_clock, arguments.by_order)
    try:
        with tqdm(unit="B", unit_scale=True, disable=None, delay=1.0, desc="comparing", file=sys.__stderr__) as bar:
            proposal = pickup.propose(flight, source, choice, bar.update)
        picked = None
        if not arguments.dry_run:
            total = sum(group.main.size for _, group in proposal.pairs)
            key = sealing.key_of(arguments.config)
            with tqdm(total=total, unit="B", unit_scale=True, disable=None, delay=1.0, file=sys.__stderr__) as bar:
                picked = pickup.bring(flight, source, proposal, clock=TimeOfDayClock(), key=key, progress=bar.update)
    finally:
        source.close()
    (_print_json if arguments.json else _print)(flight, proposal, picked)
    return 1 if proposal.missing or (proposal.doubts and not arguments.anyway) else 0


def _print(flight: Path, proposal: Proposal, picked: Picked | None) -> None:
    word = "would be" if picked is None else "is"
    for index, group in proposal.pairs:
        others = "".join(f" and {other.base}" for other in group.companions)
        print(f"shot {index:6d}  {word} {group.main.name}{others}  {proposal.reasons[index]}")
    for one in findings.in_order(proposal.findings):
        print(f"{'in doubt' if one.level > Level.NOTE else one.level.word}:".ljust(13) + findings.told(one))
    for index in proposal.missing:
        print(f"shot {index:6d}  has no file")
    if proposal.strangers:
        count = counted(len(proposal.strangers), "file")
        print(f"{count} without a shot in this flight, the first {proposal.strangers[0]}")
    for text in picked.zooms if picked else ():
        print(f"zoom:        {text}")
    done = f"{counted(len(proposal.pairs), 'frame')} {'to bring' if picked is None else 'brought'}"
    print(f"{flight.name}: {done}, {proposal.there_already} already there, {len(proposal.missing)} missing")
    if proposal.doubts:
        print("resolve what is in doubt with --pair INDEX=NAME, --offset S or --by-order; no file was guessed")


def _print_json(flight: Path, proposal: Proposal, picked: Picked | None) -> None:
    print(
        json.dumps(
            {
                "flight": flight.name,
                "dry_run": picked is None,
                "pairs": [
                    {
                        "index": index,
                        "file": group.main.name,
                        "companions": [other.name for other in group.companions],
                        "reason": proposal.reasons[index],
                    }
                    for index, group in proposal.pairs
                ],
                "findings": [one.to_json() for one in findings.in_order(proposal.findings)],
                "doubts": findings.to_rows(findings.in_order(proposal.doubts)),
                "missing": list(proposal.missing),
                "strangers": list(proposal.strangers),
                "there_already": proposal.there_already,
                "camera_clock_minus_utc_s": proposal.offset_s,
                "zooms": list(picked.zooms) if picked else [],
            },
            indent=2,
        )
    )
