"""Judge each frame of a flight: motion blur, exposure, focus, carriers and pose, by facts and bounds."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from dappled import codec
from dappled.config.profiles import VerdictBounds
from dappled.daemon.pipeline.picture_facts import PictureFacts, blur_circle
from dappled.daemon.pipeline.spacing import Height
from dappled.decode.geometry import FrameGeometry, Vector3, image_motion
from dappled.drivers.camera import ExposurePlan, off_plan
from dappled.findings import FRAME, Code, Evidence, Finding, Level, Subject, Value, finding
from dappled.flight import Tag

VerdictState = Literal["good", "usable", "bad", "unknown"]
STATES: tuple[VerdictState, ...] = ("good", "usable", "bad", "unknown")
BAD_IN_A_ROW = 3
LAST = 40  # as many as the console's film strip shows
_MOST, _LEAST, _SHARPEST = 2000, 5, 0.25
_FIX_3D = 3  # GPS_FIX_TYPE
_LOW_M = 2.0  # a barometer's height is no better
_LATE_NS = 50_000_000  # a time that is known less well may be that of another turn and speed
_SILENT_MS = 2000.0
_STAYS = 10  # frames with the lens as it is: a change of its settings is over
_SAME = 0.01  # lens settings that differ by less are equal, but for rounding


class HasExposurePlan(Protocol):
    """What frames are to be taken with; it may change from frame to frame."""

    exposure: ExposurePlan


@dataclass(slots=True)
class FixedPlan:
    """One that does not change."""

    exposure: ExposurePlan = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What a verdict is given by; None is unknown.

    Blur is how far still ground moved over the sensor during the exposure where it moved most, in pixels of the frame
    and of a view; the ground counts as flat, `height_m` below, as `height_source` has it. `blur_unknown` is why it
    isn't known, `focus_unknown` why `defocus_view_px` isn't: the diameter of the circle that a point is drawn as,
    beyond that of the flight's sharpest frames. `picture_px` is the same of the picture at the sensor's own resolution,
    in pixels of the frame. `off_plan` is what exposure and lens are instead of the planned ones.
    """

    blur_px: float | None
    blur_view_px: float | None
    blur_unknown: Finding | None
    height_m: float | None
    height_source: str
    clipped_share: float
    black_share: float
    mean_share: float
    defocus_view_px: float | None
    focus_unknown: Finding | None
    carriers_found: int | None
    carriers_predicted: int
    doubts: tuple[Finding, ...]
    off_plan: tuple[str, ...]
    pose_source: str
    position_sigma_m: float | None
    gnss_fix: int | None
    picture_px: float | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """`reasons` say why the frame isn't good, the gravest first. `facts` are None where it could not be decoded."""

    state: VerdictState
    reasons: tuple[Finding, ...] = ()
    facts: FrameFacts | None = None

    def values(self) -> dict[str, Any]:
        """As ledger and stream have it: of what led to a reason its code, since the reason holds it."""
        facts = {} if self.facts is None else codec.plain(self.facts)
        for name in ("blur_unknown", "focus_unknown") if facts else ():
            facts[name] = facts[name]["code"] if facts[name] else ""
        numbers = {name: _plain(one) for name, one in facts.items()}
        return {"state": self.state, "reasons": codec.plain(self.reasons), "facts": numbers}


def _plain(value: Any) -> Any:
    """A fact as JSON has it: what is not a finite number is unknown."""
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


def verdict(facts: FrameFacts, bounds: VerdictBounds) -> Verdict:
    """Judge a frame. One bad finding makes it bad; else one that can't be judged makes it unknown, never good."""
    found = [*_motion(facts, bounds), *_exposure(facts, bounds), *_focus(facts, bounds), *_rest(facts, bounds)]
    order: tuple[VerdictState, ...] = ("bad", "unknown", "usable")
    found.sort(key=lambda one: order.index(one[0]))
    return Verdict(found[0][0] if found else "good", tuple(why for _, why in found), facts)


def unjudged(why: Evidence) -> Verdict:
    """Of a frame that can't be judged."""
    return Verdict("unknown", (finding(Code.FRAME_UNJUDGED, FRAME, why=why),))


LensSettings = tuple[float | None, float | None]  # focal length (mm) and f-number; None where the file has none
Findings = list[tuple[VerdictState, Finding]]
_LEVELS: Mapping[VerdictState, Level] = {"bad": Level.STOP, "usable": Level.CAUTION, "unknown": Level.NOTE}


def _one(state: VerdictState, code: Code, **facts: Value) -> tuple[VerdictState, Finding]:
    return state, Finding(code, FRAME, {name: _plain(one) for name, one in facts.items()}, _LEVELS[state])


