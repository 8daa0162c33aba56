"""What a mask leaves of the picture's contrast, against waves (`tests/decode/picture/full_waves.py`, its figures)."""

from __future__ import annotations

import pytest

from dappled.decode.optics.carriers import Mask, MaskedOptics, Sensor
from dappled.decode.optics.picture_contrast import picture_contrast

SENSOR = Sensor((160, 160), (0.01, 0.0), (0.0, 0.01))
REFERENCE = MaskedOptics(SENSOR, Mask(15.5, 2), "geometric", 0.48)
BANDS = (0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(("f_number", "by_waves"), [(7.46, (0.99, 0.95, 0.89, 0.83)), (15.0, (0.98, 0.92, 0.86, 0.80))])
def test_the_reference_camera_keeps_what_waves_leave(f_number: float, by_waves: tuple[float, ...]) -> None:
    assert picture_contrast(REFERENCE, f_number, BANDS).left == pytest.approx(by_waves, abs=0.03)


def test_a_mask_on_the_sensor_takes_nothing_and_no_mask_takes_of_what_is_even() -> None:
    on_chip = MaskedOptics(SENSOR, Mask(15.5, 2), "geometric", 0.0)
    assert picture_contrast(on_chip, 8.0, BANDS).left == pytest.approx((1.0,) * 4)
    assert picture_contrast(REFERENCE, 8.0, (0.0,)).left == pytest.approx((1.0,))


def test_a_finer_mask_and_a_larger_distance_take_more() -> None:
    def left(mask: Mask, distance_mm: float) -> float:
        return picture_contrast(MaskedOptics(SENSOR, mask, "geometric", distance_mm), 8.0, (0.4,)).left[0]

    assert left(Mask(15.5, 2), 0.48) > left(Mask(15.5, 2), 0.7)
    assert left(Mask(15.5, 2), 0.48) > left(Mask(20.0, 2), 0.48)


def test_harmonics_that_the_film_cannot_draw_take_nothing() -> None:
    coarse = Mask(5.69, 10, "diagonal", film_px_per_mm=20.0)  # draws the first one alone
    one = Mask(5.69, 1, "diagonal", film_px_per_mm=20.0)
    each = [picture_contrast(MaskedOptics(SENSOR, mask, "geometric", 1.0), 8.0, BANDS).left for mask in (coarse, one)]
    assert each[0] == pytest.approx(each[1])
