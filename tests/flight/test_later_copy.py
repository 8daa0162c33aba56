"""Work at a copy, a prune here, and the next offload, in any order and at once: the two ledgers stay one."""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.findings import told
from dappled.flight import (
    FlightError,
    FlightsLock,
    Frame,
    Ledger,
    LedgerReader,
    Recording,
    layout,
    ledger_copies,
    offload,
    places,
    recording,
    seal_key,
    seals,
)
from dappled.flight.checks import flight_check
from dappled.flight.checks.flight_check import check
from dappled.flight.seal_key import SealKey
from dappled.flight.trees import Tree
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, flip, mavlink_2, request, words_of
from tests.standing import failure

CLOCK = RecordedClock(START_UTC_NS)


pytestmark = pytest.mark.usefixtures("on_ext4")


@pytest.fixture
def closed(flight: Recording) -> Path:
    """Two frames, and a shot whose file is still on the card."""
    for index in range(3):
        request(flight, index)
    for index in range(2):
        deliver(flight, index, b"raw %d" % index * 1000)
    flight.ledger.follows(2, failure("its file stays at the camera"))
    flight.telemetry.append(1, mavlink_2(b"a"))
    flight.close()
    return flight.folder.path


def go(flight: Path, there: Path, *, prune: bool = False, key: SealKey | None = None) -> offload.Offloaded:
    return offload.offload(flight, there, prune=prune, same_device=True, clock=CLOCK, key=key)


def geotag(flight: Path, words: bytes, key: SealKey | None = None) -> None:
    """What `dappled geotag` writes: sidecars, lists, and a seal."""
    with seals.work(layout.open_folder(flight), CLOCK, seals.Occasion.GEOTAG, "geotags flights in", key):
        (flight / "geotags").mkdir(exist_ok=True)
        for name in ("frames/000000.cr2.xmp", "geotags/geo.txt"):
            (flight / name).write_bytes(words)


def pick_up(flight: Path) -> None:
    """What `dappled flight pickup` writes."""
    folder = layout.open_folder(flight)
    with seals.work(folder, CLOCK, seals.Occasion.PICKUP, "picks up files into", None):
        (folder.frames / "000002.cr2").write_bytes(b"late")
        late = hashlib.sha256(b"late").hexdigest()
        with Ledger(folder.ledger, CLOCK) as ledger:
            ledger.safe(Frame(2, "frames/000002.cr2", "A.CR2", 4, late, 1))


def alike(flight: Path, copy: Path) -> bool:
    """Whether ledger and seals are the same here and there."""
    return all((flight / name).read_bytes() == (copy / name).read_bytes() for name in ("flight.sqlite", "seals.jsonl"))


def test_work_at_the_copy_comes_home_with_a_prune(closed: Path, tmp_path: Path) -> None:
    copy = go(closed, tmp_path / "disk").destination
    geotag(copy, b"only there")
    done = go(closed, tmp_path / "disk", prune=True)
    assert (done.pruned, done.brought_home) == (2, 4)  # an event, a fact, and the link of each
    assert (closed / "frames/000000.cr2.xmp").read_bytes() == (closed / "geotags/geo.txt").read_bytes() == b"only there"
    assert alike(closed, copy)
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()
    pick_up(closed)  # work here goes on from it
    done = go(closed, tmp_path / "disk", prune=True)
    assert (done.pruned, done.brought_home) == (1, 0)
    assert sorted(os.listdir(copy / "frames")) == ["000000.cr2", "000000.cr2.xmp", "000001.cr2", "000002.cr2"]
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()


def test_work_at_the_copy_after_a_prune_goes_on_from_it(closed: Path, tmp_path: Path) -> None:
    """The usual order: frames are removed here, and then geotagged where they are."""
    copy = go(closed, tmp_path / "disk", prune=True).destination
    assert alike(closed, copy)
    geotag(copy, b"there")
    assert go(closed, tmp_path / "disk").copied == 0
    assert go(closed, tmp_path / "disk", prune=True).pruned == 0
    assert (copy / "geotags/geo.txt").read_bytes() == b"there"
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()


