"""The whole camera: files, noise, exposure, truth, and that the truth can be had back from the frame."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rawpy
from numpy.typing import NDArray

from dappled.mocks.scene.masked_camera import MaskedCamera, SensorModel, SimulatedExposure, Truth, reference_camera
from tests.mocks.scene import oracles


def quiet(sensor: SensorModel) -> SensorModel:
    return replace(sensor, shot_noise=False, read_noise_e=0.0)


def plane_of(camera: MaskedCamera, exposure: SimulatedExposure) -> NDArray[np.float64]:
    sensor = camera.sensor
    return np.asarray((exposure.raw.astype(np.float64) - sensor.black) / (sensor.white - sensor.black))


@pytest.fixture(scope="module")
def flying() -> MaskedCamera:
    return reference_camera(3, scale=0.2)


@pytest.fixture(scope="module")
def bench() -> MaskedCamera:
    return reference_camera(5, scale=0.25, scene="bench")


def strengths(plane: NDArray[np.float64], truth: Truth) -> NDArray[np.float64]:
    """|carrier| / DC for every order, by a windowed sum at exactly the true frequency."""
    window = np.hanning(plane.shape[0])[:, None] * np.hanning(plane.shape[1])[None, :]
    rows, columns = np.arange(plane.shape[0]), np.arange(plane.shape[1])
    found = []
    for carrier in truth.lattice.carriers(truth.mask.orders()):
        row = np.exp(-2j * np.pi * carrier.fy * rows)
        found.append(abs(row @ (plane * window) @ np.exp(-2j * np.pi * carrier.fx * columns)))
    return np.asarray(np.array(found) / found[0])


def slices_of(plane: NDArray[np.float64], truth: Truth) -> NDArray[np.complex128]:
    """(K, h, w) grey slices by an oracle that knows the lattice: demodulate, low-pass, undo the mask's modulation.

    Carriers' phases at the frame's centre come from the mask's shift, their strengths from its pattern (Eq 11).
    """
    h, w = plane.shape
    spectrum_y, spectrum_x = np.fft.fftfreq(h)[:, None], np.fft.fftfreq(w)[None, :]
    half = 0.5 * math.hypot(*truth.lattice.ky)
    low = (np.abs(spectrum_y) < half) & (np.abs(spectrum_x) < half)
    rows, columns = np.arange(h)[:, None] - (h - 1) / 2, np.arange(w)[None, :] - (w - 1) / 2
    step = int(truth.grid[0, 0])
    offset = 1.375  # Eq 11's pattern less its lowest value, −0.375, has this mean
    found = []
    for carrier in truth.lattice.carriers(truth.mask.orders()):
        order = np.array([carrier.ky, carrier.kx])
        shift = order @ np.array(truth.mask_shift_mm) * truth.mask.frequency_per_mm
        base = plane * np.exp(-2j * np.pi * (carrier.fy * rows + carrier.fx * columns + shift))
        slice_ = np.fft.ifft2(np.fft.fft2(base) * low)[::step, ::step]
        weight = 1.0 if not order.any() else 0.5 ** np.count_nonzero(order) / offset
        found.append(slice_ / weight)
    return np.array(found)


def angular_matrix(truth: Truth, points_mm: NDArray[np.float64]) -> NDArray[np.complex128]:
    """(K, U): exp(2πi·k·f_m·α·R·θ) for aperture points (..., 2)."""
    c, s = math.cos(truth.mask_rotation_rad), math.sin(truth.mask_rotation_rad)
    k = np.array(truth.mask.orders()) @ np.array([[c, s], [-s, c]]) * truth.angular_frequency_per_mm
    return np.asarray(np.exp(2j * np.pi * (k @ points_mm.reshape(-1, 2).T)))


def inside(views: NDArray[np.floating]) -> NDArray[np.float64]:
    """Grey as the mosaic weighs it where there is colour, without the frame's border."""
    grey = views @ np.array([0.25, 0.5, 0.25]) if views.shape[-1] == 3 else views
    return np.asarray(grey[..., 12:-12, 12:-12], dtype=np.float64)


