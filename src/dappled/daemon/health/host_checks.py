"""Check what this machine lacks for a flight: libraries, camera, disk, clock, link, mask. `dappled doctor` runs this.

A check only looks: it never fires the camera, and changes nothing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from dappled.config.settings import Settings
from dappled.daemon.health import resources
from dappled.daemon.navigation.machine_clock import kernel_synchronised
from dappled.drivers import usb_bus
from dappled.drivers.camera import CameraError, StateChanged
from dappled.drivers.registry import open_camera
from dappled.drivers.usb_bus import UsbBody
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, finding, remedy
from dappled.flight import layout

OPEN_S = 12.0
_GRABBERS = ("gvfs-gphoto2-vo", "gvfsd-gphoto2", "gvfs-gphoto2-volume-monitor")  # /proc cuts names to 15 letters
_FRAME_BYTES = 20e6
USB, CAMERA, DISK = Subject("USB"), Subject("camera"), Subject("disk")


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the checks look; tests pass their own. `served`: a daemon runs here, and opens the camera."""

    bodies: Callable[[], list[UsbBody]] = usb_bus.bodies
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")
    open_s: float = OPEN_S
    unsynchronised: Callable[[], bool] = field(default=lambda: not kernel_synchronised())
    served: bool = False


def next_step(found: Iterable[Finding]) -> str:
    """What to do first: the remedy of the first stop that has one; "" where there is none."""
    return next((str(todo) for one in found if one.level is Level.STOP and (todo := remedy(one))), "")


HostCheck = Callable[[Settings, Machine], list[Finding]]


def run(settings: Settings, machine: Machine | None = None, checks: Sequence[HostCheck] | None = None) -> list[Finding]:
    """The results of all checks, in their order."""
    where = machine or Machine()
    return [one for check in checks or CHECKS for one in check(settings, where)]


def libraries(settings: Settings, machine: Machine) -> list[Finding]:
    """libusb for everything on USB, libgphoto2 for cameras."""
    gphoto2 = _library("libgphoto2", "python-gphoto2", "gphoto2")
    try:
        machine.bodies()
    except CameraError as error:
        level = Level.STOP if _wants_usb(settings) else Level.CAUTION
        return [gphoto2, finding(Code.LIBRARY_MISSING, Subject("libusb"), level, why=error)]
    return [gphoto2, _library("libusb", "pyusb", "pyusb")]


def _library(name: str, package: str, distribution: str) -> Finding:
    return finding(Code.LIBRARY_FOUND, Subject(name), package=package, version=metadata.version(distribution))


def bodies(settings: Settings, machine: Machine) -> list[Finding]:
    """Cameras on the bus: whether each can be fired, and if not, why."""
    try:
        found = machine.bodies()
    except CameraError:
        return []  # `libraries` reports it
    if found:
        return [_body(settings, machine, body) for body in found]
    return [finding(Code.USB_ABSENT if _wants_usb(settings) else Code.USB_UNNEEDED, USB)]


def _body(settings: Settings, machine: Machine, body: UsbBody) -> Finding:
    name = f"{body.maker} {body.name}".strip() + f" at {body.port} ({body.mode})"
    node = body.node(machine.dev / "bus" / "usb")
    if not machine.served and node.exists() and not os.access(node, os.R_OK | os.W_OK):
        return finding(Code.USB_FORBIDDEN, USB, body=name, node=node)
    if body.vendor == usb_bus.FUJIFILM:
        level = Level.NOTE if settings.camera.driver == "fujifilm" else Level.CAUTION
        return finding(Code.USB_FILES_ONLY, USB, level, body=name)
    if body.mode != "PTP":
        return finding(Code.USB_WRONG_MODE, USB, body=name)
    holders = ", ".join(usb_bus.holders(node, machine.proc, ours=not machine.served))
    if not holders:
        return finding(Code.USB_READY, USB, body=name)
    return finding(Code.USB_HELD_BY_DESKTOP if "gvfs" in holders else Code.USB_HELD, USB, body=name, holders=holders)


def grabbers(settings: Settings, machine: Machine) -> list[Finding]:
    """Desktop programs that open every camera as soon as it is connected."""
    running = sorted({name for name in _names(machine.proc) if name in _GRABBERS})
    level = Level.STOP if _wants_usb(settings) else Level.CAUTION
    return [finding(Code.USB_DESKTOP, Subject("desktop"), level, programs=", ".join(running))] if running else []


def camera(settings: Settings, machine: Machine) -> list[Finding]:
    """The configured driver, opened as the daemon would open it."""
    try:
        driver = open_camera(settings.camera)
    except DappledError as error:
        return [finding(Code.CAMERA_REFUSED, CAMERA, why=error)]
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
        return [finding(Code.CAMERA_UNOPENED, CAMERA, driver=settings.camera.driver, why=error)]
    finally:
        driver.stop()
    return [_opened(settings, last)]


def _opened(settings: Settings, last: StateChanged | None) -> Finding:
    if last is not None and last.state == "ready" and (who := last.identity) is not None:
        return finding(Code.CAMERA_READY, CAMERA, maker=who.make, model=who.model, serial=who.serial, port=who.port)
    why = finding(Code.CAMERA_UNANSWERING, CAMERA) if last is None or not last.reason else last.reason
    return finding(Code.CAMERA_UNOPENED, CAMERA, driver=settings.camera.driver, why=why)


def disk(settings: Settings, machine: Machine) -> list[Finding]:
    """The folder where flights are recorded."""
    folder = Path(settings.record.directory)
    place = layout.existing(folder)
    if not os.access(place, os.W_OK):
        return [finding(Code.DISK_CLOSED, DISK, place=place, folder=folder)]
    space = layout.disk_space(place)
    if (short := space.shortage(settings.record.min_free_mb)) is not None:
        return [short]
    free, frame = space.available, _FRAME_BYTES
    facts = {"free_gb": free / 1e9, "frames": int(free / frame), "frame_mb": frame / 1e6}
    return [finding(Code.DISK_ROOM, DISK, folder=folder).with_facts(**facts)]


def memory(settings: Settings, machine: Machine) -> list[Finding]:
    """Memory for a file on its way, and descriptors; nothing where there is enough."""
    short = resources.shortage(resources.look(machine.proc))
    return [] if short is None else [short]


def clock(settings: Settings, machine: Machine) -> list[Finding]:
    """Whether the kernel's clock is synchronised."""
    return [
        finding(Code.CLOCK_UNSYNCHRONISED if machine.unsynchronised() else Code.CLOCK_SYNCHRONISED, Subject("clock"))
    ]


def link(settings: Settings, machine: Machine) -> list[Finding]:
    """The links to the autopilot, and which triggers it doesn't report over them."""
    found = []
    for url in settings.mavlink.url:
        device = url.split(":")[0].split(",")[0]
        shut = device.startswith("/dev/") and not os.access(device, os.R_OK | os.W_OK)
        about = Subject("link", url)
        found.append(finding(Code.LINK_UNOPENED, about, device=device) if shut else finding(Code.LINK_NAMED, about))
    untold = [finding(Code.TRIGGER_UNREPORTED, Subject("trigger"))] if settings.camera.fired_outside else []
    return [*(found or [finding(Code.LINK_NONE, Subject("link"))]), *untold]


def mask(settings: Settings, machine: Machine) -> list[Finding]:
    """Whether frames are decoded in flight."""
    named = settings.mask.profile
    about = Subject("mask")
    return [finding(Code.MASK_NAMED, about, mask=named) if named else finding(Code.DECODE_NO_MASK, about)]


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
