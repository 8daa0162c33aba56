"""What a replay compares with the record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled.daemon.replay.verifier import Expected, ReplayVerifier
from dappled.drivers.camera import Blob
from dappled.errors import DappledError
from dappled.findings import named
from dappled.flight import Cause, Frame, Result, Shot, ShotRow, Tag, TimeSource, digest
from tests.daemon.fakes import no_pose
from tests.standing import failure

SHOT = Shot(0, Cause("test", "console", 1), 10, 20)
DATA = b"raw bytes"


def tag(frame: Frame) -> Tag:
    return Tag(
        frame.index, 1, 2, TimeSource.HOT_SHOE, 50.0, 8.0, 0.001, 100.0, "camera", "mask", frame.sha256, no_pose()
    )


def replay(tmp_path: Path, **digests: Any) -> tuple[ReplayVerifier, Frame]:
    """The verifier of a replay of one frame, which stands on disk."""
    blob = Blob.of(DATA)
    from dappled import durable  # noqa: PLC0415  # used here only

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


def play(verifier: ReplayVerifier, frame: Frame, data: bytes = DATA, slices: str = "5" * 64) -> list[str]:
    blob = Blob.of(data) if data else Blob(Blob.of(b"x").fd, 0)
    verifier.record(0, "IMG.DNG", blob)
    blob.close()
    verifier.tagged(tag(frame))
    verifier.decoded(Result(0, slices, 1, 1, "geometric", "predicted", 1.0, "replay"))
    return said(verifier)


def said(verifier: ReplayVerifier) -> list[str]:
    return [str(named(one)) for one in verifier.verdict()]


def test_the_same_again_has_no_differences(tmp_path: Path) -> None:
    verifier, frame = replay(tmp_path)
    assert play(verifier, frame) == []
    assert verifier.tag(0) == tag(frame)


@pytest.mark.parametrize("data", [b"raw bytez", b"raw", b""])
def test_other_bytes_are_a_difference(tmp_path: Path, data: bytes) -> None:
    verifier, frame = replay(tmp_path)
    assert any("is not the file that was recorded" in text for text in play(verifier, frame, data))


@pytest.mark.parametrize("what", ["pose", "tag", "slices"])
def test_another_or_a_missing_hash_is_a_difference(tmp_path: Path, what: str) -> None:
    verifier, frame = replay(tmp_path, **{f"{what}_sha256": "0" * 64})
    assert play(verifier, frame) == [f"frame 0: the {what} came out different"]
    verifier, frame = replay(tmp_path, **{f"{what}_sha256": None})
    assert play(verifier, frame) == [f"frame 0: the record holds no hash of its {what}"]


def test_a_frame_that_the_flight_left_undecoded_has_no_slices_to_differ(tmp_path: Path) -> None:
    left = {"slices_sha256": None, "undecoded": True}
    verifier, frame = replay(tmp_path, **left)
    assert play(verifier, frame) == []  # the replay could decode it
    verifier, frame = replay(tmp_path, **left)
    recorded_again = Blob.of(DATA)
    verifier.record(0, "IMG_0001.DNG", recorded_again)
    verifier.tagged(tag(frame))
    assert said(verifier) == []  # nor can the replay
    verifier, frame = replay(tmp_path, undecoded=True)
    verifier.tagged(tag(frame))
    assert said(verifier) == ["frame 0: the replay made no slices"]  # somebody decoded it after all


def test_what_did_not_come_is_a_difference(tmp_path: Path) -> None:
    verifier, _ = replay(tmp_path)
    verifier.failed(0, failure("can't be read"))
    text = "\n".join(said(verifier))
    for word in ("frame 0: can't be read", "made no pose", "made no tag", "made no slices"):
        assert word in text
    with pytest.raises(DappledError, match="no recorded frame"):
        verifier.record(None, "x", Blob.of(b"x"))


RECORDED = {"count": 64, "largest": 2.0, "sums": [1.0] * 64}


def elsewhere(tmp_path: Path, frame_tag: Tag | None, share: float | None) -> tuple[list[str], Any]:
    """What a replay says whose hashes differ from those recorded on another machine, and whose slices by `share`."""
    _, frame = replay(tmp_path)
    row = ShotRow(SHOT, "safe", None, 30, 40)
    numbers = None if share is None else RECORDED
    expected = Expected(row, frame, "0" * 64, "0" * 64, "0" * 64, frame_tag or tag(frame), numbers)
    verifier = ReplayVerifier(tmp_path, [expected], elsewhere="aarch64")
    verifier.tagged(tag(frame))
    found = {**RECORDED, "sums": [1.0] * 63 + [1.0 + 2.0 * (share or 0.0)]}
    verifier.decoded(Result(0, "5" * 64, 1, 1, "geometric", "predicted", 1.0, "replay", {"fingerprint": found}))
    return said(verifier), verifier


def test_rounding_of_another_machine_is_no_difference(tmp_path: Path) -> None:
    told, verifier = elsewhere(tmp_path, None, 2e-7)
    assert told == []
    assert (verifier.close, verifier.furthest) == (3, (pytest.approx(2e-7), 0))


def test_more_than_rounding_is_a_difference_also_elsewhere(tmp_path: Path) -> None:
    told, _ = elsewhere(tmp_path, None, 3e-6)
    assert told == ["frame 0: the slices differ by 3.0e-06 of the frame's largest value, recorded on aarch64"]
    _, frame = replay(tmp_path)
    for change, fine in (
        ({"utc_ns": 2}, True),
        ({"utc_ns": 3}, False),
        ({"f_number": 8.0 + 1e-9}, True),
        ({"f_number": 8.0 + 1e-7}, False),
        ({"index": 1}, False),
        ({"camera": "another"}, False),
        ({"iso": None}, False),
    ):
        told, _ = elsewhere(tmp_path, replace(tag(frame), **change), 0.0)
        assert told == ([] if fine else ["frame 0: the tag differs by more than 1e-9"]), change


def test_an_older_flight_can_t_be_compared_elsewhere(tmp_path: Path) -> None:
    (told,) = elsewhere(tmp_path, None, None)[0]
    assert "recorded elsewhere (aarch64), without the numbers that could be compared" in told
