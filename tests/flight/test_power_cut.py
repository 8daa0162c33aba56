"""The power goes at every step of the write order: what was acknowledged is there, and the rest is accounted for.

A small flight is recorded under strace. After each system call that changed the disk the power is cut, in several ways:
of all that no fsync had made sure, everything is left, or nothing, or data without names, or names without data, or
some. The next flight then begins on what is left, as after any crash.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from dappled import durable
from dappled.clock import RecordedClock
from dappled.flight import layout, recording
from dappled.flight.checks.flight_check import check
from tests.flight.lossy_disk import Call, Left, LossyDisk, listing, record

FRAME_BYTES = 20_000
FLIGHT = """
import os, sys, time
from pathlib import Path
from dappled.clock import RecordedClock
from dappled.flight import recording
from tests.flight.makers import deliver, deliver_straight, mavlink_2, shot, tag
flight = recording.begin(Path(sys.argv[1]), RecordedClock(1795256103000000000))
for index in range(flight.next_index, flight.next_index + 3):
    flight.journal.note(shot(index))
    os.write(1, b"noted %d" % index)
    flight.telemetry.append(index, mavlink_2(b"x"))
    flight.ledger.add_shot(shot(index))
    flight.ledger.fired(index, 1, 2)
    frame = (deliver_straight if index % 2 else deliver)(flight, index, bytes([index + 1]) * 20_000)
    flight.note_image(index)
    os.write(1, b"safe %d %s" % (index, frame.sha256.encode()))
    flight.ledger.add_tag(tag(frame))
    time.sleep(0.3)  # the journal's flusher has its turn in some of the gaps