def test_a_frame_that_came_to_the_copy_alone_is_known_here_to_be_there(closed: Path, tmp_path: Path) -> None:
    copy = go(closed, tmp_path / "disk").destination
    pick_up(copy)
    assert go(closed, tmp_path / "disk", prune=True).pruned == 2
    report = check(closed)
    assert (words_of(report.problems), report.offloaded) == ((), 3)
    with LedgerReader.open(closed / "flight.sqlite") as ledger:
        assert [frame.index for frame in ledger.frames()] == [0, 1, 2]
    (copy / "frames" / "000002.cr2").unlink()
    with pytest.raises(FlightError, match=r"000002.cr2 was offloaded to .* and removed here, and .* lacks it"):
        go(closed, tmp_path / "disk")


@pytest.mark.parametrize("signs", [True, False])
def test_a_prune_signs_what_the_key_signed_there(closed: Path, tmp_path: Path, signs: bool) -> None:
    seal_key.make(tmp_path / "key")
    key = seal_key.load(tmp_path / "key")
    seals.seal(layout.open_folder(closed), CLOCK, seals.Occasion.GEOTAG, key)
    copy = go(closed, tmp_path / "disk").destination
    geotag(copy, b"there", key if signs else None)
    go(closed, tmp_path / "disk", prune=True, key=key)
    assert check(closed, key).vouched == check(copy, key).vouched == ("signed" if signs else "not signed")


