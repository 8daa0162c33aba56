"""The picture against waves instead of rays: what diffraction between film and sensor leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.optics.carriers import Mask, Sensor, geometric
from dappled.decode.picture.blocks import MosaicPlane
from dappled.decode.picture.picture import picture_of
from dappled.decode.picture.shadow import ShadowFrom, period_of, shadow_of
from tests.decode.picture.full_rays import psnr
from tests.decode.picture.full_waves import WaveShot, contrast_left

MASK = Mask(15.5, 2)


@pytest.mark.long
@pytest.mark.parametrize(("f_number", "least_db", "least_contrast"), [(7.46, 41, 0.8), (15.0, 40, 0.77)])
def test_diffraction_takes_a_fifth_of_the_finest_detail_and_leaves_no_carrier(
    f_number: float, least_db: float, least_contrast: float
) -> None:
    shot = WaveShot(f_number, shape=(128, 128))
    truth = replace(shot, masked=False).light()
    frame = shot.light() + shot.noise()
    lattice = geometric(MASK, Sensor(shot.shape, (0.01, 0.0), (0.0, 0.01)), 0.48, 50.0)
    mosaic = MosaicPlane(frame.astype(np.float32), np.zeros((1, 1), dtype=np.intp))
    shadow = shadow_of(mosaic, lattice, MASK.half_orders(), turned=0.03, scaled=0.02)
    assert shadow.source == ShadowFrom.FRAME
    made = picture_of(mosaic, shadow, period_of(lattice)).plane
    assert psnr(made, truth) > max(least_db, psnr(frame, truth) + 10)
    assert contrast_left(made, truth, (0.05, 0.15)) > 0.95
    assert least_contrast < contrast_left(made, truth, (0.35, 0.45)) < 1
