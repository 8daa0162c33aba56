"""Batches: the same bytes by pool and cluster, and nothing lost when workers die, disks tear or a frame is bad."""

from __future__ import annotations

import asyncio
import errno
import json
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled import codec, durable
from dappled.cli import main
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, finding, told
from dappled.flight import Frame, disk_error
from dappled.products.batch import batch, workers
from dappled.products.batch.batch import Done, Job, Manifest
from dappled.products.exports import light_files
from dappled.products.geotags import geotags
from dappled.products.geotags.geotags import Placed
from dappled.products.handover import forms
from dappled.products.handover.forms import HandedFrame
from dappled.products.maps import photographs
from dappled.products.maps.georeference import Options
from dappled.products.maps.laboratory import FlightFrame
from tests import globe
from tests.products.flown import Flown

CLIPPED = finding(Code.FRAME_CLIPPED, FRAME, share=0.03)


@pytest.fixture
def flight(short_flight: Flown) -> Flown:
    return short_flight


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): durable.hash_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "manifest.jsonl"
    }


def words(flight: Flown, output: Path, *more: str) -> list[str]:
    recipe = flight.recipe
    given = ["--camera", recipe.camera, "--mask", recipe.mask, "--calibration", recipe.calibration]
    return ["batch", str(flight.folder), "-o", str(output), "--as", "npz", "cog", "kmz", *given, *more]


def job(name: str, key: str = "") -> Job:
    frame = Frame(0, name, name, 0, "", 0)
    return Job("flight", frame, None, DappledError("no position"), None, RECIPE, Options(), (), "out", key or name)


RECIPE = Recipe("reference-36mm", "reference-5x5")


def answer(one: Job) -> Done:
    """A worker's part that does what the frame's name says."""
    name = one.frame.name
    if name.startswith("dies-once:") and not Path(name.removeprefix("dies-once:")).exists():
        Path(name.removeprefix("dies-once:")).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "hangs":
        signal.pause()
    if name == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return Done(one.key, "flight", name, (), None, 0.0, 0.0, 0.0)


