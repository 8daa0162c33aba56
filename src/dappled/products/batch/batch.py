"""Process whole flights frame by frame, in any process, with the same bytes everywhere.

A job is a value that holds everything `make` needs; `make` writes under temporary names and renames. So a job may run
twice, or on another machine that sees the same folders, with the same outcome. The manifest lists what is done: a line
of JSON for each job, appended and synced, so that a batch that is started again continues there.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

from dappled import __version__, codec, confined, durable, file_lock
from dappled.bounds.parsing import parse_json
from dappled.closing import Closing
from dappled.drivers.raw import recipe_check
from dappled.drivers.raw.picture_maker import LensFrame, ToldShadow, beside
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError, sentence
from dappled.findings import Finding
from dappled.flight import Frame, Tag
from dappled.large_blocks import reuse_large_blocks
from dappled.products.exports import light_files
from dappled.products.extras import need
from dappled.products.geotags.geotags import Placed
from dappled.products.handover import FORMS, KINDS, forms, photo_files
from dappled.products.handover.forms import HandedFrame
from dappled.products.maps import cog, georeference, map_files, photographs
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.georeference import Options
from dappled.products.maps.laboratory import MEAN, FlightFrame, exposures, laboratory
from dappled.products.maps.photographs import Photograph, Station

MAPS = ("cog", "kmz")
PLACED = (*MAPS, "photos", *FORMS)  # what needs a full pose
MANIFEST = "manifest.jsonl"
_LINE_BYTES = 1 << 20  # of a manifest


@dataclass(frozen=True, slots=True)
class Job:
    """One frame and all that is to be made of it. `station` is the error where its position isn't known;
    `level_m` is the height of flat ground. `key` is a hash of everything that the outcome depends on.
    `utc_ns` is mid-exposure, corrected; None where UTC was never known. `others` are the frames that the mask's shadow
    is taken from, and `told` what these tell of it, as soon as they were asked; `flown_nats` is what decoding in flight
    told of the mask."""

    flight: str
    frame: Frame
    tag: Tag | None
    station: Station | DappledError
    level_m: float | None
    recipe: Recipe
    options: Options
    kinds: tuple[str, ...]
    output: str
    key: str
    utc_ns: int | None = None
    others: tuple[LensFrame, ...] = ()
    told: tuple[ToldShadow, ...] = ()
    flown_nats: float | None = None


@dataclass(frozen=True, slots=True)
class BatchOutput:
    """A file or folder that was made: its name in the batch's folder, size and SHA-256, and the kind it belongs to."""

    name: str
    size: int
    sha256: str
    kind: str


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a job. `error` is a sentence, or None; `cpu_seconds` and `peak_mb` (so far) are the process'.
    `refused` says why a kind was not made where others were or could have been; `doubts` are those of the frame's
    picture and light field, whichever were made, `mask_nats` the log odds that it shows its mask, or did in flight."""

    key: str
    flight: str
    frame: str
    outputs: tuple[BatchOutput, ...]
    error: str | None
    seconds: float
    cpu_seconds: float
    peak_mb: float
    refused: Mapping[str, str] = field(default_factory=dict)
    doubts: tuple[Finding, ...] = ()
    mask_nats: float | None = None

    def lacks(self, kind: str) -> bool:
        """Whether this kind was not made."""
        return kind in self.refused or (self.error is not None and not self.refused)


def plan(
    flight: Path,
    recipe: Recipe,
    options: Options,
    kinds: Sequence[str],
    output: Path,
    *,
    placed: Mapping[int, Placed] = MappingProxyType({}),
) -> list[Job]:
    """The jobs of one flight. `placed`: tags and times by image index, in place of the ledger's. Raises DappledError
    where the flight or the recipe can't be read."""
    for kind in kinds:
        if kind not in KINDS:
            raise DappledError(f"a batch makes {', '.join(KINDS)}, not {kind}")
    if "mcap" in kinds:
        need("mcap_ros2.writer")  # before any frame is decoded
    recipe_check.check(recipe)
    recipe = _anywhere(recipe)
    if options.terrain is not None:
        options = replace(options, terrain=options.terrain.absolute())
    frames, tags = photographs.recorded(flight)
    tags |= {index: one.tag for index, one in placed.items()}
    given = {"focal_length_mm": options.focal_length_mm, "f_number": options.f_number}
    files = exposures(flight.absolute(), [(one, tags.get(one.index)) for one in frames], **given)
    hashes = {files[one.index].path: one.sha256 for one in frames if one.index in files}
    if options.frames is not None:
        frames = [frame for frame in frames if frame.index in options.frames]
    stations: dict[int, Station] = {}
    unplaced: dict[int, DappledError] = {}
    for frame in frames:
        try:
            station = photographs.station(frame, tags.get(frame.index), options.mounting)
            known = placed[frame.index].camera if frame.index in placed else None
            stations[frame.index] = station if known is None else replace(station, camera=known)
        except DappledError as error:
            unplaced[frame.index] = error
    level = None
    if set(kinds) & {*MAPS, *forms.MAPPED} and stations:
        level = georeference.level_of(list(stations.values()), options)
    if set(kinds) & set(PLACED) and stations:
        first = next(iter(stations.values())).camera
        options = replace(options, crs=options.crs or utm(first.latitude_deg, first.longitude_deg))
    common = {
        "version": __version__,
        "recipe": {**codec.plain(recipe), **_digests(recipe)},
        "options": _plain(options),
        "terrain": None if options.terrain is None else durable.hash_file(options.terrain),
        "level_m": level,
        "kinds": sorted(kinds),
    }
    jobs = []
    pictured = set(kinds) & set(FORMS if options.view != MEAN else PLACED)
    near = beside(list(files.values())) if pictured else {}
    flown = photographs.flown_nats(flight) if options.as_flown else {}
    for frame in frames:
        tag = tags.get(frame.index)
        utc_ns = placed[frame.index].utc_ns if frame.index in placed else None
        others = near.get(files[frame.index], ()) if frame.index in files else ()
        said = {**common, "flight": flight.name, "name": frame.name, "frame": frame.sha256, "utc_ns": utc_ns,
                "tag": codec.plain(tag), "others": [hashes[one.path] for one in others],
                "flown_nats": flown.get(frame.index)}  # fmt: skip
        if frame.index in stations and stations[frame.index].camera.height_ellipsoid_m is not None:
            said["height_ellipsoid_m"] = stations[frame.index].camera.height_ellipsoid_m
        key = hashlib.sha256(codec.canonical(said)).hexdigest()
        jobs.append(
            Job(
                str(flight.absolute()), frame, tag, stations.get(frame.index) or unplaced[frame.index], level, recipe,
                options, tuple(kinds), str(output.absolute()), key, utc_ns, others, flown_nats=flown.get(frame.index),
            )
        )  # fmt: skip
    return jobs


