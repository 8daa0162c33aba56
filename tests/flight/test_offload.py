"""A flight brought to another disk: what is proved before anything is removed, and the faults on the way.

The destinations here are on the disk of the source, so that `--same-device` insists; `tests/flight/test_places.py` has
other devices, bind mounts and file systems.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from dappled import durable
from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.confined import OutsideError
from dappled.findings import Code
from dappled.flight import (
    FlightError,
    FlightsLock,
    Ledger,
    LedgerReader,
    Recording,
    Stray,
    layout,
    offload,
    places,
    pruning,
    read_back,
    recording,
    seals,
)
from dappled.flight.checks import flight_check as checks
from dappled.flight.checks.flight_check import check
from dappled.flight.trees import Tree
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import CARD_FULL, deliver, flip, held, mavlink_2, request, words_of
from tests.standing import STRAY

pytestmark = pytest.mark.usefixtures("on_ext4")


@pytest.fixture
def closed(flight: Recording) -> Path:
    for index in range(2):
        request(flight, index)
        deliver(flight, index, b"raw %d" % index * 1000)
    flight.telemetry.append(1, mavlink_2(b"a"))
    flight.close()
    return flight.folder.path


def go(flight: Path, there: Path, *, prune: bool = False) -> offload.Offloaded:
    return offload.offload(flight, there, prune=prune, same_device=True, clock=RecordedClock(START_UTC_NS))


def frames(flight: Path) -> list[str]:
    return sorted(os.listdir(flight / "frames"))


TWO = ["000000.cr2", "000001.cr2"]


def test_a_flight_is_copied_and_verified(closed: Path, tmp_path: Path) -> None:
    done = go(closed, tmp_path / "disk")
    assert done.destination == tmp_path / "disk" / closed.name
    assert (done.copied, done.there_already, done.pruned) == (7, 0, 0)
    assert words_of(check(done.destination).problems) == words_of(check(closed).problems) == ()
    again = go(closed, tmp_path / "disk")
    assert (again.copied, again.there_already) == (0, 7)
    assert frames(closed) == TWO


def geotag(flight: Path, words: bytes) -> None:
    """What `dappled geotag` writes: sidecars, lists, and a seal."""
    with seals.work(
        layout.open_folder(flight), RecordedClock(START_UTC_NS), seals.Occasion.GEOTAG, "geotags flights in", None
    ):
        (flight / "geotags").mkdir(exist_ok=True)
        for name in ("frames/000000.cr2.xmp", "geotags/geo.txt"):
            (flight / name).write_bytes(words)


@pytest.mark.parametrize("where", ["here", "at the copy"])
def test_sidecars_that_were_written_anew_since_go_where_the_older_ones_are(
    closed: Path, tmp_path: Path, where: str
) -> None:
    geotag(closed, b"first")
    copy = go(closed, tmp_path / "disk").destination
    geotag(closed if where == "here" else copy, b"second")
    done = go(closed, tmp_path / "disk", prune=True)
    assert (done.copied, done.pruned) == (4 if where == "here" else 0, 2)
    assert {(copy / name).read_bytes() for name in ("frames/000000.cr2.xmp", "geotags/geo.txt")} == {b"second"}
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()
    assert words_of(check(copy).notes) == ()


def test_a_sidecar_that_another_program_changed_in_the_copy_is_not_overwritten(closed: Path, tmp_path: Path) -> None:
    geotag(closed, b"first")
    copy = go(closed, tmp_path / "disk").destination
    (copy / "frames/000000.cr2.xmp").write_bytes(b"a person's own")
    geotag(closed, b"second")
    with pytest.raises(FlightError, match=r"000000.cr2.xmp is there already and differs from .*: move it away first"):
        go(closed, tmp_path / "disk", prune=True)
    assert (copy / "frames/000000.cr2.xmp").read_bytes() == b"a person's own"
    assert frames(closed) == ["000000.cr2", "000000.cr2.xmp", "000001.cr2"]


def test_the_manifest_is_one_that_sha256sum_reads(closed: Path, tmp_path: Path) -> None:
    go(closed, tmp_path / "disk")
    sums = tmp_path / "disk" / f"{closed.name}.sha256"
    subprocess.run(["/usr/bin/sha256sum", "--check", "--strict", "--quiet", sums.name], cwd=sums.parent, check=True)
    assert len(sums.read_text().splitlines()) == 7


def test_any_name_that_a_file_system_allows_is_copied_and_forges_no_line(closed: Path, tmp_path: Path) -> None:
    name = "a\r\n" + "f" * 64 + "  \udcff\\"
    (closed / name).write_bytes(b"somebody's")
    done = go(closed, tmp_path / "disk\udcff", prune=True)
    assert (done.destination / name).read_bytes() == b"somebody's"
    sums = done.destination.with_name(f"{closed.name}.sha256")
    subprocess.run(["/usr/bin/sha256sum", "--check", "--strict", "--quiet", sums.name], cwd=sums.parent, check=True)
    assert len(sums.read_bytes().splitlines()) == 8
    assert words_of(check(closed).problems) == words_of(check(done.destination).problems) == ()
    geotag(closed, b"again")  # whose event names that file


def test_prune_removes_the_frames_and_check_says_where_they_are(closed: Path, tmp_path: Path) -> None:
    done = go(closed, tmp_path / "disk", prune=True)
    assert done.pruned == 2
    assert frames(closed) == []
    assert (done.destination / "frames" / "000001.cr2").read_bytes() == b"raw 1" * 1000
    assert words_of(check(done.destination).problems) == ()
    report = check(closed)
    assert (words_of(report.problems), report.files, report.offloaded) == ((), 0, 2)
    (note,) = words_of(report.notes)
    assert f"2 files (frames/000000.cr2 to frames/000001.cr2) were offloaded to {done.destination}" in note
    with LedgerReader.open(closed / "flight.sqlite") as ledger:
        (event,) = [event for event in ledger.events() if event.kind == "offloaded"]
    assert event.finding is not None
    facts = event.finding.facts
    assert (facts["files"], facts["there"]) == (2, str(done.destination))
    assert facts["sha256"] == hashlib.sha256((closed / "offloaded.jsonl").read_bytes()).hexdigest()
    rows = [json.loads(line) for line in (closed / "offloaded.jsonl").read_text().splitlines()]
    assert [row["name"] for row in rows] == ["frames/000000.cr2", "frames/000001.cr2"]
    assert not (done.destination / "offloaded.jsonl").exists()


def test_the_verdict_does_not_call_a_pruned_flight_intact_as_if_nothing_had_happened(
    closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    go(closed, tmp_path / "disk", prune=True)
    assert main(["flight", "check", str(closed)]) == 0
    note, verdict = capsys.readouterr().out.splitlines()
    assert note.startswith("note:  2 files (frames/000000.cr2 to frames/000001.cr2) were offloaded to ")
    assert ": consistent, of what is still here: 0 files" in verdict
    assert "2 files offloaded and not read; not signed" in verdict


def test_image_indices_go_on_after_a_prune(closed: Path, tmp_path: Path) -> None:
    go(closed, tmp_path / "disk", prune=True)
    os.unlink(closed.parent / "index.sqlite")
    later = recording.begin(closed.parent, RecordedClock(START_UTC_NS))
    assert later.next_index == 2
    later.close()


def test_a_second_prune_finds_nothing_to_do_and_proves_the_copy_again(closed: Path, tmp_path: Path) -> None:
    go(closed, tmp_path / "disk", prune=True)
    again = go(closed, tmp_path / "disk", prune=True)
    assert (again.pruned, again.copied) == (0, 0)
    assert words_of(check(closed).problems) == words_of(check(again.destination).problems) == ()
    flip(again.destination / "frames" / "000001.cr2", 7)
    with pytest.raises(FlightError, match=r"000001.cr2 differs from what the ledger says"):
        go(closed, tmp_path / "disk", prune=True)


@pytest.mark.parametrize("forged", ["a line less", "no event"])
def test_check_believes_a_record_that_the_ledger_vouches_for_alone(closed: Path, tmp_path: Path, forged: str) -> None:
    go(closed, tmp_path / "disk", prune=True)
    if forged == "no event":
        with closing(sqlite3.connect(closed / "flight.sqlite")) as ledger, ledger:
            ledger.execute("DELETE FROM events WHERE kind = 'offloaded'")
    else:
        lines = (closed / "offloaded.jsonl").read_bytes().splitlines(keepends=True)
        (closed / "offloaded.jsonl").write_bytes(lines[0])
    problems = words_of(check(closed).problems)
    assert any("offloaded.jsonl was changed: the ledger has no event with its SHA-256" in text for text in problems)
    assert any("000001.cr2 is in the ledger, but the file is missing" in text for text in problems)


def test_a_frame_that_came_after_the_copy_is_copied_before_it_is_pruned(closed: Path, tmp_path: Path) -> None:
    """Reproduced 1c: names were read from the source's ledger anew, and what came after the copy was removed."""
    go(closed, tmp_path / "disk")
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger, held(b"late" * 99) as blob:
        recorder = recording.Recorder(layout.open_folder(closed), ledger)
        stray = recorder.record_stray("LATE.CR2", blob, STRAY, arrived_utc_ns=1)
    done = go(closed, tmp_path / "disk", prune=True)
    assert done.pruned == 3
    assert (done.destination / stray.name).read_bytes() == b"late" * 99
    with LedgerReader.open(done.destination / "flight.sqlite") as ledger:
        assert [one.name for one in ledger.strays()] == [stray.name]


