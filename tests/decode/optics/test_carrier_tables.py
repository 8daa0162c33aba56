"""Carriers as the thesis tabulates them, and what an installed mask adds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics import MaskedOptics, carrier_tables
from dappled.decode.optics.carriers import Mask, Sensor
from tests.decode import thesis_tables as thesis

SQUARE = Sensor((2776, 3688), (0.01, 0.0), (0.0, 0.01))


@pytest.mark.parametrize(("length", "row"), thesis.TABLE_11.items())
def test_table_11(length: float, row: tuple[float, ...]) -> None:
    (found,) = carrier_tables.table(MaskedOptics(thesis.S5200, thesis.MASK_2, "fd", 1.01), [length])
    one, two = found.harmonics
    assert (one.horizontal_mm, two.horizontal_mm) == pytest.approx(row[:2], abs=0.0101)
    assert (one.vertical_mm, two.vertical_mm) == pytest.approx(row[:2], abs=0.0101)
    pixels = (one.horizontal_px, two.horizontal_px, one.vertical_px, two.vertical_px)
    assert pixels == pytest.approx(row[2:], abs=1)
    assert one.horizontal_on_sensor == (row[2] < 1844)
    assert two.vertical_on_sensor == (row[5] < 1388)


def test_table_14() -> None:
    rows = carrier_tables.table(MaskedOptics(thesis.S5200, thesis.MASK_4, "fd", 1.01), thesis.TABLE_14_LENGTHS)
    for column, row in enumerate(rows):
        for from_top in range(6):
            place = row.harmonics[5 - from_top]
            assert place.horizontal_mm == pytest.approx(thesis.TABLE_14_MM[from_top][column], abs=0.0101, rel=5e-4)
            assert place.horizontal_px == pytest.approx(thesis.TABLE_14_H[from_top][column], abs=1, rel=5e-4)
            assert place.vertical_px == pytest.approx(thesis.TABLE_14_V[from_top][column], abs=1, rel=5e-4)


@pytest.mark.parametrize(
    ("mask", "length", "expected"),
    [
        pytest.param(thesis.MASK_2, 12, thesis.TABLE_12, id="table 12"),
        pytest.param(thesis.MASK_2, 33, thesis.TABLE_13, id="table 13"),
        pytest.param(thesis.MASK_4, 13, thesis.TABLE_15, id="table 15"),
        pytest.param(thesis.MASK_4, 6, thesis.TABLE_16, id="table 16"),
    ],
)
def test_expected_columns(mask: Mask, length: float, expected: list[Any]) -> None:
    lattice = carrier_tables.lattice_of(MaskedOptics(thesis.S5200, mask, "fd", 1.01), length)
    for order, place in expected:
        (carrier,) = lattice.carriers([order])
        assert carrier.index((2776, 3688)) == pytest.approx(place, abs=1)
        assert carrier.on_sensor
        assert (order in mask.orders()) != (order in carrier_tables.crossed_orders(mask))


def test_crossed_orders_fill_a_diagonal_mask_up_to_the_full_product() -> None:
    full = Mask(1.0, 3, "full", "octave")
    diagonal = Mask(1.0, 3, "diagonal", "octave")
    assert {*diagonal.orders(), *carrier_tables.crossed_orders(diagonal)} == set(full.orders())
    assert carrier_tables.crossed_orders(full) == []


def test_rotation_moves_a_far_carrier_as_measured() -> None:
    lattice = carrier_tables.lattice_of(
        MaskedOptics(thesis.S5200, thesis.MASK_2, "fd", 1.01), 13, rotation_rad=math.radians(1)
    )
    (carrier,) = lattice.carriers([(0, 2)])
    assert abs(carrier.fy) * 2776 == pytest.approx(20, abs=0.5)  # bin 1132 by 20 a degree
    assert carrier.fx * 3688 == pytest.approx(1132, abs=1)


@given(angle=st.floats(-3, 3), law=st.sampled_from(["fd", "geometric"]))
def test_rotation_on_square_pixels_is_the_lattice_s_own(angle: float, law: str) -> None:
    sensor = Sensor((2000, 2000), (0.005, 0.0), (0.0, 0.005))
    turned = carrier_tables.lattice_of(MaskedOptics(sensor, Mask(10.0, 2), law, 1.0), 20.0, rotation_rad=angle)
    upright = carrier_tables.lattice_of(MaskedOptics(sensor, Mask(10.0, 2), law, 1.0), 20.0)
    np.testing.assert_allclose(turned.matrix(), upright.rotated(angle).matrix(), atol=1e-12)


def test_contrast_that_diffraction_leaves() -> None:
    assert carrier_tables.fresnel_number(1.01, 11.38) == pytest.approx(0.07, abs=0.005)
    assert carrier_tables.contrast(1.01, 11.38) == pytest.approx(0.975, abs=0.001)
    assert carrier_tables.contrast(1.01, 22.76) == pytest.approx(0.62, abs=0.005)
    assert carrier_tables.fresnel_number(1.01, 45.52) == pytest.approx(1.15, abs=0.005)
    assert carrier_tables.contrast(1.01, 45.52) < 0


def test_the_thesis_finds_13_mm_for_mask_2() -> None:
    best = carrier_tables.best_focal_length(MaskedOptics(thesis.S5200, thesis.MASK_2, "fd", 1.01))
    assert best.slices_mm is not None
    assert best.carriers_mm is not None
    assert round(best.slices_mm) == 13
    (row,) = carrier_tables.table(MaskedOptics(thesis.S5200, thesis.MASK_2, "fd", 1.01), [best.carriers_mm])
    assert row.harmonics[1].vertical_px == pytest.approx(1388, abs=0.01)


def test_under_the_geometric_law_a_coarse_mask_fits_at_every_focal_length() -> None:
    found = carrier_tables.best_focal_length(MaskedOptics(SQUARE, Mask(15.5, 2), "geometric", 0.48))
    assert found == carrier_tables.BestFocalLength(None, None)
    fine = carrier_tables.best_focal_length(MaskedOptics(SQUARE, Mask(26.0, 2), "geometric", 5.0))
    assert fine.carriers_mm == pytest.approx(5 / (1 - 50 / 52), rel=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (101, 77), (2776, 3688)])
@pytest.mark.parametrize("law", ["fd", "geometric"])
def test_any_frame_shape_has_a_table(shape: tuple[int, int], law: str) -> None:
    sensor = Sensor(shape, (0.005, 0.0), (0.0, 0.005))
    (row,) = carrier_tables.table(MaskedOptics(sensor, Mask(11.38, 2), law, 1.01), [30.0])
    assert len(row.harmonics) == 2
    assert row.slice_px is None or (row.slice_px[0] <= shape[0] and row.slice_px[1] <= shape[1])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"focal_length_mm": 0.013}, "focal length = 0.013 mm must lie between 0.5"),
        ({"focal_length_mm": math.nan}, "focal length = nan mm"),
        ({"focal_length_mm": -13.0}, "-13 mm"),
        ({"distance_mm": 14.0}, "mask distance = 14 mm must lie between"),
        ({"distance_mm": 0.0}, "mask distance = 0 mm"),
        ({"rotation_rad": 45.0}, "is it in radians"),
        ({"law": "snell"}, "known are fd, geometric"),
        ({"mask": Mask(-1.0, 2)}, "mask frequency = -1"),
    ],
)
def test_nonsense_is_answered_with_value_and_limit(changed: dict[str, Any], said: str) -> None:
    values: dict[str, Any] = {
        "law": "fd",
        "mask": thesis.MASK_2,
        "sensor": thesis.S5200,
        "distance_mm": 1.01,
    }
    setting: dict[str, Any] = {"focal_length_mm": 13.0}
    for name, value in changed.items():
        (values if name in values else setting)[name] = value
    with pytest.raises(DecodeError, match=said):
        carrier_tables.lattice_of(MaskedOptics(**values), **setting)