def make(job: Job) -> Done:
    """Run a job. A failure of this frame is an error in the result and never stops the others."""
    reuse_large_blocks()
    began, cpu = time.monotonic(), time.process_time()
    outputs: list[BatchOutput] = []
    refused: dict[str, str] = {}
    making: _Making | None = None
    try:
        making = _making(job)
        for kind in job.kinds:
            try:
                outputs += making.made(kind)
            except Exception as caught:  # noqa: BLE001  one kind must not cost the frame the others
                refused[kind] = _why(job, caught)
        error = "; ".join(dict.fromkeys(refused.values())) or None
    except Exception as caught:  # noqa: BLE001  one bad frame must not end the flight: its words go into the manifest
        error = _why(job, caught)
    seconds, cpu = round(time.monotonic() - began, 3), round(time.process_time() - cpu, 3)
    name, doubts = Path(job.flight).name, () if making is None else making.frame.doubts
    nats = job.flown_nats if making is None else making.frame.mask_nats
    return Done(job.key, name, job.frame.name, tuple(outputs), error, seconds, cpu, _peak_mb(), refused, doubts, nats)


def _why(job: Job, error: Exception) -> str:
    if isinstance(error, DappledError):
        return sentence(error)
    return f"{job.frame.name}: {error if isinstance(error, OSError) else sentence(error)}"


