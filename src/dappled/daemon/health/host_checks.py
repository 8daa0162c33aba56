"""Check what this machine lacks for a flight: libraries, camera, disk, clock, link, mask. `dappled doctor` runs this.

A check only looks: it never fires the camera, and changes nothing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from dappled import findings
from dappled.config.settings import Settings
from dappled.daemon.health import resources
from dappled.daemon.navigation.machine_clock import kernel_synchronised
from dappled.drivers import usb_bus
from dappled.drivers.camera import CameraError, StateChanged
from dappled.drivers.registry import open_camera
from dappled.drivers.usb_bus import UsbBody
from dappled.errors import DappledError, counted
from dappled.flight import layout

OPEN_S = 12.0
_GRABBERS = ("gvfs-gphoto2-vo", "gvfsd-gphoto2", "gvfs-gphoto2-volume-monitor")  # /proc cuts names to 15 letters
_FRAME_BYTES = 20e6


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the checks look; tests pass their own."""

    bodies: Callable[[], list[UsbBody]] = usb_bus.bodies
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")
    open_s: float = OPEN_S
    unsynchronised: Callable[[], bool] = field(default=lambda: not kernel_synchronised())


State = Literal["go", "caution", "no-go"]


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check. "go": ready; "caution": a flight is possible, with a loss that the text names;
    "no-go": the flight brings no good frames.

    `todo` says what to do about it, "" where nothing is to be done. `measured` holds the numbers behind the text.
    """

    name: str
    state: State
    text: str
    todo: str = ""
    measured: Mapping[str, Any] = field(default_factory=dict)


def verdict(checks: Sequence[Check]) -> State:
    """The worst state of the checks."""
    states = {one.state for one in checks}
    return "no-go" if "no-go" in states else "caution" if "caution" in states else "go"


def next_step(checks: Sequence[Check]) -> str:
    """What to do first: the `todo` of the first no-go; "" where there is none."""
    return next((one.todo for one in checks if one.state == "no-go" and one.todo), "")


HostCheck = Callable[[Settings, Machine], list[Check]]


def run(settings: Settings, machine: Machine | None = None, checks: Sequence[HostCheck] | None = None) -> list[Check]:
    """The results of all checks, in their order."""
    where = machine or Machine()
    return [one for check in checks or CHECKS for one in check(settings, where)]


def libraries(settings: Settings, machine: Machine) -> list[Check]:
    """libusb for everything on USB, libgphoto2 for cameras."""
    found = [Check("libgphoto2", "go", f"python-gphoto2 {metadata.version('gphoto2')}")]
    try:
        machine.bodies()
    except CameraError as error:
        text = str(error)
        todo = "sudo apt install libusb-1.0-0 (or your distribution's libusb), then `dappled doctor` again"
        return [*found, Check("libusb", "no-go" if _wants_usb(settings) else "caution", text, todo)]
    return [*found, Check("libusb", "go", f"pyusb {metadata.version('pyusb')}")]


def bodies(settings: Settings, machine: Machine) -> list[Check]:
    """Cameras on the bus: whether each can be fired, and if not, why."""
    try:
        found = machine.bodies()
    except CameraError:
        return []  # `libraries` reports it
    if found:
        return [_body(settings, machine, body) for body in found]
    if not _wants_usb(settings):
        return [Check("USB", "caution", "no camera is on the bus; the configured driver needs none there")]
    todo = (
        "connect the camera, switch it on, and set its USB mode to PTP or PC connection; then `dappled doctor` again. "
        "Without a camera: `dappled run --simulate --frames 3`"
    )
    return [Check("USB", "no-go", "no camera is on the bus", todo)]


def _body(settings: Settings, machine: Machine, body: UsbBody) -> Check:
    name = f"{body.maker} {body.name}".strip() + f" at {body.port} ({body.mode})"
    node = body.node(machine.dev / "bus" / "usb")
    if node.exists() and not os.access(node, os.R_OK | os.W_OK):
        todo = (
            "install the udev rule (systemd/70-dappled-camera.rules to /etc/udev/rules.d/), join the group: "
            "sudo usermod -aG plugdev $USER; log in again, and plug the camera in again"
        )
        return Check("USB", "no-go", f"{name}: you have no permission to open {node}", todo)
    if body.vendor == usb_bus.FUJIFILM:
        text = f"{name}: USB can't fire it; its files can be picked up"
        if settings.camera.driver == "fujifilm":
            return Check("USB", "go", text)
        return Check("USB", "caution", text, 'set camera.driver = "fujifilm" and camera.shutter')
    if body.mode != "PTP":
        todo = "set the camera's USB mode to PTP or PC connection in its menu, and connect it again"
        return Check("USB", "no-go", f"{name}: it can't be fired in this USB mode", todo)
    holders = usb_bus.holders(node, machine.proc)
    if holders:
        names = ", ".join(holders)
        return Check("USB", "no-go", f"{name}: held by {names}", _stop(names))
    return Check("USB", "go", f"{name}: can be fired")


def grabbers(settings: Settings, machine: Machine) -> list[Check]:
    """Desktop programs that open every camera as soon as it is connected."""
    running = sorted({name for name in _names(machine.proc) if name in _GRABBERS})
    if not running:
        return []
    text = f"{', '.join(running)} is running and opens cameras before dappled can"
    return [Check("desktop", "no-go" if _wants_usb(settings) else "caution", text, _stop(running[0]))]


def _stop(name: str) -> str:
    if "gvfs" in name:
        return (
            "systemctl --user mask --now gvfs-gphoto2-volume-monitor.service; pkill -x gvfsd-gphoto2; "
            "then plug the camera in again"
        )
    return f"end {name}, then `dappled doctor` again"


def camera(settings: Settings, machine: Machine) -> list[Check]:
    """The configured driver, opened as the daemon would open it."""
    try:
        driver = open_camera(settings.camera)
    except DappledError as error:
        return [Check("camera", "no-go", str(error), "correct [camera] in your settings")]
    last: StateChanged | None = None
    try:
        driver.start()
        until = time.monotonic() + machine.open_s
        while (left_s := until - time.monotonic()) > 0:
            event = driver.next_event(left_s)
            if isinstance(event, StateChanged):
                last = event
                if event.state in ("ready", "absent"):
                    break
    except DappledError as error:
        last = StateChanged("absent", str(error), time.monotonic_ns())
    finally:
        driver.stop()
    return [_opened(settings, last)]


def _opened(settings: Settings, last: StateChanged | None) -> Check:
    if last is not None and last.state == "ready" and last.identity is not None:
        who = last.identity
        serial = f", serial number {who.serial}" if who.serial else ""
        return Check("camera", "go", f"{who.make} {who.model}{serial} at {who.port}: ready to fire")
    reason = "it did not answer in time" if last is None or not last.reason else last.reason
    todo = f"{reason[0].upper()}{reason[1:]}; then `dappled doctor` again"
    return Check("camera", "no-go", f"driver {settings.camera.driver}: {reason}", todo)


def disk(settings: Settings, machine: Machine) -> list[Check]:
    """The folder where flights are recorded."""
    folder = Path(settings.record.directory)
    place = next(one for one in (folder, *folder.parents) if os.path.exists(one))  # False without permission to look
    if not os.access(place, os.W_OK):
        return [Check("disk", "no-go", f"{place} can't be written to", f"make {folder} yours, or set record.directory")]
    space = layout.disk_space(place)
    free = space.available
    frames = counted(int(free / _FRAME_BYTES), "frame")
    text = f"{free / 1e9:.1f} GB free at {folder}, room for about {frames} of {_FRAME_BYTES / 1e6:.0f} MB"
    short = space.shortage(settings.record.min_free_mb)
    if short is not None:
        return [
            Check(
                "disk", "no-go", f"{text}: {findings.text(short)}", "`dappled flight offload DEST --prune` makes room"
            )
        ]
    return [Check("disk", "go", text)]


def memory(settings: Settings, machine: Machine) -> list[Check]:
    """Memory for a file on its way, and descriptors; nothing where there is enough."""
    short = resources.shortage(resources.look(machine.proc))
    return [] if short is None else [Check("memory", "no-go", findings.text(short), "then `dappled doctor` again")]


def clock(settings: Settings, machine: Machine) -> list[Check]:
    """Whether the kernel's clock is synchronised."""
    if machine.unsynchronised():
        text = "this machine's clock is not synchronised: poses use the autopilot's time, file dates may be wrong"
        return [Check("clock", "caution", text, "sudo apt install chrony")]
    return [Check("clock", "go", "synchronised")]


