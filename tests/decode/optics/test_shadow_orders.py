"""Orders of a mask's shadow that its pattern has not, against waves (`tests/decode/picture/full_waves.py`)."""

from __future__ import annotations

from dataclasses import replace

from dappled.decode.optics.carriers import Mask, MaskedOptics, Sensor
from dappled.decode.optics.shadow_orders import shadow_orders

REFERENCE = MaskedOptics(Sensor((160, 160), (0.01, 0.0), (0.0, 0.01)), Mask(15.5, 2), "geometric", 0.48)


def test_diffraction_makes_orders_that_the_pattern_has_not() -> None:
    lattice = REFERENCE.lattice(50.0)
    pattern = {order for order in REFERENCE.mask.half_orders() if order != (0, 0)}
    by_waves = {(0, 3), (3, 0), (1, 3), (1, -3), (3, 1), (3, -1)}  # 0.8 % of the mean, the mixed ones 0.2 %
    drawn, made = map(set, shadow_orders(REFERENCE, lattice, 10.8))
    assert drawn == pattern
    assert made > by_waves
    assert {max(map(abs, order)) for order in made} == {3, 4}  # the fourth folds: its waves are of 0.62 cycles a pixel
    drawn, made = map(set, shadow_orders(replace(REFERENCE, distance_mm=0.001), lattice, 10.8))
    assert (drawn, made) == (pattern, set())


def test_the_pattern_s_orders_beyond_the_sensor_and_of_endless_harmonics_are_left_out() -> None:
    fine = replace(REFERENCE, mask=Mask(26.0, 2))  # its second harmonic is beyond the sensor
    drawn, made = shadow_orders(fine, fine.lattice(50.0), 10.8)
    assert max(max(map(abs, order)) for order in drawn) == 1
    assert (0, 2) in made, "it folds"
    endless = replace(REFERENCE, mask=Mask(1.0, 10, harmonics="octave"))
    drawn, made = shadow_orders(endless, endless.lattice(50.0), 10.8)
    assert drawn
    assert not made
