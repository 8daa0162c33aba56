"""A camera on the USB bus of a whole machine: plugged in late, another card in it, a card with old pictures.

The kernel is compiled by `make long`; elsewhere these scenes run where that was done.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dappled.mocks.body.body import BodyOptions, pattern
from tests.machine.conftest import FLIGHTS, ROOT, Scene
from tests.machine.uml import HERE
from tests.waiting import eventually

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
SMALL = 300_000
OLD = 130
CGROUP = "/sys/fs/cgroup/system.slice/dappled.service/cgroup.procs"
ACM, USB_SERIAL = 166, 188


@pytest.fixture
def on_usb(scene: Callable[..., Scene]) -> Scene:
    """A machine with an empty USB bus, and a body that can be plugged in."""
    build = [
        sys.executable,
        str(ROOT / "tools/machine/build.py"),
        "--usb",
        *([] if "CI" in os.environ else ["--cached"]),
    ]
    done = subprocess.run(build, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        pytest.skip("there is no kernel with a USB bus: make one with tools/machine/build.py --usb")
    kernel = Path(done.stdout.strip())
    made = scene(body=BodyOptions(picture=f"pattern:{SMALL}:cr2", bind=HERE, usbip=True), usb=kernel)
    made.machine.put("/root/modules.tar", (kernel / "modules.tar").read_bytes())
    made.machine.run("tar -C /usr --no-same-owner -xf /root/modules.tar && depmod")
    made.configure("usb:")
    return made


def plug_in(scene: Scene) -> None:
    scene.machine.run(f"usbip --tcp-port {scene.body.tcp_ports[0]} attach -r {HERE} -b 1-1")


def pictures(*numbers: int) -> list[str]:
    return sorted(hashlib.sha256(pattern(number, SMALL)).hexdigest() for number in numbers)


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