flight.close()
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """In memory where there is such a place: thousands of files are written."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="dappled-cut-", dir=memory if memory.is_dir() else None) as name:
        yield Path(name)


@pytest.fixture(scope="module")
def calls(folder: Path) -> list[Call]:
    """What two flights, one after the other, did to the disk."""
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed: no system call can be recorded")
    flights = folder / "flights"
    first = record(FLIGHT, str(flights), log=folder / "trace-0")
    second = record(FLIGHT, str(flights), log=folder / "trace-1")
    return [*first, *(replace(call, began=call.began + len(first)) for call in second)]


@dataclass(slots=True)
class Told:
    """What the recorder had said of itself by some call."""

    noted: dict[int, int]
    safe: dict[int, str]

    def hear(self, number: int, call: Call) -> None:
        if call.name == "write" and call.arguments[0].startswith("1<"):
            word, index, *rest = call.data(1).decode().split()
            if word == "noted":
                self.noted[int(index)] = number
            else:
                self.safe[int(index)] = rest[0]


def source(path: str) -> bytes:
    index = layout.index_of(Path(path).name.removeprefix(".").removesuffix(".part"))
    assert index is not None
    return bytes([index + 1]) * FRAME_BYTES


def states(
    calls: list[Call], flights: Path, target: Path, ways: list[tuple[Left, int]], each: int
) -> Iterator[tuple[str, Told]]:
    """Each different state that a power cut may leave, laid out in `target`, with what had been said by then; `each`
    above 1 looks at one step of so many."""
    disk, told = LossyDisk(flights, source), Told({}, {})
    seen: dict[object, object] = {}
    steps = 0
    for number, call in enumerate(calls, 1):
        touched = disk.apply(call)
        told.hear(number, call)
        steps += touched
        if not touched or steps % each:
            continue
        sure = disk.sure_until("shots.jsonl")
        promised = Told({i: at for i, at in told.noted.items() if at <= sure}, dict(told.safe))
        for left, seed in ways:
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir()
            disk.cut(target, left, seed + number)
            state = (listing(target), tuple(promised.noted), tuple(promised.safe))
            if state not in seen:
                seen[state] = True
                yield f"after call {number} ({call.name}), {left} left, seed {seed}", promised


def put_in_order(flights: Path, told: Told) -> None:
    """The next flight begins on what is left; nothing acknowledged is lost, and every flight is whole."""
    after = recording.begin(flights, RecordedClock(1_795_256_104_000_000_000))
    try:
        assert after.next_index > max(told.noted, default=-1), "an accepted shot is lost"
        for index in told.noted:
            assert after.index.lookup(index) is not None, f"shot {index} is lost"
        for index, sha256 in told.safe.items():
            entry = after.index.lookup(index)
            assert entry is not None, f"frame {index} is lost"
            assert entry.frame is not None, f"frame {index} is lost"
            assert entry.state == "safe"
            assert durable.hash_file(flights / entry.flight / entry.frame) == sha256
    finally:
        after.close()
    for flight in layout.flights(flights):
        assert check(flight.path).problems == ()
    assert not list(flights.rglob("*.part"))


SHORT: list[tuple[Left, int]] = [("none", 0), ("some", 0)]
LONG: list[tuple[Left, int]] = [
    *SHORT,
    ("all", 0),
    ("data", 0),
    ("names", 0),
    *(("some", seed * 100_000) for seed in (1, 2)),
]


@pytest.mark.parametrize(("each", "least"), [(79, 7), pytest.param(29, 20, marks=pytest.mark.slow)])
def test_a_power_cut_at_some_steps_loses_nothing_acknowledged(
    calls: list[Call], folder: Path, each: int, least: int
) -> None:
    assert cut_everywhere(calls, folder / "flights", folder / "left", SHORT, each=each) > least


@pytest.mark.long
def test_a_power_cut_at_any_step_loses_nothing_acknowledged(calls: list[Call], folder: Path) -> None:
    assert cut_everywhere(calls, folder / "flights", folder / "left", LONG) > 300


def cut_everywhere(
    calls: list[Call], flights: Path, target: Path, ways: list[tuple[Left, int]], *, each: int = 1
) -> int:
    """Try every state, or one of so many; says how many were tried."""
    count = 0
    for where, told in states(calls, flights, target, ways, each):
        try:
            put_in_order(target, told)
        except Exception as error:
            raise AssertionError(f"{where}: {error}") from error
        count += 1
    return count


@pytest.mark.parametrize("forgotten", ["durable.sync_folder = lambda path: None", "os.fsync = lambda fd: None"])
def test_a_recorder_that_forgets_to_make_sure_is_found_out(folder: Path, forgotten: str) -> None:
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed: no system call can be recorded")
    flights = folder / f"forgetful-{len(forgotten)}"
    code = f"import os\nfrom dappled import durable\n{forgotten}\n{FLIGHT}"
    calls = record(code, str(flights), log=folder / "trace-forgetful")
    with pytest.raises(AssertionError, match="is lost"):
        cut_everywhere(calls, flights, folder / "left", [("none", 0)])


def test_the_recorded_calls_make_the_folder_that_was_made(calls: list[Call], folder: Path) -> None:
    """The model of the disk itself: with nothing lost it holds the very files. Both ways of recording are in it."""
    assert {"linkat", "sendfile", "rename"} <= {call.name for call in calls}
    disk = LossyDisk(folder / "flights", source)
    for call in calls:
        disk.apply(call)
    whole = folder / "whole"
    disk.cut(whole, "all")
    assert listing(whole) == listing(folder / "flights")


def test_the_disk_does_lose_what_is_not_made_sure(folder: Path) -> None:
    """A write without fsync, a rename without fsync of the folder: either is gone."""
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed: no system call can be recorded")
    code = """
import os, sys
os.mkdir(sys.argv[1])
for name, sync in ("a", False), ("b", True):
    fd = os.open(f"{sys.argv[1]}/{name}.part", os.O_WRONLY | os.O_CREAT)
    os.write(fd, b"x" * 1000)
    if sync:
        os.fsync(fd)
    os.close(fd)
    os.rename(f"{sys.argv[1]}/{name}.part", f"{sys.argv[1]}/{name}")
"""
    root = folder / "careless"
    disk = LossyDisk(root, source)
    for call in record(code, str(root), log=folder / "trace-careless"):
        disk.apply(call)
    disk.cut(folder / "names", "names")
    assert listing(folder / "names") == {("a", b""), ("b", b"x" * 1000)}
    disk.cut(folder / "none", "none")
    assert listing(folder / "none") == frozenset()
