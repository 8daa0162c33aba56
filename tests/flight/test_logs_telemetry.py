from __future__ import annotations

import errno
import hashlib
import os
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.findings import Code, Finding
from dappled.flight import FlightError, log_reading
from dappled.flight.log_reading import split
from dappled.flight.logs import BLOCK_BYTES, TelemetryLog, packet_length
from tests.flight.makers import logged, mavlink_1, mavlink_2

PACKETS = st.builds(mavlink_1, st.binary(max_size=255), st.integers(0, 255)) | st.builds(
    mavlink_2, st.binary(max_size=255), st.integers(0, 255), signed=st.booleans()
)
RECORDS = st.lists(st.tuples(st.integers(0, 2**53 - 1), PACKETS), max_size=8)


@given(RECORDS)
def test_what_is_logged_is_read(tmp_path_factory: pytest.TempPathFactory, records: list[tuple[int, bytes]]) -> None:
    path = tmp_path_factory.mktemp("log") / "telemetry.tlog"
    log = TelemetryLog(path)
    assert [log.append(*record) for record in records] == list(range(len(records)))
    summary = log.close()
    problems: list[Finding] = []
    assert list(log_reading.read_telemetry(path, problems.append)) == [(n, *record) for n, record in enumerate(records)]
    assert problems == []
    assert summary == log_reading.summarise(path)
    assert summary.sha256 == hashlib.sha256(b"".join(logged(*record) for record in records)).hexdigest()


@given(RECORDS, st.tuples(st.integers(0, 2**53 - 1), PACKETS), st.data())
def test_a_torn_end_costs_the_last_record_only(
    records: list[tuple[int, bytes]], last: tuple[int, bytes], data: st.DataObject
) -> None:
    torn = logged(*last)[: data.draw(st.integers(1, len(logged(*last)) - 1))]
    problems: list[Finding] = []
    found = list(split(b"".join(logged(*record) for record in records) + torn, problems.append))
    assert found[: len(records)] == records
    assert len(problems) == 1


@given(RECORDS, st.binary(max_size=60), RECORDS)
def test_reading_goes_on_behind_garbage(
    before: list[tuple[int, bytes]], garbage: bytes, after: list[tuple[int, bytes]]
) -> None:
    """Garbage without a packet's first byte costs nothing but itself."""
    garbage = garbage.replace(b"\xfe", b"").replace(b"\xfd", b"")
    start = 1_795_256_103_000_000  # a stamp of the real size holds no first byte either
    after = [(start + n, mavlink_2(b"payload")) for n, _ in enumerate(after)]
    problems: list[Finding] = []
    found = list(
        split(b"".join(logged(*r) for r in before) + garbage + b"".join(logged(*r) for r in after), problems.append)
    )
    assert found == before + after
    assert len(problems) == (1 if garbage else 0)


@given(st.binary(max_size=400))
def test_any_bytes_are_read_without_a_crash(data: bytes) -> None:
    problems: list[Finding] = []
    total = sum(len(logged(stamp, raw)) for stamp, raw in split(data, problems.append))
    assert total <= len(data)
    assert (total == len(data)) == (not problems)


def test_framing_is_that_of_mavlink() -> None:
    assert packet_length(mavlink_1(b"123")) == 11
    assert packet_length(mavlink_2(b"123")) == 15
    assert packet_length(mavlink_2(b"123", signed=True)) == 28
    assert packet_length(mavlink_2(b"123")[:-1]) is None
    assert packet_length(b"") is None
    assert packet_length(b"\x00" * 20) is None


@pytest.mark.parametrize("raw", [b"", b"hello", mavlink_1(b"1") + b"x", mavlink_2(b"1")[:-1]])
def test_what_is_no_packet_is_not_logged(tmp_path: Path, raw: bytes) -> None:
    log = TelemetryLog(tmp_path / "telemetry.tlog")
    with pytest.raises(ValueError, match="not one MAVLink packet"):
        log.append(0, raw)
    assert log.append(0, mavlink_1(b"")) == 0
    assert log.close().packets == 1


