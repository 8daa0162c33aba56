"""Disks that are full, turn read-only, lose power or rot: real file systems where this user may make them."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dappled import durable
from dappled.clock import RecordedClock
from dappled.findings import told
from dappled.flight import FlightError, Frame, Recording, layout, recording
from dappled.flight.checks.flight_check import check
from tests.flight.conftest import START_UTC_NS
from tests.flight.ext4 import MB, Image, an_image, mount, run, unmount
from tests.flight.makers import deliver, deliver_straight, flip, request, shot, tag

LATER_UTC_NS = START_UTC_NS + 10**9


def whole(flights: Path, safe: dict[int, str]) -> None:
    """The next flight begins, every acknowledged frame is there byte for byte, and all flights are in order."""
    after = recording.begin(flights, RecordedClock(LATER_UTC_NS))
    try:
        for index, sha256 in safe.items():
            entry = after.index.lookup(index)
            assert entry is not None
            assert entry.frame is not None
            assert durable.hash_file(flights / entry.flight / entry.frame) == sha256
    finally:
        after.close()
    for flight in layout.flights(flights):
        assert check(flight.path).problems == ()


# --- in a user namespace: a tmpfs of any size, without being root

IN_NAMESPACE = """
import json, os, subprocess, sys
from pathlib import Path
from dappled.clock import RecordedClock
from dappled.findings import text
from dappled.flight import recording
from dappled.flight.checks.flight_check import check
from dappled.flight.errors import FlightError
from tests.flight.ext4 import MB, Image, an_image, mount, run, unmount
from tests.flight.makers import deliver, deliver_straight, request
mount = lambda *words: subprocess.run(["mount", *words], check=True)
disk = Path(sys.argv[1])
mount("-t", "tmpfs", "-o", "size=8m", "dappled", str(disk))
flight = recording.begin(disk / "flights", RecordedClock(1795256103000000000))
told, safe = [], []
def shoot(index, size=2_500_000):
    request(flight, index)
    try:
        safe.append({way}(flight, index, os.urandom(size)).index)
    except FlightError as error:
        told.append(str(error))
{fault}
frames = sorted(os.listdir(flight.folder.frames))
rows = {{row.shot.index: [row.state, row.reason and str(text(row.reason))] for row in flight.ledger.shots()}}
flight.close()
print(json.dumps({{"told": told, "safe": safe, "frames": frames, "rows": rows,
                  "problems": [str(one) for one in check(flight.folder.path).problems]}}))
"""
WAYS = ["deliver", "deliver_straight"]
FULL = """
(disk / "ballast").write_bytes(bytes(2_000_000))
for index in range(3):
    shoot(index)
(disk / "ballast").unlink()
shoot(3)
"""
READ_ONLY = """
frames = str(flight.folder.frames)
shoot(0)
mount("--bind", frames, frames)
mount("-o", "remount,bind,ro", frames)
shoot(1)
mount("-o", "remount,bind,rw", frames)
shoot(2)
"""


def in_namespace(fault: str, disk: Path, way: str) -> dict[str, Any]:
    """Record four shots on a disk of 8 MB that only the recorder sees."""
    unshare = ["unshare", "--user", "--map-root-user", "--mount"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode
    ):
        pytest.skip("this user may not make a user namespace: no small disk can be mounted")
    disk.mkdir()
    done = subprocess.run(
        [*unshare, sys.executable, "-c", IN_NAMESPACE.format(fault=fault, way=way), str(disk)],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said: dict[str, Any] = json.loads(done.stdout)
    return said


@pytest.mark.parametrize("way", WAYS)
def test_a_disk_that_is_full_in_the_middle_of_a_frame(tmp_path: Path, way: str) -> None:
    said = in_namespace(FULL, tmp_path / "disk", way)
    assert said["safe"] == [0, 1, 3]
    assert said["frames"] == ["000000.cr2", "000001.cr2", "000003.cr2"]
    (told,) = said["told"]
    assert "000002.cr2: the disk is full; free some space" in told
    assert said["rows"]["2"] == ["failed", told]
    assert said["problems"] == []


@pytest.mark.parametrize("way", WAYS)
def test_a_folder_that_turns_read_only(tmp_path: Path, way: str) -> None:
    said = in_namespace(READ_ONLY, tmp_path / "disk", way)
    assert said["safe"] == [0, 2]
    (told,) = said["told"]
    assert "the disk is mounted read-only; remount it" in told
    assert said["rows"]["1"] == ["failed", told]
    assert said["problems"] == []


# --- as root: a real ext4 in an image


@pytest.fixture
def ext4(tmp_path: Path) -> Iterator[Image]:
    with an_image(tmp_path) as made:
        yield made


def test_a_disk_that_the_kernel_makes_read_only(ext4: Image) -> None:
    """The journal, the ledger and the frames are refused, each in a sentence; what was safe is there after a repair."""
    flights = ext4.mounted / "flights"
    flight = recording.begin(flights, RecordedClock(START_UTC_NS))
    request(flight, 0)
    safe = {0: deliver(flight, 0, os.urandom(MB)).sha256}
    request(flight, 1)
    ext4.break_down()
    with pytest.raises(FlightError, match=r"cannot record IMG_0001.CR2 .* read-only"):
        deliver(flight, 1, os.urandom(MB))
    with pytest.raises(FlightError, match=r"cannot note shot 2 .* read-only"):
        flight.journal.note(shot(2))
    with pytest.raises(FlightError, match="cannot log telemetry"):
        flight.telemetry.append(1, bytes.fromhex("fe000001011e0000"))
    with pytest.raises(FlightError, match=r"read-only|input/output"):
        flight.close()
    unmount(ext4.mounted)
    run("e2fsck", "-fy", str(ext4.file), good=(0, 1))
    mount(ext4.file, ext4.mounted)
    whole(flights, safe)


@pytest.mark.slow
def test_a_power_cut_on_a_real_file_system(ext4: Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The block device is copied before and after each step of the write order; each copy is mounted as after a cut."""
    cuts: list[tuple[Path, dict[int, str]]] = []
    safe: dict[int, str] = {}

    def cut() -> None:
        cuts.append((ext4.cut(f"cut-{len(cuts)}"), dict(safe)))

    def watched(call: Callable[..., object], *words: object, **named: object) -> object:
        cut()
        done = call(*words, **named)
        cut()
        return done

    for name in ("fsync", "replace", "sendfile", "link", "posix_fallocate"):
        monkeypatch.setattr(os, name, partial(watched, getattr(os, name)))
    flight = recording.begin(ext4.mounted / "flights", RecordedClock(START_UTC_NS))
    for index in range(2):
        request(flight, index)
        cut()
        safe[index] = (deliver_straight if index else deliver)(flight, index, os.urandom(300_000)).sha256
        cut()
    monkeypatch.undo()
    flight.close()
    for image, promised in cuts:
        place = tmp_path / "after"
        mount(image, place)
        try:
            whole(place / "flights", promised)
        finally:
            unmount(place)
            image.unlink()
    assert len(cuts) > 25


