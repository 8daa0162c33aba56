from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import refocus
from dappled.decode.lightfield.light_field import ViewStack, centred
from dappled.decode.lightfield.refocus import all_in_focus, anaglyph, eyes, focal_stack, shift_and_add, side_by_side
from tests.decode.scenes import Board, cameras, paint

INNER = (slice(8, -8), slice(8, -8))


def psnr(found: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((found[INNER] - truth[INNER]) ** 2)))


def ramps(disparity: float, *, n: int = 5, side: int = 24) -> ViewStack:
    """A quadratic picture seen at one disparity."""
    y, x = np.mgrid[0:side, 0:side] / side
    steps = centred(n)
    views = [
        [(y - disparity * sy / side) ** 2 + 0.5 * (x - disparity * sx / side) * (y - disparity * sy / side)
         for sx in steps] for sy in steps
    ]  # fmt: skip
    return ViewStack(np.array(views, dtype=np.float32), steps, steps)


@given(st.floats(-1.5, 1.5), st.sampled_from([1, 2, 3, 5]))
@settings(deadline=None)
def test_a_plane_in_focus_is_the_middle_view(disparity: float, n: int) -> None:
    made = refocus.shift_and_add(ramps(disparity, n=n), disparity)
    truth = ramps(disparity, n=1).views[0, 0]
    np.testing.assert_allclose(made[INNER], truth[INNER], atol=2e-4)  # a sinc under a window; cubic is exact on it


def test_a_textured_scene_comes_into_focus_where_it_is() -> None:
    near, far = Board(0.7, half=(40, 40), texture=1), Board(-0.4)
    stack, truth = paint([far, near], (120, 120), 7)
    sharp = {d: refocus.shift_and_add(stack, d) for d in (0.7, -0.4)}
    middle = stack.middle()
    edge = ndimage.maximum_filter(truth, 15) != ndimage.minimum_filter(truth, 15)
    for d, other in ((0.7, -0.4), (-0.4, 0.7)):
        here = (np.abs(truth - d) < 0.01) & ~edge
        rms = {name: float(np.sqrt(np.mean((made - middle)[here] ** 2))) for name, made in sharp.items()}
        assert rms[d] < 0.01
        assert rms[d] < rms[other] / 5


@pytest.mark.parametrize(("object_m", "focus_m"), [(1.0, 2.0), (2.0, 2.0), (8.0, 2.0), (0.9, math.inf), (3.0, 1.2)])
def test_alpha_is_the_film_s_distance_of_equation_28(object_m: float, focus_m: float) -> None:
    """By the thin lens and similar triangles: an object is sharp on a film at v', the sensor lies at v, α = v'/v."""
    f, aperture, pitch, view_px, n = 50.0, 6.25, 0.01, 8, 5
    sensor, film = (1 / (1 / f - 1 / (1000 * metres)) for metres in (focus_m, object_m))
    rays = np.array([-aperture / 2, aperture / 2])
    on_sensor = rays + (0.0 - rays) * sensor / film  # from the lens to the image on the axis at `film`, cut at `sensor`
    shift_px = float(np.ptp(on_sensor)) * math.copysign(1.0, film - sensor) / pitch
    stack, _ = paint([Board(shift_px / (n * view_px))], (64, 64), n)
    stack = replace(stack, sensor_px_per_disparity=float(n * view_px))
    alpha = film / sensor
    assert (alpha > 1) == (object_m < focus_m)
    made = refocus.shift_and_add(stack, refocus.disparity_of_alpha(alpha, aperture / pitch, stack))
    assert psnr(made, stack.middle()) > 42
    if object_m != focus_m:  # the plane as far on the other side is not sharp
        other = refocus.shift_and_add(stack, refocus.disparity_of_alpha(1 / alpha, aperture / pitch, stack))
        assert psnr(other, stack.middle()) < psnr(made, stack.middle()) - 5


