from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.lightfield.aperture import (
    Aperture,
    ShownContrast,
    SlicesThroughStop,
    angular_frequencies,
    transfer,
    used_aperture,
)
from dappled.decode.lightfield.views import from_slices
from dappled.decode.optics.carriers import Mask
from dappled.findings import Code

ORDERS = Mask(15.5, 2).half_orders()
TRANSFERS = transfer(ORDERS, [1.0, *[0.36] * 6, *[0.18] * 6], (0.31, -0.12))


def _slices(kappa: float, rotation: float, aperture: Aperture, texture: float, seed: int = 0) -> np.ndarray:
    """Slices of a scene without parallax, and something of each one's own."""
    rng = np.random.default_rng(seed)
    scene = 0.4 + 0.05 * rng.normal(size=(60, 80))
    through = aperture.transform(angular_frequencies(ORDERS, kappa, rotation))
    own = texture * (rng.normal(size=(13, 60, 80)) + 1j * rng.normal(size=(13, 60, 80)))
    own[0] = 0
    return np.asarray((TRANSFERS * through)[:, None, None] * scene + own, dtype=np.complex64)


@given(kappa=st.floats(0.3, 1.15), off=st.floats(-0.03, 0.03), rotation=st.floats(-0.035, 0.035))
def test_the_aperture_is_found_behind_a_rounded_f_number(kappa: float, off: float, rotation: float) -> None:
    found = used_aperture(
        SlicesThroughStop(
            _slices(kappa, rotation, Aperture(5), texture=0.01),
            TRANSFERS,
            ORDERS,
            nominal_kappa=kappa * (1 + off),
            rotation_rad=rotation,
            aperture=Aperture(5),
        )
    )
    assert found.fitted
    assert found.kappa == pytest.approx(kappa, abs=max(0.002, 3 * found.sigma))
    assert 0 < found.sigma < 0.02


def _is_told(kappa: float, true: Aperture, *, within: float) -> None:
    """Slices through `true` give its shape and its side, whatever was thought of them."""
    found = used_aperture(
        SlicesThroughStop(
            _slices(kappa, 0.01, true, texture=0.01),
            TRANSFERS,
            ORDERS,
            nominal_kappa=1.01 * kappa,
            rotation_rad=0.01,
            aperture=Aperture(5),
        )
    )
    assert (found.fitted, found.aperture) == (True, true)
    assert found.kappa == pytest.approx(kappa, abs=within)


@pytest.mark.parametrize("kappa", [0.8, 0.9, 1.1])
def test_beams_are_told_from_a_filled_aperture(kappa: float) -> None:
    for true in (Aperture(5), Aperture(5, "filled")):
        _is_told(kappa, true, within=0.002)


@pytest.mark.parametrize("kappa", [0.5, 0.8, 1.0, 1.1])
def test_a_round_stop_is_told_from_a_square_one(kappa: float) -> None:
    for true in (Aperture(5), Aperture(5, "round")):
        _is_told(kappa, true, within=0.003)


def test_views_through_a_round_stop_are_those_of_its_cells() -> None:
    rng = np.random.default_rng(4)
    stop, angular = Aperture(5, "round"), angular_frequencies(ORDERS, 0.95, 0.01)
    views = 0.4 + 0.05 * rng.normal(size=(40, 50)) + 0.01 * rng.normal(size=(25, 40, 50))
    slices = TRANSFERS[:, None, None] * np.tensordot(stop.cells(angular), views, axes=1)
    noise = 1e-5 * rng.normal(size=(2, *slices.shape))
    slices = (slices + noise[0] + 1j * noise[1]).astype(np.complex64)
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=0.96, rotation_rad=0.01, aperture=Aperture(5))
    )
    assert found.aperture == stop
    lit = stop.cells(np.zeros((1, 2)))[0].real > 0.5 / 25
    assert lit.sum() == 21

    def error(aperture: Aperture, kappa: float) -> float:
        made = from_slices(
            slices,
            angular_frequencies(ORDERS, kappa, 0.01),
            TRANSFERS,
            aperture=aperture,
            noise_variance=2e-10,
            model_error=1e-3,
        )
        return float(np.sqrt(np.mean((made.reshape(views.shape) - views)[lit] ** 2)))

    assert error(stop, found.kappa) < 0.01
    assert error(stop, found.kappa) < 0.1 * error(Aperture(5), 0.96)


