from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled import durable
from dappled.confined import OutsideError
from dappled.findings import Code
from dappled.flight import FlightError, FlightsLock, layout
from tests.flight.conftest import START_UTC_NS


def test_half_written_files_are_removed_for_good(flights: Path, synced: list[tuple[Path, frozenset[str]]]) -> None:
    """A name that came back after a power cut would stand in a flight that is closed."""
    folder = layout.create(flights, START_UTC_NS)
    part = durable.temporary(folder.frames / "000000.cr2")
    part.write_bytes(b"half")
    synced.clear()
    assert layout.remove_parts(folder) == [part.name]
    assert synced == [(folder.frames, frozenset())]


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_a_file_that_was_linked_to_where_the_lock_belongs_is_not_written_to(
    tmp_path: Path, link: Callable[[Path, Path], None]
) -> None:
    """A stick that somebody else prepared."""
    victim = tmp_path / "victim.txt"
    victim.write_text("somebody's file")
    link(victim, tmp_path / ".lock")
    with pytest.raises(FlightError, match=r"\.lock"):
        FlightsLock(tmp_path)
    assert victim.read_text() == "somebody's file"


@pytest.mark.parametrize("name", ["flight.sqlite-wal", "flight.sqlite-shm", "flight.sqlite-journal", "seals.jsonl"])
def test_a_link_that_sqlite_would_follow_is_refused(tmp_path: Path, name: str) -> None:
    folder = layout.create(tmp_path, None)
    (tmp_path / "victim.txt").write_text("somebody's file")
    (folder.path / name).symlink_to(tmp_path / "victim.txt")
    with pytest.raises(OutsideError, match=f"{name} is a link"):
        layout.open_folder(folder.path)


def test_a_new_flight_is_named_by_utc_and_holds_its_facts(flights: Path) -> None:
    folder = layout.create(
        flights, START_UTC_NS, {"camera": {"serial": None, "port": "usb:"}, "path": flights, "n": (1, 2)}
    )
    assert re.fullmatch(r"20261121T101503Z-[0-9a-f]{8}", folder.name)
    assert folder.frames.is_dir()
    assert layout.read_facts(folder) == {"camera": {"port": "usb:"}, "path": str(flights), "n": [1, 2]}
    assert [other.path for other in layout.flights(flights)] == [folder.path]
    assert layout.open_folder(folder.path) == folder


def test_without_a_clock_the_flight_is_named_by_boot(flights: Path) -> None:
    folder = layout.create(flights, None)
    assert re.fullmatch(r"boot[0-9a-f]{8}-[0-9a-f]{8}", folder.name)
    assert layout.flights(flights) == [folder]


def test_a_flight_has_a_name_where_proc_is_hidden(
    flights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "_BOOT_ID", tmp_path / "hidden")
    folder = layout.create(flights, None)
    assert re.fullmatch(r"boot[0-9a-f]{8}-[0-9a-f]{8}", folder.name)
    assert layout.flights(flights) == [folder]


def test_other_folders_are_no_flights(flights: Path) -> None:
    flights.mkdir()
    (flights / "notes").mkdir()
    (flights / "20261121T101503Z-00000000").write_text("a file")
    assert layout.flights(flights) == []
    assert layout.flights(flights / "missing") == []
    for path in (flights / "notes", flights / "missing", flights / "20261121T101503Z-00000000"):
        with pytest.raises(FlightError, match="not a flight folder"):
            layout.open_folder(path)


@pytest.mark.parametrize(
    ("camera_name", "name"),
    [
        ("IMG_0042.CR2", "frames/000042.cr2"),
        ("DSCF0001.RAF", "frames/000042.raf"),
        ("../../../etc/passwd", "frames/000042.raw"),
        ("x.d/../../n", "frames/000042.raw"),
        ("x.\u0663\u0664", "frames/000042.raw"),
        ("", "frames/000042.raw"),
        (".part", "frames/000042.part"),
        ("a.dng\0", "frames/000042.raw"),
        ("a.dng\n", "frames/000042.raw"),
    ],
)
def test_a_frame_is_named_by_its_index(camera_name: str, name: str) -> None:
    assert layout.frame_name(42, camera_name) == name