def test_a_frame_that_comes_between_copy_and_prune_stays(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reproduced 1c: a program that takes no lock puts a file and its row there while the copy is proved."""
    whole = check

    def meanwhile(path: Path) -> object:
        (closed / "frames" / "stray-000000.cr2").write_bytes(b"late")
        with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
            ledger.add_stray(Stray("frames/stray-000000.cr2", "LATE.CR2", 4, "ab", 1, STRAY))
        return whole(path)

    monkeypatch.setattr(checks, "check", meanwhile)
    assert go(closed, tmp_path / "disk", prune=True).pruned == 2
    assert frames(closed) == ["stray-000000.cr2"]


@pytest.mark.parametrize("change", ["bytes", "another file"])
def test_a_frame_that_changes_between_copy_and_prune_stays(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    whole = check
    frame = closed / "frames" / "000001.cr2"

    def meanwhile(path: Path) -> object:
        stamp = frame.stat()
        data = frame.read_bytes()
        if change == "bytes":
            flip(frame, 3)
        else:
            frame.rename(closed / "kept.cr2")
            frame.write_bytes(data)
        os.utime(frame, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        return whole(path)

    monkeypatch.setattr(checks, "check", meanwhile)
    with pytest.raises(FlightError, match=r"000001.cr2 is not the file any more that was copied: it stays"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == ["000001.cr2"]


PROVED = {
    "frames/000000.cr2": "is not the file any more that was read back: frames/000000.cr2 stays here",
    "flight.sqlite": "changed while it was checked: nothing was removed",
    "seals.jsonl": "changed while it was checked: nothing was removed",
}


@pytest.mark.parametrize("name", PROVED)
@pytest.mark.parametrize("change", ["bytes", "another file", "cut off"])
def test_a_copy_that_changes_after_it_was_proved_counts_for_nothing(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, change: str
) -> None:
    """A server or another program writes there once more, between the proof and the first removal."""
    whole = check
    copy = tmp_path / "disk" / closed.name / name

    def meanwhile(path: Path) -> object:
        found = whole(path)
        stamp, data = copy.stat(), copy.read_bytes()
        if change == "bytes":
            flip(copy, 3)
        elif change == "cut off":
            os.truncate(copy, len(data) - 1)
        else:
            copy.unlink()
            copy.write_bytes(data)
        os.utime(copy, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        return found

    monkeypatch.setattr(checks, "check", meanwhile)
    with pytest.raises(FlightError, match=PROVED[name]):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


def test_what_is_there_already_is_read_back_from_the_disk_too(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reproduced 1d: files that were there already were hashed through the page cache and never synced."""
    go(closed, tmp_path / "disk")
    synced: set[tuple[int, int]] = set()
    fsync = os.fsync

    def watched(fd: int) -> None:
        found = os.fstat(fd)
        synced.add((found.st_dev, found.st_ino))
        fsync(fd)

    read: list[str] = []
    direct = read_back.hash_on_disk

    def reading(name: str, folder: int) -> tuple[str, read_back.ReadBack]:
        read.append(name)
        return direct(name, folder)

    monkeypatch.setattr(os, "fsync", watched)
    monkeypatch.setattr(read_back, "hash_on_disk", reading)
    done = go(closed, tmp_path / "disk", prune=True)
    monkeypatch.undo()
    assert done.there_already == 7
    copy = tmp_path / "disk" / closed.name
    for path in (copy, *copy.rglob("*"), tmp_path / "disk"):
        found = path.stat()
        assert (found.st_dev, found.st_ino) in synced, path
    assert set(read) == {path.name for path in copy.rglob("*") if path.is_file()}


def test_a_copy_that_can_be_read_from_memory_only_proves_nothing(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(read_back, "_direct", lambda name, folder, size: None)
    monkeypatch.setattr(read_back, "_in_memory", lambda fd, size: True)
    done = go(closed, tmp_path / "disk")
    assert done.read_back == ("page cache",)
    assert done.doubts[0].code is Code.COPY_IN_MEMORY
    with pytest.raises(FlightError, match="nothing was removed; offload without --prune"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


def test_a_prune_that_is_refused_leaves_no_empty_folder(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places, "file_system", lambda fd: "strangefs")
    with pytest.raises(FlightError, match=rf"can't be sure of .*{closed.name}: its file system is strangefs"):
        go(closed, tmp_path / "disk", prune=True)
    assert not (tmp_path / "disk").exists()
    assert frames(closed) == TWO


def test_a_stray_outside_the_flight_is_not_removed(closed: Path, tmp_path: Path) -> None:
    """Reproduced 1e."""
    victim = closed.parent / "victim.txt"
    victim.write_bytes(b"somebody else's file")
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.add_stray(Stray("../victim.txt", "A.CR2", 20, durable.hash_file(victim), 1, STRAY))
    with pytest.raises(OutsideError, match=r"names '../victim.txt', which does not stay inside"):
        go(closed, tmp_path / "disk", prune=True)
    assert not (tmp_path / "disk").exists()
    assert victim.read_bytes() == b"somebody else's file"
    assert frames(closed) == TWO


def test_only_frames_are_removed_whatever_the_ledger_calls_a_stray(closed: Path, tmp_path: Path) -> None:
    journal = closed / "shots.jsonl"
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        stray = Stray("shots.jsonl", "A.CR2", journal.stat().st_size, durable.hash_file(journal), 1, STRAY)
        ledger.add_stray(stray)
    assert go(closed, tmp_path / "disk", prune=True).pruned == 2
    assert journal.exists()


@pytest.mark.parametrize("linked", ["frames", "frames/000000.cr2", ""])
def test_a_destination_that_links_back_is_refused(closed: Path, tmp_path: Path, linked: str) -> None:
    """Reproduced 1b: `DEST/N/frames` was a link to the source, and 4 of 4 frames were gone."""
    copy = tmp_path / "disk" / closed.name
    (copy / linked).parent.mkdir(parents=True)
    (copy / linked).symlink_to(closed / linked)
    with pytest.raises(FlightError, match="a link is in its place, and links are not followed"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


@pytest.mark.parametrize("linked", ["frames/000000.cr2", "telemetry.tlog"])
def test_a_hard_link_to_the_source_is_no_copy(closed: Path, tmp_path: Path, linked: str) -> None:
    copy = tmp_path / "disk" / closed.name
    (copy / "frames").mkdir(parents=True)
    os.link(closed / linked, copy / linked)
    with pytest.raises(FlightError, match=r"is the same file as .* under another name"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


def test_one_file_under_two_names_that_nothing_told_apart_is_put_back(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last line: the copy vanishes with the source's first file."""
    unlink = Tree.unlink

    def both(tree: Tree, name: str) -> None:
        unlink(tree, name)
        if tree.path == closed:
            os.unlink(tmp_path / "disk" / closed.name / name)

    monkeypatch.setattr(Tree, "unlink", both)
    with pytest.raises(FlightError, match=r"vanished with .*one file under two names; it was put back here"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO
    assert (closed / "frames" / "000000.cr2").read_bytes() == b"raw 0" * 1000


def test_a_link_in_the_flight_is_not_followed(closed: Path, tmp_path: Path) -> None:
    (closed / "inputs").mkdir()
    (closed / "inputs" / "white.npy").symlink_to("/etc/hostname")
    with pytest.raises(FlightError, match=r"white.npy is a link, which is not followed: nothing was touched"):
        go(closed, tmp_path / "disk")
    assert not (tmp_path / "disk").exists()


@pytest.mark.parametrize(("doing", "what"), [("records into", "stop it"), ("offloads from", "wait until it has ended")])
def test_one_process_at_a_time(closed: Path, tmp_path: Path, doing: str, what: str) -> None:
    """Reproduced 1c: no lock was taken."""
    with (
        FlightsLock(closed.parent, doing),
        pytest.raises(FlightError, match=rf"another dappled \(process {os.getpid()}\) {doing} .*; {what}"),
    ):
        go(closed, tmp_path / "disk", prune=True)
    assert not (tmp_path / "disk").exists()


def test_the_lock_is_that_of_the_flight_itself_whatever_link_leads_to_it(closed: Path, tmp_path: Path) -> None:
    (tmp_path / "today").symlink_to(closed)
    with FlightsLock(closed.parent), pytest.raises(FlightError, match="another dappled"):
        go(tmp_path / "today", tmp_path / "disk")
    assert go(tmp_path / "today", tmp_path / "disk").destination == tmp_path / "disk" / closed.name


def test_a_user_who_may_only_read_copies_without_the_lock(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(self: FlightsLock, root: Path, doing: str = "") -> None:
        raise FlightError("cannot make the lock") from PermissionError(13, "denied")

    monkeypatch.setattr(FlightsLock, "__init__", refused)
    assert go(closed, tmp_path / "disk").copied == 7
    with pytest.raises(FlightError, match="cannot make the lock"):
        go(closed, tmp_path / "disk", prune=True)


def test_a_flight_that_was_never_closed_is_refused(flight: Recording, tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="another dappled"):
        go(flight.folder.path, tmp_path / "disk")
    copy = shutil.copytree(flight.folder.path, tmp_path / "killed" / flight.folder.name)
    with pytest.raises(FlightError, match="still being recorded, or was never closed"):
        go(copy, tmp_path / "disk")


@pytest.mark.parametrize("where", ["frames/000000.cr2", "telemetry.tlog"])
def test_a_damaged_source_is_refused(closed: Path, tmp_path: Path, where: str) -> None:
    flip(closed / where, 5)
    with pytest.raises(FlightError, match="not intact"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


def test_a_disk_that_lies_is_found(closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Tree.write

    def lying(tree: Tree, name: str, pieces: object) -> None:
        whole(tree, name, pieces)  # type: ignore[arg-type]  # as it came
        if name.endswith("000001.cr2"):
            flip(tree.path / name, 3)

    monkeypatch.setattr(Tree, "write", lying)
    with pytest.raises(FlightError, match="reads back different"):
        go(closed, tmp_path / "disk", prune=True)
    assert frames(closed) == TWO


def test_a_copy_that_was_cut_short_says_so_until_it_is_finished(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A daemon that recorded there would repair it, and work there would be lost."""
    whole, there = Tree.write, tmp_path / "disk" / closed.name

    def full(tree: Tree, name: str, pieces: object) -> None:
        if name.endswith("000001.cr2"):
            raise OSError(errno.ENOSPC, "No space left on device")
        whole(tree, name, pieces)  # type: ignore[arg-type]  # as it came

    with monkeypatch.context() as broken:
        broken.setattr(Tree, "write", full)
        with pytest.raises(FlightError, match="the disk is full"):
            go(closed, tmp_path / "disk")
    assert Code.FLIGHT_COPY_UNFINISHED in [one.code for one in check(there).problems]
    with pytest.raises(FlightError, match="cut short: run that offload again"):
        layout.refuse_unfinished(layout.open_folder(there))
    go(closed, tmp_path / "disk")
    assert check(there).problems == ()


def test_another_file_of_that_name_is_not_overwritten(closed: Path, tmp_path: Path) -> None:
    there = tmp_path / "disk" / closed.name / "frames" / "000000.cr2"
    there.parent.mkdir(parents=True)
    there.write_bytes(b"other")
    with pytest.raises(FlightError, match="differs from"):
        go(closed, tmp_path / "disk", prune=True)
    assert there.read_bytes() == b"other"
    assert frames(closed) == TWO


def test_not_into_itself(closed: Path) -> None:
    for place in (closed / "frames", closed / "new" / "deep"):
        with pytest.raises(FlightError, match=r"under another name|into itself"):
            go(closed, place)
    with pytest.raises(FlightError, match="is the same folder as"):
        go(closed, closed.parent)
    assert not (closed / "new").exists()


def test_a_copy_whose_ledger_has_grown_stays(closed: Path, tmp_path: Path) -> None:
    """Frames are tagged in the copy; a later offload does not take that back."""
    done = go(closed, tmp_path / "disk")
    with Ledger(done.destination / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.add_event("tagged late", CARD_FULL)
    assert go(closed, tmp_path / "disk").copied == 0
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.add_event("picked up", CARD_FULL)
    with pytest.raises(FlightError, match="each holds what the other lacks"):
        go(closed, tmp_path / "disk")


def test_the_ledger_is_copied_with_what_stands_in_its_log(closed: Path, tmp_path: Path) -> None:
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as reader:  # keeps the log from being folded in
        reader.add_event("note", CARD_FULL)
        assert (closed / "flight.sqlite-wal").stat().st_size > 0
        done = go(closed, tmp_path / "disk")
    with LedgerReader.open(done.destination / "flight.sqlite") as ledger:
        assert ledger.events()[-1].finding == CARD_FULL
    assert not list(done.destination.glob("flight.sqlite-*"))


def test_a_ledger_without_a_log_is_copied_byte_for_byte(closed: Path, tmp_path: Path) -> None:
    done = go(closed, tmp_path / "disk")
    assert (done.destination / "flight.sqlite").read_bytes() == (closed / "flight.sqlite").read_bytes()


def test_what_was_pruned_to_one_disk_is_missed_on_another(closed: Path, tmp_path: Path) -> None:
    go(closed, tmp_path / "a", prune=True)
    with pytest.raises(FlightError, match=rf"was offloaded to {tmp_path}/a/.* and removed here, and .*/b/.* lacks it"):
        go(closed, tmp_path / "b")


def test_the_command(closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["flight", "offload", str(tmp_path / "disk"), str(closed), "--same-device"]
    assert main([*words, "--prune"]) == 0
    said = capsys.readouterr().out
    assert "7 files copied and verified, 0 already there; read back from ext4 by O_DIRECT" in said
    assert "2 files removed here" in said
    assert layout.flights(tmp_path / "disk")[0].name == closed.name


def test_a_flight_without_a_frame_is_brought_home_too(flight: Recording, tmp_path: Path) -> None:
    flight.close()
    done = go(flight.folder.path, tmp_path / "disk", prune=True)
    assert (done.pruned, words_of(check(done.destination).problems)) == (0, ())
    assert pruning.removed(flight.folder) == {}
