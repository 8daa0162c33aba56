"""What befalls a service in a whole machine: no memory, no network, another time, restarts, an upgrade."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.machine.conftest import FLIGHTS, Scene

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
Make = Callable[..., Scene]
PROCESSES = "/sys/fs/cgroup/system.slice/dappled.service/cgroup.procs"


def kept(scene: Scene) -> int:
    """How many frames all flights have."""
    return int(scene.machine.run(f"ls {FLIGHTS}/*/frames/*.cr2 2>/dev/null | wc -l"))


def test_each_process_that_the_kernel_kills_for_memory_comes_back(scene: Make) -> None:
    flown = scene()
    flown.configure(more='[mask]\nprofile = "mask-2-full"\n')
    flown.begin()
    flown.station.shoot()
    main = flown.shown("MainPID")
    names = {
        pid: flown.machine.run(f"tr '\\0' ' ' </proc/{pid}/cmdline").strip()
        for pid in flown.machine.run(f"cat {PROCESSES}").split()
    }
    assert len(names) > 2
    for pid in sorted(names, key=lambda pid: pid == main):
        flown.machine.run(
            f"echo 1000 >/proc/{pid}/oom_score_adj && echo f >/proc/sysrq-trigger && "
            f"timeout 60 sh -c 'until dmesg | grep -q \"Killed process {pid} \"; do sleep 0.1; done' || "
            f"{{ cat /proc/{pid}/status; dmesg | tail -n 20; exit 1; }}"
        )
        if pid == main:
            flown.machine.run("until test $(systemctl show -P NRestarts dappled) = 1; do sleep 0.2; done")
        flown.begin()
        photograph(flown)
    assert flown.shown("NRestarts") == "1"
    assert kept(flown) >= len(flown.station.captured) > len(names)


def photograph(scene: Scene) -> None:
    """One photograph; what was asked for while the camera was looked for anew may have failed."""
    known = len(scene.station.captured)
    for _ in range(10):
        scene.station.request()
        try:
            return scene.station.until(lambda it: len(it.captured) > known, "an announced image", timeout_s=10)
        except AssertionError:
            continue
    raise AssertionError(scene.station)


def test_a_network_that_comes_late_is_found(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.machine.run(
        "systemd-run -q sh -c 'ip link set eth0 down; systemctl start dappled; sleep 8; ip link set eth0 up'"
    )
    flown.station.until(lambda it: it.heartbeats, "a heartbeat")
    flown.begin()
    photograph(flown)
    assert flown.shown("NRestarts") == "0"
    assert kept(flown) == len(flown.station.captured) == 1


def test_the_date_that_a_first_fix_brings_ends_no_flight(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.machine.run("systemctl stop systemd-timesyncd && date -s @1700000000")
    flown.begin()
    flown.station.shoot()
    flown.machine.run("date -s @1795000000")
    flown.station.shoot()
    flown.machine.run("date -s @1794999990")
    flown.station.shoot()
    assert flown.shown("NRestarts") == "0"
    assert kept(flown) == 3
    (folder,) = flown.machine.run(f"ls -d {FLIGHTS}/*/").split()
    flown.machine.run("systemctl stop dappled")
    book = json.loads(flown.machine.run(f"dappled flight report --json {folder}", check=False))
    assert book["balanced"] is True
    assert book["began_utc_ns"] is None  # a date of 2023 is none: the flight is named by its boot


def test_a_restart_under_a_running_interval_loses_no_announced_frame(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.begin()
    flown.station.request(every_s=2, count=0)
    flown.station.until(lambda it: len(it.captured) >= 3, "three images")
    flown.machine.run("systemctl restart dappled")
    flown.begin()
    photograph(flown)
    assert kept(flown) >= len(flown.station.captured)
    flown.machine.run("systemctl stop dappled")
    for folder in flown.machine.run(f"ls -d {FLIGHTS}/*/").split():
        assert json.loads(flown.machine.run(f"dappled flight report --json {folder}", check=False))["balanced"] is True


def test_an_upgrade_starts_the_service_anew_and_the_flights_stay(scene: Make, package: Path) -> None:
    flown = scene()
    flown.configure()
    flown.begin()
    flown.station.shoot()
    before = flown.frames()
    flown.machine.put("/root/dappled.deb", package.read_bytes())
    flown.machine.run("apt-get install -y -q --reinstall /root/dappled.deb 2>&1", timeout_s=600)
    flown.begin()
    assert f'port = "{flown.body.port}"' in flown.machine.run("cat /etc/dappled/dappled.toml")
    assert flown.frames() == before
    photograph(flown)
    flown.machine.run("apt-get purge -y -q dappled 2>&1", timeout_s=300)
    assert kept(flown) == 2
    left = flown.machine.run("ls /usr/lib/systemd/system /usr/lib/udev/rules.d /etc | grep dappled || true")
    assert "dappled" not in left
