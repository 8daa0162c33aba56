"""A whole flight in virtual time: the laws of the pipeline hold over it, and its seed gives every byte of it."""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from dappled.drivers.mavlink import PacketParser, mavlink
from dappled.drivers.mavlink.framing import message_of
from dappled.flight import LedgerReader
from dappled.mocks.autopilot.autopilot import BootTime
from tests.simulated.bad_link import LinkFaults
from tests.simulated.virtual_flight import Plan, VirtualFlight, fly
from tests.system.flying import assert_whole

TEN_MINUTES = Plan(seed=1, frames=60, interval_s=9.8, hz=5.0, cuts=((100.0, 112.0), (400.0, 403.0)))
TWO_MINUTES = replace(TEN_MINUTES, frames=20, interval_s=5.8, cuts=((20.0, 32.0), (80.0, 83.0)))


HOUR = Plan(
    seed=1,
    frames=600,
    interval_s=5.9,
    cuts=((600.0, 640.0), (1500.0, 1502.0), (3000.0, 3100.0)),
    boot=BootTime(jumps=((1800.0, 1.5),)),
)


@dataclass
class Announcements:
    """Looks at the disk whenever the daemon announces a photograph: its frame must be safe by then."""

    folder: Path
    seen: int = 0
    early: list[int] = field(default_factory=list)

    def __call__(self, data: bytes) -> None:
        if message_of(data) != mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED:
            return
        message = PacketParser()(data)
        assert message is not None
        if message.capture_result != 1:
            return
        self.seen += 1
        (flight,) = (one.parent for one in self.folder.glob("flights/*/flight.sqlite"))
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            frame, shot = ledger.frame(message.image_index), ledger.shot(message.image_index)
        if shot is None or shot.state != "safe" or frame is None or not (flight / frame.name).exists():
            self.early.append(message.image_index)


def rows(flight: Path) -> Iterator[tuple[str, list[tuple[object, ...]]]]:
    """Every row of the ledger, by table."""
    ledger = sqlite3.connect(flight / "flight.sqlite")
    for (table,) in ledger.execute("select name from sqlite_master where type = 'table' order by name").fetchall():
        yield table, ledger.execute(f"select * from {table}").fetchall()  # noqa: S608  # its own names
    ledger.close()


def lawful(plan: Plan, folder: Path) -> VirtualFlight:
    """Fly the plan; the laws of the pipeline must hold."""
    announced = Announcements(folder)
    flown = fly(plan, folder, announced)
    assert announced.early == []
    assert_whole(flown.folder)
    with LedgerReader.open(flown.folder / "flight.sqlite") as ledger:
        states = {row.shot.index: row.state for row in ledger.shots()}
    assert set(states.values()) <= {"safe", "failed"}
    assert announced.seen >= list(states.values()).count("safe")
    assert len(states) <= len(flown.outcomes) == plan.frames, "a repeated request became a second photograph"
    for outcome in flown.outcomes:
        if outcome.index is None:
            assert outcome.reason, "a request without an end"
        else:
            assert states[outcome.index] == ("safe" if outcome.ok else "failed")
    return flown


@pytest.mark.parametrize("plan", [TWO_MINUTES, pytest.param(TEN_MINUTES, marks=pytest.mark.long)], ids=["2", "10"])
def test_minutes_over_a_bad_link_are_lawful(plan: Plan, tmp_path: Path) -> None:
    """Two cuts of the links, packets lost, doubled and late, and every fiftieth shot a failure."""
    flown = lawful(plan, tmp_path)
    assert flown.seconds > 0.98 * plan.frames * plan.interval_s
    assert sum(one.ok for one in flown.outcomes) > 0.84 * plan.frames


def by_seed(plan: Plan, folder: Path) -> VirtualFlight:
    """The plan's flight. A second one has every packet and every row of it."""
    first = lawful(plan, folder)
    record = dict(rows(first.folder))
    shutil.rmtree(folder)  # the same path again: sentences have it
    second = lawful(plan, folder)
    assert second.sent == first.sent
    assert dict(rows(second.folder)) == record
    return first


def test_the_seed_gives_every_packet_and_every_row(tmp_path: Path) -> None:
    minute = Plan(seed=1, frames=8, interval_s=5.0, hz=5.0, cuts=((20.0, 23.0),))
    flown = by_seed(minute, tmp_path / "one")
    assert fly(replace(minute, seed=2), tmp_path / "other").sent != flown.sent


def test_files_from_a_folder_over_a_very_bad_link(tmp_path: Path) -> None:
    """Every sixth packet lost or torn, some doubled, most late, so that they overtake each other. By this seed, the
    answer to the first question is lost."""
    faults = LinkFaults(loss=0.15, doubles=0.1, late_s=0.8, torn=0.03, garbage=0.03)
    plan = Plan(seed=9, frames=8, interval_s=2.0, hz=2.0, faults=faults, cuts=((20.0, 24.0),), by_files=True)
    by_seed(plan, tmp_path / "one")


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_an_hour_with_600_requests_is_lawful_and_the_same_by_seed(tmp_path: Path) -> None:
    """With attitudes at 50 Hz, three cuts of the links, and 1.5 s that the autopilot's clock gains at once."""
    began_s = time.process_time()
    flown = by_seed(HOUR, tmp_path / "one")
    assert flown.seconds > 3500
    assert time.process_time() - began_s < 2 * 150  # of a core that other programs use too: 65 s an hour alone


@pytest.mark.parametrize("seed", range(1, 5))
def test_threads_that_change_at_locks_and_writes_leave_a_flight_whole(seed: int, tmp_path: Path) -> None:
    """Each lock, write, fsync and statement of the ledger may hold its thread for some milliseconds, while others run.
    Without the locks around the telemetry log, no flight of these is whole."""
    lawful(Plan(seed, 6, 1.0, hz=5.0, switches=True), tmp_path)
