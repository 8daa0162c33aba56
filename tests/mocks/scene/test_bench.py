"""Boards at known distances, and real views from a folder."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.decode.optics.carriers import Mask
from dappled.mocks.scene.bench import Bench, RealViews, TexturedPlane, WhiteCard
from dappled.mocks.scene.lens import Optics, Rays

OPTICS = Optics(50.0, 7.4, 6.7, Mask(15.5, 2), 0.48)


def rays(points: NDArray[np.float64], focus_m: float = math.inf) -> Rays:
    y, x = (np.linspace(-1, 1, n) * (n - 1) * 0.025 for n in (200, 240))
    return Rays(y, x, points, 50.0, focus_m)


def shift_of(picture: NDArray[np.float32], reference: NDArray[np.float32]) -> tuple[float, float]:
    """(rows, columns) by which a picture is moved against a reference: phase correlation, to a fraction of a sample."""
    window = np.hanning(picture.shape[0])[:, None] * np.hanning(picture.shape[1])[None, :]
    cross = np.fft.fft2((picture - picture.mean()) * window) * np.conj(
        np.fft.fft2((reference - reference.mean()) * window)
    )
    fy, fx = np.fft.fftfreq(picture.shape[0])[:, None], np.fft.fftfreq(picture.shape[1])[None, :]
    low = (np.hypot(fy, fx) < 0.15) & (np.hypot(fy, fx) > 0)
    weight = np.sqrt(np.abs(cross[low]))
    a = np.stack([(fy + 0 * fx)[low], (fx + 0 * fy)[low]], axis=1) * -2 * np.pi
    solution = np.linalg.lstsq(a * weight[:, None], np.angle(cross[low]) * weight, rcond=None)[0]
    return float(solution[0]), float(solution[1])


@pytest.mark.parametrize("focus_m", [math.inf, 5.0, 1.5])
def test_neighbouring_views_of_a_board_differ_by_what_its_distance_says(focus_m: float) -> None:
    optics = replace(OPTICS, focus_m=focus_m)
    distance = optics.depth_m(0.03, 5)  # 3 px of 10 µm
    points = optics.aperture_points_mm(7.4)
    bench = Bench.of(1, (TexturedPlane(distance),), 0.2)
    seen = bench.render(rays(points[2, 2:4], focus_m), None)
    down = bench.render(rays(points[2:4, 2], focus_m), None)
    rows, columns = shift_of(seen.radiance[1, 1], seen.radiance[0, 1])
    assert columns * 5 == pytest.approx(3.0, abs=0.03)  # samples are five pixels apart
    assert rows == pytest.approx(0, abs=0.01)
    assert shift_of(down.radiance[1, 1], down.radiance[0, 1])[0] * 5 == pytest.approx(3.0, abs=0.03)


def test_a_nearer_board_hides_the_backdrop_and_says_its_depth() -> None:
    bench = Bench.of(1, (TexturedPlane(3.0), TexturedPlane(2.0, extent_mm=(-2.0, 2.0, -3.0, 1.0))), 0.2)
    look = rays(np.array([[0.0, 0.0]]))
    depth = bench.render(look, None).depth_m
    assert depth is not None
    inside = (np.abs(look.y_mm) < 1.9)[:, None] & ((look.x_mm > -2.9) & (look.x_mm < 0.9))[None, :]
    outside = (np.abs(look.y_mm) > 2.1)[:, None] | ((look.x_mm < -3.1) | (look.x_mm > 1.1))[None, :]
    assert (depth[inside] == 2.0).all()
    assert (depth[outside] == 3.0).all()


def test_the_edge_of_a_board_moves_with_the_board() -> None:
    flat = (
        TexturedPlane(3.0, (0.1, 0.1, 0.1), contrast=0),
        TexturedPlane(2.0, (0.9, 0.9, 0.9), extent_mm=(-2, 2, -2, 2), contrast=0),
    )
    theta = 30.0
    seen = Bench.of(1, flat, 0.2).render(rays(np.array([[0.0, 0.0], [0.0, theta]])), None).radiance[:, 1, 100]
    edges = [float((line > 0.5).argmax()) for line in seen]
    assert (edges[1] - edges[0]) * 0.05 == pytest.approx(theta * 50e-3 / 2.0, abs=0.06)


def test_a_leaning_board_lies_in_its_plane() -> None:
    look = rays(np.zeros((1, 2)))
    depth = Bench.of(1, (TexturedPlane(2.0, tilt=(0.5, -0.8)),), 0.2).render(look, None).depth_m
    assert depth is not None
    y, x = look.y_mm[:, None] / 50 * depth, look.x_mm[None, :] / 50 * depth
    np.testing.assert_allclose(depth, 2.0 + 0.5 * y - 0.8 * x, rtol=1e-5)
    with pytest.raises(ValueError, match="tilted along the view"):
        Bench.of(1, (TexturedPlane(2.0, tilt=(0.0, 10.0)),), 0.2).render(look, None)


def test_a_white_card_is_white() -> None:
    seen = WhiteCard().render(rays(np.zeros((4, 2))), None)
    assert (seen.radiance == 1).all()


def views_in(folder: Path, count: int) -> None:
    for number in range(count):
        grey = np.full((12, 16, 3), 40 + 10 * number, dtype=np.uint8)
        Image.fromarray(grey).save(folder / f"view_{number:02d}.png")


def test_real_views_keep_their_order_and_become_linear(tmp_path: Path) -> None:
    views_in(tmp_path, 9)
    scene = RealViews.read(tmp_path, (10.0, 12.0))
    seen = scene.render(rays(np.zeros((9, 2))), None)
    assert seen.depth_m is None
    encoded = (40 + 10 * np.arange(9)) / 255
    np.testing.assert_allclose(seen.radiance[:, 0, 50, 60], ((encoded + 0.055) / 1.055) ** 2.4, rtol=1e-4)
    with pytest.raises(ValueError, match="as many aperture samples"):
        scene.render(rays(np.zeros((25, 2))), None)


def test_a_folder_that_is_no_light_field_is_refused(tmp_path: Path) -> None:
    views_in(tmp_path, 8)
    with pytest.raises(ValueError, match="8 PNG files"):
        RealViews.read(tmp_path, (10.0, 12.0))