def link(settings: Settings, machine: Machine) -> list[Check]:
    """The links to the autopilot."""
    urls = settings.mavlink.url
    if not urls:
        return [Check("MAVLink", "caution", "no link is configured: frames will have no poses", "set mavlink.url")]
    found = []
    for url in urls:
        device = url.split(":")[0].split(",")[0]
        if device.startswith("/dev/") and not os.access(device, os.R_OK | os.W_OK):
            todo = "connect it, or: sudo usermod -aG dialout $USER and log in again"
            found.append(Check("MAVLink", "no-go", f"{url}: {device} can't be opened", todo))
        else:
            found.append(Check("MAVLink", "go", f"{url} (`dappled run` says whether the autopilot is heard)"))
    return found


def mask(settings: Settings, machine: Machine) -> list[Check]:
    """Whether frames are decoded in flight."""
    if settings.mask.profile:
        return [Check("mask", "go", settings.mask.profile)]
    return [Check("mask", "caution", "no mask is configured: frames are kept, not decoded", "set mask.profile")]


CHECKS: tuple[HostCheck, ...] = (libraries, bodies, grabbers, camera, disk, memory, clock, link, mask)


def _wants_usb(settings: Settings) -> bool:
    return settings.camera.driver == "gphoto2" and not settings.camera.port.startswith("ptpip:")


def _names(proc: Path) -> list[str]:
    names = []
    for process in proc.iterdir():
        if process.name.isdigit():
            try:
                names.append((process / "comm").read_text().strip())
            except OSError:
                continue  # it ended
    return names
