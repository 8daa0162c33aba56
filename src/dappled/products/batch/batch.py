"""Process whole flights frame by frame, in any process, with the same bytes everywhere.

A job is a value that holds everything `make` needs; `make` writes under temporary names and renames. So a job may run
twice, or on another machine that sees the same folders, with the same outcome. The manifest lists what is done: a line
of JSON for each job, appended and synced, so that a batch that is started again continues there.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from dappled import __version__, confined, durable, file_lock
from dappled.bounds.parsing import parse_json
from dappled.drivers.raw.darkroom import Darkroom, Recipe
from dappled.errors import DappledError, sentence
from dappled.flight import Frame, Tag, canonical
from dappled.products.exports import light_files
from dappled.products.geotags.geotags import Placed
from dappled.products.handover import photo_files
from dappled.products.maps import cog, georeference, map_files, photographs
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.georeference import Options
from dappled.products.maps.photographs import Station

KINDS = {"npz": ".npz", "zarr": ".zarr", "h5": ".h5", "cog": ".tif", "kmz": ".kmz", "photos": ""}
MAPS = ("cog", "kmz")
PLACED = (*MAPS, "photos")  # what needs a full pose
MANIFEST = "manifest.jsonl"
_LINE_BYTES = 1 << 20  # of a manifest
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # mallopt(3)


@dataclass(frozen=True, slots=True)
class Job:
    """One frame and all that is to be made of it. `station` is None where its position isn't known, for the reason
    `why`; `level_m` is the height of flat ground. `key` is a hash of everything that the outcome depends on.
    `utc_ns` is mid-exposure, corrected; None where UTC was never known."""

    flight: str
    frame: Frame
    tag: Tag | None
    station: Station | None
    why: str
    level_m: float | None
    recipe: Recipe
    options: Options
    kinds: tuple[str, ...]
    output: str
    key: str
    utc_ns: int | None = None


@dataclass(frozen=True, slots=True)
class BatchOutput:
    """A file or folder that was made: its name in the batch's folder, size and SHA-256."""

    name: str
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a job. `error` is a sentence, or None; `cpu_seconds` and `peak_mb` (so far) are the process'."""

    key: str
    flight: str
    frame: str
    outputs: tuple[BatchOutput, ...]
    error: str | None
    seconds: float
    cpu_seconds: float
    peak_mb: float


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
    Darkroom(recipe).check()
    recipe = _anywhere(recipe)
    if options.terrain is not None:
        options = replace(options, terrain=options.terrain.absolute())
    frames, tags = photographs.recorded(flight)
    tags |= {index: one.tag for index, one in placed.items()}
    if options.frames is not None:
        frames = [frame for frame in frames if frame.index in options.frames]
    stations: dict[int, Station] = {}
    reasons: dict[int, str] = {}
    for frame in frames:
        try:
            stations[frame.index] = photographs.station(frame, tags.get(frame.index), options.mounting)
        except DappledError as error:
            reasons[frame.index] = str(error)
    level = None
    if set(kinds) & set(MAPS) and stations:
        level = georeference.level_of(list(stations.values()), options)
    if set(kinds) & set(PLACED) and stations:
        first = next(iter(stations.values())).camera
        options = replace(options, crs=options.crs or utm(first.latitude_deg, first.longitude_deg))
    common = {
        "version": __version__,
        "recipe": {**asdict(recipe), **_digests(recipe)},
        "options": _plain(options),
        "terrain": None if options.terrain is None else durable.hash_file(options.terrain),
        "level_m": level,
        "kinds": sorted(kinds),
    }
    jobs = []
    for frame in frames:
        tag = tags.get(frame.index)
        utc_ns = placed[frame.index].utc_ns if frame.index in placed else None
        said = {**common, "flight": flight.name, "name": frame.name, "frame": frame.sha256, "utc_ns": utc_ns,
                "tag": None if tag is None else asdict(tag)}  # fmt: skip
        key = hashlib.sha256(canonical(said)).hexdigest()
        jobs.append(
            Job(
                str(flight.absolute()), frame, tag, stations.get(frame.index), reasons.get(frame.index, ""), level,
                recipe, options, tuple(kinds), str(output.absolute()), key, utc_ns,
            )
        )  # fmt: skip
    return jobs


def make(job: Job) -> Done:
    """Run a job. A failure of this frame is an error in the result and never stops the others."""
    _settle_memory()
    began, cpu = time.monotonic(), time.process_time()
    outputs: tuple[BatchOutput, ...] = ()
    error = None
    try:
        outputs = tuple(_made(job))
    except (DappledError, OSError) as caught:
        error = sentence(caught) if isinstance(caught, DappledError) else f"{job.frame.name}: {caught}"
    except Exception as caught:  # noqa: BLE001  one bad frame must not end the flight: its words go into the manifest
        error = f"{job.frame.name}: {sentence(caught)}"
    seconds, cpu = round(time.monotonic() - began, 3), round(time.process_time() - cpu, 3)
    return Done(job.key, Path(job.flight).name, job.frame.name, outputs, error, seconds, cpu, _peak_mb())


