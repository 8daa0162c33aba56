from __future__ import annotations

import errno
import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dappled import durable
from dappled.clock import RecordedClock
from dappled.flight import FlightError, Frame, Ledger, LedgerReader, Recording, Stray
from dappled.flight.checks.flight_check import check
from tests.flight.makers import deliver, deliver_straight, held, request
from tests.standing import words

DATA = b"raw bytes" * 1000


def files(flight: Recording) -> list[str]:
    return sorted(os.listdir(flight.folder.frames))


def test_a_frame_is_safe_when_record_returns(flight: Recording) -> None:
    request(flight, 0)
    frame = deliver(flight, 0, DATA)
    assert frame.name == "frames/000000.cr2"
    assert (frame.camera_name, frame.size, frame.arrived_utc_ns) == ("IMG_0001.CR2", len(DATA), 5)
    assert frame.sha256 == hashlib.sha256(DATA).hexdigest()
    assert (flight.folder.path / frame.name).read_bytes() == DATA
    with LedgerReader.open(flight.ledger.path) as reader:
        assert reader.frames() == [frame]


def test_a_file_that_was_written_while_it_came_is_the_frame(flight: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    request(flight, 0)

    def copied(*_: object) -> None:
        raise AssertionError("it was copied")

    monkeypatch.setattr(durable, "copy", copied)
    frame = deliver_straight(flight, 0, DATA)
    assert frame.sha256 == hashlib.sha256(DATA).hexdigest()
    assert (flight.folder.path / frame.name).read_bytes() == DATA
    assert flight.ledger.frame(0) == frame
    assert deliver_straight(flight, 0, DATA) == frame  # the same file again


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_to_make_it_sure_fails_the_shot_and_leaves_no_file(
    flight: Recording, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(fd: int) -> None:
        raise OSError(number, os.strerror(number))

    request(flight, 0)
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(FlightError, match=r"cannot record IMG_0001.CR2 as .*000000\.cr2: the disk"):
        deliver_straight(flight, 0, DATA)
    monkeypatch.undo()
    assert files(flight) == []
    row = flight.ledger.shot(0)
    assert row is not None
    assert row.state == "failed"


def test_the_row_comes_after_the_file(flight: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    sync, safe = durable.sync_folder, flight.ledger.safe

    def watched_sync(path: Path) -> None:
        sync(path)
        order.append(f"sync {path.name}")

    def watched_safe(_: Ledger, frame: Frame) -> None:
        order.append("row")
        safe(frame)

    monkeypatch.setattr(durable, "sync_folder", watched_sync)
    monkeypatch.setattr(Ledger, "safe", watched_safe)
    request(flight, 0)
    deliver(flight, 0, DATA)
    assert order == ["sync frames", "row"]


def test_the_same_file_twice_is_one_frame(flight: Recording) -> None:
    request(flight, 0)
    first = deliver(flight, 0, DATA)
    assert deliver(flight, 0, DATA) == first
    assert files(flight) == ["000000.cr2"]
    assert [event.kind for event in flight.ledger.events()] == ["double"]


def test_a_second_file_for_a_shot_is_kept_as_a_stray(flight: Recording) -> None:
    request(flight, 0)
    first = deliver(flight, 0, DATA)
    with pytest.raises(FlightError, match=r"IMG_0001.JPG: it is a second file for shot 0") as told:
        deliver(flight, 0, b"jpeg", "IMG_0001.JPG")
    assert told.value.finding == next(iter(flight.ledger.strays())).reason
    with pytest.raises(FlightError, match="kept as a stray"):
        deliver(flight, 0, b"other", "IMG_0001.JPG")
    assert files(flight) == ["000000.cr2", "stray-000000.jpg", "stray-000001.jpg"]
    assert flight.ledger.frame(0) == first


def test_a_stray_that_lost_its_row_does_not_keep_the_next_one_out(
    flight: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Ledger, stray: Stray) -> None:
        raise FlightError(f"no room for {stray.name}")

    with monkeypatch.context() as patched:
        patched.setattr(Ledger, "add_stray", full)
        with pytest.raises(FlightError, match="no room"):
            deliver(flight, 7, DATA)
    with pytest.raises(FlightError, match="kept as a stray"):
        deliver(flight, 7, DATA)
    assert files(flight) == ["stray-000000.cr2", "stray-000001.cr2"]


def test_a_file_for_an_unknown_shot_is_kept_as_a_stray(flight: Recording) -> None:
    with pytest.raises(FlightError, match="never requested"):
        deliver(flight, 9, DATA, "../../IMG.CR2")
    assert files(flight) == ["stray-000000.cr2"]
    assert flight.ledger.shot(9) is None


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
@pytest.mark.parametrize("call", ["open", "sendfile", "fsync", "replace"])
def test_a_disk_fault_fails_the_shot_and_leaves_no_file(
    flight: Recording, monkeypatch: pytest.MonkeyPatch, call: str, number: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    request(flight, 0)
    with held(DATA) as blob:
        monkeypatch.setattr(os, call, refuse)
        with pytest.raises(FlightError, match=r"cannot record A.CR2 as .*000000\.cr2: the disk") as told:
            flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)
        monkeypatch.undo()
    assert files(flight) == []
    row = flight.ledger.shot(0)
    assert row is not None
    assert (row.state, words(row.reason)) == ("failed", str(told.value))
    assert deliver(flight, 0, DATA).name == "frames/000000.cr2"  # the disk is well again and the file comes once more


def test_a_file_that_came_is_recorded_where_no_descriptor_is_left(flight: Recording) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    request(flight, 0)
    request(flight, 1)
    taken: list[int] = []
    with held(DATA) as blob:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, 400), hard))
            with pytest.raises(OSError, match="Too many open files"):  # noqa: PT012  all that are left
                while True:
                    taken.append(os.open(os.devnull, os.O_RDONLY))
            for index in (0, 1):
                frame = flight.recorder.record(index, "IMG_0001.CR2", blob, arrived_utc_ns=5)
                assert frame.sha256 == hashlib.sha256(DATA).hexdigest()
            with pytest.raises(FlightError, match="was never requested: kept as a stray"):
                flight.recorder.record(7, "IMG_0002.CR2", blob, arrived_utc_ns=6)
        finally:
            for fd in taken:
                os.close(fd)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    flight.close()
    assert check(flight.folder.path).problems == ()


