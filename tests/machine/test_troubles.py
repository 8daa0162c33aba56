"""What befalls a service in a whole machine: no memory, no network, another time, restarts, an upgrade."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.machine.conftest import FLIGHTS, Parts, Scene
from tests.machine.uml import copy

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
Make = Callable[..., Scene]
PROCESSES = "/sys/fs/cgroup/system.slice/dappled.service/cgroup.procs"


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
        flown.photograph()
    assert flown.shown("NRestarts") == "1"
    assert flown.kept() >= len(flown.station.captured) > len(names)


def test_a_network_that_comes_late_is_found(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.machine.run(
        "systemd-run -q sh -c 'ip link set eth0 down; systemctl start dappled; sleep 8; ip link set eth0 up'"
    )
    flown.station.until(lambda it: it.heartbeats, "a heartbeat")
    flown.begin()
    flown.photograph()
    assert flown.shown("NRestarts") == "0"
    assert flown.kept() >= len(flown.station.captured) >= 1


def test_a_disk_that_stands_still_ends_no_flight(scene: Make) -> None:
    """As a memory card does that tidies up: for longer than the service's watchdog waits."""
    flown = scene()
    flown.configure()
    flown.begin()
    flown.station.request(every_s=1, count=0)
    flown.station.until(lambda it: len(it.captured) >= 3, "three images")
    main = flown.shown("MainPID")
    with flown.machine.halted(disks_only=True):
        time.sleep(25)  # how long is what is tried
    known = len(flown.station.captured)
    flown.station.until(lambda it: len(it.captured) >= known + 3, "three more images")
    assert (flown.shown("NRestarts"), flown.shown("MainPID")) == ("0", main)
    assert "the disk did not answer for" in flown.machine.run("journalctl -u dappled --no-pager")
    flown.machine.run("systemctl stop dappled")
    assert flown.kept() >= len(flown.station.captured)
    (folder,) = flown.machine.run(f"ls -d {FLIGHTS}/*/").split()
    assert json.loads(flown.machine.run(f"dappled flight report --json {folder}", check=False))["balanced"] is True


# What gpsd tells chrony of a fix: the system's time, how far it is behind, no pulse, no leap second, a magic number.
FIX = """
import socket, struct, time
began, path = time.monotonic(), "/run/chrony.fix.sock"
told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
while True:
    now = time.time()
    behind = {utc_s} + time.monotonic() - began - now
    if abs(behind) < 0.5:
        break
    try:
        told.sendto(struct.pack("qqd4i", int(now), int(now % 1 * 1e6), behind, 0, 0, 0, 0x534F434B), path)
    except OSError:
        pass  # chrony is still starting
    time.sleep(0.2)
"""
CHRONY = """
refclock SOCK /run/chrony.fix.sock poll 0 filter 4
makestep 1 -1
bindcmdaddress /
cmdport 0
pidfile /run/chronyd.pid
"""


@pytest.fixture(scope="session")
def chrony(parts: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Debian's package; all that it needs is in the machine."""
    kept = parts.built() / "chrony.deb"
    if not kept.exists():
        folder = tmp_path_factory.mktemp("chrony")
        done = subprocess.run(
            ["/usr/bin/apt-get", "download", "-q", "chrony"], cwd=folder, capture_output=True, check=False
        )
        found = list(folder.glob("*.deb"))
        if done.returncode or not found:
            pytest.skip("Debian's package chrony can't be had here")
        copy(found[0], kept)
    return kept


def test_the_date_that_a_first_fix_brings_ends_no_flight(scene: Make, chrony: Path) -> None:
    """chrony steps the clock, as with gpsd beside it: by three years, and ten seconds back."""
    flown = scene()
    flown.configure()
    flown.machine.put("/root/chrony.deb", chrony.read_bytes())
    flown.machine.put("/root/chrony.conf", CHRONY.encode())
    flown.machine.run("systemctl stop systemd-timesyncd; dpkg -x /root/chrony.deb /root/chrony; date -s @1700000000")
    flown.begin()
    flown.station.shoot()
    flown.machine.run("systemd-run -q --unit=chrony /root/chrony/usr/sbin/chronyd -n -u root -f /root/chrony.conf")
    for utc_s in (1_795_000_000, 1_795_000_000 - 10):
        flown.machine.put("/root/fix", FIX.format(utc_s=utc_s).encode())
        flown.machine.run("timeout 100 python3 /root/fix || { journalctl -u chrony; exit 1; }")
        flown.station.shoot()
    flown.machine.run("systemctl stop chrony")
    assert flown.shown("NRestarts") == "0"
    assert flown.kept() == 3
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
    flown.photograph()
    assert flown.kept() >= len(flown.station.captured)
    flown.machine.run("systemctl stop dappled")
    for folder in flown.machine.run(f"ls -d {FLIGHTS}/*/").split():
        assert json.loads(flown.machine.run(f"dappled flight report --json {folder}", check=False))["balanced"] is True


@pytest.fixture(scope="session")
def newer(parts: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package as a later version, with other default settings."""
    folder = tmp_path_factory.mktemp("newer")
    stage = folder / "stage"
    subprocess.run(["/usr/bin/dpkg-deb", "-R", parts.package(), stage], check=True)
    for name, pattern, text in (
        ("DEBIAN/control", r"(?m)^Version: .*", "Version: 99.0+bookworm"),
        ("usr/lib/dappled/dappled/__init__.py", r'__version__ = "[^"]+"', '__version__ = "99.0"'),
        ("etc/dappled/dappled.toml", r"\A", "# Of version 99.\n"),
    ):
        before = (stage / name).read_text(encoding="utf-8")
        (stage / name).write_text(re.sub(pattern, text, before, count=1), encoding="utf-8")
    packed = ["/usr/bin/dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "--build", stage, folder / "newer.deb"]
    subprocess.run([str(word) for word in packed], check=True, stdout=subprocess.DEVNULL)
    shutil.rmtree(stage)
    return folder / "newer.deb"


def test_an_upgrade_starts_the_service_anew_and_the_flights_and_the_settings_stay(scene: Make, newer: Path) -> None:
    flown = scene(spoils=True)
    flown.configure()
    flown.begin()
    flown.station.shoot()
    before = flown.frames()
    flown.machine.put("/root/newer.deb", newer.read_bytes())
    flown.machine.run(
        "apt-get install -y -q -o Dpkg::Options::=--force-confold /root/newer.deb 2>&1 </dev/null", timeout_s=600
    )
    flown.begin()
    assert "99.0" in flown.machine.run("dappled --version")
    assert f'port = "{flown.body.port}"' in flown.machine.run("cat /etc/dappled/dappled.toml")
    assert flown.frames() == before
    flown.photograph()
    flown.machine.run("apt-get purge -y -q dappled 2>&1", timeout_s=300)
    assert flown.kept() >= len(flown.station.captured) >= 2
    left = flown.machine.run("ls /usr/lib/systemd/system /usr/lib/udev/rules.d /etc | grep dappled || true")
    assert "dappled" not in left
