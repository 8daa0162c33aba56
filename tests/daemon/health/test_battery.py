from __future__ import annotations

import pytest

from dappled.daemon.health import battery
from dappled.drivers.camera import Setting


@pytest.mark.parametrize("word", ["Low", "25%", "0 %", " 10% ", "EMPTY", "critical"])
def test_a_battery_that_will_not_last_is_told(word: str) -> None:
    said = battery.doubt((Setting("iso", "100"), Setting("battery", word)))
    assert said == f"the camera's battery is nearly empty: {word.strip()}"


@pytest.mark.parametrize("word", ["100%", "50%", "26%", "Unknown value 0x0007", "", "normal"])
def test_a_good_one_and_one_that_says_nothing_clear_are_not(word: str) -> None:
    assert battery.doubt((Setting("battery", word),)) is None
    assert battery.doubt(()) is None
