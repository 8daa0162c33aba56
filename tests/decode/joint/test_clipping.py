"""What clipped pixels would hold; standard errors of views near them: unknown, and elsewhere as they were."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dappled.decode.decoder import MaskDecoder
from dappled.decode.joint.clipping import clipped_shares, unclipped, unknown_where_clipped
from dappled.decode.joint.frame_views import TakenSlices
from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.spectrum.lineariser import lineariser
from dappled.findings import Code
from tests.decode.joint.ray_sums import FOCAL_MM, MASK, RaySum, on_slices, psnr

BAND = 0.4 * MASK.frequency_per_mm * 0.01  # cycles/pixel: inside a slice's band
SHAPE, SIZE, STEP = (600, 720), (100, 120), 6.0  # of the frame, of a view, pixels a sample
PATCHES = 10, 11


@dataclass(frozen=True)
class HalfOpen:
    """A frame as a sensor without a white has it (`whole`), as it is, which pixels are `clipped`, its true views."""

    scene: RaySum
    whole: np.ndarray
    plane: np.ndarray
    clipped: np.ndarray
    views: np.ndarray

    def decoders(self) -> tuple[MaskDecoder, MaskDecoder]:
        """One that doesn't know what is clipped, one that does."""
        decoder = self.scene.decoder(joint_views=True)
        return decoder, replace(decoder, clipped=self.clipped)


def _taken(decoder: MaskDecoder, frame: HalfOpen) -> TakenSlices:
    """The slices as they were taken through the known aperture."""
    made = decoder.decode(frame.plane, focal_length_mm=FOCAL_MM, f_number=frame.scene.f_number)
    down, across, real, imaginary = np.array(made.attributes["transfers"]).T
    carriers = decoder.predict(FOCAL_MM)
    assert [(c.ky, c.kx) for c in carriers] == [(ky, kx) for ky, kx in made.carriers[:, :2]]
    aperture = Aperture(5, made.attributes["aperture"])
    steps = float(made.grid[0, 0]), float(made.grid[1, 1])
    taken = TakenSlices(
        made.slices, carriers, real + 1j * imaginary, frame.scene.kappa, 0.0, aperture, steps, 1.0, 0.0, colours=False
    )
    np.testing.assert_allclose(taken.angular, np.stack([down, across], axis=1), atol=0.05)
    return taken


def field(*, told: bool = True) -> LightField:
    sigma = np.full((5, 5, *PATCHES), 0.01, dtype=np.float32)
    return LightField(
        np.zeros((1, *SIZE), dtype=np.complex64),
        np.zeros((1, 4)),
        np.zeros((5, 5, *SIZE), dtype=np.float32),
        np.zeros((5, 5, 2)),
        np.array([[STEP, 0.0, 0.0], [0.0, STEP, 0.0]]),
        {"view_sigma": [[0.01] * 5] * 5},
        sigma if told else None,
    )


def test_patches_that_hold_a_clipped_spot_are_unknown_and_no_others() -> None:
    """A spot of 20 × 20 pixels around (300, 200), sample (50, 33): patches are 24 samples wide around 12·i − 0.5."""
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:210] = 1
    made = unknown_where_clipped(field(), clipped, 0.01)
    assert made.view_sigma is not None
    unknown = np.isnan(made.view_sigma).all(axis=(0, 1))
    np.testing.assert_array_equal(
        np.argwhere(unknown), [[4, 2], [4, 3], [5, 2], [5, 3]]
    )  # the spot is 1.9 % of a patch
    assert np.isnan(made.view_sigma).sum() == 25 * 4
    assert made.attributes["view_sigma"] == pytest.approx(np.full((5, 5), 0.01))


def test_a_little_is_no_doubt() -> None:
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:200] = 1
    given = field()
    assert unknown_where_clipped(given, clipped, 0.01) is given


def test_nothing_is_told_of_a_frame_that_is_clipped_all_over() -> None:
    made = unknown_where_clipped(field(), np.ones(SHAPE, dtype=np.float32), 0.01)
    assert made.view_sigma is not None
    assert np.isnan(made.view_sigma).all()
    assert made.attributes["view_sigma"] is None


def test_without_standard_errors_there_is_nothing_to_take_back() -> None:
    given = field(told=False)
    assert unknown_where_clipped(given, np.ones(SHAPE, dtype=np.float32), 0.01) is given


def test_the_share_of_each_patch_that_is_clipped() -> None:
    """A spot of 20 × 20 pixels is 400 of the 144 × 144 of a patch."""
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:210] = 1
    shares = clipped_shares(clipped, SIZE, field().grid)
    assert shares.shape == PATCHES
    assert shares.max() == pytest.approx(400 / 144**2)
    np.testing.assert_array_equal(np.argwhere(shares > 0), [[4, 2], [4, 3], [5, 2], [5, 3]])


