"""Mid-exposure and the tag."""

from __future__ import annotations

from dappled.daemon import tagger
from dappled.daemon.tagger import BodyLatency, Settings
from dappled.flight.records import Frame
from tests.daemon.fakes import no_pose

LATENCY = BodyLatency(60.0, 15.0, "measured")


def test_mid_exposure_is_latency_and_half_the_exposure_after_the_call() -> None:
    found = tagger.mid_exposure(1_000, LATENCY, 0.02)
    assert (found.utc_ns, found.sigma_ns, found.source) == (70_001_000, 15_000_000, "measured")
    assert tagger.mid_exposure(0, LATENCY, None).utc_ns == 60_000_000


def test_what_a_file_does_not_say_stays_unknown() -> None:
    frame = Frame(3, "frames/000003.dng", "IMG.DNG", 5, "ab", 9)
    made = tagger.tag(frame, tagger.mid_exposure(0, LATENCY, None), Settings(), camera="c", mask="m", pose=no_pose())
    assert (made.index, made.frame_sha256, made.camera, made.mask) == (3, "ab", "c", "m")
    assert (made.focal_length_mm, made.f_number, made.exposure_s, made.iso) == (None,) * 4
