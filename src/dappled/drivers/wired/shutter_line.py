"""Wires and words that open a shutter: a GPIO line, the autopilot's servo, relay or camera trigger, or somebody else.

Named in the settings as `gpio:/dev/gpiochip0:17` (`:low` behind it for a line that is active when low),
`servo:9:1900:1100` (output, pulse in µs pressed and released), `relay:0`, `autopilot` (its own camera trigger, by
command), `outside` (who wishes for a shot has fired it already).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gpiod
from gpiod.line import Direction, Value

from dappled.drivers.camera import CameraError

HOLD_S = 0.2
DO_SET_RELAY, DO_SET_SERVO, DO_DIGICAM_CONTROL = 181, 183, 203  # MAV_CMD
KINDS = "gpio:CHIP:LINE, servo:OUTPUT:PRESSED:RELEASED, relay:NUMBER, autopilot, outside"

Order = Callable[[int, Sequence[float]], str | None]
"""Give the autopilot a command (MAV_CMD and its parameters); None once it was sent, else a sentence why it was not."""


@runtime_checkable
class UsesAutopilot(Protocol):
    """A camera that is fired by the autopilot. The daemon hands it the way there before it starts it."""

    def use_autopilot(self, order: Order) -> None:
        """From now on orders go this way."""


class ShutterLine(Protocol):
    """Opens a shutter. One thread calls it."""

    def open(self) -> None:
        """Take hold of the line. Raises CameraError."""

    def press(self) -> None:
        """Release the shutter, now. Raises CameraError where that can't be done."""

    def let_go(self) -> None:
        """The shutter was pressed long enough. Raises CameraError."""

    def close(self) -> None:
        """Leave the line, unpressed."""


class Output(Protocol):
    """What a line needs of `gpiod.LineRequest`."""

    def set_value(self, line: int | str, value: Value) -> None: ...
    def release(self) -> None: ...


Request = Callable[[str, int, bool], Output]


def request_output(chip: str, line: int, active_low: bool) -> Output:
    """The line as an output, inactive at first. Raises OSError."""
    settings = gpiod.LineSettings(direction=Direction.OUTPUT, active_low=active_low, output_value=Value.INACTIVE)
    requested: Output = gpiod.request_lines(chip, consumer="dappled shutter", config={line: settings})
    return requested


class GpioLine:
    """A line of a GPIO chip, by libgpiod: active while the shutter is pressed."""

    def __init__(self, chip: str, line: int, *, active_low: bool = False, request: Request | None = None) -> None:
        self._chip, self._line, self._active_low, self._request = chip, line, active_low, request
        self._output: Output | None = None

    def open(self) -> None:
        """See ShutterLine."""
        if self._output is None:
            try:
                self._output = (self._request or request_output)(self._chip, self._line, self._active_low)
            except (OSError, ValueError) as error:
                raise CameraError(
                    f"the shutter line {self._line} of {self._chip} can't be had ({error}): "
                    "check camera.shutter, and that you are in the group that owns the chip"
                ) from None

    def press(self) -> None:
        """See ShutterLine."""
        self._set(Value.ACTIVE)

    def let_go(self) -> None:
        """See ShutterLine."""
        self._set(Value.INACTIVE)

    def _set(self, value: Value) -> None:
        if self._output is None:
            raise CameraError(f"the shutter line {self._line} of {self._chip} is not open")
        try:
            self._output.set_value(self._line, value)
        except OSError as error:
            raise CameraError(f"the shutter line {self._line} of {self._chip} can't be set: {error.strerror}") from None

    def close(self) -> None:
        """See ShutterLine."""
        output, self._output = self._output, None
        if output is not None:
            try:
                output.set_value(self._line, Value.INACTIVE)
            except OSError:
                return  # the chip is gone, and the line with it
            finally:
                output.release()


@dataclass(frozen=True, slots=True)
class Words:
    """What the autopilot is told: a command with parameters, each time None for nothing to say."""

    pressed: tuple[int, tuple[float, ...]]
    released: tuple[int, tuple[float, ...]] | None


class AutopilotLine:
    """The autopilot presses the shutter for us."""

    def __init__(self, words: Words) -> None:
        self._words = words
        self._order: Order | None = None

    def use_autopilot(self, order: Order) -> None:
        """See UsesAutopilot."""
        self._order = order

    def open(self) -> None:
        """See ShutterLine: the way to the autopilot is the daemon's."""

    def press(self) -> None:
        """See ShutterLine."""
        self._say(self._words.pressed)

    def let_go(self) -> None:
        """See ShutterLine."""
        if self._words.released is not None:
            self._say(self._words.released)

    def _say(self, words: tuple[int, tuple[float, ...]]) -> None:
        problem = "no MAVLink link is configured: set mavlink.url" if self._order is None else self._order(*words)
        if problem is not None:
            raise CameraError(f"the autopilot was not told to fire: {problem}")

    def close(self) -> None:
        """See ShutterLine."""


class OutsideLine:
    """Somebody else fires: the autopilot on its mission, a hand. A wish is the word that it happened."""

    def open(self) -> None:
        """See ShutterLine."""

    def press(self) -> None:
        """See ShutterLine."""

    def let_go(self) -> None:
        """See ShutterLine."""

    def close(self) -> None:
        """See ShutterLine."""


def parse_line(text: str) -> ShutterLine:
    """The line that a setting names. Raises CameraError."""
    kind, *parts = text.split(":")
    try:
        return _LINES[kind](parts)
    except (KeyError, ValueError, IndexError):
        raise CameraError(f"camera.shutter = {text!r} is no shutter line; there are {KINDS}") from None


def _gpio(parts: list[str]) -> ShutterLine:
    chip, line, *low = parts
    if low not in ([], ["low"]):
        raise ValueError(low)
    return GpioLine(chip, int(line), active_low=bool(low))


def _servo(parts: list[str]) -> ShutterLine:
    output, pressed, released = (int(part) for part in parts)
    return AutopilotLine(Words((DO_SET_SERVO, (output, pressed)), (DO_SET_SERVO, (output, released))))


def _relay(parts: list[str]) -> ShutterLine:
    (number,) = (int(part) for part in parts)
    return AutopilotLine(Words((DO_SET_RELAY, (number, 1)), (DO_SET_RELAY, (number, 0))))


def _autopilot(parts: list[str]) -> ShutterLine:
    if parts:
        raise ValueError(parts)
    return AutopilotLine(Words((DO_DIGICAM_CONTROL, (0, 0, 0, 0, 1)), None))


def _outside(parts: list[str]) -> ShutterLine:
    if parts:
        raise ValueError(parts)
    return OutsideLine()


_LINES: Mapping[str, Callable[[list[str]], ShutterLine]] = {
    "gpio": _gpio,
    "servo": _servo,
    "relay": _relay,
    "autopilot": _autopilot,
    "outside": _outside,
}


def pressing(line: ShutterLine, clock_ns: Callable[[], int] = time.monotonic_ns) -> tuple[int, int]:
    """Press; the times around it. Raises CameraError."""
    called_ns = clock_ns()
    line.press()
    return called_ns, clock_ns()


def hold_s(options: Mapping[str, Any]) -> float:
    """How long the shutter is to be pressed, from a driver's options. Raises CameraError."""
    value = options.get("hold_ms", HOLD_S * 1e3)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 10_000:
        raise CameraError(f"camera.options.hold_ms must be 1 to 10000 ms, not {value!r}")
    return value / 1e3
