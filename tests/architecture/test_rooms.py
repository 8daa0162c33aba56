"""Sizes and names that keep the house readable."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest
import vulture

from dappled.cli import VERBS
from tests.architecture.walk import GROWTH, ROOT, SOURCE, parsed

MODULES = sorted(SOURCE.rglob("*.py"))
FOLDERS = sorted({module.parent for module in MODULES})
BENCHMARKS = sorted((ROOT / "benchmarks").glob("*.py"))
MODULES_A_FOLDER, LINES_A_MODULE = 26, 500  # the largest of 2026-11-27

# What nothing in src calls, and why it stays.
UNUSED = {
    "_check_value": "argparse calls it, to refuse a word that is no choice",
    "__getattr__": "Python calls it, for the public names that are loaded when they are asked for",
    "__dir__": "Python calls it, for `dir(dappled)`",
    "collect": "prometheus_client calls it",
    "redirect_request": "urllib calls it",
    "_unsupported_upgrade_warning": "uvicorn calls it",
    "get_reader": "napari calls it, by the manifest napari.json",
    "plot": "of what `dappled.open` returns: notebooks call it",
}

# Fields that nothing in src reads by name, and why they stay.
UNREAD = {
    "position_covariance_m2": "in the ledger, by the codec",
    "attitude_covariance_rad2": "in the ledger, by the codec",
    "unsigned_taken": "in the health record, by the codec",
    "peak_mb": "in a batch's report, by the codec",
    "horizontal_mm": "in a carrier table, by the codec",
    "vertical_mm": "in a carrier table, by the codec",
    "phase_pattern": "in a carrier table, by the codec",
    "frequency_scale": "in the laser bench's findings, by the codec",
    "turn_deg": "in the report of a map's refinement, by the codec",
    "periods_sigma": "in a light field's attributes, by the codec",
    "angular_frequency_per_mm": "in the file of a simulated frame's truth, field by field",
    "srcComponent": "pymavlink's",
    "red": "laspy's",
}

# What may make a thread besides `workers.Loop`, and why.
THREADS = {
    "clock.py": "starts those of `Loop`, which is all that calls it",
    "workers.py": "`share` joins its helpers without a limit of time",
    "daemon/console/__main__.py": "a timer ends the console's own process, whatever its other threads do",
    "daemon/console/app.py": "asyncio waits for the answers of two pools, in the console's own process",
    "daemon/console/offline.py": "asyncio waits for frames that one thread decodes, in the process of `dappled open`",
    "drivers/gphoto2/intake.py": "writes a file while it comes, in the camera's own process, where a disk may be stuck",
    "durable.py": "hashes one file beside its writing; the call waits for it",
    "mocks/scene/bench.py": "the views of one picture are rendered side by side; the call waits for them",
    "mocks/scene/flyover.py": "the views of one picture are rendered side by side; the call waits for them",
}

# What of a flight's rooms reads or waits for the machine's time past the clock that it was given, and why.
PAST_THE_CLOCK = {
    "daemon/console/feed.py": "the console's own process: asyncio waits there",
    "daemon/health/host_checks.py": "`doctor` looks at the machine's own camera, without a flight",
    "daemon/health/patience.py": "systemd's watchdog, whose time is the machine's",
    "daemon/pipeline/decode_process.py": "the turns of a process",
    "daemon/pipeline/decode_worker.py": "the decoder's own process: how long it computed",
    "daemon/replay/replay.py": "a replay's patience with processes that decode",
    "daemon/stream/publisher.py": "ZeroMQ",
    "daemon/stream/relay_process.py": "a process of its own, which waits for sockets",
    "daemon/stream/sockets.py": "ZeroMQ",
    "daemon/stream/subscriber.py": "ZeroMQ, in another process",
    "drivers/child_process.py": "processes",
    "drivers/gnss/port.py": "a serial device",
    "drivers/gphoto2/client.py": "the process of libgphoto2",
    "drivers/mavlink/channels.py": "sockets and serial devices",
    "drivers/raw/darkroom.py": "how long a frame took to compute, in the decoder's process",
    "drivers/reader_process.py": "processes",
}
CLOCKS = {"_clock", "clock", "_patience", "_transport"}

# Assignments of benchmarks that change data, and nothing that ships.
DATA = {"pose": ("setattr(message, ", "message.h_acc = ")}  # fields of MAVLink messages that it has just made


def name(path: Path) -> str:
    return str(path.relative_to(SOURCE))


@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_a_folder_can_be_overlooked(folder: Path) -> None:
    assert len(list(folder.glob("*.py"))) <= GROWTH * MODULES_A_FOLDER


def test_modules_are_of_a_size_to_be_read() -> None:
    lines = {name(module): len(module.read_text(encoding="utf-8").splitlines()) for module in MODULES}
    assert not {module: count for module, count in lines.items() if count > GROWTH * LINES_A_MODULE}


def test_a_class_or_type_name_means_one_thing() -> None:
    found = defaultdict(list)
    for module in MODULES:
        for node in parsed(module.read_text(encoding="utf-8")).body:
            for title in _types_made(node):
                found[title].append(name(module))
    assert not {title: places for title, places in found.items() if len(places) > 1}


def _types_made(node: ast.stmt) -> list[str]:
    """The public class or type alias that a statement makes: `class A`, `A = NDArray[…]`, `A = int | str`."""
    made = ""
    if isinstance(node, ast.ClassDef):
        made = node.name
    elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        title = node.targets[0].id
        alias = isinstance(node.value, ast.Name | ast.Attribute | ast.Subscript | ast.BinOp)
        made = title if alias and title[0].isupper() and not title.isupper() else ""
    return [made] if made and not made.startswith("_") else []


@pytest.mark.parametrize("line", ["class One: ...", "One = NDArray[np.float32]", "One = int | None", "One = Any"])
def test_a_type_is_seen(line: str) -> None:
    assert _types_made(parsed(line).body[0]) == ["One"]


def test_other_rooms_import_a_face_where_there_is_one() -> None:
    """What a room's `__init__` hands out is imported from there; and no private name or module leaves its room."""
    past, private = [], []
    for module in MODULES:
        own = module.relative_to(SOURCE).parent.parts
        for imported, title in _imports(module):
            place = f"{name(module)}: {'.'.join(imported)}.{title}"
            room = _room(imported)
            inside = own[: len(room)] == room or _room(own) == room[: len(own)]
            if not inside and (title.startswith("_") or any(part.startswith("_") for part in imported)):
                private.append(place)
            if not inside and imported != room and title in FACES.get(room, ()):
                past.append(place)
    assert past == []
    assert private == []