@pytest.mark.parametrize("alpha", [0.9, 1.0, 1.15])
def test_magnified_it_is_equation_28_itself(alpha: float) -> None:
    """E(x, y) = mean of L(u(1 − 1/α) + x/α, v(1 − 1/α) + y/α, u, v), lengths in pixels of a view on the sensor."""
    n, aperture = 3, 6.0  # px of a view
    stack, _ = paint([Board(0.3)], (64, 64), n)
    stack = replace(stack, sensor_px_per_disparity=float(n))  # one sensor pixel a pixel of a view
    y, x = np.mgrid[0:64, 0:64] - 31.5
    total = np.zeros((64, 64))
    for row, v in enumerate(np.array([-1, 0, 1]) * aperture / n):
        for column, u in enumerate(np.array([-1, 0, 1]) * aperture / n):
            at = [v * (1 - 1 / alpha) + y / alpha + 31.5, u * (1 - 1 / alpha) + x / alpha + 31.5]
            total += ndimage.map_coordinates(stack.views[row, column], at, order=5, mode="nearest")
    made = refocus.magnified(refocus.shift_and_add(stack, refocus.disparity_of_alpha(alpha, aperture, stack)), alpha)
    known = np.isfinite(made)
    assert known[INNER].mean() > (0.6 if alpha < 1 else 0.99)
    assert np.abs(made - total / 9)[INNER][known[INNER]].max() < 0.02


@pytest.mark.parametrize("alpha", [0.0, -1.0, math.nan, math.inf])
def test_an_alpha_that_is_no_plane_is_told(alpha: float) -> None:
    with pytest.raises(DecodeError, match="is not an image plane"):
        refocus.disparity_of_alpha(alpha, 100.0, replace(ramps(0.0), sensor_px_per_disparity=5.0))
    with pytest.raises(DecodeError, match="views from a folder have no sensor"):
        refocus.disparity_of_alpha(1.1, 100.0, ramps(0.0))


def test_colours_are_refocused_each() -> None:
    grey, _ = paint([Board(0.5)], (40, 48), 3)
    colour = ViewStack(np.stack([grey.views, 0.5 * grey.views, 1 - grey.views], axis=-1), *2 * (grey.row_steps,))
    made, alone = refocus.shift_and_add(colour, 0.5), refocus.shift_and_add(grey, 0.5)
    np.testing.assert_allclose(made, np.stack([alone, 0.5 * alone, 1 - alone], axis=-1), atol=1e-6)
    along = refocus.along(colour, np.full((40, 48), 0.5, np.float32))
    np.testing.assert_allclose(along[INNER], made[INNER], atol=0.01)


def test_the_same_bytes_for_any_number_of_workers() -> None:
    stack, truth = paint([Board(0.5)], (40, 48), 5)
    assert np.array_equal(refocus.shift_and_add(stack, 0.3), refocus.shift_and_add(stack, 0.3, workers=3))
    assert np.array_equal(refocus.along(stack, truth), refocus.along(stack, truth, workers=3))


def test_what_no_view_has_is_unknown() -> None:
    stack = ramps(0, n=2, side=24)
    made = refocus.shift_and_add(stack, 30.0)
    assert np.isnan(made).any()
    assert np.isfinite(made).any()
    assert np.isfinite(refocus.shift_and_add(ramps(0, n=3), 30.0)).all()


def test_a_tilted_plane_is_sharp_all_over() -> None:
    stack, truth = paint([Board(0.4, slope=(0.01, 0.0))], (100, 100), 5)
    plane = refocus.FocalPlane(0.4, over_height=0.99)
    np.testing.assert_allclose(plane.over((100, 100)), truth, atol=1e-3)
    tilted, level = refocus.tilted(stack, plane), refocus.tilted(stack, refocus.FocalPlane(0.4))
    assert psnr(tilted, stack.middle()) > psnr(level, stack.middle()) + 8


def test_along_leaves_the_unknown_unknown() -> None:
    stack, truth = paint([Board(0.4)], (40, 40), 3)
    truth[10:20, 10:20] = np.nan
    made = refocus.along(stack, truth)
    assert np.array_equal(np.isnan(made), np.isnan(truth))