def test_a_full_disk_in_the_middle_of_a_frame(flight: Recording) -> None:
    """The kernel itself refuses, after some bytes: a file size limit stands for the full disk."""
    request(flight, 0)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with held(b"x" * 3_000_000) as blob:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
            with pytest.raises(FlightError, match="cannot record"):
                flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert files(flight) == []
    row = flight.ledger.shot(0)
    assert row is not None
    assert row.state == "failed"


def test_a_disk_that_takes_no_note_either_is_told(flight: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise FlightError("cannot use the ledger")

    request(flight, 0)
    monkeypatch.setattr(type(flight.ledger), "failed", refuse)
    with (
        held(b"abc", size=5) as blob,
        pytest.raises(FlightError, match=r"ended early .* and this could not be noted either"),
    ):
        flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)


@pytest.mark.parametrize(("data", "size", "words"), [(b"", 0, "is empty"), (b"abc", 5, "only 3 of 5 bytes")])
def test_a_file_without_its_bytes_fails_the_shot(flight: Recording, data: bytes, size: int, words: str) -> None:
    request(flight, 0)
    with held(data, size) as blob, pytest.raises(FlightError, match=words):
        flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)
    assert files(flight) == []
    row = flight.ledger.shot(0)
    assert row is not None
    assert row.state == "failed"


