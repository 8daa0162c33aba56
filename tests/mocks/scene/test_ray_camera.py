"""The ray camera against results that can be derived by hand: closed forms, and rays summed one by one."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import special

from dappled.decode.optics import Mask, Order
from dappled.mocks import shoot
from dappled.mocks.scene import lens
from dappled.mocks.scene.ray_camera import REAL_COLOURS, WHITE, RayCamera, RayFrame
from dappled.mocks.scene.sharp_boards import SharpBoard

FULL = Mask(15.5, 2)
CLEAN = RayCamera(FULL, shape=(48, 64), boards=WHITE, full_well_e=0, lens_diffraction=False, mask_diffraction=False)
STOPPED = replace(CLEAN, f_number=60.0)


def jinc(cycles: float) -> float:
    return float(2 * special.j1(np.pi * cycles) / (np.pi * cycles)) if cycles else 1.0


def wave(picture: NDArray[np.floating], frequency: tuple[float, float]) -> complex:
    """Amplitude over the mean of a plane wave (cycles/pixel) about the middle, where it is the only one near by."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in picture.shape)
    window = np.outer(np.hanning(len(y)), np.hanning(len(x)))
    turns = frequency[0] * y[:, None] + frequency[1] * x[None, :]
    return complex((picture * window * np.exp(-2j * np.pi * turns)).sum() / (picture * window).sum())


def line(camera: RayCamera, order: Order) -> complex:
    """What is left of an order in a white frame after stop, film and light; the pixels' own sinc is divided out.

    A box of `finer` points stands for a pixel: sin(πf)/(n·sin(πf/n)) on each axis.
    """
    ky, kx = camera.lattice().carriers([order])[0].fy, camera.lattice().carriers([order])[0].fx
    n = camera.finer
    box = [math.sin(math.pi * f) / (n * math.sin(math.pi * f / n)) if f else 1.0 for f in (ky, kx)]
    return wave(camera.expose().plane, (ky, kx)) / (box[0] * box[1])


def board(cycles_per_px: float, disparity: float, shape: tuple[int, int] = (48, 64)) -> SharpBoard:
    """A backdrop with a vertical grating, which goes on beyond the frame where that holds whole periods."""
    n = 8
    x = (np.arange(shape[1] * n) + 0.5) / n - shape[1] / 2
    lines = (1 + 0.4 * np.cos(2 * np.pi * cycles_per_px * x)).astype(np.float32)
    return SharpBoard(disparity, picture=np.repeat(np.tile(lines, (shape[0] * n, 1))[..., None], 3, axis=-1))


@pytest.mark.parametrize(
    ("stop", "expected"),
    [
        ("square", lambda c: np.sinc(c[0]) * np.sinc(c[1])),
        ("round", lambda c: jinc(math.hypot(*c))),
        # four blades: a square of side 1/√2 on its corner
        ("polygon", lambda c: np.sinc((c[0] + c[1]) / 2) * np.sinc((c[0] - c[1]) / 2)),
    ],
)
@pytest.mark.parametrize("order", [(0, 1), (1, 1), (1, -2)])
@pytest.mark.parametrize("kappa", [0.5, 1.0])
def test_a_stop_averages_an_order_by_its_own_transform(
    stop: Any, expected: Callable[[tuple[float, float]], float], order: Order, kappa: float
) -> None:
    camera = replace(CLEAN, stop=stop, blades=4, blade_turn_rad=0.0, points_per_view=8, level=0.1)
    camera = replace(camera, f_number=15.5 * 0.48 / kappa)
    kept = lens.modulation(FULL)[max(order, (-order[0], -order[1]))]
    assert camera.kappa == pytest.approx(kappa)
    assert line(camera, order) == pytest.approx(kept * expected((order[0] * kappa, order[1] * kappa)), abs=0.004)


def test_a_round_stop_has_its_null_where_the_jinc_has() -> None:
    """J1's first zero, 3.8317/π = 1.2197; before it an order stands upright, beyond it reversed."""
    at = [replace(CLEAN, points_per_view=8, f_number=15.5 * 0.48 / c) for c in (1.0, 1.2197, 1.5)]
    before, null, beyond = (line(camera, (0, 1)).real for camera in at)
    assert before > 0.02
    assert abs(null) < 0.002
    assert beyond < -0.02