def test_a_smaller_aperture_blurs_less() -> None:
    stack, _ = paint([Board(0.8)], (80, 80), 7)
    off = [psnr(refocus.shift_and_add(stack, 0, weights=refocus.disc(stack, d)), stack.middle()) for d in (0.2, 0.5, 1)]
    assert off[0] > off[1] > off[2]
    beside = refocus.disc(stack, 0.3, (0.0, 0.3))
    assert beside[3, 5] > beside[3, 3]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: refocus.disc(s, 0), "lets no light through"),
        (lambda s: refocus.shift_and_add(s, math.nan), "is not a plane"),
        (lambda s: refocus.shift_and_add(s, 0, weights=np.zeros((5, 5))), "not all 0"),
        (lambda s: refocus.shift_and_add(s, 0, weights=np.ones((4, 5))), r"weights of shape \(4, 5\)"),
        (lambda s: refocus.along(s, np.zeros((3, 3))), r"the surface is \(3, 3\)"),
    ],
)
def test_nonsense_is_told(call, words: str) -> None:  # type: ignore[no-untyped-def]  # several signatures
    with pytest.raises(DecodeError, match=words):
        call(ramps(0))


SCENE = [Board(-0.6), Board(0.8, half=(30, 30), texture=1)]


def test_the_sharpest_picture_is_chosen_everywhere() -> None:
    stack, truth = paint(SCENE, (120, 120), 7)
    planes = np.linspace(-0.6, 0.8, 8)
    made = all_in_focus(focal_stack(stack, planes))
    inner = (slice(12, -12), slice(12, -12))
    near_edge = ndimage.maximum_filter(truth, 17) != ndimage.minimum_filter(truth, 17)
    judged = ~near_edge[inner]
    chosen = planes[made.index]
    assert np.mean(np.abs(chosen - truth)[inner][judged] < 0.11) > 0.97
    middle = stack.middle()
    error = np.sqrt(np.mean((made.picture - middle)[inner][judged] ** 2))
    alone = min(np.sqrt(np.mean((shift_and_add(stack, d) - middle)[inner][judged] ** 2)) for d in planes)
    assert error < alone / 3


def test_colour_and_flat_parts() -> None:
    stack, _ = paint(SCENE, (60, 60), 3)
    stack.views[..., :20] = 0.5
    colour = ViewStack(np.repeat(stack.views[..., None], 3, axis=4), stack.row_steps, stack.column_steps)
    made = all_in_focus(focal_stack(colour, [-0.6, 0.0, 0.8]))
    assert made.picture.shape == (60, 60, 3)
    assert (made.index[:, :8] == -1).all()
    assert (made.index[:, 40:] >= 0).all()
    with pytest.raises(DecodeError, match="at least one plane"):
        focal_stack(stack, [])


def column_of_spot(picture: np.ndarray) -> float:
    weight = picture - picture.min()
    return float((weight * np.arange(picture.shape[1])).sum() / weight.sum())


@pytest.mark.parametrize("turned", [False, True])
def test_near_things_are_further_right_for_the_left_eye(turned: bool) -> None:
    stack, _ = paint([Board(0.0, contrast=0.0, mean=0.2), Board(1.0, half=(8, 8), contrast=0.0, mean=0.9)], (48, 64), 5)
    if turned:
        stack = cameras(stack.views[::-1, ::-1])
    pair = eyes(stack, separation=0.8)
    assert column_of_spot(pair.left) > column_of_spot(pair.right) + 0.3
    both = anaglyph(pair)
    np.testing.assert_array_equal(both[..., 0], pair.left)
    np.testing.assert_array_equal(both[..., 2], pair.right)
    np.testing.assert_array_equal(side_by_side(pair)[:, :64], pair.left)
    np.testing.assert_array_equal(side_by_side(pair, crossed=True)[:, :64], pair.right)


def test_eyes_that_do_not_fit_are_told() -> None:
    stack, _ = paint([Board(0.0)], (16, 16), 3)
    with pytest.raises(DecodeError, match="don't fit"):
        eyes(stack, separation=1.2)
    with pytest.raises(DecodeError, match="several columns"):
        eyes(ViewStack(stack.views[:, :1], stack.row_steps, np.zeros(1)))
