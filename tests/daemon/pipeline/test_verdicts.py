"""Verdicts of frames: each finding with its bound, what can't be judged, and what a flight keeps of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.config.profiles import VerdictBounds
from dappled.config.settings import PlannedBody
from dappled.daemon.body_plan import exposure_of, plan_of
from dappled.daemon.pipeline.picture_facts import PictureFacts, defocus, detail, fine_detail, fineness, noise_of
from dappled.daemon.pipeline.verdicts import (
    FixedPlan,
    FrameFacts,
    Judge,
    Verdict,
    unjudged,
    verdict,
)
from dappled.decode.geometry import FrameGeometry, Gnss, GroundHeight, Pose, from_euler, image_motion, turned
from dappled.findings import FRAME, Code, Finding, finding, text
from dappled.flight import Tag, TimeSource
from tests.daemon.fakes import no_pose

NADIR = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
BOUNDS = VerdictBounds()
GOOD = FrameFacts(
    blur_px=1.5,
    blur_view_px=0.2,
    blur_unknown=None,
    height_m=60.0,
    height_source="above the take-off place",
    clipped_share=0.0,
    black_share=0.0,
    mean_share=0.2,
    defocus_view_px=0.1,
    focus_unknown=None,
    carriers_found=24,
    carriers_predicted=24,
    doubts=(),
    off_plan=(),
    pose_source="interpolated",
    position_sigma_m=1.0,
    gnss_fix=3,
)
SHARP = (0.59, 1.0, 1.7)  # power that falls as f^-2, over 1, 2 and 4 pixels
SEEN = PictureFacts(0.0, 0.0, 0.2, (SHARP, SHARP), 0.0, (20.0, 30.0), (0.05, 0.05), (0.01, 0.01))
GNSS = Gnss(3, 12, 0.8, 1.2, 1.0, 1.5, 0.2, 100.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def flown(**known: object) -> Pose:
    pose = replace(
        no_pose(),
        source="interpolated",
        velocity_ned_m_s=(10.0, 0.0, 0.0),
        attitude=LEVEL,
        height_above_home_m=100.0,
        position_sigma_m=1.0,
        gnss=GNSS,
    )
    return replace(pose, **known)  # type: ignore[arg-type]  # a test names the fields


def tag(pose: Pose, exposure_s: float | None = 1e-3, *, sigma_ns: int = 0, doubts: tuple[Finding, ...] = ()) -> Tag:
    source = TimeSource.TRIGGER_CALL
    return Tag(7, 0, sigma_ns, source, 50.0, 8.0, exposure_s, 100.0, "body", "mask", "0" * 64, pose, doubts)


def judged(pose: Pose, *, exposure_s: float | None = 1e-3, rates: tuple[float, float, float] | None = (0, 0, 0)):  # type: ignore[no-untyped-def]  # a Verdict
    judge = Judge(NADIR, on_gimbal=False)
    for _ in range(5):
        found = judge.judge(tag(pose, exposure_s), rates, SEEN, carriers=(24, 24), doubts=())
    return found


@pytest.mark.parametrize(
    ("facts", "state", "word"),
    [
        (GOOD, "good", ""),
        (replace(GOOD, blur_view_px=0.7), "usable", "motion blur 0.7 view pixels (1.5 on the sensor)"),
        (replace(GOOD, blur_view_px=1.3), "bad", "motion blur 1.3"),
        (replace(GOOD, blur_px=2.5), "usable", "motion blur 0.2 view pixels (2.5 on the sensor)"),
        (replace(GOOD, picture_px=2.4), "usable", "own resolution is out of focus by 2.4 px"),
        (replace(GOOD, picture_px=1.6), "good", ""),
        (replace(GOOD, picture_px=9.0, defocus_view_px=2.0), "bad", "out of focus by 2.0"),
        (
            replace(GOOD, blur_view_px=None, blur_px=None, blur_unknown=finding(Code.BLUR_NO_HEIGHT, FRAME)),
            "unknown",
            "no height",
        ),
        (replace(GOOD, clipped_share=0.02), "usable", "2.0% of its pixels are clipped"),
        (replace(GOOD, clipped_share=0.06), "bad", "6.0% of its pixels are clipped"),
        (replace(GOOD, mean_share=0.005), "bad", "too dark"),
        (replace(GOOD, black_share=0.6), "usable", "60% of the pixels are black"),
        (replace(GOOD, defocus_view_px=2.0), "bad", "out of focus by 2.0"),
        (replace(GOOD, defocus_view_px=None), "unknown", "focus unknown"),
        (replace(GOOD, doubts=(finding(Code.CARRIERS_ELSEWHERE, FRAME),)), "usable", "are not where"),
        (replace(GOOD, off_plan=("ISO 400, not 100 as planned",)), "usable", "taken with ISO 400, not 100 as planned"),
        (replace(GOOD, carriers_found=8), "usable", "8 of 24 carriers seen where they are predicted"),
        (replace(GOOD, carriers_found=0), "usable", "0 of 24"),
        (replace(GOOD, carriers_found=None), "good", ""),
        (replace(GOOD, pose_source="none"), "unknown", "position unknown"),
        (replace(GOOD, gnss_fix=None), "unknown", "the receiver is silent"),
        (replace(GOOD, gnss_fix=1), "unknown", "no 3D fix"),
        (replace(GOOD, position_sigma_m=None), "unknown", "accuracy is unknown"),
        (replace(GOOD, blur_view_px=math.nan), "unknown", "motion blur None"),
        (replace(GOOD, clipped_share=math.nan), "unknown", "clipped"),
        (replace(GOOD, mean_share=math.nan), "bad", "too dark"),
        (replace(GOOD, position_sigma_m=40.0), "usable", "position ±40.0 m"),
    ],
)
def test_a_finding_has_its_bound_and_its_sentence(facts: FrameFacts, state: str, word: str) -> None:
    found = verdict(facts, BOUNDS)
    assert found.state == state
    assert word in " ".join(str(text(one)) for one in found.reasons)
    assert (state == "good") == (not found.reasons)


def test_clipped_pixels_are_told_once_and_judged_by_the_camera_s_own_bounds() -> None:
    seen = replace(SEEN, clipped_share=0.03)
    shifted = finding(Code.MASK_SHIFTED, FRAME, by_um=16.0)
    doubts = [finding(Code.FRAME_CLIPPED, FRAME, share=0.03), shifted]

    def found(bounds: VerdictBounds) -> list[Code]:
        judge, facts = Judge(NADIR, on_gimbal=False), replace(seen, bounds=bounds)
        for _ in range(5):
            made = judge.judge(tag(flown()), (0, 0, 0), facts, carriers=(24, 24), doubts=doubts)
        return [one.code for one in made.reasons]

    assert found(BOUNDS) == [Code.FRAME_CLIPPED, Code.MASK_SHIFTED]
    assert found(replace(BOUNDS, clipped_usable=0.04)) == [Code.MASK_SHIFTED]


def test_bad_goes_before_unknown_and_unknown_before_usable() -> None:
    unknown = replace(GOOD, blur_view_px=None, clipped_share=0.02)
    assert verdict(unknown, BOUNDS).state == "unknown"
    both = verdict(replace(unknown, clipped_share=0.1), BOUNDS)
    assert both.state == "bad"
    assert both.reasons[0].code is Code.FRAME_CLIPPED


@pytest.mark.parametrize(
    ("pose", "exposure_s", "rates", "word"),
    [
        (flown(), None, (0, 0, 0), "no exposure time"),
        (flown(velocity_ned_m_s=None), 1e-3, (0, 0, 0), "no velocity"),
        (flown(attitude=None), 1e-3, (0, 0, 0), "no attitude"),
        (flown(height_above_home_m=None), 1e-3, (0, 0, 0), "no height"),
        (flown(height_above_home_m=-2.0), 1e-3, (0, 0, 0), "the height is -2.0 m (above the take-off place)"),
        (flown(), 1e-3, None, "no turn rates"),
        (flown(source="nearest", age_ms=8500.0), 1e-3, (0, 0, 0), "8.5 s old"),
        (flown(), 1e-3, (math.nan, 0, 0), "not finite"),
        (flown(attitude=from_euler(math.pi, 0, 0)), 1e-3, (0, 0, 0), "sees no ground"),
    ],
)
def test_what_motion_needs_and_lacks_is_named_and_the_frame_is_not_good(  # type: ignore[no-untyped-def]  # parametrised
    pose: Pose, exposure_s, rates, word: str
) -> None:
    found = judged(pose, exposure_s=exposure_s, rates=rates)
    assert found.state == "unknown"
    assert word in str(text(found.reasons[0]))


def test_blur_is_speed_over_height_times_focal_length() -> None:
    facts = judged(flown(), exposure_s=0.01).facts
    assert facts is not None
    assert facts.blur_px == pytest.approx(10 * 0.01 / 100 * 50 / 0.01)  # 0.1 m on the ground, 0.05 mm on the chip
    assert facts.blur_view_px == pytest.approx(1.0)


def test_the_height_above_the_ground_goes_before_that_above_the_take_off_place() -> None:
    """Over a hill, and where the take-off place is higher than the ground that is looked at."""
    for source in ("rangefinder", "terrain"):
        over_a_hill = flown(ground=GroundHeight(25.0, 0.1, source, 20.0), height_above_home_m=-3.0)
        found = judged(over_a_hill, exposure_s=0.01)
        assert found.facts.blur_view_px == pytest.approx(4.0)
        assert found.state == "bad"
        assert f"over flat ground 25.0 m below (by {source})" in str(text(found.reasons[0]))


def test_a_frame_that_is_not_as_planned_is_only_usable() -> None:
    plan = exposure_of(plan_of(PlannedBody(iso="100", shutter_speed="1/1000", focal_length_mm=35.0)))
    judge = Judge(NADIR, on_gimbal=False, plan=FixedPlan(plan))
    for _ in range(5):
        found = judge.judge(tag(flown()), (0, 0, 0), SEEN, carriers=(24, 24), doubts=())
    assert found.state == "usable"
    assert [str(text(one)) for one in found.reasons] == ["taken with focal length 50 mm, not 35 mm as planned"]
    late = judge.judge(tag(flown(), 1 / 60), (0, 0, 0), SEEN, carriers=(24, 24), doubts=())
    assert any("shutter speed 1/60 s, not 1/1000 as planned" in str(text(one)) for one in late.reasons)
    unread = judge.judge(tag(flown(), None), (0, 0, 0), SEEN, carriers=(24, 24), doubts=())
    assert unread.state == "unknown"
    assert any("shutter speed unknown, not 1/1000 as planned" in str(text(one)) for one in unread.reasons)


def test_the_turn_that_keeps_the_axis_on_the_ground_is_nose_down_behind_and_has_a_sign() -> None:
    """Flying north at 100 m, the axis stays on its ground point where the nose rises: a positive pitch rate."""
    camera = FrameGeometry(NADIR, 50.0, (0.001, 0.001), (0.05, 0.05), 100.0)  # the middle alone
    rising = image_motion(camera, LEVEL, (10.0, 0.0, 0.0), (0.0, 0.1, 0.0))
    sinking = image_motion(camera, LEVEL, (10.0, 0.0, 0.0), (0.0, -0.1, 0.0))
    by_hand = 50 * 10 / 100  # mm/s: f · v / h, and f · ω is as much
    assert rising is not None
    assert sinking is not None
    found = math.hypot(*rising), math.hypot(*sinking)
    ahead = from_euler(0, 0.01, 0)  # a moment later, the nose up: the axis meets the ground 1 m farther north
    assert 100 * math.tan(0.01) == pytest.approx(100 * turned(ahead, (0.0, 0.0, 1.0))[0], rel=1e-3)
    assert found[0] == pytest.approx(2 * by_hand, rel=1e-3)
    assert found[1] == pytest.approx(0, abs=1e-3)


def test_the_fastest_place_is_fastest_in_pixels_of_views_that_are_not_square() -> None:
    motions = []
    for view_mm in ((0.05, 0.05), (0.05, 5.0)):
        camera = FrameGeometry(NADIR, 50.0, (20.0, 30.0), view_mm, 100.0)
        found = image_motion(camera, LEVEL, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))  # about the axis: corners move most
        assert found is not None
        motions.append(tuple(abs(one) for one in found))
    assert motions[0] == pytest.approx((15.0, 10.0))
    assert motions[1][0] == pytest.approx(15.0)  # columns hardly count: any place at the right or left edge


@pytest.mark.parametrize(
    ("known", "word"),
    [({"sigma_ns": 10**9}, "±1000 ms"), ({"doubts": (finding(Code.FRAME_RIVAL_SHOTS, FRAME, rival=2),)}, "in doubt")],
)
def test_an_uncertain_time_leaves_the_blur_unknown(known: dict[str, Any], word: str) -> None:
    found = Judge(NADIR, on_gimbal=False).judge(tag(flown(), **known), (0, 0, 0), SEEN, carriers=(24, 24), doubts=())
    assert found.state == "unknown"
    assert word in " ".join(str(text(one)) for one in found.reasons)


def test_no_gimbal_rates_no_motion() -> None:
    judge = Judge(NADIR, on_gimbal=True)
    found = judge.judge(tag(flown()), (0, 0, 0), SEEN, carriers=(24, 24), doubts=())
    assert found.reasons[0].facts["why"] == finding(Code.BLUR_GIMBAL_RATE, FRAME)
    assert found.values()["facts"]["blur_unknown"] == "blur.gimbal_rate"
    assert found.values()["facts"]["focus_unknown"] == ""


def test_three_bad_ones_in_a_row_are_a_problem_and_a_good_one_ends_it() -> None:
    judge, bad = Judge(NADIR, on_gimbal=False), Verdict("bad", (finding(Code.FRAME_CLIPPED, FRAME, share=0.1),))
    for count in range(1, 4):
        assert list(judge.counts.findings()) == []
        judge.count(count, bad)
        judge.count(count, unjudged("no telemetry"))  # proves nothing, either way
        assert judge.counts.bad_in_a_row == count
    judge.count(4, Verdict("bad", (finding(Code.FRAME_DARK, FRAME, share=0.0),)))
    (found,) = judge.counts.findings()  # one sentence, whatever follows
    assert str(text(found)).startswith("4 bad frames in a row, the first: 10.0% of its pixels are clipped")
    judge.count(5, Verdict("good"))
    assert list(judge.counts.findings()) == []
    assert judge.counts.by_state == {"bad": 4, "unknown": 3, "good": 1}
    assert judge.counts.last[-1] == (5, "good", ())


def test_files_that_come_late_raise_no_alarm_of_long_ago_and_end_none() -> None:
    judge, bad = Judge(NADIR, on_gimbal=False), Verdict("bad", (finding(Code.FRAME_CLIPPED, FRAME, share=0.1),))
    for frame in (20, 1, 2, 3, 4):
        judge.count(frame, bad)
    assert judge.counts.bad_in_a_row == 1
    judge.count(5, Verdict("good"))
    judge.count(21, bad)
    judge.count(22, bad)
    (found,) = judge.counts.findings()
    assert str(text(found)).startswith("3 bad frames in a row, the first: 10.0% of its pixels are clipped")
    assert judge.counts.by_state == {"bad": 7, "good": 1}


@pytest.mark.parametrize(
    ("diameter", "state", "said"),
    [
        (1, "good", ""),  # sharp by itself: the first frame needs no other
        (4, "unknown", "focus unknown"),
        (9, "unknown", "focus unknown"),
    ],
)
def test_a_flight_that_was_never_sharp_is_unknown_by_an_absolute_measure(diameter: int, state: str, said: str) -> None:
    """Whatever its frames have in common: the first frame, and the twentieth."""
    rng = np.random.default_rng(5)
    judge, grounds = Judge(NADIR, on_gimbal=False), [leaves(rng) for _ in range(3)]
    for number in range(20):
        seen = replace(SEEN, detail=detail(soft(grounds[number % 3], diameter)))
        found = judge.judge(tag(flown()), (0, 0, 0), seen, carriers=(24, 24), doubts=())
        assert found.state == state
        assert said in " ".join(str(text(one)) for one in found.reasons)


def test_a_lens_that_is_turned_in_flight_is_told_at_once_until_ten_frames_show_that_it_stays() -> None:
    judge, good = Judge(NADIR, on_gimbal=False), Verdict("good")
    taken = [(20.0, 5.6), (None, None), (20.1, 5.6), (20.0, 8.0), (20.0, 8.0), (50.0, 5.6)]
    told = []
    for frame, lens in enumerate(taken):
        judge.count(frame + 10, good, lens)
        told.append([str(text(one)) for one in judge.counts.findings()])
    first = ["the f-number changed from 5.6 to 8 at frame 13"]
    both = ["the focal length changed from 20 to 50 mm, the f-number changed from 8 to 5.6 at frame 15"]
    assert told == [[], [], [], first, first, both]
    judge.count(2, good, (24.0, 2.0))  # a file that comes late
    for frame in range(16, 40):
        judge.count(frame, good)  # a file that doesn't tell its lens shows nothing
    for frame in range(40, 49):
        judge.count(frame, good, (50.0, 5.6))
    assert [str(text(one)) for one in judge.counts.findings()] == both
    judge.count(49, good, (50.0, 5.6))
    assert list(judge.counts.findings()) == []


def leaves(rng: np.random.Generator) -> NDArray[np.float32]:
    """Ground of discs over each other, drawn at three times a slice's resolution."""
    picture = np.full((384, 384), 0.3, np.float32)
    for size in (60.0**-1.8 + (1.5**-1.8 - 60.0**-1.8) * rng.random(5000)) ** (-1 / 1.8):
        cv2.circle(picture, tuple(rng.integers(0, 384, 2).tolist()), max(1, int(size)), float(rng.uniform(0.05, 1)), -1)
    return picture


