"""A camera on the USB bus of a whole machine, and a shutter line: what only a kernel of one's own shows.

The kernel is compiled by `make long`; elsewhere these scenes run where that was done.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.mocks.body.body import BodyOptions, pattern
from tests.machine.conftest import FLIGHTS, SUITE, Scene, machine_part
from tests.machine.uml import HERE
from tests.simulated.usbip import UsbBody
from tests.waiting import eventually

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
SMALL = 300_000
SLOW = 8_000_000  # 16 s at the rate of "crawl"; a silent body is given up after 12
OLD = 130
BODY = BodyOptions(picture=f"pattern:{SMALL}:cr2", bind=HERE)
CGROUP = "/sys/fs/cgroup/system.slice/dappled.service/cgroup.procs"
ACM, USB_SERIAL = 166, 188
PLACE = "/sys/bus/usb/devices/1-1/devnum"


@pytest.fixture(scope="session")
def usb_kernel() -> Path:
    return machine_part("--usb", *([] if "CI" in os.environ else ["--cached"]))


@pytest.fixture
def on_usb(usb_kernel: Path, scene: Callable[..., Scene], request: pytest.FixtureRequest) -> Scene:
    """A machine with an empty USB bus, a body to be plugged in; its pictures are small, or as given, and so is Debian's
    release."""
    given = dict(getattr(request, "param", {}))
    made = scene(usb=usb_kernel, suite=given.pop("suite", SUITE), body=replace(BODY, **given))
    made.configure("usb:")
    return made


def plug_in(scene: Scene) -> None:
    """Return when the kernel knows it."""
    attach = f"usbip --tcp-port {scene.body.tcp_ports[0]} attach -r {HERE} -b 1-1"
    scene.machine.run(f"{attach} && until test -e {PLACE}; do sleep 0.1; done")


def pictures(*numbers: int) -> list[str]:
    return sorted(hashlib.sha256(pattern(number, SMALL)).hexdigest() for number in numbers)


@pytest.mark.parametrize("on_usb", [{"suite": "trixie"}, {"suite": SUITE}], indirect=True, ids=lambda it: it["suite"])
def test_a_camera_that_is_plugged_in_late_is_found_and_every_byte_recorded(on_usb: Scene) -> None:
    flown = on_usb
    flown.machine.run(
        "systemctl start dappled && until systemctl show -P StatusText dappled | grep -q absent; do sleep 0.2; done"
    )
    plug_in(flown)
    flown.begin()
    for _ in range(5):
        flown.station.shoot()
    assert sorted(flown.frames().values()) == pictures(1, 2, 3, 4, 5)
    flown.machine.run("usbip detach -p 0")
    flown.machine.run("until systemctl show -P StatusText dappled | grep -q absent; do sleep 0.2; done")
    plug_in(flown)
    flown.begin()
    flown.station.shoot()
    assert sorted(flown.frames().values()) == pictures(1, 2, 3, 4, 5, 6)
    assert flown.shown("NRestarts") == "0"
    assert "killed" not in flown.machine.run("journalctl -u dappled --no-pager")


def test_a_port_of_a_kind_that_was_not_there_when_the_service_started_may_be_opened(on_usb: Scene) -> None:
    """Of an autopilot on USB; without a device behind the number an open that is allowed ends in ENXIO."""
    flown = on_usb
    flown.machine.run("rmmod cdc_acm usbserial 2>&1", check=False)
    assert "ttyACM" not in flown.machine.run("cat /proc/devices")
    flown.machine.run("systemctl start dappled")
    for major in (ACM, USB_SERIAL):
        said = flown.machine.run(
            f"mknod /root/port{major} c {major} 9; sh -c 'echo $$ >{CGROUP}; cat /root/port{major}' 2>&1", check=False
        )
        assert "No such device" in said


def test_a_card_that_counts_from_one_again_holds_no_shot_up(
    on_usb: Scene, table: Callable[[str, object], None]
) -> None:
    flown = on_usb
    plug_in(flown)
    flown.begin()
    flown.station.shoot()
    flown.station.shoot()
    flown.body.ask("change card")
    slowest_s = 0.0
    for _ in range(3):
        began = time.monotonic()
        flown.station.shoot()
        slowest_s = max(slowest_s, time.monotonic() - began)
    table("slowest shot after a card that counts from 1 again, s", round(slowest_s, 1))
    assert sorted(flown.frames().values()) == pictures(1, 2, 3, 4, 5)


def test_old_pictures_on_the_card_are_listed_and_not_fetched(
    on_usb: Scene, table: Callable[[str, object], None]
) -> None:
    flown = on_usb
    for number in range(1, OLD + 1):
        eventually(flown.body.contact, "an exposure")
        eventually(lambda: len(flown.body.card) == number, "a picture")  # noqa: B023 (it is called here)
    began = time.monotonic()
    plug_in(flown)
    flown.begin()
    table(f"from the start to ready, a card with {OLD} old pictures, s", round(time.monotonic() - began, 1))
    for _ in range(3):
        flown.station.shoot()
    assert sorted(flown.frames().values()) == pictures(OLD + 1, OLD + 2, OLD + 3)
    assert "stray" not in flown.machine.run(f"ls {FLIGHTS}/*/frames")


@pytest.mark.parametrize("on_usb", [{"picture": f"pattern:{SLOW}:cr2"}], indirect=True)
def test_a_slow_cable_is_no_silence(on_usb: Scene) -> None:
    """Bytes that arrive are a sign of life: a file that takes longer than a silent body is waited for comes whole."""
    flown = on_usb
    plug_in(flown)
    flown.begin()
    flown.body.fault("crawl")
    flown.station.shoot()
    assert list(flown.frames().values()) == [hashlib.sha256(pattern(1, SLOW)).hexdigest()]
    assert flown.shown("NRestarts") == "0"


def test_a_body_as_mass_storage_is_told_how_it_has_to_be_set(on_usb: Scene) -> None:
    flown = on_usb
    flown.body.fault("storage")
    flown.machine.run("echo 0 >/sys/bus/usb/devices/usb1/interface_authorized_default")  # no disk is looked for
    plug_in(flown)
    flown.machine.run("udevadm settle")
    said = flown.machine.run("dappled doctor --config /etc/dappled/dappled.toml 2>&1", check=False)
    flown.machine.run("echo 1 >/sys/bus/usb/devices/usb1/interface_authorized_default")
    assert "(mass storage): it can't be fired in this USB mode" in said
    assert "set the camera's USB mode to PTP" in said


def test_a_shutter_line_is_closed_from_inside_the_service(on_usb: Scene) -> None:
    flown = on_usb
    chip = flown.machine.run(
        "mount -t configfs none /sys/kernel/config 2>/dev/null; cd /sys/kernel/config/gpio-sim && mkdir -p s/bank && "
        "echo 8 >s/bank/num_lines && echo 1 >s/live && cat s/bank/chip_name"
    ).strip()
    rule = f'SUBSYSTEM=="gpio", KERNEL=="{chip}", MODE="0660", GROUP="dappled"\n'
    flown.machine.put("/etc/udev/rules.d/71-dappled-shutter.rules", rule.encode())
    flown.machine.run("udevadm control --reload && udevadm trigger --subsystem-match=gpio && udevadm settle")
    flown.machine.put(
        "/etc/dappled/dappled.toml",
        (
            f'[camera]\ndriver = "fujifilm"\nprofile = "fujifilm-s5200"\nshutter = "gpio:/dev/{chip}:3"\n'
            f'pickup = "later"\n[camera.options]\nhold_ms = 5000\n[mavlink]\nurl = "udpout:{HERE}:14550"\n'
            f'[record]\ndirectory = "{FLIGHTS}"\n'
        ).encode(),
    )
    flown.begin()
    value = f"/sys/devices/platform/gpio-sim.0/{chip}/sim_gpio3/value"
    assert flown.machine.run(f"cat {value}").strip() == "0"
    seen = f"for level in 1 0; do until grep -q $level {value}; do sleep 0.05; done; done"
    flown.machine.run(f"systemd-run -q --unit=seen --remain-after-exit sh -c '{seen}'")
    flown.station.request()
    flown.machine.run("until systemctl show -P SubState seen | grep -q exited; do sleep 0.2; done")


@pytest.mark.parametrize("on_usb", [{"serial": ""}], indirect=True)
def test_of_two_bodies_without_a_serial_number_one_stays_the_camera_when_the_bus_counts_anew(on_usb: Scene) -> None:
    flown = on_usb
    with UsbBody.start(replace(BODY, serial="")) as other:
        attach = f"usbip --tcp-port {{}} attach -r {HERE} -b 1-1"
        plug_in(flown)
        flown.begin()
        flown.machine.run(attach.format(other.tcp_ports[0]))
        flown.station.shoot()
        numbers = f"for one in {PLACE} {PLACE.replace('1-1', '1-2')}; do until cat $one 2>&-; do sleep 0.1; done; done"
        first, second = map(int, flown.machine.run(numbers).split())
        assert first < second
        flown.machine.run(
            "systemctl kill -s STOP dappled && usbip detach -p 0 && "  # it sees both bodies, before and after
            f"until ! test -e {PLACE}; do sleep 0.1; done && {attach.format(flown.body.tcp_ports[0])} && "
            f"until test -e {PLACE}; do sleep 0.1; done && udevadm settle && systemctl kill -s CONT dappled"
        )
        first, second = map(int, flown.machine.run(numbers).split())
        assert first > second
        flown.machine.run("until test $(journalctl -u dappled | grep -c 'camera ready') -ge 2; do sleep 0.2; done")
        flown.station.shoot()
        assert (flown.body.releases, other.releases) == (2, 0)