def _motion(facts: FrameFacts, bounds: VerdictBounds) -> Findings:
    blur, sensor = facts.blur_view_px, facts.blur_px
    if blur is None or sensor is None:
        return [_one("unknown", Code.FRAME_BLUR_UNKNOWN, why=facts.blur_unknown)]
    state = _worse(blur, bounds.blur_usable_px, bounds.blur_bad_px)
    state = state or _worse(sensor, bounds.picture_usable_px, math.inf)
    below: dict[str, Value] = {"height_m": facts.height_m or 0.0, "height_by": facts.height_source}
    return [_one(state, Code.FRAME_BLURRED, view_px=blur, sensor_px=sensor, **below)] if state else []


def _exposure(facts: FrameFacts, bounds: VerdictBounds) -> Findings:
    found: Findings = []
    if state := _worse(facts.clipped_share, bounds.clipped_usable, bounds.clipped_bad):
        found.append(_one(state, Code.FRAME_CLIPPED, share=facts.clipped_share))
    if not facts.mean_share >= bounds.mean_least:
        found.append(_one("bad", Code.FRAME_DARK, share=facts.mean_share))
    if facts.off_plan:
        found.append(_one("usable", Code.FRAME_OFF_PLAN, taken="; ".join(facts.off_plan)))
    if facts.black_share > bounds.black_usable:
        found.append(_one("usable", Code.FRAME_BLACK, share=facts.black_share))
    return found


def _focus(facts: FrameFacts, bounds: VerdictBounds) -> Findings:
    blur = facts.defocus_view_px
    if blur is None:
        return [_one("unknown", Code.FRAME_FOCUS_UNKNOWN, why=facts.focus_unknown)]
    if state := _worse(blur, bounds.defocus_usable_px, bounds.defocus_bad_px):
        return [_one(state, Code.FRAME_DEFOCUSED, view_px=blur)]
    picture = facts.picture_px
    if picture is not None and (state := _worse(picture, bounds.picture_usable_px, math.inf)):
        return [_one(state, Code.FRAME_PICTURE_DEFOCUSED, px=picture)]
    return []


def _rest(facts: FrameFacts, bounds: VerdictBounds) -> Findings:
    found: Findings = [("usable", one) for one in facts.doubts]
    seen, predicted = facts.carriers_found, facts.carriers_predicted
    if seen is not None and seen < bounds.carriers_share * predicted:
        found.append(_one("usable", Code.CARRIERS_FEW, seen=seen, predicted=predicted))
    sigma_m = facts.position_sigma_m
    if facts.pose_source != "interpolated":
        none = facts.pose_source == "none"
        found.append(_one("unknown", Code.POSITION_UNKNOWN if none else Code.POSITION_NOT_INTERPOLATED))
    elif facts.gnss_fix is None or facts.gnss_fix < _FIX_3D:
        silent = facts.gnss_fix is None
        found.append(_one("unknown", Code.POSITION_RECEIVER_SILENT if silent else Code.POSITION_NO_FIX))
    elif sigma_m is None or not math.isfinite(sigma_m):
        found.append(_one("unknown", Code.POSITION_SIGMA_UNKNOWN))
    elif sigma_m > bounds.position_sigma_m:
        found.append(_one("usable", Code.POSITION_COARSE, sigma_m=sigma_m))
    return found


def _worse(value: float, usable: float, bad: float) -> VerdictState | None:
    """What a value above its bounds makes of a frame; one that is no number can't be judged."""
    if not math.isfinite(value):
        return "unknown"
    return "bad" if value > bad else "usable" if value > usable else None


@dataclass(frozen=True, slots=True)
class VerdictCounts:
    """How a flight's frames were judged: by state, how many bad ones since the last good or usable one and why the
    first of them, and the last `LAST` as (frame, state, reasons).
    `drift` says how the lens' settings last changed from one frame to a newer one; `held` counts the frames since that
    they are known to be the same in."""

    by_state: Mapping[VerdictState, int] = field(default_factory=dict)
    bad_in_a_row: int = 0
    reason: Finding | None = None
    last: tuple[tuple[int, VerdictState, tuple[Finding, ...]], ...] = ()
    drift: Finding | None = None
    held: int = 0

    def findings(self) -> Iterator[Finding]:
        """Three or more frames that were bad without a good or usable one between them; a change of the lens' settings,
        until so many frames show that it stays."""
        if self.bad_in_a_row >= BAD_IN_A_ROW and self.reason is not None:
            yield finding(Code.FRAMES_BAD, Subject("flight"), in_a_row=self.bad_in_a_row, why=self.reason)
        if self.drift is not None and self.held < _STAYS:
            yield self.drift