@pytest.mark.long
def test_a_batch_goes_on_where_it_was_stopped(
    flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    assert main(words(flight, output, "--workers", "2")) == 0
    assert "2 frames made, 0 already there" in capsys.readouterr().out
    made = hashes(output)
    assert sorted(Path(name).suffix for name in made) == [".kmz", ".kmz", ".npz", ".npz", ".tif", ".tif"]
    assert main(words(flight, output)) == 0
    assert "0 frames made, 2 already there" in capsys.readouterr().out
    (output / flight.folder.name / "000001.tif").unlink()
    assert main(words(flight, output, "--workers", "1", "--json")) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["frame"] == "frames/000001.dng"
    assert hashes(output) == made  # one worker, the same bytes
    assert main(words(flight, output, "--gsd", "0.1", "--frames", "1")) == 0  # another wish is another job
    assert "1 frame made" in capsys.readouterr().out
    assert hashes(output)[f"{flight.folder.name}/000001.tif"] != made[f"{flight.folder.name}/000001.tif"]


@pytest.mark.long
def test_a_light_field_of_a_batch_holds_its_pose(flight: Flown, tmp_path: Path) -> None:
    (first, _) = batch.plan(flight.folder, flight.recipe, Options(), ["npz"], tmp_path)
    done = batch.make(first)
    assert done.error is None
    attributes = light_files.load(tmp_path / done.outputs[0].name).attributes
    assert attributes["pose"]["altitude_msl_m"] == pytest.approx(223.36, abs=0.5)
    assert done.peak_mb > 50


@pytest.mark.slow
def test_a_bad_frame_is_noted_and_the_others_are_made(
    flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frame cut short after it was recorded, in a copy of the flight."""
    copy = tmp_path / flight.folder.name
    subprocess.run(["cp", "-r", str(flight.folder), str(copy)], check=True)  # noqa: S607  on PATH
    frame = copy / "frames" / "000000.dng"
    frame.write_bytes(frame.read_bytes()[:5000])
    output = tmp_path / "out"
    assert main(words(replace(flight, folder=copy), output, "--workers", "2")) == 1
    said = capsys.readouterr()
    assert "1 frame made, 0 already there, 1 failed" in said.out
    assert "000000.dng" in said.err
    globe.check_archive(output / copy.name / "000001.kmz")
    noted = [json.loads(line) for line in (output / "manifest.jsonl").read_text().splitlines()]
    assert {row["frame"]: row["error"] is None for row in noted} == {
        "frames/000000.dng": False,
        "frames/000001.dng": True,
    }


@pytest.mark.long
def test_a_bad_flight_is_said_and_the_others_are_made(
    flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = words(flight, tmp_path / "out", "--as", "npz", "--frames", "0", "--workers", "1")
    (tmp_path / "none").mkdir()
    assert main([asked[0], str(tmp_path), str(tmp_path / "none"), *asked[1:]]) == 1
    said = capsys.readouterr()
    assert "1 frame made" in said.out
    lines = said.err.strip().splitlines()
    assert len(lines) == 2
    assert all("is not a flight folder" in line for line in lines)
    assert main([asked[0], str(tmp_path), *asked[2:]]) == 2  # and where none is left
    assert capsys.readouterr().err.count("is not a flight folder") == 1


@pytest.mark.long
def test_a_flight_that_is_named_twice_is_made_once(
    flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = words(flight, tmp_path / "out", "--as", "npz", "--frames", "0", "--workers", "1")
    again = tmp_path / "link"
    again.symlink_to(flight.folder)
    assert main([asked[0], str(flight.folder), str(again), *asked[1:]]) == 0
    assert "1 frame made" in capsys.readouterr().out


def test_two_flights_of_one_name_are_refused(flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / flight.folder.name
    subprocess.run(["cp", "-r", str(flight.folder), str(copy)], check=True)  # noqa: S607  on PATH
    asked = words(flight, tmp_path / "out")
    assert main([asked[0], str(copy), *asked[1:]]) == 2
    assert "would both be written to" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_frames_with_the_same_bytes_are_jobs_of_their_own(
    flight: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a still scene without noise makes them, from frames that were never tagged."""
    frames, _ = photographs.recorded(flight.folder)
    twins = [replace(frame, sha256=frames[0].sha256) for frame in frames]
    monkeypatch.setattr(photographs, "recorded", lambda _: (twins, {}))
    jobs = batch.plan(flight.folder, flight.recipe, Options(), ["npz"], tmp_path)
    assert len({one.key for one in jobs}) == 2


@pytest.mark.slow
def test_a_frame_without_a_place_still_becomes_a_light_field(flight: Flown, tmp_path: Path) -> None:
    (first, _) = batch.plan(flight.folder, flight.recipe, Options(), ["npz", "cog"], tmp_path)
    lost = replace(first, station=DappledError("no position is known for frames/000000.dng"))
    done = batch.make(lost)
    assert done.error == "no position is known for frames/000000.dng"
    assert (dict(done.refused), [one.kind for one in done.outputs]) == ({"cog": done.error}, ["npz"])
    done = batch.make(replace(lost, kinds=("cog",)))
    assert (done.error, done.outputs) == ("no position is known for frames/000000.dng", ())
    with pytest.raises(DappledError, match="a batch makes"):
        batch.plan(flight.folder, flight.recipe, Options(), ["gif"], tmp_path)


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Which frames the files of each form name. Frames are not decoded, and forms but a file each; STAC refuses the
    first frame, and the second flight's nerfstudio file can't be written."""
    named: dict[str, list[str]] = {}

    def written(form: str, folder: Path, frame: HandedFrame) -> list[Path]:
        if form == "stac" and frame.station.name == "000000":
            raise DappledError("the time of frames/000000.dng in UTC was never known")
        path = folder / f"{frame.station.name}.json"
        durable.make_folder(folder)
        durable.write_file(path, f"{frame.station.tag.pose.latitude_rad:.3f}".encode())
        return [path]

    def finished(form: str, folder: Path, flight: str, names: Sequence[str]) -> list[Path]:
        if form == "nerfstudio" and flight == "second":
            raise OSError(errno.ENOSPC, "No space left on device")
        named[f"{flight}/{form}"] = list(names)
        return []

    monkeypatch.setattr(FlightFrame, "doubts", property(lambda _: (CLIPPED,)))
    monkeypatch.setattr(workers, "in_processes", lambda jobs, make, _: map(make, jobs))
    monkeypatch.setattr(forms, "write_frame", written)
    monkeypatch.setattr(forms, "finish", finished)
    return named


def test_what_one_form_refuses_the_others_keep(
    flight: Flown, tmp_path: Path, listed: dict[str, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("first", "second"):
        subprocess.run(["cp", "-r", str(flight.folder), str(tmp_path / name)], check=True)  # noqa: S607  on PATH
    asked = words(flight, tmp_path / "out", "--as", "colmap", "nerfstudio", "stac", "--json")
    assert main(["batch", str(tmp_path / "first"), str(tmp_path / "second"), *asked[2:]]) == 1
    both = ["000000", "000001"]
    first = {"first/colmap": both, "first/nerfstudio": both, "first/stac": ["000001"]}
    assert listed == {**first, "second/colmap": both, "second/stac": ["000001"]}
    said = capsys.readouterr()
    full = disk_error("write the lists of", tmp_path / "out/second/nerfstudio", OSError(errno.ENOSPC, ""))
    assert said.err.splitlines() == [
        *["dappled batch: the time of frames/000000.dng in UTC was never known"] * 2,
        f"dappled batch: {full}",
        f"in doubt: frame second/000000: {told(CLIPPED, FRAME)}",
        f"in doubt: frame first/000000: {told(CLIPPED, FRAME)}",
        "dappled batch: done, but in doubt: see above; --anyway accepts that",
    ]
    rows = [json.loads(line) for line in said.out.splitlines()]
    assert [sorted(row["refused"]) for row in rows] == [["stac"], [], ["stac"], []]
    assert [len(row["files"]) for row in rows] == [2, 3, 2, 3]
    assert [row["doubts"] for row in rows] == [[codec.plain(CLIPPED)]] * 4


@pytest.mark.parametrize("last", [-3.4, -16.0], ids=["there", "fallen out"])
@pytest.mark.usefixtures("listed")
def test_frames_that_cant_show_their_mask_are_judged_by_the_flight(
    flight: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, last: float
) -> None:
    """The first of two frames shows it."""
    there = last > -10
    nats = {"000000": 120.0, "000001": last}
    unseen = finding(Code.MASK_UNSEEN, FRAME, nats=last)
    monkeypatch.setattr(FlightFrame, "mask_nats", property(lambda one: nats[one.path.stem]))
    monkeypatch.setattr(FlightFrame, "doubts", property(lambda one: (unseen,) if nats[one.path.stem] < 0 else ()))
    output = tmp_path / "out"
    assert main(words(flight, output, "--as", "colmap")) == (0 if there else 1)
    said = capsys.readouterr().err
    assert "the mask is seen in 1 of 2 frames, and can't be seen in 1" in said
    assert (f"frame {flight.folder.name}/000001: {told(unseen, FRAME)}" in said) is not there
    assert main(words(flight, output, "--as", "colmap")) == (0 if there else 1)  # by the manifest alone
    assert capsys.readouterr().err == said


def test_files_of_other_positions_are_made_again(
    flight: Flown, tmp_path: Path, listed: dict[str, list[str]], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Both write under the same names, and the files are of one size."""
    asked = words(flight, tmp_path, "--as", "colmap", "--anyway")
    before, read = tmp_path / flight.folder.name / "colmap" / "000000.json", geotags.read

    def moved(*given: Any) -> tuple[list[Placed], Any]:
        placed, left = read(*given)
        return [
            replace(one, tag=replace(one.tag, pose=replace(one.tag.pose, latitude_rad=0.1))) for one in placed
        ], left

    assert main(asked) == 0
    true = before.read_bytes()
    monkeypatch.setattr(geotags, "read", moved)
    assert main(asked) == 0
    assert before.read_bytes() == b"0.100"
    monkeypatch.setattr(geotags, "read", read)
    assert main(asked) == 0
    assert before.read_bytes() == true
    before.write_bytes(b"0.200")  # a job that was killed before it could say so
    capsys.readouterr()
    assert main(asked) == 0
    assert "1 frame made, 1 already there" in capsys.readouterr().out
    assert before.read_bytes() == true
    assert listed[f"{flight.folder.name}/colmap"] == ["000000", "000001"]


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    jobs = [job(f"dies-once:{tmp_path}/a"), *(job(f"{n}") for n in range(8)), job(f"dies-once:{tmp_path}/b")]
    done = list(workers.in_processes(jobs, answer, 2))
    assert sorted(one.key for one in done) == sorted(one.key for one in jobs)
    assert all(one.error is None for one in done)


@pytest.mark.slow
def test_a_frame_that_kills_every_worker_is_given_up(tmp_path: Path) -> None:
    done = {one.frame: one.error for one in workers.in_processes([job("dies"), job("1"), job("2")], answer, 1)}
    assert done["1"] is None
    assert done["2"] is None
    assert "ended or held up 3 workers" in str(done["dies"])


def test_a_frame_that_hangs_every_worker_is_given_up() -> None:
    (last,) = workers.in_processes([job("hangs")], answer, 1, job_s=0.05)
    assert "ended or held up 3 workers" in str(last.error)


@pytest.mark.slow
def test_workers_end_with_the_one_who_asked(tmp_path: Path) -> None:
    answers = workers.in_processes([job(str(n)) for n in range(20)], answer, 2)
    next(answers)
    answers.close()  # type: ignore[attr-defined]  # it is a generator
    assert not [child for child in multiprocessing.active_children() if child.is_alive()]


def test_two_batches_cant_share_a_folder(tmp_path: Path) -> None:
    with Manifest(tmp_path), pytest.raises(DappledError, match="another batch is writing to"):
        Manifest(tmp_path)
    with Manifest(tmp_path) as again:
        assert again.done == {}


def test_a_torn_manifest_keeps_its_whole_lines(tmp_path: Path) -> None:
    with Manifest(tmp_path) as manifest:
        manifest.add(
            Done("a", "flight", "frames/0.dng", (batch.BatchOutput("x", 3, "00", "npz"),), None, 1.0, 1.0, 2.0)
        )
    path = tmp_path / "manifest.jsonl"
    path.write_bytes(path.read_bytes() + b'{"key": "b", "fli')
    with Manifest(tmp_path) as manifest:
        assert set(manifest.done) == {"a"}
        assert not manifest.holds("a")  # what it made is not there
        (tmp_path / "x").write_bytes(b"123")
        assert manifest.holds("a")
        manifest.add(Done("c", "flight", "frames/1.dng", (), "bad", 1.0, 1.0, 2.0))
        assert not manifest.holds("c")
    assert len(path.read_text().splitlines()) == 2
    path.write_text("no manifest\n")
    with pytest.raises(DappledError, match="line 1"):
        Manifest(tmp_path)


@pytest.mark.slow  # Dask is in the larger environment
def test_no_scheduler_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_PATIENCE_S", 0.5)
    with pytest.raises(DappledError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(workers.on_cluster([job("1")], answer, "tcp://127.0.0.1:9"))


class Cluster:
    """A scheduler and its workers, each a process of its own, as `dask scheduler` and `dask worker` start them."""

    def __init__(self, folder: Path, crew: int = 2) -> None:
        self.folder = folder
        self.crew = crew
        self.processes: list[subprocess.Popen[bytes]] = []
        self.url = ""

    def __enter__(self) -> Cluster:
        facts = self.folder / "scheduler.json"
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(facts))
        for _ in range(self.crew):
            self.worker()
        return self

    def worker(self) -> subprocess.Popen[bytes]:
        """One more worker, without a nanny: what is killed stays dead."""
        return self._start(
            "worker", "--scheduler-file", str(self.folder / "scheduler.json"), "--nthreads", "1", "--no-nanny",
            "--no-dashboard", "--host", "127.0.0.1", "--local-directory", str(self.folder),
        )  # fmt: skip

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        path = os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments], cwd=self.folder, env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.processes.append(process)
        return process

    def __exit__(self, *_: object) -> None:
        for process in reversed(self.processes):
            process.kill()
            process.wait()

    def address(self) -> str:
        """The scheduler's address, once its workers are there."""
        return str(asyncio.run(asyncio.wait_for(self._address(), 60)))

    async def _address(self) -> str:
        facts = self.folder / "scheduler.json"
        while not facts.exists() or not facts.read_text().endswith("}"):
            await asyncio.sleep(0.05)
        url = str(json.loads(facts.read_text())["address"])
        from distributed import Client  # noqa: PLC0415  slow to import, and only here

        async with Client(url, asynchronous=True, set_as_default=False) as client:
            if self.crew:
                await client.wait_for_workers(self.crew, timeout=50)
        return url


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    with Cluster(tmp_path_factory.mktemp("dask")) as made:
        yield made


@pytest.mark.long
def test_a_scheduler_without_workers_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "_WORKERS_S", 0.2)
    with Cluster(tmp_path, crew=0) as alone, pytest.raises(DappledError, match="has no workers"):
        list(workers.on_cluster([job("1")], answer, alone.address()))


@pytest.mark.long
def test_a_cluster_makes_the_same_bytes_as_the_pool(cluster: Cluster, flight: Flown, tmp_path: Path) -> None:
    url = cluster.address()
    assert main(words(flight, tmp_path / "pool", "--workers", "2")) == 0
    assert main(words(flight, tmp_path / "dask", "--scheduler", url)) == 0
    pool, dask = (hashes(tmp_path / name) for name in ("pool", "dask"))
    assert pool == dask
    assert len(pool) == 6


@pytest.mark.long
def test_a_cluster_that_loses_a_worker_loses_nothing(cluster: Cluster, tmp_path: Path) -> None:
    jobs: Sequence[Job] = [job(f"dies-once:{tmp_path}/a"), *(job(str(n)) for n in range(10))]
    done = list(workers.on_cluster(jobs, answer, cluster.address()))
    assert sorted(one.key for one in done) == sorted(one.key for one in jobs)
    assert all(one.error is None for one in done)
    assert (tmp_path / "a").exists()
