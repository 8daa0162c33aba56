"""What the street writes, and what a replay compares."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from dappled.clock import SystemClock
from dappled.daemon.pipeline.flight_writer import Expected, LedgerWriter, ReplayVerifier
from dappled.drivers.camera import Blob, Fired
from dappled.errors import DappledError
from dappled.flight import Cause, FlightError, Frame, Result, Shot, ShotRow, Tag, digest, recording
from tests.daemon.fakes import no_pose

SHOT = Shot(0, Cause("test", "console", 1), 10, 20)
DATA = b"raw bytes"


def tag(frame: Frame) -> Tag:
    return Tag(frame.index, 1, 2, "test", 50.0, 8.0, 0.001, 100.0, "camera", "mask", frame.sha256, no_pose())


def recorded(writer: LedgerWriter, index: int | None, data: bytes = DATA) -> Frame:
    blob = Blob.of(data)
    try:
        return writer.record(index, "IMG_0001.DNG", blob)
    finally:
        blob.close()


def test_a_wish_is_entered_with_the_first_word_of_its_shot(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock().utc_ns)
    writer = LedgerWriter(flight, SystemClock())
    flight.journal.note(SHOT)
    writer.requested(SHOT)
    assert flight.ledger.shot(0) is None
    writer.fired(Fired(0, 30, 40))
    row = flight.ledger.shot(0)
    assert row is not None
    assert (row.state, row.fired_called_monotonic_ns) == ("fired", 30)
    frame = recorded(writer, 0)
    assert writer.frame(0) == frame
    assert Path(writer.path(frame)).read_bytes() == DATA
    entry = flight.index.lookup(0)
    assert entry is not None
    assert (entry.state, entry.frame) == ("safe", frame.name)
    assert flight.close() == []


def test_a_wish_that_the_ledger_refused_once_is_entered_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = recording.begin(tmp_path, SystemClock().utc_ns)
    writer = LedgerWriter(flight, SystemClock())
    flight.journal.note(SHOT)
    writer.requested(SHOT)

    def refuse(_: Shot) -> None:
        raise FlightError("the disk is full")

    with monkeypatch.context() as broken:
        broken.setattr(flight.ledger, "add_shot", refuse)
        with pytest.raises(FlightError):
            writer.fired(Fired(0, 30, 40))
    assert recorded(writer, 0).index == 0
    assert flight.close() == []


def test_a_frame_is_safe_even_when_the_index_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    flight = recording.begin(tmp_path, SystemClock().utc_ns)
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
    flight = recording.begin(tmp_path, SystemClock().utc_ns)
    writer = LedgerWriter(flight, SystemClock())
    with pytest.raises(DappledError, match="stray"):
        recorded(writer, None)
    assert [stray.camera_name for stray in flight.ledger.strays()] == ["IMG_0001.DNG"]
    flight.close()


def replay(tmp_path: Path, **digests: Any) -> tuple[ReplayVerifier, Frame]:
    """The book of a replay of one frame, which stands on disk."""
    blob = Blob.of(DATA)
    from dappled.flight import durable  # noqa: PLC0415  # used here only

    frame = Frame(0, "000000.dng", "IMG.DNG", len(DATA), durable.hash_descriptor(blob.fd, blob.size), 5)
    blob.close()
    row = ShotRow(SHOT, "safe", None, 30, 40)
    given: dict[str, Any] = {
        "pose_sha256": digest(no_pose()),
        "tag_sha256": digest(tag(frame)),
        "slices_sha256": "5" * 64,
        **digests,
    }
    return ReplayVerifier(tmp_path, [Expected(row, frame, **given)]), frame


def play(writer: ReplayVerifier, frame: Frame, data: bytes = DATA, slices: str = "5" * 64) -> list[str]:
    blob = Blob.of(data) if data else Blob(Blob.of(b"x").fd, 0)
    writer.record(0, "IMG.DNG", blob)
    blob.close()
    writer.tagged(tag(frame))
    writer.decoded(Result(0, slices, 1, 1, "geometric", "predicted", 1.0, "replay"))
    return writer.verdict()


def test_the_same_again_has_no_differences(tmp_path: Path) -> None:
    writer, frame = replay(tmp_path)
    assert play(writer, frame) == []
    assert writer.tag(0) == tag(frame)


@pytest.mark.parametrize("data", [b"raw bytez", b"raw", b""])
def test_other_bytes_are_a_difference(tmp_path: Path, data: bytes) -> None:
    writer, frame = replay(tmp_path)
    assert any("is not the file that was recorded" in text for text in play(writer, frame, data))


@pytest.mark.parametrize("what", ["pose", "tag", "slices"])
def test_another_or_a_missing_hash_is_a_difference(tmp_path: Path, what: str) -> None:
    writer, frame = replay(tmp_path, **{f"{what}_sha256": "0" * 64})
    assert play(writer, frame) == [f"frame 0: its {what} came out different"]
    writer, frame = replay(tmp_path, **{f"{what}_sha256": None})
    assert play(writer, frame) == [f"frame 0: the record holds no hash of its {what}"]


def test_a_frame_that_the_flight_left_undecoded_has_no_slices_to_differ(tmp_path: Path) -> None:
    left = {"slices_sha256": None, "told": frozenset({"not decoded"})}
    writer, frame = replay(tmp_path, **left)
    assert play(writer, frame) == []  # the replay could decode it
    writer, frame = replay(tmp_path, **left)
    recorded_again = Blob.of(DATA)
    writer.record(0, "IMG_0001.DNG", recorded_again)
    writer.tagged(tag(frame))
    assert writer.verdict() == []  # nor can the replay
    writer, frame = replay(tmp_path, told=frozenset({"not decoded"}))
    writer.tagged(tag(frame))
    assert writer.verdict() == ["frame 0: its slices did not come out of the replay"]  # somebody decoded it after all


def test_what_did_not_come_is_a_difference(tmp_path: Path) -> None:
    writer, _ = replay(tmp_path)
    writer.failed(0, "can't be read")
    text = "\n".join(writer.verdict())
    for word in ("frame 0: can't be read", "its pose did not", "its tag did not", "its slices did not"):
        assert word in text
    with pytest.raises(DappledError, match="no recorded frame"):
        writer.record(None, "x", Blob.of(b"x"))
