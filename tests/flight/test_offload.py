"""A flight brought to another disk, and the faults on the way."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.flight import FlightError, Ledger, Recording, durable, layout, offload
from dappled.flight.check import check
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, flip, mavlink_2, request


@pytest.fixture
def closed(flight: Recording) -> Path:
    for index in range(2):
        request(flight, index)
        deliver(flight, index, b"raw %d" % index * 1000)
    flight.telemetry.append(1, mavlink_2(b"a"))
    flight.close()
    return flight.folder.path


def go(flight: Path, there: Path, *, prune: bool = False) -> offload.Offloaded:
    return offload.offload(flight, there, prune=prune)


def test_a_flight_is_copied_and_verified(closed: Path, tmp_path: Path) -> None:
    done = go(closed, tmp_path / "disk")
    assert done.destination == tmp_path / "disk" / closed.name
    assert (done.copied, done.there_already) == (6, 0)
    assert check(done.destination).problems == check(closed).problems == ()
    again = go(closed, tmp_path / "disk")
    assert (again.copied, again.there_already) == (0, 6)


def test_pruning_is_refused_before_anything_is_done(closed: Path, tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="--prune is switched off"):
        go(closed, tmp_path / "disk", prune=True)
    assert not (tmp_path / "disk").exists()
    assert len(os.listdir(closed / "frames")) == 2


def test_a_flight_pruned_by_an_earlier_version_is_not_copied_again(closed: Path, tmp_path: Path) -> None:
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.set_fact("offloaded", {"destination": "/media/disk", "utc_ns": START_UTC_NS, "files": 2})
    for name in os.listdir(closed / "frames"):
        os.unlink(closed / "frames" / name)
    report = check(closed)
    assert report.problems == ()
    assert "offloaded to /media/disk" in report.notes[0]
    with pytest.raises(FlightError, match="pruned already"):
        go(closed, tmp_path / "disk")


def test_a_flight_that_is_recorded_is_refused(flight: Recording, tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="still being recorded"):
        go(flight.folder.path, tmp_path / "disk")


@pytest.mark.parametrize("where", ["frames/000000.cr2", "telemetry.tlog"])
def test_a_damaged_source_is_refused(closed: Path, tmp_path: Path, where: str) -> None:
    flip(closed / where, 5)
    with pytest.raises(FlightError, match="not intact"):
        go(closed, tmp_path / "disk")
    assert len(os.listdir(closed / "frames")) == 2


def test_a_disk_that_lies_is_found(closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = durable.copy_in

    def lying(fd: int, size: int, path: Path) -> str:
        sha256 = whole(fd, size, path)
        flip(path, 3)
        return sha256

    monkeypatch.setattr(durable, "copy_in", lying)
    with pytest.raises(FlightError, match="reads back different"):
        go(closed, tmp_path / "disk")
    assert len(os.listdir(closed / "frames")) == 2


def test_another_file_of_that_name_is_not_overwritten(closed: Path, tmp_path: Path) -> None:
    there = tmp_path / "disk" / closed.name / "frames" / "000000.cr2"
    there.parent.mkdir(parents=True)
    there.write_bytes(b"other")
    with pytest.raises(FlightError, match="differs from"):
        go(closed, tmp_path / "disk")
    assert there.read_bytes() == b"other"


def test_not_into_itself(closed: Path) -> None:
    with pytest.raises(FlightError, match="into itself"):
        go(closed, closed / "frames")
    with pytest.raises(FlightError, match="into itself"):
        go(closed, closed.parent)


def test_the_command(closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flight", "offload", str(tmp_path / "disk"), str(closed)]) == 0
    assert "6 files copied and verified" in capsys.readouterr().out
    assert layout.flights(tmp_path / "disk")[0].name == closed.name


def test_a_flight_without_a_frame_is_brought_home_too(flight: Recording, tmp_path: Path) -> None:
    flight.close()
    done = go(flight.folder.path, tmp_path / "disk")
    assert check(done.destination).problems == ()
