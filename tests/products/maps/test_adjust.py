"""Least squares over eyes, and what it is fed: against exact sightings, and against a shift that is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from dappled.products.maps import adjust, matching
from dappled.products.maps.ground import Flat
from tests.products.maps.test_eye import eye_at


def test_an_eye_is_found_from_exact_marks() -> None:
    eye = eye_at()
    pixels = eye.border(6)
    places = np.concatenate([Flat(0.0).meet(eye, pixels), Flat(5.0).meet(eye, pixels)])
    marks = adjust.Marks(0, np.concatenate([pixels, pixels]), places, 0.5, 0.01, 0.01)
    start = eye.moved(np.array([1.5, -1.0, 0.7, 0.01, -0.012, 0.015]))
    found = adjust.adjust([start], [marks], Flat(0.0), sigmas=np.full((1, 6), 10.0))
    assert found.eyes[0].centre == pytest.approx(eye.centre, abs=1e-2)
    assert found.eyes[0].project(places) == pytest.approx(marks.pixels, abs=1e-2)
    assert found.inliers[0].all()
    assert found.residuals_px[0] == pytest.approx(0.0, abs=1e-2)


def test_wrong_marks_are_outvoted() -> None:
    eye = eye_at()
    pixels = np.concatenate([eye.border(8), eye.border(8) * 0.6 + 40])
    places = Flat(0.0).meet(eye, pixels)
    lied = pixels.copy()
    lied[::7] += [25.0, -30.0]
    start = eye.moved(np.array([0.5, -0.4, 0.3, 0.004, 0.005, -0.006]))
    marks = adjust.Marks(0, lied, places, 0.5, 0.05, 0.05)
    found = adjust.adjust([start], [marks], Flat(0.0), sigmas=np.full((1, 6), 1.0))
    assert not found.inliers[0][::7].any()
    assert found.inliers[0].sum() == len(pixels) - len(pixels[::7])


def test_ties_bring_two_eyes_together_and_leave_the_strip_where_it_was() -> None:
    first = eye_at()
    second = first.moved(np.array([8.0, 3.0, 0.5, 0.01, -0.02, 0.2]))
    ground = Flat(0.0)
    pixels = np.stack(np.meshgrid(np.linspace(20, 260, 9), np.linspace(20, 190, 7)), axis=-1).reshape(-1, 2)
    seen = second.project(ground.meet(first, pixels))
    inside = ((seen > 0) & (seen < [283, 213])).all(axis=1)
    ties = adjust.Ties(0, 1, pixels[inside], seen[inside], 0.5, 0.05, 0.05)
    off = [first.moved(np.array([0.6, 0, 0, 0, 0, 0])), second.moved(np.array([-0.6, 0, 0, 0, 0, 0]))]
    found = adjust.adjust(off, [ties], ground, sigmas=np.tile([1.0, 1.0, 1.0, 0.01, 0.01, 0.01], (2, 1)))
    again = found.eyes[1].project(ground.meet(found.eyes[0], ties.pixels_first))
    assert again == pytest.approx(ties.pixels_second, abs=0.15)
    assert found.changes[:, :2].sum(axis=0) == pytest.approx([0, 0], abs=0.1)


def test_nothing_seen_changes_nothing() -> None:
    eye = eye_at()
    found = adjust.adjust([eye], [], Flat(0.0), sigmas=np.full((1, 6), 0.5))
    assert found.eyes[0].centre == pytest.approx(eye.centre)
    assert found.sigmas == pytest.approx(np.full((1, 6), 0.5))


def test_patches_are_found_to_a_fraction_of_a_pixel() -> None:
    picture = ndimage.gaussian_filter(np.random.default_rng(3).standard_normal((120, 150)), 2)
    moved = ndimage.shift(picture, (1.3, -0.6), order=3, mode="nearest")
    places, shifts = matching.nudges(picture, moved)
    assert len(places) > 40
    off = np.abs(shifts - [-0.6, 1.3])
    assert np.median(off) < 0.08
    assert np.quantile(off, 0.95) < 0.2
    blind = picture.copy()
    blind[:60] = np.nan
    assert (matching.nudges(picture, blind)[0][:, 1] > 60).all()
    assert len(matching.nudges(np.zeros((60, 60)), np.zeros((60, 60)))[0]) == 0


def test_the_same_ground_is_matched_and_noise_is_not() -> None:
    rng = np.random.default_rng(5)
    picture = ndimage.gaussian_filter(rng.standard_normal((240, 240)), 1.5).astype(np.float32)
    rotated = np.rot90(picture).copy()
    a, b = matching.features(picture), matching.features(rotated)
    pairs = matching.matched(a, b)
    good = matching.on_one_plane(a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]], 2.0)
    assert good.sum() > 50
    x, y = a.pixels[pairs[good, 0]].T
    assert b.pixels[pairs[good, 1]] == pytest.approx(np.stack([y, 239 - x], axis=1), abs=1.0)
    other = matching.features(ndimage.gaussian_filter(rng.standard_normal((240, 240)), 1.5).astype(np.float32))
    wrong = matching.matched(a, other)
    assert matching.on_one_plane(a.pixels[wrong[:, 0]], other.pixels[wrong[:, 1]], 2.0).sum() < 15
    assert len(matching.features(np.full((50, 50), np.nan, np.float32)).pixels) == 0
    assert len(matching.matched(matching.features(np.zeros((50, 50), np.float32)), a)) == 0
