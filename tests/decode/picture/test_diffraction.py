"""The picture against waves instead of rays: what diffraction between film and sensor leaves."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Mask, MaskedOptics, Sensor
from dappled.decode.optics.picture_contrast import picture_contrast
from dappled.decode.optics.shadow_orders import shadow_orders
from dappled.decode.picture.blocks import MosaicPlane
from dappled.decode.picture.picture import picture_of
from dappled.decode.picture.shadow import Shadow, ShadowFrom, period_of
from dappled.decode.picture.shadow_fit import ExpectedShadow, shadow_of
from tests.decode.picture.full_rays import psnr
from tests.decode.picture.full_waves import CAMERAS, WaveCamera, WaveShot, contrast_left, draw

BANDS = {0.1: (0.05, 0.15), 0.2: (0.15, 0.25), 0.3: (0.25, 0.35), 0.4: (0.35, 0.45)}  # cycles/px


def optics_of(camera: WaveCamera) -> MaskedOptics:
    """As `dappled` has it; of 450D's masks, the one that the film's frequency names."""
    film = None if math.isinf(camera.px_per_um) else camera.px_per_um * 1e3
    mask = Mask(camera.per_um * 1e3, camera.p, camera.pattern, film_px_per_mm=film)
    down, across = (pitch / 1e3 for pitch in camera.pitch_um)
    return MaskedOptics(Sensor((160, 160), (down, 0.0), (0.0, across)), mask, "geometric", camera.distance_um / 1e3)


def picture_in(shot: WaveShot, frame: NDArray[np.floating]) -> tuple[NDArray[np.float32], Shadow]:
    """The picture of a frame, and the shadow that it was made with."""
    optics = optics_of(shot.camera)
    lattice = optics.lattice(50.0)
    mosaic = MosaicPlane(frame.astype(np.float32), np.zeros((1, 1), dtype=np.intp))
    orders = shadow_orders(optics, lattice, shot.f_number)
    shadow = shadow_of(mosaic, ExpectedShadow(lattice, *orders, 0.03, 0.02))
    return picture_of(mosaic, shadow, period_of(lattice)).plane, shadow


@pytest.mark.long
@pytest.mark.parametrize(("f_number", "least_db", "least_contrast"), [(7.46, 41, 0.8), (15.0, 40, 0.77)])
def test_diffraction_takes_a_fifth_of_the_finest_detail_and_leaves_no_carrier(
    f_number: float, least_db: float, least_contrast: float
) -> None:
    shot = WaveShot(f_number, shape=(128, 128))
    truth = replace(shot, masked=False).light()
    frame = shot.light() + shot.noise()
    made, shadow = picture_in(shot, frame)
    assert shadow.source == ShadowFrom.FRAME
    assert psnr(made, truth) > max(least_db, psnr(frame, truth) + 10)
    assert contrast_left(made, truth, (0.05, 0.15)) > 0.95
    assert least_contrast < contrast_left(made, truth, (0.35, 0.45)) < 1


def shadow_off(name: str, f_number: float) -> tuple[Shadow, float, float]:
    """The shadow of a drawn frame, the rms of what it is off, and the true one's standard deviation."""
    shot = next(shot for of, shot in draw() if of == name and round(shot.f_number, 1) == f_number)
    _, shadow = picture_in(shot, shot.light() + shot.noise())
    there = shot.shadow()
    (place,) = MosaicPlane(there.astype(np.float32), np.zeros((1, 1), dtype=np.intp)).places()
    return shadow, float((shadow.at(place) - there).std()), float(there.std())


@pytest.mark.slow
def test_orders_that_only_diffraction_makes_are_in_the_shadow() -> None:
    shadow, off, _ = shadow_off("reference", 10.8)
    assert set(shadow.orders) > {(0, 3), (3, 0), (0, 4), (4, 0)}  # the fourth is beyond the sensor's, and folds
    assert off < 0.004


@pytest.mark.slow
def test_orders_that_diffraction_makes_tell_the_lattice_where_the_stop_leaves_no_others() -> None:
    shadow, off, there = shadow_off("mask-1", 6.9)
    assert shadow.source == ShadowFrom.FRAME
    assert off < there / 4


@pytest.mark.slow
def test_a_few_blocks_tell_no_polynomial_but_how_well_they_know_the_shadow() -> None:
    shadow, off, _ = shadow_off("mask-2", 12.0)
    assert shadow.degree == 0
    assert 0.5 < off / float(shadow.sigma[0]) < 2


@pytest.mark.long
@pytest.mark.parametrize(
    ("camera", "f_number", "tolerance"),
    [("reference", 7.46, 0.03), ("reference", 15.0, 0.03), ("mask-2", 11.5, 0.05), ("mask-2", 8.0, 0.05)],
)
def test_the_plan_tells_the_contrast_that_waves_leave(camera: str, f_number: float, tolerance: float) -> None:
    """Little noise, which the picture's filter takes detail for."""
    shot = WaveShot(f_number, snr=1000.0, shape=(160, 160), camera=CAMERAS[camera])
    truth = replace(shot, masked=False).light()
    made, _ = picture_in(shot, shot.light() + shot.noise())
    told = picture_contrast(optics_of(shot.camera), f_number, list(BANDS))
    found = [contrast_left(made, truth, band) for band in BANDS.values()]
    assert found == pytest.approx(told.left, abs=tolerance)


@pytest.mark.long
def test_drawn_pictures_by_waves() -> None:
    """In focus, of every camera as often, against the better of raw over the true shadow and the band of the mean."""
    short = []
    for name, shot in draw():
        truth, frame = replace(shot, masked=False).light(), shot.light() + shot.noise()
        made, _ = picture_in(shot, frame)
        others = frame / np.maximum(shot.shadow(), 0.01), shot.band(frame)
        short.append((psnr(made, truth) - max(psnr(one, truth) for one in others), name, shot))
    assert Counter(name for _, name, _ in short) == dict.fromkeys(CAMERAS, len(short) / len(CAMERAS))
    assert np.median([one for one, *_ in short]) > 0.5
    assert min(one for one, *_ in short) > -3.5
