"""Find cameras on the USB bus with PyUSB: their modes, their device files, the programs that hold them, and a reset."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from ctypes.util import find_library
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import libusb_package
import usb.backend.libusb1
import usb.core
import usb.util

from dappled.drivers.camera import CameraError

UsbMode = Literal["PTP", "mass storage", "other"]

CANON, FUJIFILM = 0x04A9, 0x04CB
MAKERS = {CANON: "Canon", FUJIFILM: "Fujifilm", 0x04B0: "Nikon", 0x054C: "Sony", 0x07B4: "Olympus", 0x04DA: "Panasonic"}
_STILL_IMAGE, _MASS_STORAGE = 0x06, 0x08  # USB class codes; a still image device speaks PTP
_OURS = b"dappled.drivers."  # in the command line of a process that holds a camera for us
_NO_LIBUSB = "no libusb works on this machine: install libusb-1.0-0 (Debian, Ubuntu) or libusb1 (Fedora)"


@dataclass(frozen=True, slots=True)
class UsbBody:
    """A camera on the bus. `name` is its own name, "" where this user may not read it."""

    bus: int
    address: int
    vendor: int
    product: int
    mode: UsbMode
    name: str = ""

    @property
    def port(self) -> str:
        """libgphoto2's name of the port."""
        return f"usb:{self.bus:03d},{self.address:03d}"

    @property
    def maker(self) -> str:
        """The maker, by the vendor number."""
        return MAKERS.get(self.vendor, f"vendor {self.vendor:04x}")

    @property
    def fires(self) -> bool:
        """Whether USB can fire it: not a Fujifilm of the thesis' time, and not a body in mass storage mode."""
        return self.mode == "PTP" and self.vendor != FUJIFILM

    def node(self, dev: Path = Path("/dev/bus/usb")) -> Path:
        """Return its device file."""
        return dev / f"{self.bus:03d}" / f"{self.address:03d}"


def bodies(backend: Any = None) -> list[UsbBody]:
    """List all cameras on the bus in the order of their addresses. Raises CameraError without a libusb.

    `backend` is PyUSB's; None: the libusb of this machine, or the one that the package libusb-package brings.
    """
    found = (_body(device) for device in _devices(backend))
    return sorted((body for body in found if body is not None), key=lambda body: (body.bus, body.address))


def changes(before: Iterable[UsbBody], after: Iterable[UsbBody]) -> tuple[list[UsbBody], list[UsbBody]]:
    """Return the bodies that came and those that went. One plugged in again has a new address, and did both."""
    was, now = set(before), set(after)
    return sorted(now - was, key=lambda body: body.port), sorted(was - now, key=lambda body: body.port)


def reset(port: str, backend: Any = None) -> None:
    """Reset the device at a libgphoto2 port ("usb:001,005"), as if its cable had been pulled. Raises CameraError."""
    match = re.fullmatch(r"usb:(\d+),(\d+)", port)
    if match is None:
        raise CameraError(f"{port!r} names no device on USB, as usb:001,005 does")
    bus, address = int(match[1]), int(match[2])
    for device in _devices(backend):
        if (device.bus, device.address) == (bus, address):
            try:
                device.reset()
            except (usb.core.USBError, NotImplementedError) as error:
                raise CameraError(f"the device at {port} can't be reset ({error}): pull its cable") from None
            finally:
                usb.util.dispose_resources(device)
            return
    raise CameraError(f"there is no device at {port} any more")


def holders(node: Path, proc: Path = Path("/proc"), *, ours: bool = True) -> list[str]:
    """List the programs that have a device file open, as "name (process 123)", as far as this user may see them; with
    or without `ours`, the camera processes of dappled."""
    found = []
    for process in proc.iterdir():
        if process.name.isdigit() and process.name != str(os.getpid()):
            try:
                open_files = {os.readlink(link) for link in (process / "fd").iterdir()}
                if str(node) in open_files and (ours or _OURS not in (process / "cmdline").read_bytes()):
                    found.append(f"{(process / 'comm').read_text().strip()} (process {process.name})")
            except OSError:
                continue  # another user's, or it has ended
    return sorted(found)


def _devices(backend: Any) -> Iterator[Any]:
    try:
        yield from usb.core.find(find_all=True, backend=backend or _libusb())
    except usb.core.NoBackendError:
        raise CameraError(_NO_LIBUSB) from None
    except usb.core.USBError as error:
        raise CameraError(f"the USB bus can't be read ({error})") from None


def _libusb() -> Any:
    """Return PyUSB's backend for the machine's libusb, else for the packaged one; None where neither can be loaded."""
    return usb.backend.libusb1.get_backend(lambda name: find_library(name) or libusb_package.find_library(name))


def _body(device: Any) -> UsbBody | None:
    """Return the device as a camera; None for a hub, a mouse, or another maker's disk."""
    try:
        classes = {interface.bInterfaceClass for configuration in device for interface in configuration}
    except usb.core.USBError:
        classes = set()
    camera = _STILL_IMAGE in classes
    if not camera and device.idVendor not in MAKERS:
        return None
    mode: UsbMode = "PTP" if camera else "mass storage" if _MASS_STORAGE in classes else "other"
    return UsbBody(device.bus, device.address, device.idVendor, device.idProduct, mode, _name(device))


def _name(device: Any) -> str:
    try:
        return str(device.product or "").strip()
    except (usb.core.USBError, ValueError, NotImplementedError):
        return ""  # this user may not read it, or it has none
    finally:
        usb.util.dispose_resources(device)