@pytest.fixture(scope="module", params=[0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 5))])
def half_open(request: pytest.FixtureRequest) -> HalfOpen:
    """Half the ideal aperture, one pixel in a hundred at white."""
    scene = RaySum(finest=BAND, snr=100, kappa=0.5, seed=request.param, covers="apart", shape=(240, 280))
    plane, true = scene.expose()
    white = float(np.quantile(plane, 0.99))
    return HalfOpen(scene, plane, np.minimum(plane, np.float32(white)), (plane >= white).astype(np.float32), true)


@pytest.mark.long
def test_what_clipped_beside_the_masks_dark_places_is_told_by_these(half_open: HalfOpen) -> None:
    """Views are nearly those of a sensor without a white, and slices those of the file."""
    decoder, knows = half_open.decoders()
    whole, lost, told = (
        each.decode(seen, focal_length_mm=FOCAL_MM, f_number=half_open.scene.f_number)
        for each, seen in ((decoder, half_open.whole), (decoder, half_open.plane), (knows, half_open.plane))
    )
    truth = on_slices(half_open.views, whole.grid, whole.slices.shape[1:])
    best, without, made = (psnr(field.views, truth) for field in (whole, lost, told))
    assert made > without + 2.5, (best, without, made)
    assert made > best - 3.5, (best, without, made)
    np.testing.assert_array_equal(told.slices, lost.slices)
    assert [field.attributes["views_unclipped"] for field in (whole, lost, told)] == [False, False, True]


@pytest.mark.slow
def test_a_wrong_f_number_is_told_of_frames_with_clipped_pixels_too(half_open: HalfOpen) -> None:
    _, knows = half_open.decoders()
    _, report = knows.decode_reported(
        half_open.plane, focal_length_mm=FOCAL_MM, f_number=1.3 * half_open.scene.f_number
    )
    (told,) = [one.facts["told"] for one in report.doubts if one.code is Code.APERTURE_DISAGREES]
    assert told == pytest.approx(19, abs=0.5)


@pytest.mark.slow
def test_a_mosaic_gives_the_same_as_its_plane(half_open: HalfOpen) -> None:
    _, knows = half_open.decoders()
    counts = np.rint(half_open.plane * 20_000).astype(np.uint16)
    rows = lineariser(counts.shape, black=0.0, white=20_000.0, cfa=None).apply(counts)
    given = {"focal_length_mm": FOCAL_MM, "f_number": half_open.scene.f_number}
    np.testing.assert_allclose(knows.decode(rows, **given).views, knows.decode(rows.plane(), **given).views, atol=1e-5)


@pytest.mark.slow
def test_places_without_a_sample_tell_nothing(half_open: HalfOpen) -> None:
    """A staggered sensor spread on a square: every other place holds a sample, twice as bright, the others nothing."""
    decoder, _ = half_open.decoders()
    taken = _taken(decoder, half_open)
    there = np.indices(half_open.plane.shape).sum(axis=0) % 2 == 0
    spread, clipped = np.where(there, 2 * half_open.plane, 0), np.where(there, half_open.clipped, 0)
    made = unclipped(spread, clipped, taken)
    lost = clipped > 0
    np.testing.assert_array_equal(made[~lost], spread[~lost])
    off, before = (np.sqrt(np.mean((one - 2 * half_open.whole)[lost] ** 2)) for one in (made, spread))
    assert off < 0.6 * before


def test_a_wide_highlight_keeps_its_white_inside(half_open: HalfOpen) -> None:
    decoder, _ = half_open.decoders()
    clipped = half_open.clipped.copy()
    clipped[60:180, 80:200] = 1
    plane = np.where(clipped > 0, half_open.plane.max(), half_open.plane)
    made = unclipped(plane, clipped, _taken(decoder, half_open))
    assert np.isfinite(made).all()
    np.testing.assert_array_equal(made[100:140, 120:160], plane[100:140, 120:160])


@pytest.mark.slow
def test_a_highlight_that_clipped_as_a_whole_is_not_made_up() -> None:
    """At the ideal aperture the mask lets the same light through to all pixels of an even scene."""
    scene = RaySum(boards=(0.0,), exponent=2.0, finest=0.02, kappa=1.0, points=3, shape=(240, 280))
    plane, _ = scene.expose()
    white = np.quantile(plane, 0.97)
    cut = np.minimum(plane, white)
    decoder = scene.decoder(joint_views=True)
    clipped = (plane >= white).astype(np.float32)
    plain = decoder.decode(cut, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    told = replace(decoder, clipped=clipped).decode(cut, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    highlight = on_slices(clipped, told.grid, told.slices.shape[1:]) > 0.9
    assert highlight.any()
    assert np.abs(told.views - plain.views)[:, :, highlight].max() < 0.02 * white