def soft(ground: NDArray[np.float32], diameter: int) -> NDArray[np.float64]:
    """A slice of it, out of focus by a disc, `diameter` in thirds of a pixel."""
    y, x = np.mgrid[-9:10, -9:10]
    disc = (np.hypot(y, x) <= diameter / 2).astype(np.float32)
    blurred = cv2.filter2D(ground, -1, disc / disc.sum(), borderType=cv2.BORDER_WRAP)
    spectrum = np.fft.rfft2(blurred)
    band = np.concatenate([spectrum[:64, :65], spectrum[-64:, :65]]) / 9
    band[64] = band[:, 64] = 0
    return np.asarray(np.fft.irfft2(band, s=(128, 128)))


def test_a_lens_that_is_knocked_stays_bad_and_other_ground_is_not_out_of_focus() -> None:
    rng = np.random.default_rng(3)
    judge = Judge(NADIR, on_gimbal=False)

    def state(ground: NDArray[np.float32], diameter: int) -> str:
        seen = replace(SEEN, detail=detail(soft(ground, diameter)))
        return judge.judge(tag(flown()), (0, 0, 0), seen, carriers=(24, 24), doubts=()).state

    grounds = [leaves(rng) for _ in range(4)]
    assert [state(ground, 1) for ground in grounds] == ["good"] * 4
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (384, 384)).astype(np.float32), (0, 0), 20)
    assert state(grounds[0], 1) != "bad"
    assert state(grounds[1] * np.exp(smooth * 20), 1) != "bad"  # fields in clouds' shadows
    assert [state(grounds[number % 4], 9) for number in range(100)] == ["bad"] * 100