@pytest.mark.parametrize("pattern", ["full", "diagonal"])
@pytest.mark.parametrize("harmonics", ["linear", "octave"])
def test_a_film_makes_the_orders_of_its_picture(pattern: Any, harmonics: Any) -> None:
    """Against the DFT of the drawn picture, scaled from black to clear."""
    mask = Mask(4.0, 3, pattern, harmonics)
    turns = np.arange(512) / 512
    drawn = lens.transmission(mask, turns[:, None], turns[None, :])
    series = np.fft.fft2(drawn - drawn.min())
    orders, strengths, _ = replace(CLEAN, mask=mask).orders()
    assert {(0, 0), *map(tuple, orders)} == set(mask.half_orders())
    assert [series[ky, kx] / series[0, 0] for ky, kx in orders] == pytest.approx(list(strengths), abs=1e-4)


def test_a_film_keeps_the_sinc_of_its_pixels_and_draws_nothing_finer_than_two() -> None:
    mask = Mask(10.0, 3, film_px_per_mm=50.0)  # the third harmonic would be 1.67 px a period
    there = {tuple(order): s for order, s in zip(*replace(CLEAN, mask=mask).orders()[:2], strict=True)}
    whole = {tuple(order): s for order, s in zip(*replace(CLEAN, mask=Mask(10.0, 2)).orders()[:2], strict=True)}
    assert there.keys() == whole.keys()
    assert there[1, 2] / whole[1, 2] == pytest.approx(np.sinc(0.2) * np.sinc(0.4))
    without = replace(CLEAN, mask=mask, film=False).orders()
    assert (3, 3) in set(map(tuple, without[0]))


def test_diffraction_on_the_way_takes_an_order_and_reverses_it() -> None:
    """cos(π·λ·d·f²) at 550 nm: λ·d·f² = 1/2 takes it, 1 reverses it. An order (1, 1) has √2 times the frequency."""
    f = math.sqrt(0.5 / 550e-6 / 0.48)
    camera = replace(CLEAN, mask=Mask(f, 1), mask_diffraction=True)
    orders, strengths, _ = camera.orders()
    left = {
        tuple(order): s / lens.modulation(camera.mask)[tuple(order)] for order, s in zip(orders, strengths, strict=True)
    }
    assert left[0, 1] == pytest.approx(0, abs=1e-9)
    assert left[1, 1] == pytest.approx(-1)


def test_exit_pupil_zoom_and_print_place_the_carriers() -> None:
    """k·f·(1 − d/v): v is the exit pupil's, whatever the focal length says; the print's scale multiplies f."""
    camera = replace(STOPPED, exit_pupil_mm=24.0, print_scale=1.01, anisotropy=0.004, f_number=90.0)
    step = 15.5 * 1.01 * (1 - 0.48 / 24) * 0.01
    assert camera.lattice().ky == pytest.approx((step * 1.002, 0))
    assert camera.lattice().kx == pytest.approx((0, step * 0.998))
    zoomed = replace(camera, focal_length_mm=13.0, exit_pupil_mm=None)
    assert zoomed.lattice().kx[1] == pytest.approx(15.5 * 1.01 * (1 - 0.48 / 13) * 0.01 * 0.998)
    kept = abs(line(camera, (0, 1)))
    plane = camera.expose().plane
    assert abs(wave(plane, (0.0, step * 0.998))) > 0.9 * kept > 0.2
    assert abs(wave(plane, (0.0, step * 0.998 + 1.9 / 64))) < 0.1 * kept


