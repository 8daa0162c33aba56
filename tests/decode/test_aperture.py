from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled.decode.aperture import used_aperture
from dappled.decode.masks import Mask
from dappled.decode.views import Aperture, angular_frequencies, transfer

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


@settings(max_examples=30, deadline=None)
@given(kappa=st.floats(0.3, 1.15), off=st.floats(-0.03, 0.03), rotation=st.floats(-0.035, 0.035))
def test_the_aperture_is_found_behind_a_rounded_f_number(kappa: float, off: float, rotation: float) -> None:
    found = used_aperture(
        _slices(kappa, rotation, Aperture(5), texture=0.01),
        TRANSFERS,
        ORDERS,
        nominal_kappa=kappa * (1 + off),
        rotation_rad=rotation,
        aperture=Aperture(5),
    )
    assert found.fitted
    assert found.kappa == pytest.approx(kappa, abs=max(0.002, 3 * found.sigma))
    assert 0 < found.sigma < 0.02


@pytest.mark.parametrize("kappa", [0.8, 0.9, 1.1])
def test_beams_are_told_from_a_filled_aperture(kappa: float) -> None:
    for true, filled in ((Aperture(5), False), (Aperture(5, 15), True)):
        found = used_aperture(
            _slices(kappa, 0.01, true, texture=0.01),
            TRANSFERS,
            ORDERS,
            nominal_kappa=1.01 * kappa,
            rotation_rad=0.01,
            aperture=Aperture(5),
        )
        assert (found.fitted, found.filled) == (True, filled)
        assert found.kappa == pytest.approx(kappa, abs=0.002)
        cells = found.cells(ORDERS, Aperture(5), 0.01)
        assert cells[0] == 1
        assert (cells.min() < 0.8) == filled


@pytest.mark.parametrize("aperture", [Aperture(5, 9, round=True)])
def test_another_shape_of_aperture_is_not_fitted(aperture: Aperture) -> None:
    found = used_aperture(
        _slices(1.0, 0.0, aperture, texture=0.0),
        TRANSFERS,
        ORDERS,
        nominal_kappa=1.0,
        rotation_rad=0.0,
        aperture=Aperture(5),
    )
    assert (found.kappa, found.fitted) == (1.0, False)


def test_what_tells_nothing_leaves_the_f_number_s_word() -> None:
    black = np.zeros((13, 20, 30), dtype=np.complex64)
    for slices, transfers in ((black, TRANSFERS), (_slices(1.0, 0.0, Aperture(5), 0.0), np.eye(13)[0] + 0j)):
        found = used_aperture(slices, transfers, ORDERS, nominal_kappa=1.02, rotation_rad=0.0, aperture=Aperture(5))
        assert (found.kappa, found.fitted) == (1.02, False)
