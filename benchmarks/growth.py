"""How work on a flight grows with its frames: CPU time and memory of the verbs that read a whole flight.

python benchmarks/growth.py [--json] [--frames 10 600 2400] [--repeats 5] [--pictures 5 25 400]

Each flight is recorded by the recorder itself, frames in lines over a field, every frame with a tag and a verdict's
facts; a raw file is 60 kB, so that what grows is the verbs' own work and not the hashing of bytes. Each verb runs in a
process of its own. `growth` is the CPU time of a frame between the second flight and the third, over that between the
first and the second: 1 is linear, 5 quadratic (10, 600 and 2400 frames). Memory is the largest of the process, or of
one of its workers. Verbs that make something of each frame's pixels have flights of their own, with frames of 0.64 MP,
and are run once: there `growth` is what a frame costs at 400 over what it costs at 25, and so is `memory_growth`.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the tags are the tests' own

from limits import show
from tests.flight.makers import hot_shoe_tag

from dappled.clock import RecordedClock
from dappled.decode.geometry import Pose
from dappled.drivers.camera import Blob
from dappled.flight import Cause, Shot, recording
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene.masked_camera import reference_camera

CAMERA, MASK, F_NUMBER = "reference-36mm", "reference-5x5", 14.8
BY = ("--camera", CAMERA, "--mask", MASK)
LINE, STEP_M, APART_M = 25, 4.0, 6.0
"""Frames of a line, metres between frames, metres between lines."""
VERBS = ("show", "report", "check", "coverage", "geotag")
OF_PIXELS = ("georeference", "picture", "photos")
SPREAD = 0.15
"""What runs of one command differ by, of their CPU time: a verb that takes less for more frames counts as this."""


def fly(folder: Path, count: int, file: bytes | None = None) -> Path:
    """A flight of so many frames over a field, each with these bytes (default: a small white frame), in `folder`."""
    path = FlightPath(5)
    file = reference_camera(5, scale=0.125, scene="bench").bench_frame().file if file is None else file
    begun = recording.begin(folder / "flights", RecordedClock(1_795_256_103_000_000_000))
    home = path.pose(0.0)
    metres = 6_371_000.0 * math.pi / 180
    for index in range(count):
        line, place = divmod(index, LINE)
        shot = Shot(index, Cause("mavlink:255/190", "IMAGE_START_CAPTURE", index), 1_000 + index, 2_000 + index)
        begun.journal.note(shot)
        begun.ledger.add_shot(shot)
        begun.ledger.fired(index, 10, 20)
        with closing(Blob.of(file)) as blob:
            frame = begun.recorder.record(index, f"IMG_{index:04d}.DNG", blob, arrived_utc_ns=5)
        utc_ns = 1_795_256_103_000_000_000 + index * 1_000_000_000
        north_m, east_m = STEP_M * (place if line % 2 == 0 else LINE - 1 - place), APART_M * line
        pose = Pose(
            source="interpolated",
            utc_ns=utc_ns,
            boot_us=None,
            latitude_rad=math.radians(home.latitude_deg + north_m / metres),
            longitude_rad=math.radians(
                home.longitude_deg + east_m / (metres * math.cos(math.radians(home.latitude_deg)))
            ),
            altitude_msl_m=path.home_altitude_msl_m + 30.0,
            height_above_home_m=30.0,
            velocity_ned_m_s=(STEP_M, 0.0, 0.0),
            attitude=(0.0, 0.0, 0.0, 1.0),
            position_sigma_m=0.02,
            attitude_sigma_rad=0.001,
            age_ms=1.0,
            telemetry_packets=1,
        )
        begun.ledger.add_tag(hot_shoe_tag(frame, pose, F_NUMBER))
    begun.close()
    return begun.folder.path


def words(verb: str, flight: Path) -> list[str]:
    """The command line of a verb on a flight, with what it writes beside the flight."""
    beside = str(flight.parent / verb)
    match verb:
        case "coverage":
            return ["flight", "coverage", str(flight), "-o", beside, "--cell", "1", "--overwrite"]
        case "geotag":
            return ["geotag", str(flight), "-o", beside]
        case "georeference":
            return ["georeference", str(flight), "-o", beside, "--as", "cog", "footprints", "--gsd", "0.1", *BY]
        case "picture":
            return ["picture", str(flight), "-o", beside, *BY]
        case "photos":
            return ["batch", str(flight), "-o", beside, "--as", "photos", *BY]
        case _:
            return ["flight", verb, str(flight)]


_VERB = """
import resource, sys, threading, time
from pathlib import Path
from dappled.__main__ import main
most = 0
def look():
    global most
    resident, shared = Path("/proc/self/statm").read_text().split()[1:3]
    most = max(most, (int(resident) - int(shared)) * resource.getpagesize() // 1024)
def watch():
    while True:
        look()
        time.sleep(0.01)
threading.Thread(target=watch, daemon=True).start()
sys.argv = ["dappled", *sys.argv[1:]]
try:
    sys.exit(main())
finally:
    look()
    with open(3, "w") as peak:
        peak.write(str(max(most, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)))
"""
"""`dappled`, and the largest memory of it or of a worker, kB, on descriptor 3. Its own is without mapped files: a
flight's pictures lie in such, and the system takes their pages back when it needs them."""


def run(command: Sequence[str]) -> tuple[float, float]:
    """CPU seconds and largest memory, MB, of `dappled` with these words. Raises SystemExit where it ends badly."""
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as peak:
        process = os.posix_spawn(
            sys.executable,
            [sys.executable, "-c", _VERB, *command],
            os.environ,
            file_actions=[(os.POSIX_SPAWN_DUP2, file.fileno(), at) for file, at in ((said, 1), (said, 2), (peak, 3))],
        )
        _, status, usage = os.wait4(process, 0)
        if (code := os.waitstatus_to_exitcode(status)) not in (0, 1):  # 1: holes, or no seal
            said.seek(0)
            raise SystemExit(f"dappled {' '.join(command)}: exit {code}\n{said.read().decode()[-2000:]}")
        peak.seek(0)
        return usage.ru_utime + usage.ru_stime, int(peak.read()) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--frames", type=int, nargs=3, default=(10, 600, 2400), help="of the three flights")
    parser.add_argument("--repeats", type=int, default=5, help="runs of a verb, of which the shortest counts")
    parser.add_argument("--pictures", type=int, nargs=3, default=(5, 25, 400), help="of those whose pixels are used")
    arguments = parser.parse_args()
    file = reference_camera(5, scale=0.25, scene="bench").bench_frame().file
    figures = measure(VERBS, arguments.frames, arguments.repeats) | measure(OF_PIXELS, arguments.pictures, 1, file)
    show("growth", {"frames": arguments.frames[-1], **figures}, as_json=arguments.json)


def measure(
    verbs: Sequence[str], frames: Sequence[int], repeats: int, file: bytes | None = None
) -> dict[str, dict[str, float]]:
    """What each verb takes on three flights of so many frames."""
    used: dict[str, list[tuple[float, float]]] = {verb: [] for verb in verbs}
    for count in frames:
        with tempfile.TemporaryDirectory() as name:
            flight = fly(Path(name), count, file)
            for verb in verbs:
                runs = [run(words(verb, flight)) for _ in range(repeats)]
                used[verb].append((min(cpu for cpu, _ in runs), max(peak for _, peak in runs)))
    few, some, many = frames
    return {
        verb: {
            "cpu_ms_a_frame": 1e3 * (cpu_many - cpu_few) / (many - few),
            "growth": (cpu_many - cpu_some) / (many - some) * (some - few) / max(cpu_some - cpu_few, SPREAD * cpu_few),
            "memory_kb_a_frame": 1e3 * (most - least) / (many - few),
            "memory_growth": most / middle,
        }
        for verb, ((cpu_few, least), (cpu_some, middle), (cpu_many, most)) in used.items()
    }


if __name__ == "__main__":
    main()
