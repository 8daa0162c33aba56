"""Lines that fire a shutter: a GPIO line, or the autopilot's servo, relay or camera trigger.

The settings name them as `gpio:/dev/gpiochip0:17` (with `:low` appended for a line that is active when low),
`servo:9:1900:1100` (output, pulse in µs pressed and released), `relay:0`, `autopilot` (its own camera trigger, by
command), and `outside` (the camera is fired by something else, before the shot is requested).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from dappled.drivers.camera import CameraError, text_option

if TYPE_CHECKING:
    from gpiod.line import Value

HOLD_S = 0.2
HALF_PRESS_S = 0.5
DO_SET_RELAY, DO_SET_SERVO, DO_DIGICAM_CONTROL = 181, 183, 203  # MAV_CMD
KINDS = "gpio:CHIP:LINE, servo:OUTPUT:PRESSED:RELEASED, relay:NUMBER, autopilot, outside"

CommandSender = Callable[[int, Sequence[float]], str | None]
"""Send the autopilot a command (MAV_CMD and its parameters). Returns None when sent, else a sentence why it was not."""


@runtime_checkable
class UsesAutopilot(Protocol):
    """A camera or shutter line that the autopilot fires. The daemon gives it a sender before it starts the camera."""

    def use_autopilot(self, send: CommandSender) -> None:
        """Send commands by this from now on."""


class ShutterLine(Protocol):
    """What fires a shutter. One thread calls it."""

    def open(self) -> None:
        """Acquire the line; called again after an error. Raises CameraError."""

    def press(self) -> None:
        """Press the shutter, now. Raises CameraError."""

    def let_go(self) -> None:
        """Release the shutter after it was held long enough. Raises CameraError."""

    def close(self) -> None:
        """Give the line back, released."""


class TriggerOutput(Protocol):
    """The part of `gpiod.LineRequest` that a line needs."""

    def set_value(self, line: int | str, value: Value) -> None: ...
    def release(self) -> None: ...


OutputRequest = Callable[[str, int, bool], TriggerOutput]


def request_output(chip: str, line: int, active_low: bool) -> TriggerOutput:
    """Request the line as an output, inactive at first. Raises OSError."""
    import gpiod  # noqa: PLC0415  # by whom such a line is named, and nobody else
    from gpiod.line import Direction  # noqa: PLC0415  # as above

    off = _level(active=False)
    settings = gpiod.LineSettings(direction=Direction.OUTPUT, active_low=active_low, output_value=off)
    requested: TriggerOutput = gpiod.request_lines(chip, consumer="dappled shutter", config={line: settings})
    return requested


def _level(*, active: bool) -> Value:
    from gpiod.line import Value  # noqa: PLC0415  # as above

    return Value.ACTIVE if active else Value.INACTIVE


class GpioLine:
    """A line of a GPIO chip, by libgpiod: active while the shutter is pressed."""

    def __init__(self, chip: str, line: int, *, active_low: bool = False, request: OutputRequest | None = None) -> None:
        self._chip, self._line, self._active_low, self._request = chip, line, active_low, request
        self._output: TriggerOutput | None = None

    def open(self) -> None:
        """Acquire the line; called again after an error."""
        if self._output is None:
            try:
                self._output = (self._request or request_output)(self._chip, self._line, self._active_low)
            except (OSError, ValueError) as error:
                raise CameraError(
                    f"the shutter line {self._line} of {self._chip} can't be opened ({error}): "
                    "check camera.shutter, and that a group of yours owns the chip (docs/drivers.md)"
                ) from None

    def press(self) -> None:
        """Press the shutter, now."""
        self._set(active=True)

    def let_go(self) -> None:
        """Release the shutter after it was held long enough."""
        self._set(active=False)

    def _set(self, *, active: bool) -> None:
        if self._output is None:
            raise CameraError(f"the shutter line {self._line} of {self._chip} is not open")
        try:
            self._output.set_value(self._line, _level(active=active))
        except OSError as error:
            raise CameraError(f"the shutter line {self._line} of {self._chip} can't be set: {error.strerror}") from None

    def close(self) -> None:
        output, self._output = self._output, None
        if output is not None:
            try:
                output.set_value(self._line, _level(active=False))
            except OSError:
                return  # the chip is gone, and the line with it
            finally:
                output.release()


@dataclass(frozen=True, slots=True)
class TriggerCommands:
    """The commands that press and release: MAV_CMD and parameters; `released` is None where there is none."""

    pressed: tuple[int, tuple[float, ...]]
    released: tuple[int, tuple[float, ...]] | None


class AutopilotLine:
    """A shutter that the autopilot presses by command."""

    def __init__(self, commands: TriggerCommands) -> None:
        self._commands = commands
        self._sender: CommandSender | None = None

    def use_autopilot(self, send: CommandSender) -> None:
        self._sender = send

    def open(self) -> None:
        """Acquire the line; called again after an error. The daemon opens the link to the autopilot."""

    def press(self) -> None:
        """Press the shutter, now."""
        self._send(self._commands.pressed)

    def let_go(self) -> None:
        """Release the shutter after it was held long enough."""
        if self._commands.released is not None:
            self._send(self._commands.released)

    def _send(self, command: tuple[int, tuple[float, ...]]) -> None:
        problem = "no MAVLink link is configured: set mavlink.url" if self._sender is None else self._sender(*command)
        if problem is not None:
            raise CameraError(f"the autopilot did not get the command to fire: {problem}")

    def close(self) -> None:
        """Give the line back, released."""


class OutsideLine:
    """A camera that something else fires (the autopilot on its mission, a person) before the shot is requested."""

    def open(self) -> None:
        """Acquire the line; called again after an error."""

    def press(self) -> None:
        """Press the shutter, now."""

    def let_go(self) -> None:
        """Release the shutter after it was held long enough."""

    def close(self) -> None:
        """Give the line back, released."""


class HalfPressedLine:
    """A shutter with a second line for its half-press, on which the body focuses and meters before the shot.

    Both contacts stay closed during the exposure, as a remote's button closes them. `lead_s` is how long the first one
    is held before the shutter is pressed.
    """

    def __init__(self, full: ShutterLine, half: ShutterLine, lead_s: float) -> None:
        self._full, self._half, self.lead_s = full, half, lead_s

    def use_autopilot(self, send: CommandSender) -> None:
        for line in (self._full, self._half):
            if isinstance(line, UsesAutopilot):
                line.use_autopilot(send)

    def open(self) -> None:
        """Acquire the line; called again after an error."""
        self._half.open()
        self._full.open()

    def prepare(self) -> None:
        """Press half-way. Raises CameraError."""
        self._half.press()

    def press(self) -> None:
        """Press the shutter, now."""
        try:
            self._full.press()
        except CameraError:
            self._half.let_go()
            raise

    def let_go(self) -> None:
        """Release the shutter after it was held long enough. Both, the shutter first."""
        self._full.let_go()
        self._half.let_go()

    def close(self) -> None:
        try:
            self._full.close()
        finally:
            self._half.close()


def shutter(options: Mapping[str, Any], default: str = "") -> ShutterLine:
    """The shutter that a driver's options name (`default` without one), with its half-press where they name one. Raises
    CameraError."""
    full = parse_line(text_option(options, "shutter") or default)
    half = text_option(options, "half_press")
    lead_s = _milliseconds(options, "half_press_ms", HALF_PRESS_S)
    if not half:
        return full
    if isinstance(full, OutsideLine) or half.split(":")[0] not in ("gpio", "servo", "relay"):
        raise CameraError(
            f"camera.options.half_press = {half!r} needs a line of its own (gpio, servo or relay), and a shutter "
            "that is fired from here"
        )
    return HalfPressedLine(full, parse_line(half, "camera.options.half_press"), lead_s)


def parse_line(text: str, key: str = "camera.shutter") -> ShutterLine:
    """Return the line that a setting (`key`) names. Raises CameraError."""
    kind, *parts = text.split(":")
    try:
        return _LINES[kind](parts)
    except (KeyError, ValueError, IndexError):
        raise CameraError(f"{key} = {text!r} is not a shutter line; the kinds are {KINDS}", setting=key) from None


def _gpio(parts: list[str]) -> ShutterLine:
    chip, line, *low = parts
    if low not in ([], ["low"]) or int(line) < 0:
        raise ValueError(parts)
    return GpioLine(chip, int(line), active_low=bool(low))


def _servo(parts: list[str]) -> ShutterLine:
    output, pressed, released = (int(part) for part in parts)
    return AutopilotLine(TriggerCommands((DO_SET_SERVO, (output, pressed)), (DO_SET_SERVO, (output, released))))


def _relay(parts: list[str]) -> ShutterLine:
    (number,) = (int(part) for part in parts)
    return AutopilotLine(TriggerCommands((DO_SET_RELAY, (number, 1)), (DO_SET_RELAY, (number, 0))))


def _autopilot(parts: list[str]) -> ShutterLine:
    if parts:
        raise ValueError(parts)
    return AutopilotLine(TriggerCommands((DO_DIGICAM_CONTROL, (0, 0, 0, 0, 1)), None))


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


def hold_s(options: Mapping[str, Any]) -> float:
    """Return how long the shutter is pressed, from a driver's options. Raises CameraError."""
    return _milliseconds(options, "hold_ms", HOLD_S)


def _milliseconds(options: Mapping[str, Any], name: str, default_s: float) -> float:
    value = options.get(name, default_s * 1e3)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 10_000:
        raise CameraError(f"camera.options.{name} must be 1 to 10000 ms, not {value!r}")
    return value / 1e3
