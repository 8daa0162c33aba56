"""What is missing on this machine for a flight: each check is a function that returns findings, in the order of need.

`dappled doctor` runs them. A check looks; it never fires, changes or keeps anything.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Literal

from dappled.config.settings import Settings
from dappled.daemon.cameras import open_camera
from dappled.daemon.navigation import utc
from dappled.drivers import usb_bus
from dappled.drivers.camera import CameraError, StateChanged
from dappled.drivers.usb_bus import UsbBody
from dappled.errors import DappledError

State = Literal["ok", "note", "wrong"]

OPEN_S = 12.0
_GRABBERS = ("gvfs-gphoto2-vo", "gvfsd-gphoto2", "gvfs-gphoto2-volume-monitor")  # /proc cuts names at 15 letters
_FRAME_BYTES = 20e6


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found. `todo` is what to do about it, "" where there is nothing to do."""

    name: str
    state: State
    text: str
    todo: str = ""


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the checks look; a test hands in others."""

    bodies: Callable[[], list[UsbBody]] = usb_bus.bodies
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")
    open_s: float = OPEN_S
    unsynchronised: Callable[[], bool] = field(default=lambda: not utc.kernel_synchronised())


Check = Callable[[Settings, Machine], list[Finding]]


def checkup(settings: Settings, machine: Machine | None = None, checks: Sequence[Check] | None = None) -> list[Finding]:
    """All findings, in the order of the checks."""
    where = machine or Machine()
    return [finding for check in checks or CHECKS for finding in check(settings, where)]


def next_step(findings: Sequence[Finding]) -> str:
    """What to do first; "" where nothing stands in the way."""
    return next((finding.todo for finding in findings if finding.state == "wrong" and finding.todo), "")


def libraries(settings: Settings, machine: Machine) -> list[Finding]:
    """libusb for everything on USB, libgphoto2 for cameras."""
    found = [Finding("libgphoto2", "ok", f"python-gphoto2 {metadata.version('gphoto2')}")]
    try:
        machine.bodies()
    except CameraError as error:
        text = str(error)
        todo = "sudo apt install libusb-1.0-0 (or your distribution's libusb), then `dappled doctor` again"
        return [*found, Finding("libusb", "wrong" if _wants_usb(settings) else "note", text, todo)]
    return [*found, Finding("libusb", "ok", f"pyusb {metadata.version('pyusb')}")]


def bodies(settings: Settings, machine: Machine) -> list[Finding]:
    """Cameras on the bus: whether each can be fired, and what is in the way."""
    try:
        found = machine.bodies()
    except CameraError:
        return []  # `libraries` says why
    if found:
        return [_body(settings, machine, body) for body in found]
    if not _wants_usb(settings):
        return [Finding("USB", "note", "no camera is on the bus; none is needed there")]
    todo = (
        "connect the camera, switch it on, and set its USB mode to PTP or PC connection; then `dappled doctor` again. "
        "Without a camera: `dappled run --simulate --frames 3`"
    )
    return [Finding("USB", "wrong", "no camera is on the bus", todo)]


def _body(settings: Settings, machine: Machine, body: UsbBody) -> Finding:
    name = f"{body.maker} {body.name}".strip() + f" at {body.port} ({body.mode})"
    node = body.node(machine.dev / "bus" / "usb")
    if node.exists() and not os.access(node, os.R_OK | os.W_OK):
        todo = (
            "install the udev rule (systemd/70-dappled-camera.rules to /etc/udev/rules.d/), join the group: "
            "sudo usermod -aG plugdev $USER; log in anew, and plug the camera in again"
        )
        return Finding("USB", "wrong", f"{name}: you may not open {node}", todo)
    if body.vendor == usb_bus.FUJIFILM:
        text = f"{name}: USB can't fire it; its files can be picked up"
        if settings.camera.driver == "fujifilm":
            return Finding("USB", "ok", text)
        return Finding("USB", "note", text, 'set camera.driver = "fujifilm" and camera.shutter')
    if body.mode != "PTP":
        todo = "set the camera's USB mode to PTP or PC connection in its menu, and connect it again"
        return Finding("USB", "wrong", f"{name}: as a disk it can't be fired", todo)
    holders = usb_bus.holders(node, machine.proc)
    if holders:
        names = ", ".join(holders)
        return Finding("USB", "wrong", f"{name}: held by {names}", _stop(names))
    return Finding("USB", "ok", f"{name}: can be fired")


def grabbers(settings: Settings, machine: Machine) -> list[Finding]:
    """Desktop programs that take every camera as soon as it is there."""
    running = sorted({name for name in _names(machine.proc) if name in _GRABBERS})
    if not running:
        return []
    text = f"{', '.join(running)} runs and takes cameras before anybody else can"
    return [Finding("desktop", "wrong" if _wants_usb(settings) else "note", text, _stop(running[0]))]


def _stop(name: str) -> str:
    if "gvfs" in name:
        return (
            "systemctl --user mask --now gvfs-gphoto2-volume-monitor.service; pkill -x gvfsd-gphoto2; "
            "then plug the camera in again"
        )
    return f"end {name}, then `dappled doctor` again"


def camera(settings: Settings, machine: Machine) -> list[Finding]:
    """The configured driver, opened as the daemon would open it."""
    try:
        driver = open_camera(settings.camera)
    except DappledError as error:
        return [Finding("camera", "wrong", str(error), "correct [camera] in your settings")]
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


def _opened(settings: Settings, last: StateChanged | None) -> Finding:
    if last is not None and last.state == "ready" and last.identity is not None:
        who = last.identity
        serial = f", serial number {who.serial}" if who.serial else ""
        return Finding("camera", "ok", f"{who.make} {who.model}{serial} at {who.port}: ready to fire")
    reason = "it did not answer in time" if last is None or not last.reason else last.reason
    todo = f"{reason[0].upper()}{reason[1:]}; then `dappled doctor` again"
    return Finding("camera", "wrong", f"driver {settings.camera.driver}: {reason}", todo)


def disk(settings: Settings, machine: Machine) -> list[Finding]:
    """Where flights are recorded."""
    folder = Path(settings.record.directory)
    place = next(one for one in (folder, *folder.parents) if os.path.exists(one))  # False where one may not look
    if not os.access(place, os.W_OK):
        return [
            Finding("disk", "wrong", f"{place} can't be written to", f"make {folder} yours, or set record.directory")
        ]
    free = shutil.disk_usage(place).free
    text = f"{free / 1e9:.1f} GB free at {folder}, room for some {int(free / _FRAME_BYTES)} frames"
    if free < settings.record.min_free_mb * 1e6:
        mend = "`dappled flight offload`, then remove frames by hand"
        return [Finding("disk", "wrong", f"{text}: below record.min_free_mb", mend)]
    return [Finding("disk", "ok", text)]


def clock(settings: Settings, machine: Machine) -> list[Finding]:
    """Poses go by time: this machine's clock should be kept by something."""
    if machine.unsynchronised():
        text = "this machine's clock is not synchronised: poses go by the autopilot's time, file dates may be wrong"
        return [Finding("clock", "note", text, "sudo apt install chrony")]
    return [Finding("clock", "ok", "synchronised")]


def link(settings: Settings, machine: Machine) -> list[Finding]:
    """The way to the autopilot."""
    urls = settings.mavlink.url
    if not urls:
        return [Finding("MAVLink", "note", "no link is configured: frames will have no poses", "set mavlink.url")]
    found = []
    for url in urls:
        device = url.split(":")[0].split(",")[0]
        if device.startswith("/dev/") and not os.access(device, os.R_OK | os.W_OK):
            todo = "connect it, or: sudo usermod -aG dialout $USER and log in anew"
            found.append(Finding("MAVLink", "wrong", f"{url}: {device} can't be opened", todo))
        else:
            found.append(Finding("MAVLink", "ok", f"{url} (`dappled run` says whether anybody is heard there)"))
    return found


def mask(settings: Settings, machine: Machine) -> list[Finding]:
    """Decoding in flight."""
    if settings.mask.profile:
        return [Finding("mask", "ok", settings.mask.profile)]
    return [Finding("mask", "note", "no mask is configured: frames are kept, not decoded", "set mask.profile")]


CHECKS: tuple[Check, ...] = (libraries, bodies, grabbers, camera, disk, clock, link, mask)


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
