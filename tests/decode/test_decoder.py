from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import DecodeReport, MaskDecoder
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Mask
from dappled.findings import Code
from tests.decode.ray_trials import print_costs_db
from tests.decode.rays import (
    FOCAL_MM,
    FULL_F,
    MASK,
    SENSOR,
    STATED_DISTANCE_MM,
    STOPPED_F,
    Camera,
    Plane,
    Texture,
    psnr,
)

Decoded = tuple[LightField, DecodeReport]


def _calibration(camera: Camera, noise: float = 0.0, design: Mask | None = None) -> Calibration:
    rng = np.random.default_rng(77)
    plane = camera.expose([(Texture.random(rng), 1.0)], STOPPED_F)
    plane = (plane + rng.normal(0, noise, plane.shape)).astype(np.float32)
    return calibrate(
        [CalibrationFrame(plane, FOCAL_MM, STOPPED_F)],
        MaskedOptics(SENSOR, design or camera.mask, "geometric", STATED_DISTANCE_MM),
    )


def _decoder(calibration: Calibration | None = None, mask: Mask = MASK, workers: int = 1) -> MaskDecoder:
    return MaskDecoder(MaskedOptics(SENSOR, mask, "geometric", STATED_DISTANCE_MM), calibration, workers=workers)


def _scene(seed: int) -> list[tuple[Texture, float]]:
    """Two depths, one of them three pixels from view to view."""
    rng = np.random.default_rng(seed)
    return [
        (Texture.random(rng, mean=0.2, rms=0.08), 3.0),
        (Texture.random(rng, mean=0.2, rms=0.08), 3.0 if seed % 2 else -1.0),
    ]


@pytest.mark.parametrize(
    "stops",
    [pytest.param(4, marks=pytest.mark.slow), *(pytest.param(stops, marks=pytest.mark.long) for stops in (2, 8))],
)
def test_a_smaller_aperture_never_gives_worse_views_than_its_one_image(stops: int) -> None:
    camera, scene = Camera.hidden(3), _scene(0)
    f_number = stops * FULL_F
    field = _decoder(_calibration(camera)).decode(
        camera.expose(scene, f_number), focal_length_mm=FOCAL_MM, f_number=f_number
    )
    truth = camera.truth(scene, field.grid, field.views.shape[2:4], f_number)
    assert psnr(field.views, truth) > psnr(np.broadcast_to(field.slices[0].real, truth.shape), truth) - 0.5


@pytest.fixture(scope="module")
def far_out() -> tuple[Camera, Calibration, Plane]:
    """A mask 8 % off its stated place, and a frame through it."""
    return _hidden(3)


def _hidden(seed: int) -> tuple[Camera, Calibration, Plane]:
    camera = Camera.hidden(seed)
    return camera, _calibration(camera), camera.expose(_scene(seed))


@pytest.fixture(scope="module")
def decoded(far_out: tuple[Camera, Calibration, Plane]) -> Decoded:
    """What comes of that frame."""
    _, known, plane = far_out
    return _decoder(known).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=FULL_F)


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 1, 2))])
def test_views_of_a_hidden_camera_meet_the_truth(request: pytest.FixtureRequest, seed: int) -> None:
    if seed == 3:
        (camera, _, _), (field, report) = request.getfixturevalue("far_out"), request.getfixturevalue("decoded")
    else:
        camera, known, plane = _hidden(seed)
        field, report = _decoder(known).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=FULL_F)
    scene = _scene(seed)
    truth = camera.truth(scene, field.grid, field.views.shape[2:4])
    mean = np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape)
    assert report.carriers_from == "calibrated"
    assert report.views_from == "calibration"
    assert psnr(field.views, truth) > 40
    assert psnr(field.views, truth) > 12 + psnr(mean, truth)


@pytest.fixture(
    scope="module",
    params=[False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["distance-unknown", "distance-known"],
)
def told_right(
    far_out: tuple[Camera, Calibration, Plane], decoded: Decoded, request: pytest.FixtureRequest
) -> tuple[bool, Calibration, Decoded]:
    """Whether the mask's distance is known, so that even a tenth is too much for an f-number, the calibration, and what
    comes of the frame with the f-number that it was taken with."""
    camera, known, plane = far_out
    if not request.param:
        return False, known, decoded
    fits = tuple(replace(f, mask_distance_mm=camera.distance_mm, distance_fitted=True) for f in known.fits)
    known = replace(known, fits=fits)
    return True, known, _decoder(known).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=FULL_F)


