"""Views by the joint model, against sums over rays and against the model that takes each frequency alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from dappled.decode.joint.joint_views import joint_views
from dappled.decode.joint.patch_model import is_calm, is_motionless
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies
from dappled.decode.lightfield.light_field import LightField
from dappled.findings import Code
from tests.decode.joint.ray_sums import FOCAL_MM, MASK, RaySum, on_slices, psnr

BAND = 0.4 * MASK.frequency_per_mm * 0.01  # cycles/pixel: inside a slice's band


@dataclass(frozen=True)
class Reached:
    """PSNR of the views in dB: by the joint model, the quick one, and of the true views' mean."""

    joint: float
    quick: float
    mean: float
    field: LightField
    truth: np.ndarray


@cache
def _reached(scene: RaySum) -> Reached:
    plane, true = scene.expose()
    fields = [
        scene.decoder(joint_views=joint).decode(plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
        for joint in (True, False)
    ]
    assert [field.attributes["views_model"] for field in fields] == ["joint", "independent"]
    np.testing.assert_array_equal(fields[0].slices, fields[1].slices)
    truth = on_slices(true, fields[0].grid, fields[0].slices.shape[1:])
    mean = np.broadcast_to(np.nanmean(truth, axis=(0, 1)), truth.shape)
    joint, quick = (psnr(field.views, truth) for field in fields)
    return Reached(joint, quick, psnr(mean, truth), fields[0], truth)


@pytest.mark.slow
def test_noise_is_kept_out_of_views_by_the_disparities_that_are_there() -> None:
    found = _reached(RaySum(finest=BAND, snr=50, shape=(220, 260)))
    assert found.joint > max(found.quick + 4, found.mean + 6), found


def test_a_depth_map_of_the_first_views_makes_them_better() -> None:
    """40.0 dB with the first look alone."""
    found = _reached(RaySum(finest=BAND, snr=50, shape=(220, 260), covers="apart"))
    assert found.joint > max(40.7, found.quick + 4, found.mean + 6), found
    sigma = found.field.view_sigma
    assert sigma is not None
    rms = np.sqrt(np.mean(sigma**2, axis=(2, 3)))
    np.testing.assert_allclose(found.field.attributes["view_sigma"], rms, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "least"),
    [
        (RaySum(finest=BAND, snr=50, shape=(220, 260), covers="apart"), 0.58),
        *(
            pytest.param(RaySum(shape=(440, 520), covers="apart", **kind), least, marks=pytest.mark.long)
            for kind, least in (
                ({"finest": BAND, "snr": 100, "seed": 2}, 0.53),
                ({"exponent": 1.1, "seed": 3}, 0.53),
                ({"boards": (-8.0, 0.0, 9.0), "snr": 100, "seed": 6}, 0.53),
            )
        ),
    ],
)
def test_two_thirds_of_errors_are_within_the_standard_error(scene: RaySum, least: float) -> None:
    found = _reached(scene)
    samples = [(np.arange(side) + 0.5) / 12 for side in found.truth.shape[2:]]
    at = np.meshgrid(*samples, indexing="ij")
    assert found.field.view_sigma is not None
    there = np.array([[ndimage.map_coordinates(one, at, order=1) for one in line] for line in found.field.view_sigma])
    off = (np.abs(found.field.views - found.truth) / there)[..., 5:-5, 5:-5]
    assert least < float(np.mean(off < 1)) < 0.72
    assert 0.8 < float(np.mean(off < 2)) < 0.99


@pytest.mark.parametrize(
    ("scene", "least"),
    [
        (RaySum(finest=BAND, snr=300, shape=(220, 260), covers="apart", seed=1), 46.5),
        pytest.param(RaySum(exponent=1.5, shape=(440, 520), covers="apart"), 47.5, marks=pytest.mark.long),
        pytest.param(RaySum(finest=BAND, shape=(440, 520), covers="apart"), 56.0, marks=pytest.mark.long),
    ],
)
def test_a_frame_of_little_noise_is_decoded_at_least_as_well_as_by_inverting_it(scene: RaySum, least: float) -> None:
    """With the model's error as large as a camera's that nobody measured: 41.4, 43.1 and 44.6 dB."""
    found = _reached(scene)
    assert found.joint > max(least, found.quick + 1), found


@pytest.mark.long
def test_detail_that_folds_in_from_beyond_the_band_does_not_spoil_the_views() -> None:
    found = _reached(RaySum(exponent=1.1))
    assert found.joint > max(found.quick + 4, found.mean + 4), found


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("round_", [False, True])
def test_a_continuous_stop_s_unmeasured_orders_belong_to_the_model(seed: int, round_: bool) -> None:
    found = _reached(RaySum(points=2, round=round_, snr=100, seed=seed))
    assert found.joint > max(found.quick + 2.5, found.mean + 3.5), found


