"""What is written of a flight."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled import codec
from dappled.clock import SystemClock
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.drivers.camera import Blob, Fired
from dappled.drivers.raw.recipe import DECISION, LawDecision, Recipe, of_flight
from dappled.errors import DappledError
from dappled.flight import Cause, FlightError, Frame, Shot, Tag, TimeSource, layout, recording
from tests.daemon.fakes import no_pose

SHOT = Shot(0, Cause("test", "console", 1), 10, 20)
DATA = b"raw bytes"


def tag(frame: Frame) -> Tag:
    return Tag(
        frame.index, 1, 2, TimeSource.HOT_SHOE, 50.0, 8.0, 0.001, 100.0, "camera", "mask", frame.sha256, no_pose()
    )


def recorded(writer: LedgerWriter, index: int | None, data: bytes = DATA) -> Frame:
    blob = Blob.of(data)
    try:
        return writer.record(index, "IMG_0001.DNG", blob)
    finally:
        blob.close()


def test_a_shot_is_entered_fired_and_recorded(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock())
    writer = LedgerWriter(flight, SystemClock())
    assert LedgerWriter(flight, SystemClock()).frame_bytes is None
    flight.journal.note(SHOT)
    writer.requested(SHOT)
    writer.fired(Fired(0, 30, 40))
    row = flight.ledger.shot(0)
    assert row is not None
    assert (row.state, row.fired_called_monotonic_ns) == ("fired", 30)
    frame = recorded(writer, 0)
    assert writer.frame(0) == frame
    assert writer.frame_bytes == len(DATA)
    jpeg = Blob.of(b"beside it")
    writer.companion(0, "IMG_0001.JPG", jpeg)
    jpeg.close()
    assert writer.frame_bytes == len(DATA) + len(b"beside it")
    assert Path(writer.path(frame)).read_bytes() == DATA
    entry = flight.index.lookup(0)
    assert entry is not None
    assert (entry.state, entry.frame) == ("safe", frame.name)
    assert flight.close() == []


def test_the_law_of_a_flight_is_written_down_and_read_with_its_recipe(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock(), {"settings": {"mask": {"profile": "mask-2"}}})
    decision = LawDecision("geometric", (1.01, 0.02, -0.02, 1.01), 3, "why")
    LedgerWriter(flight, SystemClock()).law_decided(decision)
    (event,) = [event for event in flight.ledger.events() if event.kind == "law"]
    assert (event.index, event.words) == (3, "decoded by the law geometric from frame 3 on")
    facts = layout.read_facts(flight.folder)
    made = of_flight(flight.folder.path, facts, {})
    assert made is not None
    assert made.decided == decision
    assert codec.read(Recipe, codec.plain(made)) == made
    asked = of_flight(flight.folder.path, facts, {"law": "fd"})
    assert asked is not None
    assert asked.decided is None
    facts[DECISION]["law"] = "none"
    with pytest.raises(DappledError, match=r"flight\.toml: the law"):
        of_flight(flight.folder.path, facts, {})
    assert flight.close() == []


def test_a_frame_is_safe_even_when_the_index_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    flight = recording.begin(tmp_path, SystemClock())
    writer = LedgerWriter(flight, SystemClock())
    flight.journal.note(SHOT)
    writer.requested(SHOT)

    def refuse(_: object) -> None:
        raise FlightError("the index is locked")

    with monkeypatch.context() as broken:
        broken.setattr(flight.index, "put", refuse)
        assert recorded(writer, 0).index == 0
    assert "the index is locked" in caplog.text
    flight.close()


def test_a_file_without_a_shot_is_kept_and_told(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock())
    writer = LedgerWriter(flight, SystemClock())
    with pytest.raises(DappledError, match="stray"):
        recorded(writer, None)
    assert [stray.camera_name for stray in flight.ledger.strays()] == ["IMG_0001.DNG"]
    flight.close()