def psnr(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return -10 * math.log10(float(np.mean((np.asarray(a, dtype=np.float64) - b) ** 2)))


def test_the_file_holds_the_frame_and_the_shot(flying: MaskedCamera) -> None:
    shot = flying.expose(4.0, 7)
    assert shot.name_suffix == ".dng"
    with rawpy.imread(io.BytesIO(shot.file)) as seen:
        np.testing.assert_array_equal(seen.raw_image_visible, shot.raw)
        assert seen.raw_image_visible.shape == flying.sensor.shape
        assert seen.other.focal_length == 50.0
        assert seen.other.aperture == pytest.approx(7.4)
        assert seen.other.shutter_speed == pytest.approx(1 / 1000, rel=0.2)


def test_a_shot_belongs_to_its_seed_its_number_and_its_time(flying: MaskedCamera) -> None:
    shot = flying.expose(4.0, 7)
    assert flying.expose(4.0, 7).file == shot.file
    assert flying.latency_s(8) != flying.latency_s(7) == shot.latency_s
    assert not np.array_equal(flying.expose(9.0, 7).raw, shot.raw)
    other = reference_camera(4, scale=0.2)
    assert other.installed != flying.installed


def test_the_picture_is_taken_latency_and_half_the_exposure_after_the_trigger(flying: MaskedCamera) -> None:
    shot = flying.expose(4.0, 7, exposure_s=0.002)
    assert shot.mid_exposure_t_s == pytest.approx(4.0 + shot.latency_s + 0.001)
    assert flying.path is not None
    assert shot.truth.pose == flying.path.pose(shot.mid_exposure_t_s)
    latencies = [flying.latency_s(n) for n in range(200)]
    assert 0.045 <= min(latencies) < 0.050
    assert 0.070 < max(latencies) <= 0.075


def test_exposure_time_scales_the_light_and_white_is_white(flying: MaskedCamera) -> None:
    metered_s, level = flying.metered(7.4)
    assert 0.36 < level <= 0.4
    once = plane_of(flying, flying.expose(4.0, 7)).mean()
    half = plane_of(flying, flying.expose(4.0, 7, exposure_s=metered_s / 2)).mean()
    assert half == pytest.approx(once / 2, rel=0.01)
    burnt = flying.expose(4.0, 7, exposure_s=metered_s * 50)
    assert burnt.raw.max() == flying.sensor.white
    with pytest.raises(ValueError, match="positive"):
        flying.expose(4.0, 7, exposure_s=0.0)


def test_noise_is_shot_and_read_noise_and_can_be_switched_off() -> None:
    loud = SensorModel((200, 200))
    rng = np.random.default_rng(0)
    for light in (0.0, 0.05, 0.4):
        plane = np.full((200, 200), light, dtype=np.float32)
        assert np.ptp(quiet(loud).develop(plane, rng)) == 0
        scale = (loud.white - loud.black) / loud.full_well_e
        expected = math.sqrt(light * loud.full_well_e + loud.read_noise_e**2) * scale
        assert loud.develop(plane, rng).std() == pytest.approx(expected, rel=0.03)


def test_carriers_of_a_white_card_stand_when_stopped_down_and_vanish_when_open(bench: MaskedCamera) -> None:
    stopped = bench.bench_frame()
    assert stopped.raw.max() < bench.sensor.white
    small = strengths(plane_of(bench, stopped), stopped.truth)
    assert small[1:].min() > 0.1
    opened = bench.bench_frame(f_number=7.4)
    assert strengths(plane_of(bench, opened), opened.truth)[1:].max() < 0.05


def test_the_carriers_stand_at_the_true_lattice_and_not_at_the_nominal_one(bench: MaskedCamera) -> None:
    stopped = bench.bench_frame()
    nominal = bench.optics.mask.frequency_per_mm * 0.01 * (1 - 0.48 / 50)
    wrong = replace(stopped.truth.lattice, ky=(nominal, 0.0), kx=(0.0, nominal))
    missed = strengths(plane_of(bench, stopped), replace(stopped.truth, lattice=wrong))
    assert missed[1:].max() < 0.5 * strengths(plane_of(bench, stopped), stopped.truth)[1:].max()


@pytest.mark.slow
def test_an_oracle_decodes_the_views_from_the_noisy_bench_frame(bench: MaskedCamera) -> None:
    shot = bench.expose(0.0, 1)
    truth = shot.truth
    assert truth.disparity_mm_per_mm is not None
    per_view_px = truth.disparity_mm_per_mm * 6.7 / 5 / 0.01
    assert per_view_px.min() > 2.99
    slices = slices_of(plane_of(bench, shot), truth)
    k, h, w = slices.shape
    n = truth.mask.views_per_axis

    plain = angular_matrix(truth, oracles.view_points_mm(truth, n)).conj().T @ slices.reshape(k, -1)
    expected = inside(oracles.band_views(truth, n))
    assert psnr(inside(plain.real.reshape(n, n, h, w)), expected) > 32

    # with the aperture's true size known, the aperture's own samples come back
    matrix = angular_matrix(truth, truth.aperture_points_mm) / k
    solved = (np.linalg.pinv(matrix) @ slices.reshape(k, -1)).real.reshape(n, n, h, w)
    samples = inside(truth.views)
    quality = psnr(inside(solved), samples)
    assert quality > 32
    assert quality > psnr(np.broadcast_to(samples.mean(axis=(0, 1)), samples.shape), samples) + 5


def test_projected_on_an_ideal_mask_the_views_are_themselves(bench: MaskedCamera) -> None:
    truth = bench.expose(0.0, 1).truth
    n, points = 5, truth.aperture_points_mm
    spacing = points[1, 1, 0] - points[0, 0, 0]
    ideal = replace(truth, angular_frequency_per_mm=1 / (n * spacing), mask_rotation_rad=0.0)
    np.testing.assert_allclose(oracles.view_points_mm(ideal, n), points, atol=1e-12)
    np.testing.assert_allclose(oracles.band_views(ideal, n), truth.views, atol=1e-5)
    np.testing.assert_allclose(oracles.band_views(truth, n).mean(), truth.views.mean(), rtol=0.02)


def test_truth_is_saved_without_what_is_not_known(bench: MaskedCamera, flying: MaskedCamera, tmp_path: Path) -> None:
    bench.expose(0.0, 1).truth.save(tmp_path / "bench.npz")
    flying.expose(0.0, 1).truth.save(tmp_path / "flight.npz")
    with np.load(tmp_path / "bench.npz") as on_bench, np.load(tmp_path / "flight.npz") as in_flight:
        assert on_bench["views"].dtype == np.float32
        assert on_bench["views"].shape[:2] == (5, 5)
        assert "attitude" not in on_bench
        assert in_flight["attitude"].shape == (4,)


def test_a_view_sample_lies_where_the_grid_says() -> None:
    camera = replace(reference_camera(5, scale=0.2, scene="bench"), sensor=quiet(SensorModel((556, 738))))
    shot = camera.expose(0.0, 1)
    truth = shot.truth
    step = int(truth.grid[0, 0])
    assert truth.views.shape[2:4] == tuple(-(-side // step) for side in camera.sensor.shape)
    # the frame's low-passed green is the mean view's green, sample for sample
    plane = plane_of(camera, shot)
    h, w = plane.shape
    half = 0.8 * 0.5 * math.hypot(*truth.lattice.ky)
    low = (np.abs(np.fft.fftfreq(h))[:, None] < half) & (np.abs(np.fft.fftfreq(w))[None, :] < half)
    base = np.fft.ifft2(np.fft.fft2(plane) * low).real[::step, ::step][8:-8, 8:-8]
    grey = (truth.views.mean(axis=(0, 1)) @ np.array([0.25, 0.5, 0.25], dtype=np.float32))[8:-8, 8:-8]
    assert float(np.corrcoef(base.ravel(), grey.ravel())[0, 1]) > 0.98
    assert base.mean() == pytest.approx(grey.mean(), rel=1e-2)


def test_the_fd_camera_places_its_carriers_where_the_thesis_does() -> None:
    camera = reference_camera(2, scale=0.25, scene="white", law="fd")
    rows = camera.sensor.shape[0]
    distance = camera.installed.distance_mm
    # Eq 30 on the chip of 4.29 mm: k · f_mask · d / f · px/mm
    expected = 11.38 * distance / 13 * (rows / (rows * camera.sensor.pitch_mm))
    assert math.hypot(*camera.lattice.ky) * rows == pytest.approx(expected, rel=1e-9)
    stopped = camera.bench_frame()
    found = strengths(plane_of(camera, stopped), stopped.truth)
    assert found[1:].min() > 0.1


def test_real_views_from_a_folder(shared_data: Path) -> None:
    camera = reference_camera(1, scale=0.2, scene=shared_data / "views" / "lytro_2067")
    truth = camera.expose(0.0, 1).truth
    assert truth.views.shape[:2] == (5, 5)
    assert truth.depth_m is None


def test_wrong_options_are_refused(flying: MaskedCamera) -> None:
    with pytest.raises(ValueError, match="wider"):
        flying.expose(0.0, 1, f_number=2.0)
    with pytest.raises(ValueError, match="no reference camera"):
        reference_camera(1, law="magic")


@pytest.mark.long
def test_the_full_sensor_makes_a_frame() -> None:
    shot = reference_camera(1).expose(3.0, 1)
    assert shot.raw.shape == (2776, 3688)
    assert shot.truth.views.shape[:2] == (5, 5)