@pytest.mark.parametrize("step", [1, 2])
def test_a_picture_that_is_out_of_focus_by_less_than_a_view_s_pixel_is_only_usable(step: int) -> None:
    """Samples of one colour stand two pixels apart."""
    rng = np.random.default_rng(8)
    judge, grounds = Judge(NADIR, on_gimbal=False), [leaves(rng).astype(np.float64) for _ in range(4)]
    y, x = np.mgrid[-3:4, -3:4]
    disc = (np.hypot(y, x) <= 2).astype(np.float64)

    def judged(number: int, *, soft: bool) -> Verdict:
        ground = grounds[number % 4]
        seen_px = cv2.filter2D(ground, -1, disc / disc.sum()) if soft else ground
        samples = [(part := seen_px[row::step, row::step], np.full(part.shape, 1e-4)) for row in range(step)]
        seen = replace(SEEN, fine=fine_detail(samples, (step, step)))
        return judge.judge(tag(flown()), (0, 0, 0), seen, carriers=(24, 24), doubts=())

    first = [judged(number, soft=False) for number in range(6)]
    assert {one.state for one in first} == {"good"}
    assert [one.facts is not None and one.facts.picture_px is None for one in first] == [True] * 5 + [False]
    for number in range(40):  # for long: what is out of focus does not become the measure
        blurred = judged(number, soft=True)
        assert blurred.state == "usable"
        assert [one.code for one in blurred.reasons] == [Code.FRAME_PICTURE_DEFOCUSED]
        assert blurred.facts is not None
        assert blurred.facts.picture_px == pytest.approx(4.5, abs=1.5)
    assert judged(7, soft=False).state == "good"


