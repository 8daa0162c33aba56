"""A USB bus for PyUSB: devices with descriptors, as its backends tell them.

`usb.core.find(backend=UsbDevices(...))`."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

_STRING_DESCRIPTOR = 0x03
_ACCESS = 13


@dataclass(slots=True)
class UsbDevice:
    """One device. `allowed`: this user may open it. `resets` counts them."""

    bus: int
    address: int
    vendor: int
    product: int
    interface_class: int
    name: str = ""
    allowed: bool = True
    resets: int = field(default=0, compare=False)


class UsbDevices(usb.backend.IBackend):  # type: ignore[misc]  # PyUSB has no types
    """The bus. Its devices may be changed at any time."""

    def __init__(self, devices: Sequence[UsbDevice]) -> None:
        self.devices = list(devices)

    def enumerate_devices(self) -> Iterator[UsbDevice]:
        """See IBackend."""
        return iter(list(self.devices))

    def get_device_descriptor(self, dev: UsbDevice) -> Any:
        """See IBackend."""
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=dev.vendor, idProduct=dev.product, bcdDevice=1, iManufacturer=0,
            iProduct=1 if dev.name else 0, iSerialNumber=0, bNumConfigurations=1, address=dev.address, bus=dev.bus,
            port_number=1, port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: UsbDevice, config: int) -> Any:
        """See IBackend."""
        self._one(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=18, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: UsbDevice, intf: int, alt: int, config: int) -> Any:
        """See IBackend."""
        self._one(intf + alt + config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=0,
            bInterfaceClass=dev.interface_class, bInterfaceSubClass=1, bInterfaceProtocol=1, iInterface=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: UsbDevice) -> UsbDevice:
        """See IBackend."""
        if not dev.allowed:
            raise usb.core.USBError("Access denied (insufficient permissions)", errno=_ACCESS)
        return dev

    def close_device(self, dev_handle: UsbDevice) -> None:
        """See IBackend."""

    def release_interface(self, dev_handle: UsbDevice, intf: int) -> None:
        """See IBackend."""

    def ctrl_transfer(  # noqa: PLR0917  # PyUSB's own signature
        self, dev_handle: UsbDevice, bm_type: int, b_request: int, w_value: int, w_index: int, data: Any, timeout: int
    ) -> int:
        """See IBackend: string descriptors."""
        index = w_value & 0xFF
        text = b"\x09\x04" if index == 0 else dev_handle.name.encode("utf-16-le")
        raw = array("B", bytes([len(text) + 2, _STRING_DESCRIPTOR]) + text)[: len(data)]
        data[: len(raw)] = raw
        return len(raw)

    def reset_device(self, dev_handle: UsbDevice) -> None:
        """See IBackend."""
        dev_handle.resets += 1

    @staticmethod
    def _one(number: int) -> None:
        if number:
            raise IndexError(number)


EOS_450D = UsbDevice(1, 5, 0x04A9, 0x3145, 0x06, "Canon Digital Camera")
FINEPIX_DISK = UsbDevice(1, 6, 0x04CB, 0x01BF, 0x08, "USB Mass Storage")
MOUSE = UsbDevice(1, 2, 0x046D, 0xC077, 0x03, "Mouse")
