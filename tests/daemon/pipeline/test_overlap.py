"""The overlap of the last two photographs, and what is said of a vehicle that is too fast."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dappled.config.settings import PoseSettings
from dappled.daemon.pipeline.overlap import OverlapWatch
from dappled.decode.geometry import from_euler, metres_per_radian
from dappled.findings import Code, remedy, text
from dappled.flight import Frame, Tag
from tests.daemon.fakes import no_pose
from tests.daemon.pipeline.test_spacing import HOME, Rig
from tests.flight.makers import tag

S = 10**9
SEEN_M = 20.0 * 0.4  # at 20 m, along the way of a level camera whose rows lie across it
FRAME = Frame(0, "frames/000000.cr2", "IMG_0001.CR2", 3, "00", 0)


def watch(wanted: float) -> OverlapWatch:
    return OverlapWatch(Rig(), PoseSettings().mount, wanted)


def at(index: int, north_m: float, seconds: float, height_m: float | None = 20.0) -> Tag:
    """A frame of a level vehicle that flies north."""
    per_radian, _ = metres_per_radian(HOME[0], HOME[2])
    place = replace(
        no_pose(),
        latitude_rad=HOME[0] + north_m / per_radian,
        longitude_rad=HOME[1],
        altitude_msl_m=HOME[2],
        height_above_home_m=height_m,
        velocity_ned_m_s=(5.0, 0.0, 0.0),
        attitude=from_euler(0.0, 0.0, 0.0),
    )
    return replace(tag(FRAME), index=index, utc_ns=round(seconds * S), pose=place)


def test_two_photographs_overlap_by_what_both_see() -> None:
    one = watch(0.0)
    one.take(at(0, 0.0, 10.0))
    assert one.last(11 * S) is None
    one.take(at(1, 2.0, 10.5))
    found = one.last(11 * S)
    assert found is not None
    assert found.frame == 1
    assert (found.apart_m, found.share) == pytest.approx((2.0, 1 - 2 / SEEN_M), abs=1e-6)
    assert found.speed_m_s == pytest.approx(4.0)
    one.take(at(0, 0.0, 10.0))  # a file that comes late
    assert one.last(11 * S) == found
    assert one.last(27 * S) is None, "the series is over"


def test_too_fast_is_told_with_the_speed_that_would_do() -> None:
    one = watch(0.7)
    one.take(at(0, 0.0, 10.0))
    one.take(at(1, 4.0, 11.0))
    found = one.trouble(11 * S)
    assert found is not None
    assert found.code is Code.SERIES_TOO_FAST
    assert str(text(found)) == (
        "too fast: the last two photographs are 4.0 m apart at 4.0 m/s, and overlap by 50% where 70% are wanted"
    )
    assert str(remedy(found)) == "fly at 2.4 m/s or slower"  # 0.3 of 8 m in a second
    one.take(at(2, 6.3, 12.0))
    assert one.trouble(12 * S) is None


def test_a_gap_is_no_overlap_and_without_a_wanted_one_nothing_is_too_fast() -> None:
    for wanted, codes in ((0.5, [Code.SERIES_TOO_FAST]), (0.0, [])):
        one = watch(wanted)
        one.take(at(0, 0.0, 10.0))
        one.take(at(1, 10.0, 12.0))
        last, found = one.last(12 * S), one.trouble(12 * S)
        assert last is not None
        assert last.share == pytest.approx(-0.25, abs=1e-6)
        assert ([] if found is None else [found.code]) == codes
        if found is not None:
            assert found.facts["overlap"] == 0.0


def test_what_is_not_known_is_not_judged() -> None:
    for low in (None, 1.0):
        one = watch(0.9)
        one.take(at(0, 0.0, 10.0))
        one.take(at(1, 100.0, 11.0, low))
        assert one.trouble(11 * S) is None
