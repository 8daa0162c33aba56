"""`dappled batch`: process whole flights, frame by frame, on all cores or a cluster."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from tqdm import tqdm

from dappled.cli import georeference, geotag
from dappled.cli.arguments import whole
from dappled.errors import DappledError, counted
from dappled.findings import first_by_name, to_rows, told
from dappled.flight import disk_error, layout
from dappled.products.batch import batch, workers
from dappled.products.batch.batch import KINDS, Done, Job, Manifest
from dappled.products.geotags import geotags, marks
from dappled.products.geotags.geotags import Placed
from dappled.products.handover import forms, photo_files
from dappled.products.handover.forms import FORMS
from dappled.products.maps import earth
from dappled.products.maps.earth import EarthError


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled batch ~/flights/20261121T* -o products\n"
        "  dappled batch FLIGHT --as photos -o products --pos rover_events.pos\n"
        "  dappled batch FLIGHT --as npz cog -o products --scheduler tcp://10.0.0.5:8786\n"
        "Continues where it was stopped. A bad frame is reported and does not stop the others."
    )
    parser.add_argument("flights", nargs="+", type=Path, metavar="FLIGHT",
                        help="flight folders, or a folder of flights")  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--as", dest="kinds", nargs="+", choices=tuple(KINDS), default=["npz"],
                        help="per frame: a light field (npz, zarr, h5; default: npz), a map (cog, kmz), or pictures\n"
                        "with position (photos: 16-bit TIFF and JPEG, and geo.txt for OpenDroneMap);\n"
                        "per flight: a rig of the views' cameras (colmap, nerfstudio), a catalogue of maps (stac),\n"
                        "or a recording for Foxglove and ROS 2 (mcap)")  # fmt: skip
    parser.add_argument("--pos", type=Path, metavar="FILE",
                        help="marks after PPK, as for dappled geotag; one FLIGHT only")  # fmt: skip
    geotag.add_mark_arm(parser)
    parser.add_argument("--workers", type=whole, default=os.cpu_count() or 1, metavar="N",
                        help="number of processes (default: one per core)")  # fmt: skip
    parser.add_argument(
        "--scheduler", metavar="URL", help="use this Dask scheduler instead, such as tcp://10.0.0.5:8786"
    )
    georeference.add_placing(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame")


def run(arguments: argparse.Namespace) -> int:
    flights = _different(_flights(arguments.flights))
    if arguments.pos and len(flights) > 1:
        raise DappledError(f"--pos {arguments.pos} holds the marks of one flight: give one FLIGHT")
    jobs: list[Job] = []
    refused = 0
    lists: list[Callable[[Manifest], list[str]]] = []
    for flight in flights:
        try:
            planned, placed = _planned(flight, arguments)
            jobs += planned
            lists.append(partial(_lists, placed=placed, jobs=planned))
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
        bar = tqdm(
            total=len(jobs),
            initial=len(jobs) - len(todo),
            unit="frame",
            disable=not sys.stderr.isatty(),
            file=sys.__stderr__,
        )
        with bar:
            for done in answers:
                manifest.add(done)
                bar.update()
                bad += done.error is not None
                _report(done, as_json=arguments.json)
        for write in lists:
            for text in write(manifest):
                refused += 1
                print(f"dappled batch: {text}", file=sys.stderr)
        _tell_doubts(manifest, jobs)
    if not jobs:
        raise DappledError("these flights hold no frames")
    if not arguments.json:
        print(f"{counted(len(todo) - bad, 'frame')} made, {len(jobs) - len(todo)} already there, {bad} failed")
    return 1 if bad or refused else 0


def _report(done: Done, *, as_json: bool) -> None:
    """Say what became of a frame."""
    for text in dict.fromkeys(done.refused.values()) or ([done.error] if done.error else []):
        tqdm.write(f"dappled batch: {text}", file=sys.stderr)
    if as_json:
        said = {"flight": done.flight, "frame": done.frame, "error": done.error, "refused": dict(done.refused)}
        files = [one.name for one in done.outputs]
        print(json.dumps({**said, "doubts": to_rows(done.doubts), "seconds": done.seconds, "files": files}))


def _tell_doubts(manifest: Manifest, jobs: Sequence[Job]) -> None:
    """Say what is in doubt about the light fields of each flight."""
    for flight in dict.fromkeys(job.flight for job in jobs):
        known = [manifest.done[job.key] for job in jobs if job.flight == flight and job.key in manifest.done]
        for one in first_by_name((Path(done.frame).stem, done.doubts) for done in known):
            print(f"dappled batch: {Path(flight).name}: in doubt: {told(one)}", file=sys.stderr)


def _flights(given: Sequence[Path]) -> list[Path]:
    """The flights that were named, and those in folders of flights that were."""
    found: list[Path] = []
    for path in given:
        inside = [] if (path / "flight.toml").exists() or not path.is_dir() else layout.flights(path)
        found += [one.path for one in inside] or [path]
    return found


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


def _planned(flight: Path, arguments: argparse.Namespace) -> tuple[list[Job], list[Placed]]:
    """The jobs of one flight, and where its frames were taken. Raises DappledError."""
    folder = layout.open_folder(flight)
    facts = layout.read_facts(folder)
    recipe = georeference.recipe(folder.path, facts, arguments)
    options = georeference.options(facts, arguments)
    marked = geoid = None
    if arguments.pos:
        geoid = earth.geoid(arguments.geoid)
        marked = marks.find(folder.path, arguments.pos, geoid, geotag.mark_arm(arguments, options.mounting))
        for text in marks.sentences(marked):
            print(text, file=sys.stderr)
    elif "mcap" in arguments.kinds:  # its altitudes are above the ellipsoid, or unknown
        geoid = _geoid(arguments.geoid)
    placed, _ = geotags.read(folder.path, options.mounting, geoid, marked)
    by_index = {one.frame.index: one for one in placed}
    return batch.plan(folder.path, recipe, options, arguments.kinds, arguments.output, placed=by_index), placed


def _geoid(given: str | None) -> earth.Geoid | None:
    """The geoid that was named, or one of this machine's; None where it has none. Raises EarthError."""
    try:
        return earth.geoid(given)
    except EarthError as error:
        if given is not None:
            raise
        print(f"dappled batch: {error}; until then heights above the ellipsoid are left out", file=sys.stderr)
        return None


def _lists(manifest: Manifest, placed: Sequence[Placed], jobs: Sequence[Job]) -> list[str]:
    """Write what names the files of a flight that are there; returns what could not be written, a sentence each."""
    if not jobs:
        return []
    flight = Path(jobs[0].flight).name
    folder = manifest.path.parent / flight
    said = []
    for kind in (one for one in ("photos", *FORMS) if one in jobs[0].kinds):
        frames = [job.frame.name for job in jobs if manifest.made(job.key, kind)]
        try:
            if frames and kind == "photos":
                photo_files.write_lists(folder / kind, [one for one in placed if one.frame.name in frames])
            elif frames:
                names = [Path(name).stem for name in frames]
                forms.finish(kind, folder / kind, flight, names)
        except OSError as error:
            said.append(str(disk_error("write the lists of", folder / kind, error)))
        except DappledError as error:
            said.append(str(error))
    return said
