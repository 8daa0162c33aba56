"""`dappled batch`: process whole flights, frame by frame, on all cores or a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dappled import codec
from dappled.cli.frame_arguments import Several
from dappled.cli.geotag import MarkArguments, geoid_or_none
from dappled.cli.placing import Placing
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Report, Verb, argument, flag, option
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Finding, Subject
from dappled.products.handover import FORMS, KINDS

if not words_only:
    from dappled.flight import disk_error, layout
    from dappled.flight.flight_mask import doubts_over
    from dappled.products.batch import batch, workers
    from dappled.products.batch.batch import Done, Job, Manifest
    from dappled.products.geotags import geotags, marks
    from dappled.products.geotags.geotags import Placed, PlacedBy
    from dappled.products.handover import forms, photo_files
    from dappled.products.maps import earth


@dataclass(frozen=True, kw_only=True)
class ProcessFlights(Doubtable, Several, MarkArguments, Placing, Verb):
    """Process whole flights."""

    examples = (
        "dappled batch ~/flights/20261121T* -o products",
        "dappled batch FLIGHT --as photos -o products --pos rover_events.pos",
        "dappled batch FLIGHT --as npz cog -o products --scheduler tcp://10.0.0.5:8786",
    )
    notes = "Continues where it was stopped. A bad frame is reported and does not stop the others."

    flights: tuple[Path, ...] = argument("FLIGHT", "flight folders, or a folder of flights", there=True)
    output: Path = option("-o --output", "folder for the results", metavar="DIR")
    kinds: tuple[str, ...] = option(
        "--as", "per frame: a light field (npz, zarr, h5), a map (cog, kmz), or pictures with position and every "
        "pixel of the sensor (photos: 16-bit TIFF and JPEG, and geo.txt for OpenDroneMap); per flight: these pictures' "
        "cameras, with --view ground a rig of the views' (colmap, nerfstudio), a catalogue of maps "
        "(stac), or a recording for Foxglove and ROS 2 (mcap)", ("npz",),
        choices=tuple(KINDS),
    )  # fmt: skip
    scheduler: str | None = option(
        "--scheduler", "use this Dask scheduler instead, such as tcp://10.0.0.5:8786", None, metavar="URL",
    )  # fmt: skip
    json: bool = flag("--json", "print one JSON object per frame")

    def check(self) -> None:
        self.check_profiles()
        wrong = [layout.not_a_flight(one) for one in self._folders()]
        if all(wrong):
            raise CallError(wrong[0])
        if self.pos and len(self._folders()) > 1:
            raise CallError(f"--pos {self.pos} holds the marks of one flight: give one FLIGHT")

    def _folders(self) -> list[Path]:
        return _different(_flights(self.flights))

    def run(self, output: Output) -> Report:
        jobs: list[Job] = []
        doubts: list[Finding] = []
        refused = 0
        lists: list[Callable[[Manifest], list[str]]] = []
        for flight in self._folders():
            try:
                planned, placed, found = self._planned(flight, output)
                doubts += found
                jobs += planned
                lists.append(partial(_lists, placed=placed, jobs=planned))
            except DappledError as error:  # go on with the other flights
                refused += 1
                output.warn(f"{flight.name}: {error}")
        if refused and not jobs:
            return Report(failed=True)
        bad = 0
        with Manifest(self.output) as manifest:
            todo = [job for job in jobs if not manifest.holds(job.key)]
            if self.scheduler:
                answers = workers.on_cluster(todo, batch.make, self.scheduler)
            else:
                answers = workers.in_processes(todo, batch.make, min(self.workers, max(1, len(todo))))
            with output.bar(len(jobs), "frame") as add:
                add(len(jobs) - len(todo))
                for done in answers:
                    manifest.add(done)
                    add(1)
                    bad += done.error is not None
                    _tell(done, output)
            for write in lists:
                for text in write(manifest):
                    refused += 1
                    output.warn(text)
            doubts += _doubts(manifest, jobs)
        if not jobs:
            raise DappledError("these flights hold no frames")
        said = f"{counted(len(todo) - bad, 'frame')} made, {len(jobs) - len(todo)} already there, {bad} failed"
        return Report(None, [said], findings=doubts, failed=bool(bad or refused))

    def _planned(self, flight: Path, output: Output) -> tuple[list[Job], list[Placed], list[Finding]]:
        """The jobs of one flight, where its frames were taken, and its marks' doubts. Raises DappledError."""
        folder = layout.open_folder(flight)
        facts = layout.read_facts(folder)
        recipe, options = self.recipe(folder.path, facts), self.options(facts)
        marked = geoid = None
        doubts: list[Finding] = []
        if self.pos:
            geoid = earth.geoid(self.geoid)
            marked = marks.find(folder.path, self.pos, geoid, self.mark_arm(options.mounting, output))
            for text in marks.sentences(marked):
                output.remark(text)
            doubts = [replace(one, subject=_of_flight(folder.name, one.subject)) for one in marked.doubts]
        elif "mcap" in self.kinds:  # its altitudes are above the ellipsoid, or unknown
            geoid = geoid_or_none(self.geoid, output)
        placed, _ = geotags.read(folder.path, PlacedBy(options.mounting, geoid, marked))
        if "photos" in self.kinds:
            output.remark(f"{folder.name}: {photo_files.ground_words(placed)}")
        by_index = {one.frame.index: one for one in placed}
        return batch.plan(folder.path, recipe, options, self.kinds, self.output, placed=by_index), placed, doubts


def _tell(done: Done, output: Output) -> None:
    """Say what became of a frame."""
    for text in dict.fromkeys(done.refused.values()) or ([done.error] if done.error else []):
        output.warn(text)
    said = {"flight": done.flight, "frame": done.frame, "error": done.error, "refused": dict(done.refused)}
    files = [one.name for one in done.outputs]
    output.row({**said, "doubts": codec.plain(done.doubts), "seconds": done.seconds, "files": files})


def _of_flight(flight: str, subject: Subject) -> Subject:
    """What a finding is about, where there are several flights."""
    return Subject(subject.kind, f"{flight}/{subject.which}" if subject.which != "" else flight)


def _doubts(manifest: Manifest, jobs: Sequence[Job]) -> list[Finding]:
    """What is in doubt about the light fields of each flight."""
    found = []
    for flight in dict.fromkeys(job.flight for job in jobs):
        made = (manifest.done.get(job.key) for job in jobs if job.flight == flight)
        doubts = doubts_over((Path(one.frame).stem, one.mask_nats, one.doubts) for one in made if one is not None)
        found += [replace(one, subject=_of_flight(Path(flight).name, one.subject)) for one in doubts]
    return found


def _flights(given: Sequence[Path]) -> list[Path]:
    """The flights that were named, and those in folders of flights that were."""
    found: list[Path] = []
    for path in given:
        inside = [] if (path / "flight.toml").exists() or not path.is_dir() else layout.held_flights(path)
        found += [one.path for one in inside] or [path]
    return found


def _different(flights: Sequence[Path]) -> list[Path]:
    """The folders, each once. Raises CallError for two of one name: they would share a folder of the output."""
    named: dict[str, Path] = {}
    for flight in flights:
        folder = flight.resolve()
        if named.setdefault(folder.name, folder) != folder:
            raise CallError(
                f"{named[folder.name]} and {folder} would both be written to {folder.name}: give them separate batches"
            )
    return list(named.values())


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
