"""Mid-exposure and the tag."""

from __future__ import annotations

import pytest

from dappled.daemon.pipeline import tagger
from dappled.daemon.pipeline.tagger import BodyLatency, FrameSettings
from dappled.flight import Frame
from tests.daemon.fakes import no_pose

LATENCY = BodyLatency(60.0, 15.0, "measured")


def test_mid_exposure_is_latency_and_half_the_exposure_after_the_call() -> None:
    found = tagger.mid_exposure(1_000, LATENCY, 0.02)
    assert (found.utc_ns, found.sigma_ns, found.source) == (70_001_000, 15_000_000, "measured")
    assert tagger.mid_exposure(0, LATENCY, None).utc_ns == 60_000_000


def test_what_a_file_does_not_say_stays_unknown() -> None:
    frame = Frame(3, "frames/000003.dng", "IMG.DNG", 5, "ab", 9)
    made = tagger.tag(
        frame, tagger.mid_exposure(0, LATENCY, None), FrameSettings(), camera="c", mask="m", pose=no_pose()
    )
    assert (made.index, made.frame_sha256, made.camera, made.mask) == (3, "ab", "c", "m")
    assert (made.focal_length_mm, made.f_number, made.exposure_s, made.iso) == (None,) * 4


def test_a_wish_is_a_poor_witness_of_the_exposure() -> None:
    """Nobody saw the trigger call: it came between the wish and the file."""
    found = tagger.by_wish(0, 3_070_000_000, LATENCY, 0.02)
    assert found.utc_ns == 70_000_000
    assert found.source == "wish + body latency"
    assert found.sigma_ns == pytest.approx(2.99e9 / 3**0.5, rel=1e-3)
    assert found.called_utc_ns == 0
    early = tagger.by_wish(0, 10_000_000, LATENCY, None)
    assert early.sigma_ns == 15_000_000  # a stamp before the exposure bounds nothing
    assert tagger.by_wish(0, None, LATENCY, None).sigma_ns > 500_000_000