def test_a_crash_while_work_comes_home_is_finished_by_the_next_call(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = go(closed, tmp_path / "disk").destination
    geotag(copy, b"there")
    for step in ("adopt", "add_event"):
        with monkeypatch.context() as dying:
            dying.setattr(Ledger, step, lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                go(closed, tmp_path / "disk", prune=True)
        assert sorted(os.listdir(closed / "frames")) == ["000000.cr2", "000000.cr2.xmp", "000001.cr2"]
    assert go(closed, tmp_path / "disk", prune=True).pruned == 2
    assert alike(closed, copy)
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()


def test_two_that_went_apart_are_refused_and_the_way_home_that_is_told_leads_there(
    closed: Path, tmp_path: Path
) -> None:
    copy = go(closed, tmp_path / "disk", prune=True).destination
    geotag(copy, b"there")
    geotag(closed, b"here")
    with pytest.raises(FlightError, match=r"move .* away, and offload again; .* copy them back first"):
        go(closed, tmp_path / "disk", prune=True)
    copy.rename(tmp_path / "away")
    for path in (tmp_path / "away" / "frames").glob("*.cr2"):
        shutil.copy(path, closed / "frames")
    done = go(closed, tmp_path / "disk", prune=True)
    assert done.pruned == 2
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()


def edited(ledger: Path, sql: str) -> None:
    """What another program does to a ledger."""
    with closing(sqlite3.connect(ledger)) as db, db:
        db.execute(sql)


@pytest.mark.parametrize("where", ["here", "at the copy"])
def test_an_edited_ledger_neither_replaces_a_copy_nor_is_replaced(closed: Path, tmp_path: Path, where: str) -> None:
    """Rows that the chain doesn't know, while work here has made the copy's ledger the earlier one."""
    copy = go(closed, tmp_path / "disk").destination
    geotag(closed, b"here")
    edited((closed if where == "here" else copy) / "flight.sqlite", "UPDATE frames SET camera_name = 'B' WHERE idx = 1")
    before = (copy / "flight.sqlite").read_bytes()
    with pytest.raises(FlightError, match=r"the row of frames 1 was changed .*: the copy's ledger was not replaced"):
        go(closed, tmp_path / "disk", prune=True)
    assert (copy / "flight.sqlite").read_bytes() == before
    assert sorted(path.name for path in closed.glob("frames/*.cr2")) == ["000000.cr2", "000001.cr2"]


@pytest.mark.parametrize("key", ["'['", "'[[1]]'", "'[1e999]'", "'[123456789012345678901]'", "'[1,2,3]'"])
def test_a_link_of_the_copy_that_is_none_is_refused_in_a_sentence(closed: Path, tmp_path: Path, key: str) -> None:
    copy = go(closed, tmp_path / "disk").destination
    edited(copy / "flight.sqlite", f"INSERT INTO chain SELECT max(number) + 1, 'frames', {key}, 'a', 'b' FROM chain")  # noqa: S608  ours
    with pytest.raises(FlightError, match=r"flight.sqlite is there already and is no copy|the copy .* is not intact"):
        go(closed, tmp_path / "disk", prune=True)
    assert len(list(closed.glob("frames/*.cr2"))) == 2


def test_a_file_that_changes_after_the_copy_was_checked_does_not_come_home(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be sealed here as if work had written it."""
    geotag(closed, b"before")
    copy = go(closed, tmp_path / "disk").destination
    geotag(copy, b"there")

    def meanwhile(path: Path) -> object:
        found = check(path)
        (copy / "geotags/geo.txt").write_bytes(b"other")
        return found

    monkeypatch.setattr(flight_check, "check", meanwhile)
    with pytest.raises(FlightError, match=r"geo.txt changed while it was copied; try again"):
        go(closed, tmp_path / "disk", prune=True)
    assert (closed / "geotags/geo.txt").read_bytes() == b"before"
    assert len(list(closed.glob("frames/*.cr2"))) == 2


def test_what_comes_home_is_read_back_here(closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk here lies about a list that work at the copy wrote."""
    copy = go(closed, tmp_path / "disk").destination
    geotag(copy, b"there")
    whole = Tree.write

    def lying(tree: Tree, name: str, pieces: Iterable[bytes | memoryview]) -> None:
        whole(tree, name, pieces)
        if tree.path == closed and name == "geotags/geo.txt":
            flip(closed / name, 2)

    monkeypatch.setattr(Tree, "write", lying)
    with pytest.raises(FlightError, match=r"geo.txt reads back different"):
        go(closed, tmp_path / "disk", prune=True)
    assert len(list(closed.glob("frames/*.cr2"))) == 2


def test_a_different_frame_on_another_machine_is_not_written_over(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a network a prune writes every file anew; what is there may be the better one."""
    monkeypatch.setattr(places, "file_system", lambda fd: "nfs4")
    copy = go(closed, tmp_path / "disk").destination
    (closed / "frames" / "000000.cr2").write_bytes(b"rotten")
    with pytest.raises(FlightError, match=r"000000.cr2 is there already and differs from"):
        go(closed, tmp_path / "disk", prune=True)
    assert (copy / "frames" / "000000.cr2").read_bytes() == b"raw 0" * 1000


def test_nobody_works_at_the_destination_meanwhile(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work there would remove files that are half-written as left over from a crash."""
    there = tmp_path / "disk"
    go(closed, there)
    said = []

    def meanwhile(path: Path) -> object:
        try:
            geotag(path, b"at once")
        except FlightError as error:
            said.append(str(error))
        return check(path)

    monkeypatch.setattr(flight_check, "check", meanwhile)
    go(closed, there)
    assert [f"offloads into {there}; wait until it has ended" in text for text in said] == [True]
    with FlightsLock(there, "geotags flights in"), pytest.raises(FlightError, match="geotags flights in"):
        go(closed, there)


def test_an_offload_that_was_cut_short_is_left_to_itself(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody records at the destination, or works on the copy, before the offload is called again."""
    there = tmp_path / "disk"
    with monkeypatch.context() as dying:
        dying.setattr(ledger_copies, "bring", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            go(closed, there)
    copy = there / closed.name
    before = sorted(path.name for path in copy.rglob("*"))
    begun = recording.begin(there, CLOCK)
    begun.close()
    assert any(f"{copy} is the copy of an offload that was cut short" in str(told(one)) for one in begun.recovered)
    assert sorted(path.name for path in copy.rglob("*")) == before
    assert any(
        "an offload to this folder was cut short: run it again" in text for text in words_of(check(copy).problems)
    )
    assert go(closed, there, prune=True).pruned == 2
    assert words_of(check(copy).problems) == words_of(check(closed).problems) == ()


def test_work_waits_for_the_rest_of_a_copy(closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = tmp_path / "disk"
    copy = go(closed, there).destination
    pick_up(closed)
    with monkeypatch.context() as dying:
        dying.setattr(ledger_copies, "bring", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            go(closed, there)
    with pytest.raises(FlightError, match="run that offload again first"):
        geotag(copy, b"too early")
    assert go(closed, there, prune=True).pruned == 3
    geotag(copy, b"in time")
    assert words_of(check(copy).problems) == ()


@pytest.mark.timeout(30)
def test_a_pipe_at_the_destination_is_not_waited_for(closed: Path, tmp_path: Path) -> None:
    copy = go(closed, tmp_path / "disk", prune=True).destination
    (copy / "frames/000000.cr2").unlink()
    os.mkfifo(copy / "frames/000000.cr2")
    with pytest.raises(FlightError, match=r"000000.cr2"):
        go(closed, tmp_path / "disk")