@given(st.integers(0, 2**31 - 1), st.text())
def test_no_camera_name_leaves_the_folder(index: int, camera_name: str) -> None:
    folder, _, file = layout.frame_name(index, camera_name).rpartition("/")
    assert folder == "frames"
    assert re.fullmatch(r"[0-9]{6,10}\.[a-z0-9]{1,8}", file)
    assert layout.index_of(file) == index


def test_a_negative_index_is_refused() -> None:
    with pytest.raises(ValueError, match="0 or more"):
        layout.frame_name(-1, "a.dng")


def test_a_file_in_place_of_the_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FlightError, match=r"cannot make the flight folder .*/file/.*not a folder"):
        layout.create(tmp_path / "file", START_UTC_NS)


@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "full"), (errno.EROFS, "read-only"), (errno.EIO, "dmesg")]
)
def test_a_disk_that_refuses_is_told(flights: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    flights.mkdir()
    monkeypatch.setattr(os, "mkdir", refuse)
    with pytest.raises(FlightError, match=words):
        layout.create(flights, START_UTC_NS)


def test_free_space_is_a_number_or_a_sentence(tmp_path: Path) -> None:
    assert layout.disk_space(tmp_path).available > 0
    with pytest.raises(FlightError, match="does not exist"):
        layout.disk_space(tmp_path / "missing")


def test_unreadable_facts_are_told(flights: Path) -> None:
    folder = layout.create(flights, START_UTC_NS)
    for text in ("a = = 1", "a = " + "[" * 100_000, "a = " + "1" * 5000, "a" + ".a" * 100_000 + " = 1"):
        folder.settings.write_text(text)
        with pytest.raises(FlightError, match=r"flight\.toml is not readable as TOML"):
            layout.read_facts(folder)
    for text, words in (
        ("settings = 1", "settings is no table"),
        ("settings = {pose = [1]}", r"settings\.pose is no table"),
        ("names = 'x'", "names is no table"),
    ):
        folder.settings.write_text(text)
        with pytest.raises(FlightError, match=rf"flight\.toml is damaged: {words}"):
            layout.read_facts(folder)
    folder.settings.unlink()
    with pytest.raises(FlightError, match="does not exist"):
        layout.read_facts(folder)


def test_a_disk_without_inodes_or_room_for_the_journal_is_too_small() -> None:
    room = layout.DiskSpace(10**12, 0, 10**9, files=16)
    assert room.shortage(500) is None
    assert replace(room, files=None).shortage(500) is None  # btrfs: no number is not none left
    short = replace(room, files=15).shortage(500), room.shortage(1001), replace(room, available=999_999).shortage(0)
    assert [(one.code, dict(one.facts)) for one in short if one] == [
        (Code.DISK_FEW_FILES, {"files": 15}),
        (Code.DISK_NEARLY_FULL, {"left_mb": 1000, "least_mb": 1001}),
        (Code.DISK_FULL, {"left_kb": 999}),
    ]


def test_a_file_system_without_inodes_reports_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    btrfs = SimpleNamespace(f_frsize=4096, f_blocks=9, f_bfree=5, f_bavail=4, f_files=0, f_favail=0)
    monkeypatch.setattr(os, "statvfs", lambda _: btrfs)
    assert layout.disk_space(tmp_path) == layout.DiskSpace(9 * 4096, 4 * 4096, 4 * 4096, None)


@pytest.mark.parametrize(("umask", "mode"), [(0o000, 0o750), (0o022, 0o750), (0o077, 0o700)])
def test_a_flight_is_not_for_every_user_of_the_machine(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        folder = layout.create(tmp_path, START_UTC_NS, {})
    finally:
        os.umask(before)
    assert folder.path.stat().st_mode & 0o777 == mode
