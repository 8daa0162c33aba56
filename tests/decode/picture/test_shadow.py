"""The mask's shadow from frames alone, against rays that share nothing with dappled: what raw over it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Lattice, Mask, Sensor, geometric
from dappled.decode.picture.blocks import EMPTY, MosaicPlane
from dappled.decode.picture.picture import UnmaskedPicture, interpolated, picture_of
from dappled.decode.picture.shadow import Shadow, ShadowFrom, period_of
from dappled.decode.picture.shadow_fit import ExpectedShadow, shadow_of
from tests.decode.picture.full_rays import Shot, psnr

MASK = Mask(15.5, 2)
GREY = np.zeros((1, 1), dtype=np.intp)


def _lattice(shot: Shot) -> Lattice:
    """What the law predicts of the print as it was drawn."""
    return geometric(MASK, Sensor(shot.shape, (0.01, 0.0), (0.0, 0.01)), 0.48, 50.0)


def _shadow(shot: Shot, mosaic: MosaicPlane, *others: Shadow) -> Shadow:
    return shadow_of(mosaic, ExpectedShadow(_lattice(shot), MASK.half_orders(), (), 0.03, 0.02), others)


def _picture(shot: Shot, mosaic: MosaicPlane | None = None) -> UnmaskedPicture:
    mosaic = mosaic or MosaicPlane(shot.frame, GREY)
    return picture_of(mosaic, _shadow(shot, mosaic), period_of(_lattice(shot)))


@pytest.mark.parametrize(
    ("shot", "least_db"),
    [
        pytest.param(Shot(disparity_px=0.03), 44, marks=pytest.mark.slow),
        (Shot(disparity_px=0.1), 43),
        pytest.param(Shot(disparity_px=0.1, exponent=1.5), 45, marks=pytest.mark.slow),
        pytest.param(Shot(disparity_px=0.3), 37, marks=pytest.mark.slow),
        pytest.param(Shot(disparity_px=1.0, exponent=1.5), 37, marks=pytest.mark.slow),
        pytest.param(Shot(snr=20), 32, marks=pytest.mark.slow),
        pytest.param(Shot(f_number=15.0), 42, marks=pytest.mark.slow),
        pytest.param(Shot(f_number=25.0), 41, marks=pytest.mark.slow),
        pytest.param(Shot(f_number=62.0), 39, marks=pytest.mark.slow),
        pytest.param(Shot(stop="square", f_number=9.9), 42, marks=pytest.mark.slow),
        pytest.param(Shot(scale=1.003), 43, marks=pytest.mark.slow),
        (Shot(scale=0.998, turn_deg=1.0, shift_mm=(0.05, -0.03), falloff=0.4), 43),
    ],
    ids=repr,
)
def test_raw_over_its_own_shadow_is_as_good_as_over_the_true_one(shot: Shot, least_db: float) -> None:
    picture = _picture(shot)
    found = psnr(picture.plane, shot.truth)
    assert found >= psnr(shot.frame / shot.shadow, shot.truth) - 0.4
    assert (picture.soft_share > 0.1) == (shot.disparity_px > 0.5)
    assert found >= least_db
    assert found > psnr(shot.frame, shot.truth) + 8


@pytest.mark.parametrize(
    ("disparity_px", "exponent", "least_db"),
    [
        (1.0, 1.1, 37),
        pytest.param(1.0, 1.5, 45, marks=pytest.mark.slow),
        pytest.param(2.0, 1.1, 43, marks=pytest.mark.slow),
        pytest.param(3.3, 1.5, 55, marks=pytest.mark.slow),
    ],
)
def test_out_of_focus_it_is_no_worse_than_sharp_picture_and_band(
    disparity_px: float, exponent: float, least_db: float
) -> None:
    shot = Shot(disparity_px=disparity_px, exponent=exponent, shape=(320, 432))
    found = _picture(shot)
    band = np.fft.rfft2(shot.frame)
    fy, fx = np.fft.fftfreq(shot.shape[0])[:, None], np.fft.rfftfreq(shot.shape[1])[None, :]
    band[(np.abs(fy) > 0.0767) | (np.abs(fx) > 0.0767)] = 0
    others = shot.frame / shot.shadow, np.fft.irfft2(band, s=shot.shape)
    measured = psnr(found.plane, shot.truth)
    assert measured >= max(psnr(one, shot.truth) for one in others) - 0.3
    assert measured >= least_db
    assert found.soft_share > 0.7


def test_the_lattice_is_found_where_the_print_stands() -> None:
    shot = Shot(scale=1.003, turn_deg=-0.7)
    found = _shadow(shot, MosaicPlane(shot.frame, GREY)).lattice.matrix()
    predicted = _lattice(shot).matrix()[0, 0]
    assert np.hypot(*found[0]) / predicted == pytest.approx(1.003, abs=2e-4)
    assert np.degrees(np.arctan2(found[0, 1], found[0, 0])) == pytest.approx(-0.7, abs=0.02)


def test_its_error_is_told() -> None:
    shot = Shot(disparity_px=0.0, snr=50)
    shadow = _shadow(shot, MosaicPlane(shot.frame, GREY))
    off = shadow.at(next(MosaicPlane(shot.frame, GREY).places())) - shot.shadow
    assert 0.5 < off.std() / shadow.sigma[0] < 2


def test_clipped_pixels_are_left_out_and_not_trusted() -> None:
    shot = Shot(f_number=15.0)
    limit = float(np.quantile(shot.frame, 0.95))
    valid = shot.frame < limit
    found = _picture(shot, MosaicPlane(np.minimum(shot.frame, np.float32(limit)), GREY, valid))
    assert (
        np.abs(found.shadow.at(next(MosaicPlane(shot.frame, GREY).places())) - shot.shadow).std() < 0.025
    )  # 0.32 of it is shadow
    assert found.shadow.sigma[0] > 0.02  # which is told
    assert not found.trusted[~valid].any()
    assert psnr(np.where(valid, found.plane, shot.truth), shot.truth) > 40


def test_on_a_staggered_chip_what_lies_around_clipped_pixels_is_left_out_too() -> None:
    shot = Shot(f_number=15.0, exponent=1.8)
    there = np.add.outer(np.arange(shot.shape[0]), np.arange(shot.shape[1])) % 2 == 0
    limit = np.float32(np.quantile(shot.frame, 0.95))
    frame = np.where(there, np.minimum(shot.frame, limit), np.float32(0))
    mosaic = MosaicPlane(frame, np.array([[0, EMPTY], [EMPTY, 0]]), there & (shot.frame < limit))
    shadow = _shadow(shot, mosaic)
    off = np.concatenate([(shadow.at(one) - shot.shadow[one.cut]).ravel() for one in mosaic.places()])
    assert off.std() < 2.5 * shadow.sigma[0]  # five times before


def test_each_colour_has_a_shadow_of_its_own() -> None:
    shots = [Shot(f_number=f, shape=(256, 320)) for f in (15.0, 12.0, 20.0)]
    pattern = np.array([[0, 1], [1, 2]])
    index = np.tile(pattern, (128, 160))
    frame = np.choose(index, [one.frame * gain for one, gain in zip(shots, (0.5, 1.0, 0.7), strict=True)])
    found = _picture(shots[1], MosaicPlane(frame.astype(np.float32), pattern))
    truth = np.choose(index, [one.truth * gain for one, gain in zip(shots, (0.5, 1.0, 0.7), strict=True)])
    assert psnr(found.plane, truth) > 40


def _lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) CIE L*a*b* of linear sRGB, D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(rgb @ to_xyz.T / to_xyz.sum(axis=1)).T  # patches are brighter than where the curve is straight
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("f_number", [7.5, 15.0])
def test_patches_keep_their_colours(f_number: float) -> None:
    shot = Shot(f_number=f_number, shape=(288, 416), white=True)
    chart = np.random.default_rng(24).uniform(0.06, 0.7, size=(4, 6, 3))
    pattern = np.array([[0, 1], [1, 2]])
    index = np.tile(pattern, (144, 208))
    whole = np.pad(chart.repeat(64, 0).repeat(64, 1), [(16, 16), (16, 16), (0, 0)], "edge")
    plain = np.choose(index, np.moveaxis(whole, 2, 0))
    frame = plain * shot.shadow + shot.noise()
    found = _picture(shot, MosaicPlane(frame.astype(np.float32), pattern)).plane
    means = []
    for image in (found, plain):
        patches = image[16:-16, 16:-16].reshape(4, 64, 6, 64).transpose(0, 2, 1, 3).reshape(24, 32, 2, 32, 2)
        a, b, c, d = (patches[:, :, row, :, column].mean(axis=(1, 2)) for row in (0, 1) for column in (0, 1))
        means.append(_lab(np.stack([a, (b + c) / 2, d], axis=1).astype(np.float64)))
    assert np.linalg.norm(means[0] - means[1], axis=1).max() <= 1


def test_a_chip_with_staggered_rows_gives_a_picture_in_every_pixel() -> None:
    shot = Shot(f_number=15.0, exponent=1.8)
    there = np.add.outer(np.arange(shot.shape[0]), np.arange(shot.shape[1])) % 2 == 0
    pattern = np.array([[0, EMPTY], [EMPTY, 0]])
    found = _picture(shot, MosaicPlane(np.where(there, shot.frame, np.float32(0)), pattern))
    assert psnr(np.where(there, found.plane, shot.truth), shot.truth) > 40
    assert psnr(interpolated(found), shot.truth) > 38


def test_where_the_mask_lets_little_through_the_picture_is_not_trusted() -> None:
    shot = Shot(f_number=62.0)
    found = _picture(shot)
    dark = shot.shadow < 0.15
    assert dark.any()
    assert not found.trusted[dark].any()
    assert found.sigma[dark].mean() > 3 * found.sigma[shot.shadow > 1].mean()


def test_a_shadow_that_a_white_frame_shows_goes_before_none() -> None:
    shot = Shot(disparity_px=0.1, exponent=1.1, contrast=0.3, snr=20, shape=(96, 96))
    card = replace(shot, white=True, shape=(288, 352))
    white = _shadow(card, MosaicPlane(card.frame, GREY))
    told = replace(white, shape=shot.shape, source=ShadowFrom.WHITE)
    made = _shadow(shot, MosaicPlane(shot.frame, GREY), told)
    assert made.source == ShadowFrom.WHITE
