"""Cameras on the bus as PyUSB lists it, with devices made of descriptors."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import usb.core

from dappled.drivers.camera import CameraError
from dappled.drivers.usb_bus import bodies, changes, holders, reset
from tests.simulated.usb_devices import EOS_450D, FINEPIX_DISK, MOUSE, UsbDevices


@pytest.fixture(scope="module", autouse=True)
def libusb() -> None:
    """PyUSB opens libusb once for the life of the process, with a socket that tells of devices."""
    with suppress(CameraError):
        bodies()


def test_cameras_are_distinguished_from_mice() -> None:
    found = bodies(UsbDevices([FINEPIX_DISK, MOUSE, EOS_450D]))
    assert [(one.port, one.maker, one.mode, one.fires) for one in found] == [
        ("usb:001,005", "Canon", "PTP", True),
        ("usb:001,006", "Fujifilm", "mass storage", False),
    ]
    assert found[0].name == "Canon Digital Camera"
    assert found[0].node() == Path("/dev/bus/usb/001/005")


def test_a_fujifilm_in_ptp_mode_can_t_be_fired_over_usb() -> None:
    (one,) = bodies(UsbDevices([replace(FINEPIX_DISK, interface_class=0x06)]))
    assert (one.mode, one.fires) == ("PTP", False)


def test_a_camera_of_an_unknown_maker_is_found_by_its_class() -> None:
    (one,) = bodies(UsbDevices([replace(EOS_450D, vendor=0x1234)]))
    assert one.maker == "vendor 1234"


def test_a_device_that_may_not_be_opened_has_no_name() -> None:
    (one,) = bodies(UsbDevices([replace(EOS_450D, allowed=False)]))
    assert (one.name, one.mode) == ("", "PTP")


def test_without_a_libusb_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(**_: object) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    with pytest.raises(CameraError, match="install libusb"):
        bodies()


def test_hot_plug_is_the_difference_of_two_listings() -> None:
    bus = UsbDevices([EOS_450D])
    before = bodies(bus)
    bus.devices = [replace(EOS_450D, address=9), FINEPIX_DISK]
    came, went = changes(before, bodies(bus))
    assert [one.port for one in came] == ["usb:001,006", "usb:001,009"]
    assert [one.port for one in went] == ["usb:001,005"]


def test_reset_resets_the_one_at_the_port() -> None:
    one, other = replace(EOS_450D), replace(FINEPIX_DISK)
    reset("usb:001,005", UsbDevices([one, other]))
    assert (one.resets, other.resets) == (1, 0)
    with pytest.raises(CameraError, match="there is no device at usb:001,007 any more"):
        reset("usb:001,007", UsbDevices([one]))
    with pytest.raises(CameraError, match="can't be reset"):
        reset("usb:001,005", UsbDevices([replace(EOS_450D, allowed=False)]))
    with pytest.raises(CameraError, match="names no device"):
        reset("ptpip:127.0.0.1:1:1")


def test_who_holds_a_device_file_is_named(tmp_path: Path) -> None:
    node = tmp_path / "005"
    node.write_bytes(b"")
    process = tmp_path / "proc" / "4711"
    (process / "fd").mkdir(parents=True)
    (process / "fd" / "7").symlink_to(node)
    (process / "comm").write_text("gvfsd-gphoto2\n")
    (tmp_path / "proc" / "self").mkdir()
    (tmp_path / "proc" / "1").mkdir()  # another user's: no fd folder to be seen
    assert holders(node, tmp_path / "proc") == ["gvfsd-gphoto2 (process 4711)"]
    assert holders(tmp_path / "other", tmp_path / "proc") == []
    ours = tmp_path / "proc" / "4712"
    (ours / "fd").mkdir(parents=True)
    (ours / "fd" / "3").symlink_to(node)
    (ours / "comm").write_text("python3\n")
    (ours / "cmdline").write_bytes(b"python3\0-P\0-m\0dappled.drivers.gphoto2.process\0" + b"7\0")
    (process / "cmdline").write_bytes(b"/usr/libexec/gvfsd-gphoto2\0")
    assert len(holders(node, tmp_path / "proc")) == 2
    assert holders(node, tmp_path / "proc", ours=False) == ["gvfsd-gphoto2 (process 4711)"]