@pytest.mark.parametrize(
    "told",
    [
        *(pytest.param(told, marks=pytest.mark.long) for told in (0.67, 0.9)),
        *(pytest.param(told, marks=pytest.mark.slow) for told in (1.0, 1.5)),
    ],
)
def test_an_f_number_told_wrong_costs_nothing_and_is_doubted(
    far_out: tuple[Camera, Calibration, Plane], told_right: tuple[bool, Calibration, Decoded], told: float
) -> None:
    camera, _, plane = far_out
    placed, known, right = told_right
    field, report = right
    if told != 1:
        field, report = _decoder(known).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=told * FULL_F)
    truth = camera.truth(_scene(3), field.grid, field.views.shape[2:4])
    assert field.attributes["views_model"] == right[0].attributes["views_model"]
    assert psnr(field.views, truth) > max(40, psnr(right[0].views, truth) - 0.5)
    shown = FULL_F if placed else FULL_F * STATED_DISTANCE_MM / camera.distance_mm  # a distance is an aperture, too
    far = abs(np.log(told * FULL_F / shown)) > (0.08 if placed else 0.25)
    doubts = [one.facts for one in report.doubts if one.code is Code.APERTURE_DISAGREES]
    assert doubts == ([{"shown": pytest.approx(shown, rel=0.05), "told": told * FULL_F}] if far else [])


@pytest.mark.parametrize("told", [pytest.param(0.5, marks=pytest.mark.long), 1.5, 2.0])
def test_an_f_number_told_far_off_is_doubted(far_out: tuple[Camera, Calibration, Plane], told: float) -> None:
    camera, known, plane = far_out
    decoder = replace(_decoder(known), joint_views=False)
    _, report = decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=told * FULL_F)
    shown = FULL_F * STATED_DISTANCE_MM / camera.distance_mm  # a distance is an aperture, too
    (doubt,) = [one.facts for one in report.doubts if one.code is Code.APERTURE_DISAGREES]
    assert doubt == {"shown": pytest.approx(shown, rel=0.05), "told": told * FULL_F}


@pytest.mark.long
def test_a_print_s_scale_that_was_fitted_belongs_to_the_aperture() -> None:
    """A film 4.5 % too coarse at a known distance, its frame's f-number told 5 % too small: together 9.5 %."""
    camera = replace(Camera.hidden(3), mask=replace(MASK, frequency_per_mm=0.955 * MASK.frequency_per_mm))
    plane, found = camera.expose(_scene(3)), _calibration(camera, design=MASK)
    for scale in (0.955, 1.0):
        fits = [
            replace(f, mask_distance_mm=camera.distance_mm, distance_fitted=True, print_scale=scale) for f in found.fits
        ]
        decoder = _decoder(replace(found, fits=tuple(fits)))
        _, report = decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=0.95 * FULL_F)
        assert (report.doubts == ()) == (scale < 1)


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.99, 1.01])
def test_a_print_one_percent_off_costs_the_views_less_than_a_decibel(scale: float) -> None:
    design, printed = print_costs_db(scale, seed=3, beams=5)
    assert design > printed - 1.0
    assert printed > 36


@pytest.mark.parametrize("told", [pytest.param(0.67, marks=pytest.mark.long), 1.33])
def test_without_a_calibration_visible_carriers_tell_the_aperture(
    far_out: tuple[Camera, Calibration, Plane], told: float
) -> None:
    camera, rng = far_out[0], np.random.default_rng(3)
    plane = camera.expose(_scene(3), 2 * FULL_F)
    plane = (plane + rng.normal(0, plane.mean() / 100, plane.shape)).astype(np.float32)
    right, wrong = (
        _decoder().decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=2 * n * FULL_F) for n in (1.0, told)
    )
    assert wrong[1].views_from == "frame"
    truth = camera.truth(_scene(3), wrong[0].grid, wrong[0].views.shape[2:4], 2 * FULL_F)
    assert psnr(wrong[0].views, truth) > max(30, psnr(right[0].views, truth) - 0.5)


def test_an_f_number_that_no_search_reaches_is_doubted(far_out: tuple[Camera, Calibration, Plane]) -> None:
    _, known, plane = far_out
    _, report = _decoder(known).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=3 * FULL_F)
    assert Code.APERTURE_UNEXPLAINED in {one.code for one in report.doubts}


