"""What `dappled doctor` sees on machines that lack this or that."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled.config.settings import CameraSettings, MavlinkSettings, RecordSettings, Settings
from dappled.daemon.health import host_checks
from dappled.daemon.health.host_checks import Machine, next_step
from dappled.drivers.camera import CameraError
from dappled.drivers.usb_bus import CANON, FUJIFILM, UsbBody
from dappled.findings import Code, Finding, Level, Subject, finding, remedy, text
from tests.daemon.fakes import FakeCamera

EOS = UsbBody(1, 5, CANON, 0x3145, "PTP", "EOS 450D")


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    proc = tmp_path / "proc"
    proc.mkdir()
    return Machine(bodies=list, proc=proc, dev=tmp_path / "dev", open_s=5.0, unsynchronised=lambda: False)


def having(machine: Machine, *bodies: UsbBody) -> Machine:
    return replace(machine, bodies=lambda: list(bodies))


def the_one(findings: list[Finding]) -> Finding:
    (found,) = findings
    return found


def no_libusb() -> list[UsbBody]:
    raise CameraError("no libusb is on this machine")


def test_without_a_camera_it_says_what_to_do_next(machine: Machine) -> None:
    found = the_one(host_checks.bodies(Settings(), machine))
    assert found.level == Level.STOP
    assert "USB mode" in str(remedy(found))
    assert "--simulate" in str(remedy(found))


def test_without_a_libusb_it_says_what_to_install(machine: Machine) -> None:
    found = host_checks.libraries(Settings(), replace(machine, bodies=no_libusb))
    assert found[-1].level == Level.STOP
    assert "apt install" in str(remedy(found[-1]))
    assert host_checks.bodies(Settings(), replace(machine, bodies=no_libusb)) == []


def test_a_body_that_can_be_fired(machine: Machine) -> None:
    found = the_one(host_checks.bodies(Settings(), having(machine, EOS)))
    assert (found.level, "can be fired" in str(text(found)), "EOS 450D" in str(text(found))) == (Level.NOTE, True, True)


def test_a_body_in_the_wrong_usb_mode(machine: Machine) -> None:
    found = the_one(host_checks.bodies(Settings(), having(machine, replace(EOS, mode="mass storage"))))
    assert found.level == Level.STOP
    assert "PTP" in str(remedy(found))


def test_a_body_that_this_user_may_not_open(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    node = EOS.node(machine.dev / "bus" / "usb")
    node.parent.mkdir(parents=True)
    node.write_bytes(b"")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != node)  # root may do everything
    found = the_one(host_checks.bodies(Settings(), having(machine, EOS)))
    assert found.level == Level.STOP
    assert "udev rule" in str(remedy(found))


def test_a_body_that_another_program_holds(machine: Machine) -> None:
    process = machine.proc / "4711"
    (process / "fd").mkdir(parents=True)
    (process / "fd" / "3").symlink_to(EOS.node(machine.dev / "bus" / "usb"))
    (process / "comm").write_text("gvfsd-gphoto2\n")
    found = the_one(host_checks.bodies(Settings(), having(machine, EOS)))
    assert "gvfsd-gphoto2 (process 4711)" in str(text(found))
    assert "gvfs-gphoto2-volume-monitor" in str(remedy(found))


def test_beside_a_daemon_its_own_camera_process_and_this_user_s_rights_are_no_finding(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It named the service's own process as the one to end, and told a user to join the group of the service."""
    node = EOS.node(machine.dev / "bus" / "usb")
    node.parent.mkdir(parents=True)
    node.write_bytes(b"")
    process = machine.proc / "4711"
    (process / "fd").mkdir(parents=True)
    (process / "fd" / "3").symlink_to(node)
    (process / "comm").write_text("python3\n")
    (process / "cmdline").write_bytes(b"python3\0-P\0-m\0dappled.drivers.gphoto2.process\0" + b"7\0")
    assert the_one(host_checks.bodies(Settings(), having(machine, EOS))).code is Code.USB_HELD
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != node)  # root may do everything
    found = the_one(host_checks.bodies(Settings(), having(replace(machine, served=True), EOS)))
    assert found.code is Code.USB_READY


def test_gvfs_is_named_as_the_culprit(machine: Machine) -> None:
    assert host_checks.grabbers(Settings(), machine) == []
    (machine.proc / "17").mkdir()
    (machine.proc / "17" / "comm").write_text("gvfs-gphoto2-vo\n")
    found = the_one(host_checks.grabbers(Settings(), machine))
    assert found.level == Level.STOP
    assert "mask --now" in str(remedy(found))
    elsewhere = Settings(camera=CameraSettings(port="ptpip:127.0.0.1:1:1"))
    assert the_one(host_checks.grabbers(elsewhere, machine)).level == Level.CAUTION


def test_a_fujifilm_is_told_to_need_a_wire(machine: Machine) -> None:
    finepix = UsbBody(1, 6, FUJIFILM, 0x1BF, "mass storage", "FinePix S5200")
    found = the_one(host_checks.bodies(Settings(), having(machine, finepix)))
    assert "can't fire it" in str(text(found))
    assert "camera.shutter" in str(remedy(found))
    right = Settings(camera=CameraSettings(driver="fujifilm", shutter="relay:0"))
    assert the_one(host_checks.bodies(right, having(machine, finepix))).level == Level.NOTE


