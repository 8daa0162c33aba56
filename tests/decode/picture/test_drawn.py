"""The picture over masks, layouts, stops, noise and distances drawn by Latin hypercube, against rays of their own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from dappled.decode.optics.carriers import Lattice, MaskedOptics, Sensor
from dappled.decode.optics.shadow_orders import shadow_orders
from dappled.decode.picture.blocks import MosaicPlane
from dappled.decode.picture.picture import picture_of
from dappled.decode.picture.shadow import Shadow, ShadowEvidence, ShadowFrom, period_of
from dappled.decode.picture.shadow_fit import ExpectedShadow, shadow_of, told_by
from tests.decode.picture.drawn import COUNT, FILMS, SHAPE, V_MM, Drawn, draw
from tests.decode.ray_trials import mask_of


@dataclass(frozen=True)
class Judged:
    """`short_db`: how far the picture falls short of the better of raw over the true shadow and the band around the
    mean; `depth` the shadow's standard deviation; `shares` of the pixels within 1 and 2 σ; `sure_noise` of the noise is
    no detail."""

    short_db: float
    depth: float
    shares: tuple[float, float]
    sure_noise: float


def _masked(shot: Drawn) -> tuple[MosaicPlane, ExpectedShadow]:
    """The frame, the true lattice, and the orders that may be seen."""
    sensor = Sensor(SHAPE, (shot.pitch_mm[0], 0.0), (0.0, shot.pitch_mm[1]))
    optics = MaskedOptics(sensor, mask_of(shot.film), "geometric", shot.distance_mm)
    lattice = optics.lattice(V_MM)
    orders = shadow_orders(optics, lattice, shot.f_number)
    return MosaicPlane(shot.frame(), shot.pattern), ExpectedShadow(lattice, *orders, 0.03, 0.02)


def shadow_in(shot: Drawn, beside: Sequence[ShadowEvidence] = ()) -> tuple[MosaicPlane, Shadow, Lattice]:
    """The frame, the shadow that is found in it, and in others beside it, and the true lattice."""
    mosaic, expected = _masked(shot)
    return mosaic, shadow_of(mosaic, expected, beside=beside), expected.lattice


def _told(shots: Sequence[Drawn]) -> list[ShadowEvidence]:
    found = [told_by(*_masked(shot)) for shot in shots]
    return [one.evidence for one in found if one.seen]


def judged(shot: Drawn, beside: Sequence[ShadowEvidence] = ()) -> Judged:
    mosaic, shadow, lattice = shadow_in(shot, beside)
    frame = mosaic.plane
    made = picture_of(mosaic, shadow, period_of(lattice))
    others = [shot.psnr(frame / np.maximum(shot.lights[2], 0.01)), shot.psnr(shot.band(frame))]
    cut = np.zeros(SHAPE, dtype=bool)
    cut[20:-20, 20:-20] = True
    inside = cut & made.trusted & (shot.colour_at >= 0)
    off = np.abs(made.plane - shot.lights[1])[inside] / np.maximum(made.sigma[inside], 1e-9)
    return Judged(
        shot.psnr(made.plane) - max(others),
        float(shot.lights[2][shot.colour_at >= 0].std()),
        (float(np.mean(off < 1)), float(np.mean(off < 2))),
        made.sure_noise,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "most_short_db"),
    [
        # masks 1 to 5 and the reference; noise, ghosts of 1 to 3 px a view, and frames in focus
        *[(2, -1.5), (5, -3), (20, -6), (23, 0.3), (46, -0.8), (52, -2)],
        *[(61, -5), (72, -1), (74, -2), (90, -5), (133, -1)],
    ],
)
def test_a_drawn_picture_is_about_as_good_as_the_better_of_true_shadow_and_band(
    number: int, most_short_db: float
) -> None:
    assert judged(draw()[number]).short_db > -most_short_db


def test_orders_that_fold_into_local_means_on_samples_that_stand_far_apart_are_found() -> None:
    assert judged(draw()[155]).short_db > -0.3


@pytest.mark.slow
@pytest.mark.parametrize(("number", "least_db"), [(110, -1.0), (153, 2.0)])
def test_orders_that_are_a_thousandth_of_the_mean_are_found_where_the_scene_has_little_detail(
    number: int, least_db: float
) -> None:
    assert judged(draw()[number]).short_db > least_db


@pytest.mark.parametrize(
    ("number", "least_db"),
    [(187, -0.3), *[pytest.param(*one, marks=pytest.mark.slow) for one in ((50, -2.5), (174, 0))]],
)
def test_orders_that_only_diffraction_makes_are_not_fitted_where_there_is_none(number: int, least_db: float) -> None:
    assert judged(draw()[number]).short_db > least_db


def test_ghosts_end_where_parallax_over_the_stop_blurs_what_they_are_of() -> None:
    assert judged(draw()[134]).short_db > 6


def test_a_shadow_that_is_not_seen_is_not_known_to_be_none() -> None:
    shot = draw()[120]
    _, shadow, _ = shadow_in(shot)
    assert shadow.source == ShadowFrom.NONE
    there = shot.lights[2][shot.colour_at >= 0].std()
    assert 0.3 < shadow.sigma.mean() / there < 3


@pytest.mark.slow
def test_the_shadow_s_errors_are_as_large_as_its_sigma_says() -> None:
    shares = []
    for shot in draw()[::10]:
        mosaic, shadow, _ = shadow_in(shot)
        off = np.concatenate([(shadow.at(one) - shot.lights[2][one.cut]).ravel() for one in mosaic.places()])
        shares.append(off.std() / shadow.sigma.mean())
    assert 0.7 < np.median(shares) < 1.3
    assert np.quantile(shares, 0.9) < 2


def test_what_the_lattice_is_off_is_a_part_of_the_shadow_s_error() -> None:
    shot = draw()[50]
    mosaic, shadow, _ = shadow_in(shot)
    off = np.concatenate([(shadow.at(one) - shot.lights[2][one.cut]).ravel() for one in mosaic.places()])
    assert 0.5 < off.std() / shadow.sigma.mean() < 2


def test_a_weak_shadow_s_lattice_is_turned_and_scaled_rather_than_sheared() -> None:
    _, shadow, true = shadow_in(draw()[110])
    assert np.abs((shadow.lattice.matrix() - true.matrix()) * SHAPE).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("number", "most_short_db"), [(38, -0.9), (50, -0.8), (57, -1.0)])
def test_four_other_scenes_behind_the_same_mask_tell_a_shadow_that_one_scene_hides(
    number: int, most_short_db: float
) -> None:
    shot = draw()[number]
    beside = _told([replace(shot, seed=1000 + at) for at in range(4)])
    assert judged(shot, beside).short_db > most_short_db


def test_a_frame_whose_shadow_others_know_tells_as_much_as_one_that_is_searched() -> None:
    shot = draw()[50]
    beside = _told([replace(shot, seed=1000 + at) for at in range(2)])
    mosaic, shadow, _ = shadow_in(shot, beside)
    searched = told_by(*_masked(shot)).shadow((), beside)
    assert (shadow.source, shadow.alike) == (searched.source, searched.alike) == (ShadowFrom.FLIGHT, 2)
    off, off_searched = (
        np.concatenate([(each.at(one) - shot.lights[2][one.cut]).ravel() for one in mosaic.places()]).std()
        for each in (shadow, searched)
    )
    assert off < 1.1 * off_searched
    assert shadow.sigma == pytest.approx(searched.sigma, rel=0.1)


@pytest.mark.slow
def test_a_frame_that_was_taken_at_another_stop_keeps_a_shadow_of_its_own() -> None:
    shot = draw()[50]
    beside = _told([replace(shot, seed=1000 + at, f_number=shot.f_number / 1.2) for at in range(2)])
    shadow = shadow_in(shot, beside)[1]
    assert (shadow.source, shadow.alike, shadow.unlike) == (ShadowFrom.FRAME, 0, 2)


@pytest.mark.slow
def test_shares_within_one_and_two_sigma_where_detail_ends_before_the_noise() -> None:
    shares = judged(draw()[20]).shares
    assert 0.6 < shares[0] < 0.85
    assert 0.9 < shares[1] < 0.997


@pytest.mark.parametrize(
    "number",
    [
        150,  # grey, 0.3 px a view: blur takes the finest detail, and what is left there is noise
        pytest.param(40, marks=pytest.mark.slow),  # staggered, in focus, SNR 54
        pytest.param(184, marks=pytest.mark.slow),
        pytest.param(163, marks=pytest.mark.slow),  # 3 px a view: ghosts reach into the band around the mean
        pytest.param(23, marks=pytest.mark.slow),
    ],
)
def test_blurred_detail_is_no_less_noise_and_ghosts_within_the_band_are_errors(number: int) -> None:
    shares = judged(draw()[number]).shares
    assert 0.5 < shares[0] < 0.85
    assert shares[1] > 0.8


@pytest.mark.parametrize(
    ("number", "sure"),
    [(120, False), pytest.param(97, False, marks=pytest.mark.slow), (20, True), (150, True)],
)
def test_noise_that_may_be_detail_is_told_where_sigma_is_too_wide(number: int, sure: bool) -> None:
    found = judged(draw()[number])
    assert (found.sure_noise > 0.2) == sure
    assert (found.shares[0] < 0.9) == sure


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_two_hundred_drawn_pictures() -> None:
    drawn = draw()
    assert len(drawn) == COUNT
    for levels in (Counter(one.mask for one in drawn), Counter((one.stop) for one in drawn)):
        assert min(levels.values()) >= 20
    assert {one.mask for one in drawn} == set(FILMS)
    found = [judged(one) for one in drawn]
    for deep, tenth in ((True, -1.0), (False, -0.5)):
        short = np.array([one.short_db for one in found if (one.depth > 0.1) == deep])
        assert np.median(short) > 1, deep
        assert np.quantile(short, 0.1) > tenth, deep
        assert short.min() > -5.5, deep
    known = np.array([one.shares for one in found if one.sure_noise > 0.2])
    assert np.quantile(known[:, 0], 0.1) > 0.6
    assert np.quantile(known[:, 0], 0.9) < 0.87