@pytest.mark.slow
def test_views_at_a_raw_signal_to_noise_of_100() -> None:
    camera, scene = Camera.hidden(7), _scene(1)
    frame = camera.expose(scene)
    noisy = (frame + np.random.default_rng(0).normal(0, frame.mean() / 100, frame.shape)).astype(np.float32)
    field = _decoder(_calibration(camera, noise=0.004)).decode(noisy, focal_length_mm=FOCAL_MM, f_number=FULL_F)
    truth = camera.truth(scene, field.grid, field.views.shape[2:4])
    mean = np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape)
    assert psnr(field.views, truth) > 30
    assert psnr(field.views, truth) > 4 + psnr(mean, truth)


@pytest.fixture(scope="module")
def stopped() -> tuple[Camera, Plane]:
    camera = Camera.hidden(11)
    return camera, camera.expose(_scene(0), STOPPED_F)


@pytest.mark.long
def test_a_stopped_down_frame_is_decoded_at_its_own_carriers(stopped: tuple[Camera, Plane]) -> None:
    camera, plane = stopped
    field, report = _decoder().decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=STOPPED_F)
    assert (report.carriers_from, report.views_from, report.found) == ("measured", "frame", 13)
    expected = np.array([(c.fy, c.fx) for c in camera.lattice.carriers(MASK.half_orders())])
    off = (field.carriers[:, 2:] - expected) * SENSOR.shape
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05
    assert field.attributes["carriers_from"] == "measured"
    assert field.slices.shape[0] == len(field.carriers) == 13
    truth = camera.truth(_scene(0), field.grid, field.views.shape[2:4], STOPPED_F)
    assert psnr(field.views, truth) > 30  # hardly any parallax is there, and none is made up


def test_without_calibration_a_full_aperture_frame_has_slices_and_no_views() -> None:
    camera = Camera(STATED_DISTANCE_MM, 0.0, (0.004, 0.007))
    field, report = _decoder().decode_reported(camera.expose(_scene(3)), focal_length_mm=FOCAL_MM, f_number=FULL_F)
    assert (report.carriers_from, report.views_from) == ("predicted", "none")
    assert field.views.shape[:2] == (0, 0)
    assert field.slices.shape[0] == 13
    assert field.slices[0].real.mean() == pytest.approx(0.4, abs=0.02)


def test_unknown_f_number_leaves_slices(stopped: tuple[Camera, Plane]) -> None:
    field, report = _decoder().decode_reported(stopped[1], focal_length_mm=FOCAL_MM)
    assert report.views_from == "none"
    assert field.attributes["f_number"] is None
    assert field.view_offsets.shape == (0, 0, 2)


def test_a_diagonal_mask_decodes(stopped: tuple[Camera, Plane]) -> None:
    mask = Mask(15.5, 2, "diagonal")
    camera = Camera(0.47, 0.012, (0.01, 0.02), mask=mask)
    field, report = _decoder(mask=mask).decode_reported(
        camera.expose(_scene(0), STOPPED_F), focal_length_mm=FOCAL_MM, f_number=STOPPED_F
    )
    assert report.found == len(mask.half_orders()) == 5
    assert field.views.shape[:2] == (5, 5)


@pytest.mark.long
def test_the_same_frame_gives_the_same_bytes_for_any_workers(stopped: tuple[Camera, Plane]) -> None:
    fields = [_decoder(workers=n).decode(stopped[1], focal_length_mm=FOCAL_MM, f_number=STOPPED_F) for n in (1, 1, 3)]
    assert len({field.slices.tobytes() for field in fields}) == 1
    assert len({field.views.tobytes() for field in fields}) == 1


def test_bad_calls_are_refused_in_words(stopped: tuple[Camera, Plane]) -> None:
    decoder = _decoder()
    with pytest.raises(DecodeError, match="--focal-length"):
        decoder.decode(stopped[1], f_number=8.0)
    with pytest.raises(DecodeError, match="choose its profile"):
        decoder.decode(stopped[1][:200], focal_length_mm=50.0)
    with pytest.raises(DecodeError, match="above 0"):
        decoder.decode(stopped[1], focal_length_mm=-50.0)
    with pytest.raises(DecodeError, match="fall off the sensor"):
        _decoder(mask=Mask(80.0, 1)).decode(stopped[1], focal_length_mm=50.0)
    with pytest.raises(DecodeError, match="unknown law"):
        MaskDecoder(MaskedOptics(SENSOR, MASK, "none", 1.0))
    with pytest.raises(DecodeError, match="another mask"):
        _decoder(_calibration(stopped[0]), mask=Mask(14.0, 2))