def test_threads_share_the_log(tmp_path: Path) -> None:
    log = TelemetryLog(tmp_path / "telemetry.tlog")
    numbers: list[int] = []

    def write() -> None:
        numbers.extend(log.append(n, mavlink_2(bytes(n))) for n in range(200))

    threads = [threading.Thread(target=write) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(numbers) == list(range(600))
    summary = log.close()
    assert log_reading.summarise(log.path) == summary


@pytest.mark.parametrize("fault", ["ENOSPC", "short"])
def test_a_full_disk_uses_up_no_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    write = os.write

    def refuse(fd: int, data: bytes) -> int:
        if fault == "short":
            return write(fd, data[:5])
        raise OSError(errno.ENOSPC, "full")

    log = TelemetryLog(tmp_path / "telemetry.tlog")
    assert log.append(1, mavlink_1(b"a")) == 0
    monkeypatch.setattr(os, "write", refuse)
    with pytest.raises(FlightError, match="the disk is full"):
        log.append(2, mavlink_1(b"b"))
    monkeypatch.undo()
    assert log.append(3, mavlink_1(b"c")) == 1
    summary = log.close()
    problems: list[Finding] = []
    assert [stamp for _, stamp, _ in log_reading.read_telemetry(log.path, problems.append)] == [1, 3]
    assert problems == []
    assert log_reading.summarise(log.path) == summary


def test_a_torn_record_that_can_not_be_cut_at_once_is_cut_before_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write

    def short(fd: int, data: bytes) -> int:
        return write(fd, data[:5])

    def refuse(_fd: int, _size: int) -> None:
        raise OSError(errno.EIO, "io")

    log = TelemetryLog(tmp_path / "telemetry.tlog")
    log.append(1, mavlink_1(b"a"))
    monkeypatch.setattr(os, "write", short)
    monkeypatch.setattr(os, "ftruncate", refuse)
    for _ in range(2):
        with pytest.raises(FlightError, match="input/output error"):
            log.append(2, mavlink_1(b"b"))
    monkeypatch.undo()
    assert log.append(3, mavlink_1(b"c")) == 1
    summary = log.close()
    assert [stamp for _, stamp, _ in log_reading.read_telemetry(log.path)] == [1, 3]
    assert log_reading.summarise(log.path) == summary


def test_what_is_logged_after_the_end_gets_into_no_other_file(tmp_path: Path) -> None:
    log = TelemetryLog(tmp_path / "telemetry.tlog")
    log.append(1, mavlink_1(b"a"))
    summary = log.close()
    told = r"cannot log telemetry in .*: the flight is closed"
    with (tmp_path / "other").open("wb"), pytest.raises(FlightError, match=told):  # it is given the log's descriptor
        log.append(2, mavlink_1(b"b"))
    assert (tmp_path / "other").read_bytes() == b""
    assert log.close() == log_reading.summarise(log.path) == summary


def test_faults_of_the_file_are_told(tmp_path: Path) -> None:
    log = TelemetryLog(tmp_path / "telemetry.tlog")
    log.close()
    assert list(log_reading.read_telemetry(log.path)) == []
    with pytest.raises(FlightError, match="in the way"):
        TelemetryLog(log.path)
    with pytest.raises(FlightError, match="does not exist"):
        list(log_reading.read_telemetry(tmp_path / "missing"))
    with pytest.raises(FlightError, match="is a folder"):
        list(log_reading.read_telemetry(tmp_path))


def test_a_real_flight_reads_but_for_its_torn_end(shared_data: Path) -> None:
    problems: list[Finding] = []
    path = shared_data / "telemetry" / "dronekit-flight.tlog"
    stamps = [stamp for _, stamp, _ in log_reading.read_telemetry(path, problems.append)]
    assert [(one.code, one.facts["bytes"]) for one in problems] == [(Code.LOG_BYTES_SKIPPED, 19)]
    assert len(stamps) > 10_000
    assert round((stamps[-1] - stamps[0]) / 1e6) == 1377


def test_a_block_counts_once_it_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link to bytes that a power cut may take would look like damage."""
    may, synced, fdatasync = threading.Event(), threading.Event(), os.fdatasync

    def slow(fd: int) -> None:
        assert may.wait(60)
        fdatasync(fd)
        synced.set()

    monkeypatch.setattr(os, "fdatasync", slow)
    log = TelemetryLog(tmp_path / "telemetry.tlog", flush_interval_s=0.01)
    packet = mavlink_2(b"x" * 200)
    while log.append(1, packet) * (len(packet) + 8) < 3 * BLOCK_BYTES:
        pass
    assert log.blocks(0) == []
    may.set()
    assert synced.wait(60)
    deadline = time.monotonic() + 60
    while len(found := log.blocks(0)) < 3 and time.monotonic() < deadline:
        pass
    assert [block.start for block in found] == [0, found[0].end, found[1].end]
    data = log.path.read_bytes()
    for block in found:
        assert block.end - block.start >= BLOCK_BYTES
        assert hashlib.sha256(data[block.start : block.end]).hexdigest() == block.sha256
    assert log.blocks(2) == found[2:]
    log.close()


def test_a_log_that_could_not_be_flushed_has_no_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(fd: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", broken)
    log = TelemetryLog(tmp_path / "telemetry.tlog", flush_interval_s=0.01)
    packet = mavlink_2(b"x" * 200)
    while log.append(1, packet) * (len(packet) + 8) < 2 * BLOCK_BYTES:
        pass
    log.close()
    assert log.problem is not None
    assert log.problem.code is Code.LOG_UNWRITTEN
    assert log.blocks(0) == []