def test_a_mask_that_moved_and_turned_is_where_it_was_in_the_calibration() -> None:
    camera = replace(STOPPED, shift_mm=(0.0, 0.01), moved_mm=(0.0, 0.016), turned_rad=0.01, turn_rad=0.02)
    before = camera.calibration()
    phases = [np.angle(line(one, (0, 1))) / (2 * np.pi) for one in (before, camera)]
    assert phases == pytest.approx([15.5 * 0.01, 15.5 * 0.026], abs=2e-3)
    assert before.lattice().kx[0] / before.lattice().kx[1] == pytest.approx(-math.tan(0.02))
    assert camera.lattice().kx[0] / camera.lattice().kx[1] == pytest.approx(-math.tan(0.03))


@pytest.mark.parametrize("bow_mm", [0.0, 0.04])
def test_a_frame_is_the_sum_of_its_rays(bow_mm: float) -> None:
    """Every sample of some pixels, from every point of the stop, through the mask at its own place."""
    camera = replace(
        CLEAN, shape=(24, 32), boards=(board(0.125, 0.02, (24, 32)),), points_per_view=2, turn_rad=0.03,
        shift_mm=(0.011, -0.007), print_scale=1.02, anisotropy=0.02, bow_mm=bow_mm, defocus=0.01,
    )  # fmt: skip
    made = camera.expose()
    y, x = camera.grid.places_mm
    corner = y[0] ** 2 + x[0] ** 2
    alpha = (0.48 - bow_mm * (y[:, None] ** 2 + x[None, :] ** 2) / corner) / 50
    low, high = lens.pattern_range(FULL)
    c, s = math.cos(0.03), math.sin(0.03)
    total = np.zeros((72, 96))
    for (ty, tx), weight in zip(camera.open_stop.points * camera.aperture_mm, camera.open_stop.weights, strict=True):
        at_y, at_x = (1 - alpha) * y[:, None] + alpha * ty, (1 - alpha) * x[None, :] + alpha * tx
        own_y, own_x = c * at_y + s * at_x, -s * at_y + c * at_x
        film = lens.transmission(FULL, (own_y + 0.011) * 15.81 * 1.01, (own_x - 0.007) * 15.81 * 0.99)
        light = 1 + 0.4 * np.cos(2 * np.pi * 12.5 * (x - 0.03 * tx))
        total += weight * light[None, :] * (film - low) / (high - low)
    expected = total.reshape(24, 3, 32, 3).mean(axis=(1, 3))
    expected *= made.plane.mean() / expected.mean()
    assert np.abs(made.plane - expected).max() < 0.01 * made.plane.mean()


def test_defocus_blurs_by_the_stops_own_transform_and_views_by_their_cells() -> None:
    """A grating f seen at disparity D moves by D·θ: the frame keeps jinc(f·D·A), a whole cell of the stop its sinc."""
    f, disparity = 0.125, 0.02
    sharp, blurred = (replace(CLEAN, boards=(board(f, d),), points_per_view=6).expose() for d in (0.0, disparity))
    cycles = f / 0.01 * disparity * CLEAN.aperture_mm  # over the diameter
    means = [np.einsum("ij,ijhw->hw", t.view_weights, t.views[..., 0]) for t in (sharp.truth, blurred.truth)]
    ratio = [wave(mean, (0, f)) for mean in means]
    assert (ratio[1] / ratio[0]).real == pytest.approx(jinc(cycles), abs=0.01)
    middle = [wave(t.views[2, 2, ..., 0], (0, f)) for t in (sharp.truth, blurred.truth)]
    assert abs(middle[1] / middle[0]) == pytest.approx(np.sinc(cycles / 5), abs=0.01)
    beside = wave(blurred.truth.views[2, 3, ..., 0], (0, f)) / middle[1]
    assert np.angle(beside) / (2 * np.pi) == pytest.approx((-cycles / 5 + 0.5) % 1 - 0.5, abs=0.01)
    assert blurred.truth.disparity == pytest.approx(disparity)


def test_a_lens_diffracts_detail_away() -> None:
    """A round lens keeps 2/π·(acos s − s·√(1 − s²)) at s = f·λ·N; at f/22, 12 cycles/mm: s = 0.145."""
    camera = replace(CLEAN, boards=(board(0.12, 0.0),), f_number=22.0)
    sharp, real = (replace(camera, lens_diffraction=on).expose().truth.views[2, 2, ..., 0] for on in (False, True))
    s = 12 * 550e-6 * 22
    expected = 2 / math.pi * (math.acos(s) - s * math.sqrt(1 - s * s))
    assert (wave(real, (0, 0.12)) / wave(sharp, (0, 0.12))).real == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("exponent", [1.1, 2.0])