def test_noise_over_the_finest_detail_leaves_the_picture_unjudged() -> None:
    flat = np.full((192, 192), 0.3) + np.random.default_rng(2).normal(0, 0.01, (192, 192))
    fine = fine_detail([(flat, np.full(flat.shape, 0.01))], (1, 1))
    assert fine.circle_px is None


def test_noise_and_shadow_do_not_hide_defocus() -> None:
    rng = np.random.default_rng(4)
    clean = soft(leaves(rng), 6)
    noisy = clean + rng.normal(0, 0.003, clean.shape)
    assert noise_of(noisy, 0.003) > 0
    with_noise = replace(SEEN, detail=detail(noisy), noise=noise_of(noisy, 0.003))
    judge = Judge(NADIR, on_gimbal=False)
    unknown = judge.judge(tag(flown()), (0, 0, 0), replace(with_noise, noise=1.0), carriers=(24, 24), doubts=())
    assert "more noise than fine detail" in " ".join(str(text(one)) for one in unknown.reasons)
    shaded = clean.copy()
    shaded[:10] = 0.0005 + rng.normal(0, 0.002, (10, 128))
    (_, along), (_, dark) = detail(clean), detail(shaded)
    assert defocus(dark) == pytest.approx(defocus(along), abs=0.4)


def test_the_border_of_a_picture_whose_sides_differ_does_not_hide_defocus() -> None:
    """A slice is cut from the frame's spectrum: what left and right differ by rings at the border."""
    bright = np.linspace(1.0, 2.0, 384, dtype=np.float32) * leaves(np.random.default_rng(6)) + 0.5
    y, x = np.mgrid[-9:10, -9:10]
    disc = (np.hypot(y, x) <= 4.5).astype(np.float32)  # 3 pixels of a view
    spectrum = np.fft.rfft2(cv2.filter2D(bright, -1, disc / disc.sum()))
    picture = np.fft.irfft2(np.concatenate([spectrum[:64, :65], spectrum[-64:, :65]]) / 9, s=(128, 128))
    assert [defocus(along) for along in detail(picture)] == pytest.approx([3.0, 3.0], abs=0.6)


def test_pixels_that_were_not_measured_are_unknown() -> None:
    judge = Judge(NADIR, on_gimbal=False)
    assert judge.judge(tag(flown()), None, None, carriers=(24, 24), doubts=()).state == "unknown"


def test_fineness_tells_noise_from_smoothness() -> None:
    noise = np.random.default_rng(1).random((80, 90)) + 1
    assert all(value == pytest.approx(1, abs=0.1) for value in fineness(noise).values())
    slope = np.exp(np.add.outer(np.arange(80.0), np.arange(90.0)) / 50)
    assert fineness(slope)["across"] == pytest.approx(0.25, abs=0.01)
    assert set(fineness(np.zeros((8, 8))).values()) == {0.0}