def test_a_driver_that_opens_is_ready(machine: Machine) -> None:
    settings = Settings(camera=CameraSettings(driver="simulated", options={"picture": "pattern:1000:dng"}))
    found = the_one(host_checks.camera(settings, machine))
    assert (found.level, "Simulated" in str(text(found))) == (Level.NOTE, True)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"driver": "fujifilm"}, "camera.shutter"),
        ({"driver": "nothing"}, "nothing"),
        ({"driver": "fujifilm", "shutter": "gpio:/no/such/chip:4"}, "/no/such/chip"),
    ],
)
def test_a_driver_that_can_t_be_opened_says_why(machine: Machine, camera: dict[str, Any], words: str) -> None:
    found = the_one(host_checks.camera(Settings(camera=CameraSettings(**camera)), replace(machine, open_s=0.3)))
    assert found.level == Level.STOP
    assert words in str(text(found))
    assert remedy(found)


def test_a_driver_that_fails_as_it_begins_costs_no_other_finding(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(FakeCamera):
        def start(self) -> None:
            raise CameraError("no such port")

    broken = Broken()
    monkeypatch.setattr(host_checks, "open_camera", lambda _: broken)
    found = host_checks.run(Settings(), machine, [host_checks.camera, host_checks.mask])
    assert [one.subject.kind for one in found] == ["camera", "mask"]
    assert (found[0].level, "no such port" in str(text(found[0])), broken.stopped) == (Level.STOP, True, True)


@pytest.mark.parametrize("shutter", ["outside", "relay:0"])
def test_a_relay_that_is_switched_by_itself_is_no_shot_where_something_else_fires(
    machine: Machine, shutter: str
) -> None:
    url = ("udpin:127.0.0.1:14550",)
    camera = CameraSettings(driver="fujifilm", shutter=shutter)
    found = host_checks.link(Settings(camera=camera, mavlink=MavlinkSettings(url=url)), machine)
    untold = [one for one in found if one.code is Code.TRIGGER_UNREPORTED]
    assert [one.level for one in untold] == [Level.NOTE] * (shutter == "outside")
    assert all("DO_SET_RELAY" in str(text(one)) for one in untold)


def test_the_disk_behind_a_closed_door(machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in one that may not be looked into: as if it were not there yet."""
    closed = tmp_path / "closed"
    real = os.stat

    def stat(path: Any, **how: Any) -> os.stat_result:
        if str(path).startswith(f"{closed}/"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, **how)

    closed.mkdir()
    monkeypatch.setattr(os, "stat", stat)
    settings = Settings(record=RecordSettings(directory=str(closed / "flights")))
    assert the_one(host_checks.disk(settings, machine)).level == Level.NOTE


def test_the_disk(machine: Machine, tmp_path: Path) -> None:
    def at(folder: Path, least: int = 0) -> Settings:
        return Settings(record=RecordSettings(directory=str(folder), min_free_mb=least))

    assert the_one(host_checks.disk(at(tmp_path / "not" / "yet"), machine)).level == Level.NOTE
    assert the_one(host_checks.disk(at(tmp_path, 10_000_000), machine)).level == Level.STOP


def test_the_disk_of_somebody_else(machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    settings = Settings(record=RecordSettings(directory=str(tmp_path)))
    assert "record.directory" in str(remedy(the_one(host_checks.disk(settings, machine))))


@pytest.mark.parametrize(
    ("check", "settings", "level"),
    [
        (host_checks.link, Settings(), Level.CAUTION),
        (host_checks.link, Settings(mavlink=MavlinkSettings(url=("/dev/no-such-tty:57600",))), Level.STOP),
        (host_checks.link, Settings(mavlink=MavlinkSettings(url=("udpin:127.0.0.1:14550",))), Level.NOTE),
        (host_checks.mask, Settings(), Level.CAUTION),
        (host_checks.clock, Settings(), Level.NOTE),
    ],
)
def test_the_rest(
    machine: Machine, check: Callable[[Settings, Machine], list[Finding]], settings: Settings, level: Level
) -> None:
    assert the_one(check(settings, machine)).level == level


def test_a_clock_that_nobody_keeps_is_noted(machine: Machine) -> None:
    found = the_one(host_checks.clock(Settings(), replace(machine, unsynchronised=lambda: True)))
    assert (found.level, "chrony" in str(remedy(found))) == (Level.CAUTION, True)


def test_this_machine_s_own_clock_can_be_asked() -> None:
    assert Machine().unsynchronised() in (True, False)


def test_the_first_wrong_thing_is_the_next_step() -> None:
    found = [
        finding(Code.CLOCK_SYNCHRONISED, Subject("clock")),
        finding(Code.CLOCK_UNSYNCHRONISED, Subject("clock")),
        finding(Code.DISK_CLOSED, Subject("disk"), place="/mnt", folder="/mnt/flights"),
    ]
    assert next_step(found) == "make /mnt/flights yours, or set record.directory"
    assert next_step(found[:2]) == ""