def test_a_file_that_lost_its_row_is_the_frame_when_it_comes_again(flight: Recording) -> None:
    """A power cut between the rename and the row; the camera still has the file."""
    request(flight, 0)
    (flight.folder.frames / "000000.cr2").write_bytes(b"raw")
    with held(b"raw") as blob:
        frame = flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)
    assert (frame.name, frame.camera_name) == ("frames/000000.cr2", "A.CR2")
    assert flight.ledger.frame(0) == frame


def test_nothing_is_written_over(flight: Recording) -> None:
    request(flight, 0)
    (flight.folder.frames / "000000.cr2").write_bytes(b"older")
    with pytest.raises(FlightError, match="already exists without"):
        deliver(flight, 0, DATA)
    assert (flight.folder.frames / "000000.cr2").read_bytes() == b"older"


def test_the_blob_stays_open_and_its_offset_stays(flight: Recording) -> None:
    request(flight, 0)
    with held(DATA) as blob:
        place = os.lseek(blob.fd, 7, os.SEEK_SET)
        flight.recorder.record(0, "A.CR2", blob, arrived_utc_ns=5)
        assert os.lseek(blob.fd, 0, os.SEEK_CUR) == place


WRITER = """
import sys, itertools
from pathlib import Path
from dappled.clock import RecordedClock
from dappled.flight import recording
from tests.flight.makers import deliver, deliver_straight, mavlink_2, shot
flight = recording.begin(Path(sys.argv[1]), RecordedClock(1795256103000000000))
for index in itertools.count(flight.next_index):
    flight.journal.note(shot(index))
    print("noted", index, flush=True)
    flight.telemetry.append(index, mavlink_2(b"x"))
    flight.ledger.add_shot(shot(index))
    flight.ledger.fired(index, 1, 2)
    frame = (deliver_straight if index % 2 else deliver)(flight, index, bytes([index % 251]) * 300_000)
    flight.note_image(index)
    print("safe", index, frame.sha256, flush=True)
"""


def killed_after(flights: Path, lines: int, later_s: float = 0.0) -> list[list[str]]:
    """Run the writer, kill it -9 so long after so many lines; return all whole lines that it said."""
    command = [sys.executable, "-c", WRITER, str(flights)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]) as writer:
        assert writer.stdout is not None
        said = [writer.stdout.readline() for _ in range(lines)]
        time.sleep(later_s)  # a moment that is nobody's, not a wait for something
        writer.kill()
        said += writer.stdout.readlines()
    return [line.decode().split() for line in said if line.endswith(b"\n")]


def some_moments(seed: int, count: int) -> list[tuple[int, float]]:
    """Moments spread over the first dozen frames: after how many lines, and how much later."""
    chosen = random.Random(seed)  # noqa: S311  moments, not secrets
    return [(chosen.randint(1, 24), chosen.uniform(0, 0.012)) for _ in range(count)]


@pytest.mark.parametrize(
    ("seed", "count"),
    [
        (0, 3),
        pytest.param(1, 20, marks=pytest.mark.slow),
        *(pytest.param(seed, 40, marks=pytest.mark.long) for seed in range(2, 6)),
    ],
)
def test_kill_9_loses_nothing_that_was_acknowledged(flights: Path, seed: int, count: int) -> None:
    from dappled.flight import layout, recording  # noqa: PLC0415  only what the check afterwards needs

    said = [line for moment in some_moments(seed, count) for line in killed_after(flights, *moment)]
    ended = recording.begin(flights, RecordedClock(1_795_256_104_000_000_000))
    indices = [int(line[1]) for line in said if line[0] == "noted"]
    assert indices == sorted(set(indices))
    assert ended.next_index > max(indices)
    for index in indices:
        assert ended.index.lookup(index) is not None
    for _, number, sha256 in (line for line in said if line[0] == "safe"):
        entry = ended.index.lookup(int(number))
        assert entry is not None
        assert entry.frame is not None
        assert durable.hash_file(flights / entry.flight / entry.frame) == sha256
    ended.close()
    for folder in layout.flights(flights):
        assert check(folder.path).problems == ()