def test_another_shape_of_aperture_is_not_fitted() -> None:
    ring = 1.5 * Aperture(5, "round").transform(angular_frequencies(ORDERS, 1.0, 0.0)) - 0.5
    slices = np.asarray((TRANSFERS * ring)[:, None, None] * np.full((60, 80), 0.4), dtype=np.complex64)
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=1.0, rotation_rad=0.0, aperture=Aperture(5))
    )
    assert (found.kappa, found.fitted, found.aperture) == (1.0, False, Aperture(5))


@pytest.mark.parametrize("astray", [0.0, 1e-3, 3e-3])
def test_what_no_aperture_explains_is_told(astray: float) -> None:
    """Light of the mean that is in each slice, whatever its transfer."""
    slices = _slices(0.5, 0.0, Aperture(5), texture=0.0)
    slices[1::2] += astray * slices[0]
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=0.5, rotation_rad=0.0, aperture=Aperture(5))
    )
    in_phase = np.abs((TRANSFERS[1::2] / np.abs(TRANSFERS[1::2])).real)
    wanted = astray * float(np.sqrt(np.sum(in_phase**2) / (len(ORDERS) - 1)))
    assert found.unexplained == pytest.approx(wanted, rel=0.15, abs=2e-5)


def test_what_tells_nothing_leaves_the_f_number_s_word() -> None:
    black = np.zeros((13, 20, 30), dtype=np.complex64)
    for slices, transfers in ((black, TRANSFERS), (_slices(1.0, 0.0, Aperture(5), 0.0), np.eye(13)[0] + 0j)):
        found = used_aperture(
            SlicesThroughStop(slices, transfers, ORDERS, nominal_kappa=1.02, rotation_rad=0.0, aperture=Aperture(5))
        )
        assert (found.kappa, found.fitted) == (1.02, False)


@pytest.mark.parametrize("told", [0.5, 2.0])
def test_an_f_number_told_two_stops_wrong_is_found(told: float) -> None:
    slices = _slices(0.7, 0.0, Aperture(5), texture=0.01)
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=0.7 * told, rotation_rad=0.0, aperture=Aperture(5))
    )
    assert found.kappa == pytest.approx(0.7, rel=0.003)
    assert found.share == pytest.approx(1 / told, rel=0.003)


@pytest.mark.parametrize("contrast", [0.5, 0.8, 1.0])
def test_a_shadow_of_less_contrast_is_told_from_another_stop(contrast: float) -> None:
    slices = _slices(0.6, 0.0, Aperture(5, "round"), texture=0.01)
    slices[1:] *= contrast
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=0.61, rotation_rad=0.0, aperture=Aperture(5))
    )
    assert found.contrast == pytest.approx(contrast, abs=0.02)
    assert found.kappa == pytest.approx(0.6, rel=0.01)
    assert found.aperture == Aperture(5, "round")
    doubt = found.finding(10.0)
    assert (None if doubt is None else doubt.code) == (Code.MASK_CONTRAST if contrast < 1 else None)


def test_what_no_contrast_explains_either_is_no_contrast() -> None:
    slices = _slices(0.6, 0.0, Aperture(5, "round"), texture=0.01)
    slices[1::2] *= 0.87
    slices[2::2] *= 0.79
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=0.61, rotation_rad=0.0, aperture=Aperture(5))
    )
    assert found.contrast == 1.0


@pytest.mark.parametrize(("shown", "contrast"), [(0.6, 0.6), (0.93, 1.0)])
def test_a_faded_shadow_is_told_by_texture_where_the_stop_leaves_no_carriers(shown: float, contrast: float) -> None:
    slices = _slices(0.99, 0.0, Aperture(5), texture=0.01)
    slices[1:] *= contrast
    found = used_aperture(
        SlicesThroughStop(slices, TRANSFERS, ORDERS, nominal_kappa=1.0, rotation_rad=0.0, aperture=Aperture(5)),
        texture=ShownContrast(1.0, shown, 0.02),
    )
    assert found.contrast == pytest.approx(contrast, abs=0.02)
    assert found.kappa == pytest.approx(0.99, abs=0.004)