class Judge:
    """Judges the frames of one flight, in the order of their decoding, and keeps what later ones are compared with.

    `mount` leads from camera axes to body axes; with `on_gimbal` it leads to the gimbal's, whose turn no message gives.
    `plan` is what exposure and lens are compared with.
    """

    def __init__(self, mount: Sequence[float], *, on_gimbal: bool, plan: HasExposurePlan | None = None) -> None:
        self._mount, self._on_gimbal, self._plan = tuple(mount), on_gimbal, plan or FixedPlan()
        self._sharpest: dict[LensSettings, deque[float]] = {}
        self._pictures: dict[LensSettings, deque[float]] = {}
        self._states: Counter[VerdictState] = Counter()
        self._newest = -1
        self._lens: LensSettings = (None, None)
        self.counts = VerdictCounts()

    def judge(
        self,
        tag: Tag,
        rates: Vector3 | None,
        seen: PictureFacts | None,
        *,
        carriers: tuple[int | None, int],
        doubts: Sequence[Finding],
    ) -> Verdict:
        """Judge a frame. `rates` are the body's at mid-exposure (rad/s), None where unknown; `carriers` were found, and
        are predicted."""
        if seen is None:
            return unjudged(finding(Code.FRAME_PIXELS_UNTOLD, FRAME))
        blur, blur_unknown = self._blur(tag, rates, seen)
        lens = tag.focal_length_mm, tag.f_number
        circle, focus_unknown = self._defocus(lens, seen)
        height = Height.of(tag.pose)
        gnss = tag.pose.gnss
        fresh = gnss is not None and gnss.age_ms <= _SILENT_MS
        facts = FrameFacts(
            blur_px=blur and _pixels(blur, seen.pixel_mm),
            blur_view_px=blur and _pixels(blur, seen.view_mm),
            blur_unknown=blur_unknown,
            height_m=None if height is None else height.metres,
            height_source="" if height is None else height.source,
            clipped_share=seen.clipped_share,
            black_share=seen.black_share,
            mean_share=seen.mean_share,
            defocus_view_px=circle,
            focus_unknown=focus_unknown,
            carriers_found=carriers[0],
            carriers_predicted=carriers[1],
            doubts=tuple(one for one in doubts if one.code != Code.FRAME_CLIPPED),  # judged by its own bounds
            off_plan=off_plan(tag, self._plan.exposure),
            pose_source=tag.pose.source,
            position_sigma_m=tag.pose.position_sigma_m,
            gnss_fix=gnss.fix_type if gnss is not None and fresh else None,
            picture_px=self._picture(lens, seen),
        )
        return verdict(facts, seen.bounds)

    def count(self, frame: int, found: Verdict, lens: LensSettings = (None, None)) -> Verdict:
        """Count a verdict, also one that can't be given. An unknown frame proves nothing: it neither ends a row of bad
        ones nor adds to it; nor does one that comes late, behind a newer frame. `lens` is what it was taken with."""
        self._states[found.state] += 1
        before, late = self.counts, frame < self._newest
        self._newest = max(frame, self._newest)
        in_a_row, reason = before.bad_in_a_row, before.reason
        if found.state == "bad" and not late:
            in_a_row, reason = in_a_row + 1, reason if in_a_row else found.reasons[0]
        elif found.state != "unknown" and not late:
            in_a_row, reason = 0, None
        last = (*before.last, (frame, found.state, found.reasons))[-LAST:]
        drift, held = before.drift, before.held + (not late and lens != (None, None))
        if not late:
            if moved := _moved(self._lens, lens):
                drift, held = finding(Code.FRAMES_LENS_MOVED, Subject("flight"), moved=moved, frame=frame), 0
            self._lens = (lens[0] or self._lens[0], lens[1] or self._lens[1])
        self.counts = VerdictCounts(dict(self._states), in_a_row, reason, last, drift, held)
        return found

    def _defocus(self, lens: LensSettings, seen: PictureFacts) -> tuple[float | None, Finding | None]:
        """The circle of confusion beyond that of the sharpest quarter of the frames in focus so far, which are kept by
        the lens' settings; or None, and why."""
        circle = blur_circle(seen)
        if circle is None:
            return None, finding(Code.FOCUS_NOISE, FRAME)
        known = self._sharpest.setdefault(lens, deque(maxlen=_MOST))
        reference, beyond = _beyond(known, circle, seen.bounds.defocus_usable_px)
        if reference is None:  # what is sharp by itself needs no other frame
            few = finding(Code.FOCUS_FEW_FRAMES, FRAME, circle_px=circle, frames=_LEAST)
            return (circle, None) if circle <= seen.bounds.defocus_usable_px else (None, few)
        if reference > seen.bounds.defocus_usable_px:  # an absolute measure: then no frame was seen to be sharp
            return None, finding(Code.FOCUS_FLIGHT_SOFT, FRAME, circle_px=reference)
        return beyond, None

    def _picture(self, lens: LensSettings, seen: PictureFacts) -> float | None:
        """How far the picture is out of focus beyond the sharpest quarter of the frames with the lens as it is; None
        where noise covers its finest detail, or with too few frames to compare with. What a lens and a sensor's own
        filter blur is in all of them."""
        circle = None if seen.fine is None else seen.fine.circle_px
        if circle is None:
            return None
        known = self._pictures.setdefault(lens, deque(maxlen=_MOST))
        reference, beyond = _beyond(known, circle, seen.bounds.picture_usable_px)
        return None if reference is None else beyond

    def _blur(
        self, tag: Tag, rates: Vector3 | None, seen: PictureFacts
    ) -> tuple[tuple[float, float] | None, Finding | None]:
        """How far ground moved over the sensor during the exposure, (down, right) in mm; or None, and why."""
        pose, height = tag.pose, Height.of(tag.pose)
        missing: list[tuple[bool, Code, dict[str, Evidence]]] = [
            (tag.exposure_s is None, Code.BLUR_NO_EXPOSURE_TIME, {}),
            (tag.focal_length_mm is None, Code.BLUR_NO_FOCAL_LENGTH, {}),
            (seen.side_mm is None, Code.BLUR_SIZE_UNKNOWN, {}),
            (bool(tag.doubts), Code.BLUR_TIME_DOUBTED, {"why": next(iter(tag.doubts), None)}),
            (tag.utc_sigma_ns > _LATE_NS, Code.BLUR_TIME_INEXACT, {"sigma_ms": tag.utc_sigma_ns / 1e6}),
            (pose.velocity_ned_m_s is None, Code.BLUR_NO_VELOCITY, {}),
            (pose.attitude is None, Code.BLUR_NO_ATTITUDE, {}),
            (pose.source != "interpolated", Code.BLUR_POSE_OLD, {"age_s": (pose.age_ms or 0) / 1e3}),
            (self._on_gimbal, Code.BLUR_GIMBAL_RATE, {}),
            (rates is None, Code.BLUR_NO_TURN_RATES, {}),
            (height is None, Code.BLUR_NO_HEIGHT, {}),
        ]
        if why := next((finding(code, FRAME).with_facts(**facts) for is_so, code, facts in missing if is_so), None):
            return None, why
        assert height is not None
        if not height.metres >= (_LOW_M if pose.ground is None else 0.0):
            return None, finding(Code.BLUR_TOO_LOW, FRAME, height_m=height.metres, height_by=height.source)
        assert tag.exposure_s is not None
        assert tag.focal_length_mm is not None
        assert seen.side_mm is not None
        assert seen.view_mm is not None
        assert pose.attitude is not None
        assert pose.velocity_ned_m_s is not None
        assert rates is not None
        camera = FrameGeometry(self._mount, tag.focal_length_mm, seen.side_mm, seen.view_mm, height.metres)
        moving = image_motion(camera, pose.attitude, pose.velocity_ned_m_s, rates)
        if moving is None:
            return None, finding(Code.BLUR_NO_GROUND, FRAME)
        if not all(map(math.isfinite, (*pose.velocity_ned_m_s, *rates, *moving))):
            return None, finding(Code.BLUR_NOT_FINITE, FRAME)
        return (moving[0] * tag.exposure_s, moving[1] * tag.exposure_s), None


def _moved(before: LensSettings, now: LensSettings) -> str:
    """How the lens' settings changed; "" where they did not, or either is unknown."""
    words = ("the focal length changed from {0:g} to {1:g} mm", "the f-number changed from {0:g} to {1:g}")
    pairs = zip(words, before, now, strict=True)
    return ", ".join(word.format(a, b) for word, a, b in pairs if a and b and abs(b / a - 1) > _SAME)


def _beyond(known: deque[float], circle: float, usable: float) -> tuple[float | None, float]:
    """The circle of the sharpest quarter of those `known`, None of too few; and by how much a circle is beyond it, 0
    then. One that is usable is known from now on: what is out of focus must not become the measure."""
    reference = float(np.quantile(list(known), _SHARPEST)) if len(known) >= _LEAST else None
    beyond = 0.0 if reference is None else math.sqrt(max(0.0, circle**2 - reference**2))
    if beyond <= usable:
        known.append(circle)
    return reference, beyond


def _pixels(blur_mm: tuple[float, float], pitch_mm: tuple[float, float] | None) -> float | None:
    return None if pitch_mm is None else math.hypot(blur_mm[0] / pitch_mm[0], blur_mm[1] / pitch_mm[1])