# --- a ledger that rots


@pytest.fixture
def flown(flights: Path) -> Recording:
    """A closed flight of six frames."""
    flight = recording.begin(flights, RecordedClock(START_UTC_NS))
    for index in range(6):
        request(flight, index)
        flight.ledger.add_tag(tag(deliver(flight, index, b"raw %d" % index)))
    flight.close()
    return flight


PAGE = 4096


def pages(ledger: Path) -> int:
    return ledger.stat().st_size // PAGE


def spoil(ledger: Path, page: int) -> None:
    with ledger.open("r+b") as file:
        file.seek(page * PAGE)
        file.write(b"\xa5" * PAGE)


def test_a_corrupted_page_of_a_closed_ledger_is_found_and_harms_no_frame(flights: Path, flown: Recording) -> None:
    whole_ledger = flown.folder.ledger.read_bytes()
    for page in range(pages(flown.folder.ledger)):
        flown.folder.ledger.write_bytes(whole_ledger)
        spoil(flown.folder.ledger, page)
        report = check(flown.folder.path)
        assert not report.intact, f"page {page}"
        after = recording.begin(flights, RecordedClock(LATER_UTC_NS))
        assert after.next_index == 6
        entry = after.index.lookup(3)
        assert entry is not None
        assert entry.frame == "frames/000003.cr2"
        assert (flown.folder.path / entry.frame).read_bytes() == b"raw 3"
        after.close()


def test_a_corrupted_ledger_of_a_crashed_flight_is_made_anew(flights: Path) -> None:
    """Frames and journal say what the ledger can't any more; the damaged file stays beside them."""
    flight = recording.begin(flights, RecordedClock(START_UTC_NS))
    frames: list[Frame] = []
    for index in range(6):
        request(flight, index)
        if index != 4:
            frames.append(deliver(flight, index, b"raw %d" % index))
    flight.close()
    name = flight.folder.name
    with closing(sqlite3.connect(flights / "index.sqlite")) as index_file, index_file:
        index_file.execute("UPDATE flights SET sealed = 0")  # as if it had crashed before that
    index_file.close()
    for page in range(pages(flight.folder.ledger)):
        spoil(flight.folder.ledger, page)
    after = recording.begin(flights, RecordedClock(LATER_UTC_NS))
    said = "\n".join(str(told(one)) for one in after.recovered)
    assert f"flight {name}: the ledger was damaged" in said
    assert "flight.sqlite.damaged" in said
    assert after.next_index == 6
    after.close()
    assert check(flight.folder.path).problems == ()
    assert {path.name for path in flight.folder.path.glob("flight.sqlite*")} == {
        "flight.sqlite",
        "flight.sqlite.damaged",
    }
    whole(flights, {frame.index: frame.sha256 for frame in frames})


def test_a_flipped_bit_in_the_journal_of_a_crashed_flight(flights: Path, flight: Recording) -> None:
    for index in range(3):
        request(flight, index)
    sha256 = deliver(flight, 0, b"raw").sha256
    flight.close()
    flip(flight.folder.journal, 40)
    assert not check(flight.folder.path).intact
    with pytest.raises(AssertionError):
        whole(flights, {0: sha256})  # a sealed flight is not mended in silence
