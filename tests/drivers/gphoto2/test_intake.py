"""A file that comes is written while it comes, and is whole whatever the disk does; a part of one leaves nothing."""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled import durable
from dappled.clock import SystemClock
from dappled.drivers.camera import Blob
from dappled.drivers.gphoto2.intake import Intake
from tests.flight.makers import PatientClock, come
from tests.waiting import eventually

DATA = os.urandom(6_500_001)  # more than six pieces


class LaterClock(SystemClock):
    later_ns = 0
    patience = 1

    def monotonic_ns(self) -> int:
        return super().monotonic_ns() + self.later_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        return super().wait(event, self.patience * timeout_s)


@pytest.fixture
def intake(tmp_path: Path) -> Intake:
    intake = Intake(PatientClock())
    intake.folder = tmp_path
    return intake


@pytest.fixture
def no_descriptor_left() -> Iterator[None]:
    before = open_files()
    yield
    eventually(lambda: open_files() == before, "what was opened is closed")


def open_files() -> list[str]:
    """What this process has open of plain files."""
    found = []
    for fd in os.listdir("/proc/self/fd"):
        try:
            found.append(os.readlink(f"/proc/self/fd/{fd}"))
        except FileNotFoundError:  # the listing's own
            continue
    return sorted(name for name in found if "memfd:camera" in name or "/#" in name)


def stands_on(folder: Path, blob: Blob) -> bool:
    found = os.fstat(blob.fd)
    return (found.st_dev, found.st_nlink) == (folder.stat().st_dev, 0) and os.readlink(
        f"/proc/self/fd/{blob.fd}"
    ).startswith(str(folder))


def is_whole(blob: Blob) -> bool:
    return os.pread(blob.fd, blob.size + 1, 0) == DATA


@pytest.mark.usefixtures("no_descriptor_left")
def test_a_file_comes_to_the_disk_with_its_hash_and_without_a_name(intake: Intake, tmp_path: Path) -> None:
    for _ in range(2):  # the second one in buffers that were used
        blob = come(intake, DATA)
        assert stands_on(tmp_path, blob)
        assert is_whole(blob)
        assert blob.sha256 == hashlib.sha256(DATA).hexdigest()
        assert os.listdir(tmp_path) == []
        blob.close()


@pytest.mark.usefixtures("no_descriptor_left")
def test_without_a_folder_it_comes_to_memory_with_its_hash(tmp_path: Path) -> None:
    for folder in (None, tmp_path / "missing"):
        intake = Intake(PatientClock())
        intake.folder = folder
        blob = come(intake, DATA)
        assert is_whole(blob)
        assert blob.sha256 == hashlib.sha256(DATA).hexdigest()
        blob.close()


@pytest.mark.usefixtures("no_descriptor_left")
def test_a_file_that_is_cut_off_leaves_nothing(intake: Intake, tmp_path: Path) -> None:
    def cut(into: memoryview) -> int:
        raise ConnectionError("the cable was pulled")

    with pytest.raises(ConnectionError), intake.begin(len(DATA)) as coming:  # noqa: PT012  in its middle
        coming.take(len(DATA), len)
        coming.take(len(DATA), cut)
    assert os.listdir(tmp_path) == []
    blob = come(intake, DATA)
    assert is_whole(blob)
    blob.close()


@pytest.mark.usefixtures("no_descriptor_left")
@pytest.mark.parametrize("good", [0, 3, 6])
def test_a_disk_that_refuses_in_the_middle_costs_no_byte(
    intake: Intake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: int
) -> None:
    """It is full, say. What came before and after it is in memory, and the next file is tried on the disk again."""
    write, pieces = durable.write_all, []

    def full(fd: int, piece: bytes | memoryview) -> None:
        if os.readlink(f"/proc/self/fd/{fd}").startswith(str(tmp_path)):
            pieces.append(piece)
            if len(pieces) > good:
                write(fd, piece[:1000])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(fd, piece)

    monkeypatch.setattr(durable, "write_all", full)
    blob = come(intake, DATA)
    assert not stands_on(tmp_path, blob)
    assert is_whole(blob)
    assert blob.sha256 is None  # the recorder computes it
    blob.close()
    monkeypatch.undo()
    blob = come(intake, DATA)
    assert stands_on(tmp_path, blob)
    blob.close()


@pytest.mark.usefixtures("no_descriptor_left")
def test_a_disk_that_stands_still_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither by this file nor by those of the next minute."""
    clock, goes_on, write = LaterClock(), threading.Event(), durable.write_all

    def stuck(fd: int, piece: bytes | memoryview) -> None:
        if os.readlink(f"/proc/self/fd/{fd}").startswith(str(tmp_path)):
            goes_on.wait()
        write(fd, piece)

    intake = Intake(clock)
    intake.folder = tmp_path
    monkeypatch.setattr(durable, "write_all", stuck)
    try:
        for _ in range(2):
            blob = come(intake, DATA)
            assert not stands_on(tmp_path, blob)
            assert is_whole(blob)
            blob.close()
    finally:
        goes_on.set()
    clock.later_ns, clock.patience = 61 * 10**9, 60
    blob = come(intake, DATA)
    assert stands_on(tmp_path, blob)
    assert is_whole(blob)
    blob.close()