@pytest.mark.long
def test_a_scene_beyond_the_range_of_disparities_is_not_smeared() -> None:
    found = _reached(RaySum(boards=(45.0,), finest=BAND, snr=100))
    assert found.joint > found.mean + 1, found


@pytest.mark.long
def test_a_frame_without_texture_has_views_like_its_mean() -> None:
    scene = RaySum(contrast=0.0, boards=(6.0,), snr=100)
    plane, true = scene.expose()
    field = scene.decoder(joint_views=True).decode(plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    assert psnr(field.views, on_slices(true, field.grid, field.slices.shape[1:])) > 55


def test_slices_smaller_than_a_patch_get_quick_views() -> None:
    scene = RaySum(shape=(120, 140), finest=BAND, snr=100)
    plane, _ = scene.expose()
    field = scene.decoder(joint_views=True).decode(plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    assert min(field.slices.shape[1:]) < 24
    assert (field.attributes["views_model"], field.attributes["view_sigma"]) == ("independent", None)
    assert field.views_reason is not None
    assert (field.views_reason.code, field.views_reason.facts["patch_px"]) == (Code.VIEWS_SLICES_SMALL, 24)


def test_few_slices_don_t_blow_rounding_up() -> None:
    """Nine slices see fewer directions than a patch's disparities have: the rest is rounding, and was divided by."""
    orders = [(0, 0), (0, 1), (1, -1), (1, 0), (1, 1)]
    aperture = Aperture(5)
    angular = angular_frequencies(orders, 0.5, 0.0)
    transfers = np.array([1.0, 0.39, 0.21, 0.39, 0.21], dtype=np.complex128)
    frequencies = np.array([(0.075 * ky, 0.075 * kx) for ky, kx in orders])
    model = SliceModel.of_half(orders, transfers, angular, frequencies, aperture)
    chance = np.random.default_rng(1)
    scene = ndimage.gaussian_filter(chance.normal(size=(72, 72)), 1.5)
    scene = 0.3 + 0.05 * scene / scene.std()
    through = transfers * aperture.transform(angular)
    slices = (through[:, None, None] * scene).astype(np.complex64)
    slices += (1e-4 * (chance.normal(size=slices.shape) + 1j * chance.normal(size=slices.shape))).astype(np.complex64)
    made = joint_views(slices, model, samples_px=(6.6, 6.6), noise=np.full(5, 1e-8), reach=33.0)
    assert psnr(made.views[2, 2].astype(np.float64), scene) > 35
    assert np.abs(made.views - scene).max() < 0.3


@pytest.mark.long
def test_clipped_light_that_goes_astray_is_not_taken_for_parallax() -> None:
    """Clipping bends the mask's waves, and at half the ideal aperture weak orders decide how far views differ."""
    scene = RaySum(finest=BAND, snr=100, kappa=0.5, contrast=0.3)
    plane, true = scene.expose()
    white = np.quantile(plane, 0.99)
    found = []
    for clipped in (None, (plane >= white).astype(np.float32)):
        decoder = replace(scene.decoder(joint_views=True), clipped=clipped)
        field = decoder.decode(np.minimum(plane, white), focal_length_mm=FOCAL_MM, f_number=scene.f_number)
        assert field.attributes["views_model"] == "joint"
        found.append(psnr(field.views, on_slices(true, field.grid, field.slices.shape[1:])))
    assert found[1] > found[0] + 1.5, found


@pytest.mark.long
def test_a_scene_without_parallax_has_its_mean_picture_for_every_view() -> None:
    """At the ideal aperture the mask's waves average out: the frame is the scene. Its straight edges have detail beyond
    the band, which stands in the other slices as parallax would."""
    camera = RaySum(shape=(340, 400))
    chance = np.random.default_rng(5)
    f = np.hypot(np.fft.fftfreq(340)[:, None], np.fft.rfftfreq(400))
    texture = np.fft.irfft2(np.fft.rfft2(chance.normal(size=camera.shape)) * np.maximum(f, 1 / 400) ** -1.3)
    texture *= np.outer(np.hanning(340), np.hanning(400)) ** 0.3 / texture.std()
    scene = 0.3 + 0.045 * texture
    scene[120:230, 90:300] += 0.15
    plane = (scene + chance.normal(0, 0.003, camera.shape)).astype(np.float32)
    field = camera.decoder(joint_views=True).decode(plane, focal_length_mm=FOCAL_MM, f_number=camera.f_number)
    assert field.attributes["views_model"] == "joint"
    assert psnr(field.views, np.broadcast_to(field.slices[0].real, field.views.shape)) > 55
    assert field.attributes["views_shares"]["at_rest"] > 0.9


def test_a_frame_whose_slices_contradict_the_depth_of_its_views_is_doubted() -> None:
    """Two textures, far from each other, shine through each other all over: a depth map has one of them."""
    scene = RaySum(finest=BAND, snr=100, boards=(-16.0, 20.0), covers="everywhere")
    plane, true = scene.expose()
    field, report = scene.decoder(joint_views=True).decode_reported(
        plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number
    )
    assert psnr(field.views, on_slices(true, field.grid, field.slices.shape[1:])) > 43
    shares = field.attributes["views_shares"]
    assert (shares["told"], shares["at_rest"]) == (0, 0)
    (share,) = [one.facts["share"] for one in report.doubts if one.code is Code.VIEWS_CONTRADICTED]
    assert share == shares["contradict"]


@pytest.mark.parametrize(("moved", "motionless"), [(0.5, True), (6.0, False)])
def test_only_a_frame_in_which_nothing_tells_of_parallax_has_none(moved: float, motionless: bool) -> None:
    """By most of its patches: a few that move, or seem to, are not asked."""
    patches = np.full(40, moved)
    patches[:15] += np.where(np.arange(15) % 2, 500.0, -500.0)
    assert is_motionless(patches) is motionless


@pytest.mark.parametrize(("share", "calm"), [(0.15, True), (0.3, False)])
def test_a_frame_is_calm_where_four_fifths_of_it_tell_of_no_parallax(share: float, calm: bool) -> None:
    """A motionless one may have two fifths that move: by these patches alone it could not be left to the rest."""
    moved = np.where(np.arange(100) < 100 * share, 30.0, -3.0)
    assert is_calm(moved) is calm
    assert is_motionless(moved)


@pytest.mark.slow
def test_a_thing_that_hardly_moves_in_a_calm_frame_keeps_its_parallax() -> None:
    """By 0.4 px from view to view; 53.3 dB where a patch may have errors that look like it."""
    scene = RaySum(finest=BAND, snr=100, shape=(300, 400), boards=(0.0, 0.0, 2.0), covers="apart", seed=2)
    plane, true = scene.expose()
    field = scene.decoder(joint_views=True).decode(plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    assert field.attributes["views_shares"]["at_rest"] == 1
    assert psnr(field.views, on_slices(true, field.grid, field.slices.shape[1:])) > 54.8


@pytest.mark.slow
def test_a_thing_that_moves_before_a_scene_that_does_not_keeps_its_parallax() -> None:
    """Two thirds of the frame have none; 46.6 dB where patches lean to what most of a frame has."""
    scene = RaySum(finest=BAND, snr=100, shape=(300, 400), boards=(0.0, 0.0, 4.5), covers="apart", seed=1)
    plane, true = scene.expose()
    field = scene.decoder(joint_views=True).decode(plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    assert psnr(field.views, on_slices(true, field.grid, field.slices.shape[1:])) > 48.2


@pytest.mark.slow
def test_a_thing_before_a_background_near_the_focus_keeps_its_parallax() -> None:
    """Most of the frame moves by a tenth of a sample from view to view, and was taken as at rest with all of it."""
    found = _reached(RaySum(finest=BAND, snr=100, shape=(300, 400), boards=(3.2, 3.2, 12.0), covers="apart", seed=1))
    assert found.joint > 44.8, found


@pytest.mark.long
def test_a_thing_beyond_all_ranges_beside_others_within_is_not_smeared() -> None:
    found = _reached(RaySum(boards=(2.0, 100.0), finest=BAND, snr=100))
    assert found.joint > max(found.quick - 1, found.mean + 10), found


@pytest.mark.long
def test_a_scene_beyond_all_ranges_is_told() -> None:
    scene = RaySum(boards=(90.0,), finest=BAND, snr=100)
    plane, _ = scene.expose()
    field, report = scene.decoder(joint_views=True).decode_reported(
        plane, focal_length_mm=FOCAL_MM, f_number=scene.f_number
    )
    assert field.attributes["views_model"] == "independent"
    (px,) = [one.facts["px"] for one in report.doubts if one.code is Code.VIEWS_OUT_OF_REACH]
    assert px == pytest.approx(13, abs=0.5)
