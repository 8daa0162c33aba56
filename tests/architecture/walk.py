"""Trace the modules that one command and one frame pass in a simulated flight.

    python -m tests.architecture.walk            print both walks
    python -m tests.architecture.walk --write    render them, and the list of all modules, into docs/modules.md

The command is an IMAGE_START_CAPTURE: from the packet on a MAVLink link, through shutter and camera driver, to the
acknowledgement. A frame is followed from the camera's arrival event to the published slices, in the daemon and in its
decode process; what the third and the fourth pass is taken together, because not every frame has a preview. Every
module of dappled whose functions run in the threads of a frame counts; the camera's own process is not followed.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "dappled"
PAGE = ROOT / "docs" / "modules.md"
WALK = ("<!-- walk: begin -->", "<!-- walk: end -->")
MODULES = ("<!-- modules: begin -->", "<!-- modules: end -->")
RECORDED = {"command": 18, "frame": 69}  # modules passed; of a frame 49 before its picture was judged in flight
GROWTH = 1.25  # over what is recorded: more fails
FRAMES = 4  # the third and the fourth are followed: the decode process has set up by then
_BETWEEN_FRAMES_NS = 300_000_000  # two frames of one camera are further apart
_JOB = "Darkroom.decode"
_FRAME_THREADS = frozenset({"capture", "tag", "decode", "publisher"})
_SETTINGS = '[record]\ndirectory = "flights"\n[publish]\nslices = "ipc://{sockets}/slices"\n'


@cache
def parsed(source: str) -> ast.Module:
    """One tree for all who look at a module; not to be changed."""
    return ast.parse(source)


class WalkError(Exception):
    """The trace does not show what it should; one sentence."""


@dataclass(frozen=True, slots=True)
class Step:
    """A thread enters a module by a function; the module is "" where it begins to wait."""

    at_ns: int
    thread: str
    module: str
    function: str


@dataclass(frozen=True, slots=True)
class Walk:
    """The modules that a command and a frame pass, in the order of their first use."""

    command: tuple[str, ...]
    frame: tuple[str, ...]


def fly(folder: Path) -> Walk:
    """Fly a simulated flight of `FRAMES` frames in `folder` under the tracer, and read the walks from it."""
    trace = folder / "trace"
    trace.mkdir()
    path = os.pathsep.join([str(Path(__file__).parent / "tracing"), str(SOURCE.parent)])
    simulated = ["run", "--simulate", "--seed", "3", "--frames", str(FRAMES), "--config", "dappled.toml"]
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:  # a path of a socket must be short
        (folder / "dappled.toml").write_text(_SETTINGS.format(sockets=sockets), encoding="utf-8")
        subprocess.run(
            [sys.executable, "-m", "dappled", *simulated],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path, "DAPPLED_TRACE": str(trace)},
            check=True,
            timeout=100,
            stdout=subprocess.DEVNULL,
        )
    return read([list(_steps(file)) for file in sorted(trace.iterdir())])


def read(processes: Sequence[Sequence[Step]]) -> Walk:
    """Both walks from the steps of every process. Raises WalkError where the trace doesn't show them."""
    daemon = next((steps for steps in processes if any(step.thread == "publisher" for step in steps)), None)
    if daemon is None:
        raise WalkError("no process of the flight has a thread `publisher`")
    worker = [steps for steps in processes if any("decode_worker" in step.module for step in steps)]
    if not worker:
        raise WalkError("no process of the flight ran the decode worker")
    return Walk(command_of(daemon), _frame(daemon, [step for steps in worker for step in steps]))


def command_of(daemon: Iterable[Step]) -> tuple[str, ...]:
    """What a MAVLink thread runs between two waits, where it asks the shutter and hands over to the camera process."""
    ways = [
        way
        for thread, steps in _threads(daemon).items()
        if thread.startswith("mavlink")
        for way in _between_waits(steps)
        if any(module.endswith(".shutter") for module in way) and any("drivers.gphoto2" in module for module in way)
    ]
    if len(ways) < FRAMES:
        raise WalkError(f"{len(ways)} commands in the trace reached the camera process, and {FRAMES} were given")
    return tuple(dict.fromkeys(module for way in ways for module in way))


def _frame(daemon: Iterable[Step], worker: Iterable[Step]) -> tuple[str, ...]:
    """From the wait before the third frame is recorded to the end of the fourth, which the decode thread finishes."""
    threads = _threads(daemon)
    if missing := _FRAME_THREADS - set(threads):
        raise WalkError(f"the daemon has no thread {', '.join(sorted(missing))}: a frame's way can't be followed")
    recorded = _bursts(step.at_ns for step in threads["capture"] if step.function == "Recorder.record")
    if len(recorded) != FRAMES:
        raise WalkError(f"{len(recorded)} frames in the trace were recorded, and {FRAMES} were taken")
    began = _wait_before(threads["capture"], recorded[2])
    ended = max(step.at_ns for step in threads["decode"] if step.module)
    captured = _wait_after(threads["capture"], recorded[3])  # later events are the camera's end
    steps = [step for step in threads["capture"] if step.at_ns <= captured]
    steps += [step for thread in _FRAME_THREADS - {"capture"} for step in threads[thread]] + _last_jobs(worker)
    walked = [(step.at_ns, step.module) for step in steps if began <= step.at_ns <= ended and step.module]
    return tuple(dict.fromkeys(module for _, module in sorted(walked)))


