"""What a person may say of files that are brought after landing, and what is refused before anything is recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.replay import pickup
from dappled.daemon.replay.pickup import Choice, PickupError
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.sources import parse_source
from dappled.flight import recording
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import request, shot


def test_a_file_is_no_frame_of_a_shot_that_never_fired(tmp_path: Path) -> None:
    """Shot 0 was fired and its file stayed at the camera; shot 1 found no camera."""
    flight = recording.begin(tmp_path / "flights", RecordedClock(START_UTC_NS))
    request(flight, 0)
    flight.journal.note(shot(1))
    flight.ledger.add_shot(shot(1))
    flight.ledger.follows(0, "its file stays at the camera")
    flight.ledger.failed(1, "the camera was absent")
    flight.close()
    card = tmp_path / "card"
    card.mkdir()
    (card / "DSCF0001.RAF").write_bytes(b"a frame")
    source = parse_source(str(card), PtpSource)
    with pytest.raises(PickupError, match=r"shot 1 never fired, according to the flight: the camera was absent$"):
        pickup.propose(flight.folder.path, source, Choice(pairs={1: "DSCF0001.RAF"}))
    proposal = pickup.propose(flight.folder.path, source, Choice(pairs={0: "DSCF0001.RAF"}))
    assert [index for index, _ in proposal.pairs] == [0]