@dataclass(frozen=True, slots=True, eq=False)
class _Making:
    """A frame, of which one kind after the other is made."""

    job: Job
    frame: FlightFrame

    def made(self, kind: str) -> list[BatchOutput]:
        """Make one kind. Raises DappledError and OSError."""
        job = self.job
        if kind not in PLACED:
            return [self._light_field(kind)]
        if isinstance(job.station, DappledError):
            raise job.station
        assert job.options.crs is not None
        projection = _projection(job.options.crs)
        folder = Path(job.output) / Path(job.flight).name
        if kind == "photos":
            one = self._photograph(job.station, projection)
            pictures = photo_files.encoded(one, job.station, job.utc_ns)
            paths = photo_files.paths(folder / "photos", job.frame)
            for path, data in zip(paths, pictures.values(), strict=True):
                durable.make_folder(path.parent)
                durable.write_file(path, data)
        elif kind in FORMS:
            frame = HandedFrame(folder.name, job.station, self.frame, projection, job.options, job.level_m, job.utc_ns)
            paths = forms.write_frame(kind, folder / kind, frame)
        else:
            paths = [self._map(kind, job.station, projection)]
        return [_output(path, job, kind) for path in paths]

    def _light_field(self, kind: str) -> BatchOutput:
        job = self.job
        pose = {} if job.tag is None else {"pose": codec.plain(job.tag.pose)}
        made = self.frame.decoded.light_field
        light_files.save(_beside(job, kind), replace(made, attributes={**made.attributes, **pose}), overwrite=True)
        return _output(_beside(job, kind), job, kind)

    def _photograph(self, station: Station, projection: Projection) -> Photograph:
        options = self.job.options
        return self.frame.photograph(station, projection, view=options.view, focus_m=options.focus_m)

    def _map(self, kind: str, station: Station, projection: Projection) -> Path:
        job, path = self.job, _beside(self.job, kind)
        assert job.level_m is not None
        one = self._photograph(station, projection)
        survey = georeference.on_ground(
            Path(job.flight).name, [one], [], projection=projection, level_m=job.level_m, options=job.options
        )
        draw = map_files.frame_cog if kind == "cog" else map_files.frame_kmz
        draw(survey, one, path, cog.gain_of([one.image]))
        return path


def _making(job: Job) -> _Making:
    """A job's frame. Raises DappledError where nothing that is wanted could be made of it."""
    durable.make_folder(Path(job.output) / Path(job.flight).name)
    if isinstance(job.station, DappledError) and set(job.kinds) <= set(PLACED):
        raise job.station
    given = {"focal_length_mm": job.options.focal_length_mm, "f_number": job.options.f_number}
    frame = laboratory(job.recipe).frame(
        Path(job.flight), job.frame, job.tag, **given, told=job.told, flown_nats=job.flown_nats
    )
    return _Making(job, frame)


def _beside(job: Job, kind: str) -> Path:
    """Where a kind that is one file or folder for each frame stands."""
    return (Path(job.output) / Path(job.flight).name / Path(job.frame.name).stem).with_suffix(KINDS[kind])


def _output(path: Path, job: Job, kind: str) -> BatchOutput:
    """A finished file or folder, with one hash over its content."""
    name = str(path.relative_to(job.output))
    if path.is_file():
        return BatchOutput(name, path.stat().st_size, durable.hash_file(path), kind)
    whole = hashlib.sha256()
    size = 0
    for inner in sorted(path.rglob("*")):
        if inner.is_file():
            size += inner.stat().st_size
            whole.update(f"{inner.relative_to(path)} {durable.hash_file(inner)}\n".encode())
    return BatchOutput(name, size, whole.hexdigest(), kind)


def _digests(recipe: Recipe) -> dict[str, str]:
    """Hashes of the recipe's files: another calibration under the same name makes another job."""
    named = {"calibration": recipe.calibration, "white": recipe.white, "dark": recipe.dark}
    named |= {
        name: value for name, value in (("camera", recipe.camera), ("mask", recipe.mask)) if value.endswith(".toml")
    }
    return {name: durable.hash_file(Path(path)) for name, path in named.items() if path}