def _last_jobs(worker: Iterable[Step]) -> list[Step]:
    """What the decode process does for the last two frames: on a busy machine it still reads its recipe when the third
    frame comes."""
    steps = list(worker)
    decoded = [step.at_ns for step in steps if step.function == _JOB]
    if len(decoded) < 2:
        raise WalkError(f"{len(decoded)} frames in the trace were decoded, and {FRAMES} were taken")
    return [step for step in steps if step.at_ns >= decoded[-2]]


def _steps(file: Path) -> Iterator[Step]:
    for line in file.read_text(encoding="utf-8").splitlines():
        words = line.split(" ")
        if len(words) == 4 and words[0].isdigit():  # else the process was killed in the middle of a line
            yield Step(int(words[0]), words[1], words[2] if words[2] != "-" else "", words[3])


def _threads(steps: Iterable[Step]) -> dict[str, list[Step]]:
    found: defaultdict[str, list[Step]] = defaultdict(list)
    for step in steps:
        found[step.thread].append(step)
    return found


def _between_waits(steps: Iterable[Step]) -> Iterator[list[str]]:
    way: list[str] = []
    for step in steps:
        if step.module:
            way.append(step.module)
        else:
            yield way
            way = []


def _bursts(times_ns: Iterable[int]) -> list[int]:
    """The first of each group of times that lie close together."""
    found: list[int] = []
    last_ns = -_BETWEEN_FRAMES_NS
    for at_ns in times_ns:
        if at_ns - last_ns > _BETWEEN_FRAMES_NS:
            found.append(at_ns)
        last_ns = at_ns
    return found


def _wait_before(steps: Iterable[Step], at_ns: int) -> int:
    return max(step.at_ns for step in steps if not step.module and step.at_ns <= at_ns)


def _wait_after(steps: Iterable[Step], at_ns: int) -> int:
    return min(step.at_ns for step in steps if not step.module and step.at_ns >= at_ns)


def rendered(walk: Walk) -> str:
    """Both walks as Markdown. The list of all modules says what each one does."""
    parts = []
    for title, modules in (("One command", walk.command), ("One frame", walk.frame)):
        parts += [f"{title} passes {len(modules)} modules:", "", " →\n".join(f"`{module}`" for module in modules), ""]
    return "\n".join(parts)


def on_page(page: str) -> list[list[str]]:
    """The modules of both walks as the page lists them."""
    walk = between(page, WALK)
    tables = walk.split("One frame passes")
    return [re.findall(r"^`(.*?)`", table, re.MULTILINE) for table in tables]


def between(page: str, marks: tuple[str, str]) -> str:
    """The part of a page between two marks, without them."""
    return page.partition(marks[0])[2].partition(marks[1])[0].removeprefix("\n")


def module_list() -> str:
    """All modules as Markdown, a list for each folder, with each docstring's first line up to its colon."""
    parts = []
    for folder in sorted({file.parent for file in SOURCE.rglob("*.py")}):
        modules = sorted(file.stem for file in folder.glob("*.py") if file.stem != "__init__")
        inside = ".".join(folder.relative_to(SOURCE).parts)
        parts += [f"**`{inside or 'dappled'}/`** {_docstring(inside or '__init__')}", ""]
        parts += [f"- `{name}`: {_docstring(f'{inside}.{name}' if inside else name)}" for name in modules]
        parts.append("")
    return "\n".join(parts)


def _docstring(module: str) -> str:
    place = SOURCE / module.replace(".", "/")
    package = place / "__init__.py"
    file = package if package.exists() else place.with_suffix(".py")
    line = (ast.get_docstring(parsed(file.read_text(encoding="utf-8"))) or "").partition("\n")[0]
    said = re.split("[:;] ", line)[0]
    whole = len(said.split()) > 5 and said.count("`") % 2 == 0 and said.count("(") == said.count(")")
    return f"{said.rstrip('.')}." if whole else line


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        walk = fly(Path(folder))
    text = rendered(walk)
    if "--write" not in sys.argv[1:]:
        sys.stdout.write(text)
        return 0
    page = PAGE.read_text(encoding="utf-8")
    for marks, content in ((WALK, text), (MODULES, module_list())):
        before, _, rest = page.partition(marks[0])
        page = f"{before}{marks[0]}\n{content}{marks[1]}{rest.partition(marks[1])[2]}"
    PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