def _made(job: Job) -> list[BatchOutput]:
    flight = Path(job.flight)
    folder = Path(job.output) / flight.name
    durable.make_folder(folder)
    beside = folder / Path(job.frame.name).stem
    fields = [kind for kind in job.kinds if kind not in PLACED]
    drawn = [kind for kind in job.kinds if kind in MAPS]
    if set(job.kinds) & set(PLACED) and job.station is None:
        raise DappledError(job.why)
    darkroom = _darkroom(job.recipe)
    made = georeference.decode(darkroom, flight, job.frame, job.tag, job.options)
    outputs = []
    for kind in fields:
        path = beside.with_suffix(KINDS[kind])
        pose = {} if job.tag is None else {"pose": asdict(job.tag.pose)}
        field = replace(made.light_field, attributes={**made.light_field.attributes, **pose})
        light_files.save(path, field, overwrite=True)
        outputs.append(_output(path, job))
    if "photos" in job.kinds:
        assert job.station is not None
        assert job.options.crs is not None
        one = georeference.place(job.station, made, darkroom, _projection(job.options.crs), job.options)
        for form, data in photo_files.encoded(one, job.station, job.utc_ns).items():
            path = folder / "photos" / form / (beside.name + photo_files.SUFFIXES[form])
            durable.make_folder(path.parent)
            durable.write_file(path, data)
            outputs.append(_output(path, job))
    if drawn:
        assert job.station is not None
        assert job.level_m is not None
        assert job.options.crs is not None
        projection = _projection(job.options.crs)
        one = georeference.place(job.station, made, darkroom, projection, job.options)
        survey = georeference.on_ground(
            flight.name, [one], [], projection=projection, level_m=job.level_m, options=job.options
        )
        gain = cog.gain_of([one.image])
        for kind in drawn:
            path = beside.with_suffix(KINDS[kind])
            if kind == "cog":
                map_files.frame_cog(survey, one, path, gain)
            else:
                map_files.frame_kmz(survey, one, path, gain)
            outputs.append(_output(path, job))
    return outputs


def _output(path: Path, job: Job) -> BatchOutput:
    """A finished file or folder, with one hash over its content."""
    name = str(path.relative_to(job.output))
    if path.is_file():
        return BatchOutput(name, path.stat().st_size, durable.hash_file(path))
    whole = hashlib.sha256()
    size = 0
    for inner in sorted(path.rglob("*")):
        if inner.is_file():
            size += inner.stat().st_size
            whole.update(f"{inner.relative_to(path)} {durable.hash_file(inner)}\n".encode())
    return BatchOutput(name, size, whole.hexdigest())


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
    values = asdict(replace(options, frames=None, terrain=None))
    return {name: value if isinstance(value, str | None) else repr(value) for name, value in values.items()}


_here = threading.local()  # a decoder keeps buffers: one for each working thread


def _darkroom(recipe: Recipe) -> Darkroom:
    """This thread's darkroom for a recipe, kept from job to job."""
    kept: dict[Recipe, Darkroom] = _here.__dict__.setdefault("darkrooms", {})
    if recipe not in kept:
        kept.clear()
        kept[recipe] = Darkroom(recipe)
    return kept[recipe]


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


@cache
def _settle_memory() -> None:
    """Keep freed memory in this process for the next frame.

    glibc returns it to the system and fetches it again, page by page, for every array; in a Dask worker
    (MALLOC_TRIM_THRESHOLD_) even from 64 KiB on, which doubles a frame's time. Without glibc nothing happens.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    mallopt(_TRIM_THRESHOLD, 1 << 30)
    mallopt(_MMAP_THRESHOLD, 1 << 25)


class ManifestError(DappledError):
    """A manifest can't be used."""


class Manifest:
    """The manifest of an output folder, locked by one batch at a time. Use as a context manager."""

    def __init__(self, output: Path) -> None:
        """Raises ManifestError where another batch is writing to this folder, or the disk refuses."""
        self.path = output / MANIFEST
        try:
            durable.make_folder(output)
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                file_lock.lock(self._fd)
            except BlockingIOError:
                os.close(self._fd)
                raise ManifestError(
                    f"another batch is writing to {output}: wait for it, or choose another -o"
                ) from None
        except OSError as error:
            raise ManifestError(f"cannot keep a manifest in {output}: {error.strerror}") from None
        self.done = self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def add(self, done: Done) -> None:
        """Append a result, durably."""
        os.write(self._fd, json.dumps(asdict(done), sort_keys=True).encode() + b"\n")
        os.fsync(self._fd)
        self.done[done.key] = done

    def holds(self, key: str) -> bool:
        """Whether a job is done and its files are still there."""
        done = self.done.get(key)
        if done is None or done.error is not None:
            return False
        folder, where = self.path.parent, f"the manifest {self.path}"
        return all(_size(confined.path(folder, one.name, where)) == one.size for one in done.outputs)

    def _read(self) -> dict[str, Done]:
        text = b""
        while block := os.read(self._fd, 1 << 20):
            text += block
        whole = text.rfind(b"\n") + 1
        if whole < len(text):  # torn by a power cut: that job runs again
            os.ftruncate(self._fd, whole)
            os.lseek(self._fd, 0, os.SEEK_END)
        known: dict[str, Done] = {}
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                done = _done(parse_json(line, _LINE_BYTES))
            except (ValueError, TypeError, KeyError):
                raise ManifestError(
                    f"{self.path}, line {number} is not a line of a manifest: move the file away, "
                    "and everything will be made again"
                ) from None
            known[done.key] = done
        return known


def _done(row: dict[str, Any]) -> Done:
    """Raises ValueError, TypeError and KeyError."""
    done = Done(**{**row, "outputs": tuple(BatchOutput(**one) for one in row["outputs"])})
    if not all(isinstance(name, str) for name in (done.key, *(one.name for one in done.outputs))):
        raise TypeError("a name is not text")
    return done


def _size(path: Path) -> int | None:
    if path.is_file():
        return path.stat().st_size
    if path.is_dir():
        return sum(inner.stat().st_size for inner in path.rglob("*") if inner.is_file())
    return None
