"""`dappled batch`: process whole flights, frame by frame, on all cores or a cluster."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from dappled.cli import georeference
from dappled.cli.arguments import whole
from dappled.errors import DappledError, counted
from dappled.flight import layout
from dappled.products.batch import batch, workers
from dappled.products.batch.batch import KINDS, Job, Manifest


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled batch ~/flights/20261121T* -o products\n"
        "  dappled batch FLIGHT --as npz cog -o products --scheduler tcp://10.0.0.5:8786\n"
        "Continues where it was stopped. A bad frame is reported and does not stop the others."
    )
    parser.add_argument("flights", nargs="+", type=Path, metavar="FLIGHT", help="flight folders")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--as", dest="kinds", nargs="+", choices=tuple(KINDS), default=["npz"],
                        help="per frame: a light field (npz, zarr, h5) or a map (cog, kmz); default: npz")  # fmt: skip
    parser.add_argument("--workers", type=whole, default=os.cpu_count() or 1, metavar="N",
                        help="number of processes (default: one per core)")  # fmt: skip
    parser.add_argument(
        "--scheduler", metavar="URL", help="use this Dask scheduler instead, such as tcp://10.0.0.5:8786"
    )
    georeference.add_placing(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame")


def run(arguments: argparse.Namespace) -> int:
    jobs: list[Job] = []
    refused = 0
    for flight in _different(arguments.flights):
        try:
            jobs += _planned(flight, arguments)
        except DappledError as error:  # go on with the other flights
            refused += 1
            named = str(error) if str(flight) in str(error) else f"{flight}: {error}"
            print(f"dappled batch: {named}", file=sys.stderr)
    if refused and not jobs:
        return 1
    bad = 0
    with Manifest(arguments.output) as manifest:
        todo = [job for job in jobs if not manifest.holds(job.key)]
        if arguments.scheduler:
            answers = workers.on_cluster(todo, batch.make, arguments.scheduler)
        else:
            answers = workers.in_processes(todo, batch.make, min(arguments.workers, max(1, len(todo))))
        bar = tqdm(total=len(jobs), initial=len(jobs) - len(todo), unit="frame", disable=not sys.stderr.isatty())
        with bar:
            for done in answers:
                manifest.add(done)
                bar.update()
                if done.error is not None:
                    bad += 1
                    tqdm.write(f"dappled batch: {done.error}", file=sys.stderr)
                if arguments.json:
                    said = {"flight": done.flight, "frame": done.frame, "error": done.error, "seconds": done.seconds}
                    print(json.dumps({**said, "files": [one.name for one in done.outputs]}))
    if not jobs:
        raise DappledError("these flights hold no frames")
    if not arguments.json:
        print(f"{counted(len(todo) - bad, 'frame')} made, {len(jobs) - len(todo)} already there, {bad} failed")
    return 1 if bad or refused else 0


def _different(flights: Sequence[Path]) -> list[Path]:
    """The folders, each once. Raises DappledError for two of one name: they would share a folder of the output."""
    named: dict[str, Path] = {}
    for flight in flights:
        folder = flight.resolve()
        if named.setdefault(folder.name, folder) != folder:
            raise DappledError(
                f"{named[folder.name]} and {folder} would both be written to {folder.name}: give them separate batches"
            )
    return list(named.values())


def _planned(flight: Path, arguments: argparse.Namespace) -> list[Job]:
    """The jobs of one flight. Raises DappledError."""
    folder = layout.open_folder(flight)
    facts = layout.read_facts(folder)
    recipe = georeference.recipe(folder.path, facts, arguments)
    options = georeference.options(facts, arguments)
    return batch.plan(folder.path, recipe, options, arguments.kinds, arguments.output)
