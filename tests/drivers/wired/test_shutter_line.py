"""Shutter lines by name, and what each does when it is pressed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from gpiod.line import Value

from dappled.drivers.camera import CameraError
from dappled.drivers.wired.shutter_line import (
    GpioLine,
    HalfPressedLine,
    OutsideLine,
    UsesAutopilot,
    hold_s,
    parse_line,
    shutter,
)
from tests.simulated.finepix import Contact, FinePix


class Wire:
    """What `gpiod.LineRequest` does, and how often."""

    def __init__(self) -> None:
        self.values: list[Value] = []
        self.released = False
        self.broken = False

    def set_value(self, line: int | str, value: Value) -> None:
        if self.broken:
            raise OSError(19, "No such device")
        assert line == 17
        self.values.append(value)

    def release(self) -> None:
        self.released = True


def test_a_gpio_line_is_active_while_it_is_pressed() -> None:
    wire = Wire()
    asked: list[tuple[str, int, bool]] = []

    def request(chip: str, number: int, low: bool) -> Wire:
        asked.append((chip, number, low))
        return wire

    line = GpioLine("/dev/gpiochip0", 17, active_low=True, request=request)
    with pytest.raises(CameraError, match="not open"):
        line.press()
    line.open()
    line.open()
    line.press()
    line.let_go()
    line.close()
    line.close()
    assert asked == [("/dev/gpiochip0", 17, True)]
    assert wire.values == [Value.ACTIVE, Value.INACTIVE, Value.INACTIVE]
    assert wire.released


def test_a_gpio_line_that_breaks_says_so_and_is_let_go() -> None:
    wire = Wire()
    line = GpioLine("/dev/gpiochip0", 17, request=lambda chip, number, low: wire)
    line.open()
    wire.broken = True
    with pytest.raises(CameraError, match="No such device"):
        line.press()
    line.close()
    assert wire.released


def test_without_a_chip_the_real_library_s_error_becomes_a_sentence() -> None:
    with pytest.raises(CameraError, match=r"/no/such/chip.*check camera\.shutter"):
        parse_line("gpio:/no/such/chip:17").open()


@pytest.mark.parametrize(
    ("text", "pressed", "released"),
    [
        ("servo:9:1900:1100", (183, (9, 1900)), (183, (9, 1100))),
        ("relay:2", (181, (2, 1)), (181, (2, 0))),
        ("autopilot", (203, (0, 0, 0, 0, 1)), None),
    ],
)
def test_the_autopilot_is_told(
    text: str, pressed: tuple[int, Sequence[float]], released: tuple[int, Sequence[float]] | None
) -> None:
    line = parse_line(text)
    with pytest.raises(CameraError, match=r"mavlink\.url"):
        line.press()
    told: list[tuple[int, Sequence[float]]] = []

    def order(number: int, parameters: Sequence[float]) -> str | None:
        told.append((number, parameters))
        return None

    assert isinstance(line, UsesAutopilot)
    line.use_autopilot(order)
    line.open()
    line.press()
    line.let_go()
    line.close()
    assert told == [pressed, *([] if released is None else [released])]


def test_an_order_that_can_t_be_given_is_told() -> None:
    line = parse_line("relay:0")
    assert isinstance(line, UsesAutopilot)
    line.use_autopilot(lambda number, parameters: "no autopilot was heard")
    with pytest.raises(CameraError, match="no autopilot was heard"):
        line.press()


def test_half_way_comes_before_the_shutter_and_is_let_go_after_it() -> None:
    told: list[tuple[float, ...]] = []
    refuse: list[int] = []

    def order(number: int, parameters: Sequence[float]) -> str | None:
        told.append(tuple(parameters))
        return "it is refused" if parameters[0] in refuse and parameters[1] else None

    line = shutter({"shutter": "relay:0", "half_press": "relay:1", "half_press_ms": 300})
    assert isinstance(line, HalfPressedLine)
    assert line.lead_s == 0.3
    line.use_autopilot(order)
    line.open()
    line.prepare()
    line.press()
    line.let_go()
    assert told == [(1, 1), (0, 1), (0, 0), (1, 0)]
    told.clear()
    refuse.append(0)
    line.prepare()
    with pytest.raises(CameraError, match="it is refused"):
        line.press()
    assert told == [(1, 1), (0, 1), (1, 0)]  # not left pressed
    line.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shutter": "outside", "half_press": "relay:1"}, "fired from here"),
        ({"shutter": "relay:0", "half_press": "autopilot"}, "a line of its own"),
        ({"shutter": "relay:0", "half_press": "relay:x"}, "half_press = 'relay:x' is not"),
        ({"shutter": "relay:0", "half_press": 7}, "must be text"),
        ({"shutter": "relay:0", "half_press": "relay:1", "half_press_ms": 0}, "half_press_ms"),
    ],
)
def test_a_half_press_that_cant_be_is_a_sentence(options: dict[str, Any], words: str) -> None:
    with pytest.raises(CameraError, match=words):
        shutter(options)


def test_outside_is_fired_by_others() -> None:
    line = parse_line("outside")
    assert isinstance(line, OutsideLine)
    line.open()
    line.press()
    line.let_go()
    line.close()


@pytest.mark.parametrize(
    "text", ["", "gpio", "gpio:/dev/gpiochip0", "gpio:/dev/gpiochip0:x", "gpio:/dev/gpiochip0:17:high", "servo:9",
             "relay", "relay:a", "autopilot:1", "outside:1", "laser:1"],
)  # fmt: skip
def test_a_wrong_line_is_named_with_the_right_ones(text: str) -> None:
    with pytest.raises(CameraError, match=r"camera\.shutter = .*gpio:CHIP:LINE"):
        parse_line(text)


def test_the_shutter_is_held_as_long_as_is_asked_for() -> None:
    assert hold_s({"hold_ms": 50}) == 0.05
    assert hold_s({}) == 0.2
    for wrong in (0, 100_000, "x", True):
        with pytest.raises(CameraError, match="hold_ms"):
            hold_s({"hold_ms": wrong})


def test_the_simulated_contact_is_what_gpiod_has(tmp_path: Path) -> None:
    body = FinePix(tmp_path, write_s=10.0)
    contact = body.request("/dev/gpiochip0", 4, False)
    assert isinstance(contact, Contact)
    for value in (Value.ACTIVE, Value.INACTIVE, Value.ACTIVE):  # the second comes while it still writes
        contact.set_value(4, value)
    assert (body.pressed, body.made) == (2, 1)
    with pytest.raises(ValueError, match="line 5"):
        contact.set_value(5, Value.ACTIVE)
