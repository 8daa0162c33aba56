"""Shutter lines by name, and what each does when it is pressed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from gpiod.line import Value

from dappled.drivers.camera import CameraError
from dappled.drivers.wired.shutter_line import GpioLine, OutsideLine, UsesAutopilot, hold_s, parse_line
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