def test_a_sharp_scene_has_detail_beyond_a_slices_band_and_a_kind_one_has_none(exponent: float) -> None:
    """Amplitude ∝ f^−exponent: from the ratio of power in two rings, the pixels' sinc divided out."""
    scene = SharpBoard(exponent=exponent, contrast=0.1)
    camera = replace(CLEAN, shape=(128, 128), points_per_view=1, stop="square", seed=4)
    fy, fx = np.meshgrid(np.fft.fftfreq(128), np.fft.fftfreq(128), indexing="ij")
    f = np.hypot(fy, fx)

    def rings(one: SharpBoard) -> list[float]:
        view = replace(camera, boards=(one,)).expose().truth.views[2, 2, ..., 0]
        window = np.outer(np.hanning(128), np.hanning(128))
        spectrum = np.abs(np.fft.fft2((view - view.mean()) * window)) / (np.sinc(fy) * np.sinc(fx))
        return [
            float(np.sqrt((spectrum[(f > low) & (f < high)] ** 2).mean())) for low, high in ((0.05, 0.06), (0.2, 0.24))
        ]

    near, far = rings(scene)
    assert math.log(near / far) / math.log(4) == pytest.approx(exponent, abs=0.12)
    near, far = rings(replace(scene, finest=0.07))
    assert far < 1e-3 * near


def test_a_board_hides_what_is_behind_it_from_each_view_apart() -> None:
    dark = SharpBoard(0.0, colour=(0.1, 0.1, 0.1), contrast=0)
    near = SharpBoard(0.06, (-0.6, 0.6, 0.0, 0.6), (0.9, 0.9, 0.9), contrast=0)
    truth = replace(CLEAN, boards=(dark, near), stop="square").expose().truth
    edges = [int(np.argmax(truth.views[2, u, 24, :, 0] > np.ptp(truth.views[2, u, 24]) / 2)) for u in range(5)]
    step_px = 0.06 * CLEAN.aperture_mm / 5 / 0.01
    assert np.diff(edges) == pytest.approx(step_px, abs=1)
    middle = truth.views[2, 2, 24, :, 0]
    assert middle[-4] / middle[3] == pytest.approx(9)  # 0.9 hides the 0.1 behind it
    assert truth.disparity[24, 10] == 0
    assert truth.disparity[24, 50] == pytest.approx(0.06)


def test_corners_lose_light_and_part_of_their_stop() -> None:
    """Two circles of diameter 1 shifted by s overlap by 2/π·(acos s − s·√(1 − s²))."""
    falls = replace(CLEAN, falloff=0.4).expose().truth.views[2, 2, ..., 0]
    assert falls[0, 0] / falls[24, 32] == pytest.approx(0.6, abs=0.03)
    truth = replace(CLEAN, cats_eye=0.5, points_per_view=6, shape=(24, 32)).expose().truth
    light = np.einsum("ij,ijhw->hw", truth.view_weights, truth.views[..., 0])
    s = 0.5 * math.hypot(11.5, 15.5) / math.hypot(12 - 1 / 6, 16 - 1 / 6)
    expected = 2 / math.pi * (math.acos(s) - s * math.sqrt(1 - s * s))
    assert light[0, 0] / light[12, 16] == pytest.approx(expected, abs=0.03)
    assert truth.views[0, 2, 0, 16, 0] != pytest.approx(truth.views[4, 2, 0, 16, 0], rel=0.1)


