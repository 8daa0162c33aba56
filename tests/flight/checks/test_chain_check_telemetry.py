"""Telemetry is vouched for block by block, also in a flight that was never closed."""

from __future__ import annotations

import time

import pytest

from dappled.findings import Code
from dappled.flight import FlightFolder, LedgerReader, Recording
from dappled.flight.checks.flight_check import check
from dappled.flight.logs import BLOCK_BYTES
from tests.flight.checks.test_chain_check import attacked
from tests.flight.makers import CARD_FULL, flip, mavlink_2, words_of


@pytest.fixture
def folder(flight: Recording) -> FlightFolder:
    """A flight that is being recorded, with more than two blocks of telemetry."""
    while flight.telemetry.append(1, mavlink_2(b"x" * 200)) < 2.5 * BLOCK_BYTES / 220:
        pass
    deadline = time.monotonic() + 60
    while len(flight.telemetry.blocks(0)) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    flight.ledger.add_event("camera", CARD_FULL)  # a row takes the blocks with it
    flight.ledger.add_event("camera", CARD_FULL)  # and the next one doesn't again
    return flight.folder


def blocks(folder: FlightFolder) -> int:
    with attacked(folder) as db:
        return int(db.execute("SELECT count(*) FROM chain WHERE subject = 'telemetry.tlog'").fetchone()[0])


def test_each_block_is_linked_once(folder: FlightFolder) -> None:
    assert blocks(folder) == 2
    assert words_of(check(folder.path).problems) == ()


@pytest.mark.parametrize(("at", "start"), [(3, 0), (BLOCK_BYTES + 1000, BLOCK_BYTES)])
def test_the_block_that_was_changed_is_named(folder: FlightFolder, at: int, start: int) -> None:
    flip(folder.telemetry, at)
    (problem,) = [one for one in check(folder.path).problems if one.code is Code.TELEMETRY_BLOCK_CHANGED]
    assert problem.number("start") <= at
    assert abs(problem.number("start") - start) < 300


def test_a_log_that_is_cut_or_gone_is_named(folder: FlightFolder) -> None:
    folder.telemetry.write_bytes(folder.telemetry.read_bytes()[: BLOCK_BYTES + 5000])
    assert any("telemetry.tlog was changed between" in text for text in words_of(check(folder.path).problems))
    folder.telemetry.unlink()
    assert any("telemetry.tlog is missing, and the chain" in text for text in words_of(check(folder.path).problems))


def test_blocks_stay_vouched_for_when_the_flight_is_closed(folder: FlightFolder, flight: Recording) -> None:
    flight.close()
    assert words_of(check(folder.path).problems) == ()
    with LedgerReader.open(folder.ledger) as ledger:
        assert ledger.facts()["telemetry_bytes"] > 2 * BLOCK_BYTES
    flip(folder.telemetry, 3)
    assert any("between bytes 0 and" in text for text in words_of(check(folder.path).problems))