@pytest.fixture(scope="module")
def unused_in_src() -> dict[str, set[str]]:
    """The names that nothing in `src` uses, by kind."""
    finder = vulture.Vulture()
    finder.noqa_lines = defaultdict(set)  # its own marks, of which there are none here
    for module in MODULES:
        if SOURCE / "testing" not in module.parents:
            finder.filename = module
            finder.visit(parsed(module.read_text(encoding="utf-8")))
            finder.reachability.reset()
    finder.scavenge([])  # what it knows of the libraries that were imported
    found = defaultdict(set)
    for item in finder.get_unused_code():
        found[item.typ].add(item.name)
    return found


def test_nothing_is_there_for_tests_only(unused_in_src: dict[str, set[str]]) -> None:
    unused = set[str]().union(*(unused_in_src[kind] for kind in ("function", "class", "method", "property")))
    verbs = {where.partition(":")[2] for where, _ in VERBS.values()}  # the command line loads them by name
    assert unused - set(UNUSED) - verbs == set()
    assert set(UNUSED) - unused == set(), "these are used by now: strike them from the list"


def test_no_field_is_there_for_tests_only(unused_in_src: dict[str, set[str]]) -> None:
    """What nothing in `src` reads by name, and a test does."""
    unread = unused_in_src["attribute"] | unused_in_src["variable"]
    mentioned = re.compile(rf"\.({'|'.join(unread)})\b")
    texts = [text for path in (ROOT / "tests").rglob("*.py") if mentioned.search(text := path.read_text("utf-8"))]
    tested = {
        node.attr
        for text in texts
        for node in ast.walk(parsed(text))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    assert (unread & tested) - set(UNREAD) == set()
    assert set(UNREAD) - unread == set(), "these are read by now: strike them from the list"


def test_threads_are_loops() -> None:
    """So that each has a name, an end, and a place in `dead_threads`."""
    makers = {"Thread(", "Timer(", "ThreadPoolExecutor(", "ThreadPool(", "start_new_thread(", "to_thread("}
    made = {name(module) for module in MODULES if makers & _calls(module)}
    assert made - set(THREADS) == set()
    assert set(THREADS) - made == set(), "these make none by now: strike them from the list"


def test_waits_of_a_flight_go_through_its_clock() -> None:
    """So that a whole flight can run in virtual time, and nothing in it waits unseen."""
    rooms = [SOURCE / room for room in ("daemon", "drivers", "flight")]
    found = {name(module) for module in MODULES if set(rooms) & set(module.parents) and _past_the_clock(module)}
    assert found - set(PAST_THE_CLOCK) == set()
    assert set(PAST_THE_CLOCK) - found == set(), "these ask the clock by now: strike them from the list"


def _past_the_clock(module: Path) -> list[str]:
    """Calls that read the machine's time, or wait for something with its time."""
    tree, found = parsed(module.read_text(encoding="utf-8")), list[str]()
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    for node in (one for one in ast.walk(tree) if isinstance(one, ast.Call)):
        *of, called = ast.unparse(node.func).split(".")
        bounded = any(word.arg in {"timeout", "timeout_s"} for word in node.keywords)
        reads = of in (["time"], ["select"], ["selectors"]) and of[0] in imported
        waits = called in {"wait", "wait_for", "poll"} or (called in {"acquire", "get", "run"} and bounded)
        if reads or (waits and of and of[-1] not in CLOCKS):
            found.append(ast.unparse(node))
    return found


def _calls(module: Path) -> set[str]:
    """The last words of what a module calls: {"Thread(", "start(", …}."""
    called = [node.func for node in ast.walk(parsed(module.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    return {f"{ast.unparse(each).rpartition('.')[2]}(" for each in called}


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda path: path.stem)
def test_a_benchmark_calls_what_ships(benchmark: Path) -> None:
    """No benchmark assigns to an attribute of anything but its own `self`, nor patches by another way."""
    found = _patches(benchmark.read_text(encoding="utf-8"))
    assert [text for text in found if not text.startswith(DATA.get(benchmark.stem, ()))] == []


@pytest.mark.parametrize(
    "line",
    [
        "Publisher.publish = lambda: None",
        "one = Publisher(); one.publish = lambda: None",
        "setattr(one, 'publish', None)",
        "mock.patch('dappled.clock.SystemClock')",
        "mock.patch.object(dappled, 'open')",
        "monkeypatch.setattr(dappled, 'open', None)",
        "Publisher.__dict__['publish'] = None",
        "vars(Publisher)['publish'] = None",
    ],
)
def test_a_patch_is_seen(line: str) -> None:
    assert _patches(line)


def _imports(module: Path) -> list[tuple[tuple[str, ...], str]]:
    """(module below dappled as a tuple, name) of each `from dappled… import name`."""
    return [
        (tuple(node.module.split(".")[1:]), alias.name)
        for node in ast.walk(parsed(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "dappled"
        for alias in node.names
    ]


def _room(parts: tuple[str, ...]) -> tuple[str, ...]:
    """The innermost folder in which a module of this name lies."""
    return parts if SOURCE.joinpath(*parts).is_dir() else parts[:-1]


def _face(folder: Path) -> tuple[str, ...]:
    for node in parsed((folder / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return tuple(ast.literal_eval(node.value))
    return ()


# The face of `drivers` is for third parties; the project itself imports the contract, `drivers.camera`.
FACES = {
    folder.relative_to(SOURCE).parts: _face(folder) for folder in FOLDERS if folder not in (SOURCE, SOURCE / "drivers")
}


def _patches(source: str) -> list[str]:
    """What in a program may change the product: its assignments to attributes, and its calls of setattr and patch."""
    return [ast.unparse(node) for node in ast.walk(parsed(source)) if _is_patch(node)]


def _is_patch(node: ast.AST) -> bool:
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return any(
            (isinstance(target, ast.Attribute) and _root(target) != "self")
            or (isinstance(target, ast.Subscript) and _is_namespace(target.value))
            for target in targets
        )
    called = ast.unparse(node.func).split(".") if isinstance(node, ast.Call) else []
    return "setattr" in called or "patch" in called


def _is_namespace(node: ast.expr) -> bool:
    if isinstance(node, ast.Attribute):
        return node.attr == "__dict__"
    return isinstance(node, ast.Call) and ast.unparse(node.func) == "vars"


def _root(node: ast.expr) -> str:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""