def test_overlapping_filters_mix_saturated_colours() -> None:
    red = SharpBoard(colour=(0.9, 0.0, 0.0), contrast=0)
    camera = replace(CLEAN, boards=(red,), colour_filters=REAL_COLOURS, f_number=1.0)  # the mask averaged away
    frame = camera.expose()
    share = np.array(REAL_COLOURS)[:, 0]
    plane = frame.plane
    assert plane[0::2, 1::2].mean() / plane[0::2, 0::2].mean() == pytest.approx(share[1] / share[0], rel=0.02)
    assert plane[1::2, 1::2].mean() / plane[0::2, 0::2].mean() == pytest.approx(share[2] / share[0], rel=0.02)
    means = frame.truth.views[2, 2].mean(axis=(0, 1))
    assert means / means[0] == pytest.approx(share / share[0], rel=1e-3)


def test_a_chip_clips_drifts_bands_and_has_dead_spots() -> None:
    light = replace(STOPPED, shape=(64, 64), f_number=1.0)
    clean = light.expose().plane
    noisy = replace(light, full_well_e=1000.0, read_noise_e=10.0).expose().plane
    assert (noisy - clean).std() == pytest.approx(math.sqrt(0.35 / 1000 + 1e-4), rel=0.05)
    drift = replace(light, gain_drift=0.2).expose().plane
    assert drift[-1].mean() / drift[0].mean() == pytest.approx(1.1 / 0.9, rel=1e-3)
    bands = replace(light, banding=0.01).expose().plane - clean
    assert bands.std(axis=0).mean() == pytest.approx(0.01, rel=0.3)
    assert bands.std(axis=1).max() < 1e-6
    hot = replace(light, hot_pixels=0.01).expose()
    assert (hot.plane == 1).sum() == 41
    assert hot.truth.clipped == pytest.approx(0.01, abs=1e-4)
    dusty = replace(light, dust=3).expose().plane / clean
    assert 0.2 < dusty.min() < 0.92
    assert dusty.max() == pytest.approx(1, abs=1e-5)
    bright = replace(STOPPED, level=0.5).expose()
    assert 0.05 < bright.truth.clipped < 0.3
    assert bright.plane.max() == 1


def test_a_jpeg_has_the_tone_curve_of_srgb() -> None:
    grey = RayFrame(np.full((16, 16), 0.2, np.float32), CLEAN.expose().truth)
    with Image.open(io.BytesIO(grey.jpeg(95))) as picture:
        assert picture.mode == "L"
        assert np.asarray(picture).mean() == pytest.approx(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055), abs=1)
    colour = replace(CLEAN, colour_filters=REAL_COLOURS, f_number=1.0).expose()
    with Image.open(io.BytesIO(colour.jpeg())) as picture:
        assert picture.mode == "RGB"
        assert picture.size == (64, 48)


def test_what_no_camera_is_has_a_sentence() -> None:
    with pytest.raises(ValueError, match=r"2\.5 times finer than its pixels"):
        replace(CLEAN, finer=2)
    with pytest.raises(ValueError, match="finer than its pixels"):
        replace(CLEAN, mask_distance_mm=60.0)
    with pytest.raises(ValueError, match="must be positive"):
        replace(CLEAN, print_scale=0.0)


def test_shoot_writes_a_frame_with_the_imperfections_that_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, truth = tmp_path / "hard.dng", tmp_path / "truth.npz"
    words = [str(out), "--scale", "0.02", "--truth", str(truth), "--rays", "print_scale=1.003", "points_per_view=1"]
    assert shoot.main([*words, "stop=square", "moved_mm=0.016,0", "colours=yes", "film=no"]) == 0
    assert out.stat().st_size > 2 * 56 * 74
    assert np.load(truth)["lattice"][0, 0] == pytest.approx(0.155 * 1.003 * (1 - 0.48 / 50))
    for more in ([], ["--super-ccd"]):
        picture = tmp_path / f"hard{len(more)}.jpg"
        assert shoot.main([str(picture), "--scale", "0.02", *more, "--rays", "points_per_view=1"]) == 0
        with Image.open(picture) as read:
            assert read.size == (74, 56)
    assert (tmp_path / "hard0.jpg").read_bytes() != (tmp_path / "hard1.jpg").read_bytes()
    with pytest.raises(SystemExit):
        shoot.main([str(out), "--rays", "print_size=2"])
    assert "print_size=2: no such parameter" in capsys.readouterr().err
