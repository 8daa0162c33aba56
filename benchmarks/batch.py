"""How a batch grows with workers, and what Dask costs beside a plain pool; on frames of the reference camera.

python benchmarks/batch.py [--json] [--frames 16] [--repeats 3] [--scale 1.0]

One flight of simulated frames (10 MP at scale 1), each made into a light field and a map. Ratios are of times within
one run, interleaved, the median over repeats; CPU seconds, which other work on the machine disturbs less, stand beside
them. The clock starts when the workers are warm, as in a long batch; how long that takes is reported too. Memory is the
largest of any worker's.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import tomli_w

sys.path.insert(0, str(Path(__file__).parents[1]))  # the tags are the tests' own

from limits import show
from tests.flight.makers import hot_shoe_tag

from dappled.config import profiles
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.geometry import Pose
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum.plane import to_plane
from dappled.drivers.raw import reading
from dappled.drivers.raw.recipe import Recipe
from dappled.flight import Frame
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.products.batch import batch, workers
from dappled.products.batch.batch import Done, Job
from dappled.products.maps import photographs
from dappled.products.maps.georeference import Options
from dappled.products.mounting import Mounting

CAMERA, MASK, F_NUMBER, SEED = "reference-36mm", "reference-5x5", 14.8, 5
KINDS = ("npz", "cog")


def flight(folder: Path, count: int, scale: float) -> list[Job]:
    """Jobs of a flight that was never recorded: two frames' bytes under many names, each with its own pose."""
    path = FlightPath(SEED)
    camera = reference_camera(SEED, scale=scale, path=path)
    exposures = [camera.expose(1.0 + 0.7 * k, k, f_number=F_NUMBER) for k in range(2)]
    bench = reference_camera(SEED, scale=scale, scene="white").bench_frame()
    raw = reading.read(bench.file, "bench frame")
    plane = to_plane(raw.mosaic, black=raw.black, white=raw.white, cfa=raw.cfa)
    profile = profiles.camera(CAMERA)
    found = calibrate(
        [CalibrationFrame(plane, 50.0, float(raw.f_number or F_NUMBER))],
        MaskedOptics(
            profile.sensor((plane.shape[0], plane.shape[1])),
            profiles.mask(MASK).mask,
            profile.law,
            profile.mask_distance_mm,
        ),
    )
    calibration = folder / "calibration.toml"
    calibration.write_text(tomli_w.dumps(found.to_dict()), encoding="utf-8")
    (folder / "flight" / "frames").mkdir(parents=True)
    recipe = Recipe(CAMERA, MASK, calibration=str(calibration), colour=True)
    jobs = []
    for index in range(count):
        exposure = exposures[index % 2]
        name = f"frames/{index:06d}.dng"
        (folder / "flight" / name).write_bytes(exposure.file)
        true = path.pose(exposure.mid_exposure_t_s)
        frame = Frame(index, name, name, len(exposure.file), f"{index:064x}", 0)
        pose = Pose(
            "interpolated", round(true.t_s * 1e9), None, _radians(true.latitude_deg), _radians(true.longitude_deg),
            true.altitude_msl_m, -true.position_ned_m[2], None, true.attitude, 0.02, 0.001, 1.0, 1,
        )  # fmt: skip
        tag = hot_shoe_tag(frame, pose)
        station = photographs.station(frame, tag, Mounting())
        options = Options(crs="EPSG:32615")
        jobs.append(
            Job(str(folder / "flight"), frame, tag, station, path.home_altitude_msl_m, recipe, options, KINDS,
                str(folder / "out"), f"{index}")
        )  # fmt: skip
    return jobs


def _radians(degrees: float) -> float:
    return degrees * 3.141592653589793 / 180


def timed(
    jobs: Sequence[Job], run: Callable[[Sequence[Job]], Iterator[Done]], warm: int
) -> tuple[float, float, float, float]:
    """(seconds for the jobs after so many that warm the workers up, seconds until then, largest memory in MB, CPU
    seconds of a job)."""
    began = time.monotonic()
    started = 0.0
    peak = 0.0
    cpu = []
    for number, done in enumerate(run(jobs), 1):
        if done.error is not None:
            raise SystemExit(done.error)
        peak = max(peak, done.peak_mb)
        cpu += [done.cpu_seconds] if number > warm else []
        if number == warm:
            started = time.monotonic()
    return time.monotonic() - started, started - began, peak, statistics.median(cpu)


@contextmanager
def dask(folder: Path, count: int) -> Iterator[str]:
    """A scheduler and so many one-thread workers, started as the documentation says."""
    facts = folder / "scheduler.json"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file", str(facts)],
            cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    processes = [start("scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        while not facts.exists() or not facts.read_text().endswith("}"):
            time.sleep(0.1)
        processes.append(start("worker", "--nworkers", str(count), "--nthreads", "1", "--local-directory", str(folder)))
        from distributed import Client  # noqa: PLC0415  an extra, and slow to import

        url = str(json.loads(facts.read_text())["address"])
        with Client(url, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=60)
        yield url
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scale", type=float, default=1.0, choices=(0.5, 1.0))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dappled-bench-") as name:
        folder = Path(name)
        jobs = flight(folder, arguments.frames + 4, arguments.scale)
        ways: dict[str, list[tuple[float, float, float, float]]] = {"pool of 1": [], "pool of 2": [], "dask of 2": []}
        with dask(folder, 2) as url:
            for repeat in range(arguments.repeats):
                shutil.rmtree(folder / "out", ignore_errors=True)
                fresh = [replace(job, key=f"{repeat}-{job.key}") for job in jobs]
                ways["pool of 1"].append(timed(fresh, lambda some: workers.in_processes(some, batch.make, 1), 4))
                ways["pool of 2"].append(timed(fresh, lambda some: workers.in_processes(some, batch.make, 2), 4))
                ways["dask of 2"].append(timed(fresh, lambda some: workers.on_cluster(some, batch.make, url), 4))
    one, two, cluster = (ways[way] for way in ways)
    peak = {way: max(t[2] for t in runs) for way, runs in ways.items()}
    result = {
        "frames": arguments.frames,
        "scale": arguments.scale,
        "seconds_per_frame": {
            way: statistics.median(t[0] for t in runs) / arguments.frames for way, runs in ways.items()
        },
        "until_the_fourth_frame_s": {way: statistics.median(t[1] for t in runs) for way, runs in ways.items()},
        "two_workers_over_one": statistics.median(a[0] / b[0] for a, b in zip(one, two, strict=True)),
        "dask_over_pool": statistics.median(b[0] / a[0] for a, b in zip(two, cluster, strict=True)),
        "cpu_seconds_per_frame": {way: min(t[3] for t in runs) for way, runs in ways.items()},
        "peak_mb_per_worker": peak,
    }
    show("batch", result, as_json=arguments.json)


if __name__ == "__main__":
    main()