def _anywhere(recipe: Recipe) -> Recipe:
    """The recipe for a worker in any folder: absolute paths, and one thread, as frames run in parallel."""

    def full(path: str, is_file: bool) -> str:
        return str(Path(path).absolute()) if is_file else path

    return replace(
        recipe,
        camera=full(recipe.camera, recipe.camera.endswith(".toml")),
        mask=full(recipe.mask, recipe.mask.endswith(".toml")),
        calibration=full(recipe.calibration, bool(recipe.calibration)),
        white=full(recipe.white, bool(recipe.white)),
        dark=full(recipe.dark, bool(recipe.dark)),
        workers=1,
    )


def _plain(options: Options) -> dict[str, object]:
    """The options as JSON values, without the choice of frames, which is not part of a job."""
    values = codec.plain(replace(options, frames=None, terrain=None))
    return {name: value if isinstance(value, str | None) else repr(value) for name, value in values.items()}


_here = threading.local()


def _projection(name: str) -> Projection:
    kept: dict[str, Projection] = _here.__dict__.setdefault("projections", {})
    if name not in kept:
        kept[name] = Projection(name)
    return kept[name]


def _peak_mb() -> float:
    """The most memory that this process held so far. (getrusage would include its parent's, from before the fork.)"""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return round(int(line.split()[1]) / 1024, 1)
    return 0.0


class Manifest(Closing):
    """The manifest of an output folder, locked by one batch at a time. Use as a context manager."""

    def __init__(self, output: Path) -> None:
        """Raises DappledError where another batch is writing to this folder, or the disk refuses."""
        self.path = output / MANIFEST
        try:
            durable.make_folder(output)
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                file_lock.lock(self._fd)
            except BlockingIOError:
                os.close(self._fd)
                raise DappledError(f"another batch is writing to {output}: wait for it, or choose another -o") from None
        except OSError as error:
            raise DappledError(f"cannot keep a manifest in {output}: {error.strerror}") from None
        self._latest: dict[str, str] = {}  # the SHA-256 of each output as it was last written, by its name
        self.done: dict[str, Done] = {}
        for done in self._read():
            self._note(done)

    def close(self) -> None:
        os.close(self._fd)

    def add(self, done: Done) -> None:
        """Append a result, durably."""
        os.write(self._fd, codec.canonical(done) + b"\n")
        os.fsync(self._fd)
        self._note(done)

    def holds(self, key: str) -> bool:
        """Whether a job is done and its files are still there, as it wrote them."""
        done = self.done.get(key)
        return done is not None and done.error is None and all(map(self._there, done.outputs))

    def made(self, key: str, kind: str) -> bool:
        """Whether a job made this kind, and its files are still there, as it wrote them."""
        done = self.done.get(key)
        if done is None or done.lacks(kind):
            return False
        return all(self._there(one) for one in done.outputs if one.kind == kind)

    def _there(self, one: BatchOutput) -> bool:
        """Jobs with other options write under the same names: what the last one wrote is there."""
        path = confined.path(self.path.parent, one.name, f"the manifest {self.path}")
        if self._latest[one.name] != one.sha256 or _size(path) != one.size:
            return False
        return path.suffix != ".json" or durable.hash_file(path) == one.sha256

    def _note(self, done: Done) -> None:
        self.done[done.key] = done
        self._latest |= {one.name: one.sha256 for one in done.outputs}

    def _read(self) -> Iterator[Done]:
        text = b""
        while block := os.read(self._fd, 1 << 20):
            text += block
        whole = text.rfind(b"\n") + 1
        if whole < len(text):  # torn by a power cut: that job runs again
            os.ftruncate(self._fd, whole)
            os.lseek(self._fd, 0, os.SEEK_END)
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                done = codec.read(Done, parse_json(line, _LINE_BYTES))
            except ValueError:
                raise DappledError(
                    f"{self.path}, line {number} is not a line of a manifest: move the file away, "
                    "and everything will be made again"
                ) from None
            yield done


def _size(path: Path) -> int | None:
    if path.is_file():
        return path.stat().st_size
    if path.is_dir():
        return sum(inner.stat().st_size for inner in path.rglob("*") if inner.is_file())
    return None
