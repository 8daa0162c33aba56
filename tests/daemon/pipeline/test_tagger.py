"""The tag."""

from __future__ import annotations

from dappled.daemon.navigation import BodyLatency
from dappled.daemon.navigation.clocks import mid_exposure
from dappled.daemon.pipeline import tagging
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.flight import Frame
from tests.daemon.fakes import no_pose

LATENCY = BodyLatency(60.0, 15.0)


def test_what_a_file_does_not_say_stays_unknown() -> None:
    frame = Frame(3, "frames/000003.dng", "IMG.DNG", 5, "ab", 9)
    made = tagging.tag(frame, mid_exposure(0, LATENCY, None), ExposureSettings(), camera="c", mask="m", pose=no_pose())
    assert (made.index, made.frame_sha256, made.camera, made.mask) == (3, "ab", "c", "m")
    assert (made.focal_length_mm, made.f_number, made.exposure_s, made.iso) == (None,) * 4
