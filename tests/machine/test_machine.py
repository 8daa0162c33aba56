"""The package in a whole machine: systemd as PID 1, a body and a ground station outside of it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable

import pytest

from dappled.mocks.body.body import pattern
from tests.machine.conftest import SIZE, SUITE, Scene

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
Make = Callable[..., Scene]
CGROUP = "/sys/fs/cgroup/system.slice/dappled.service"


@pytest.mark.parametrize("suite", ["trixie", SUITE])
def test_the_package_is_ready_soon_records_every_byte_and_is_confined(
    scene: Make, table: Callable[[str, object], None], suite: str
) -> None:
    flown = scene(suite=suite)
    flown.configure()
    table(f"{suite}: READY=1, s from the start of the unit", flown.start())
    flown.begin()
    for _ in range(20):
        flown.station.shoot()
    table(f"{suite}: most memory of the service, MB", int(flown.machine.run(f"cat {CGROUP}/memory.peak")) / 1e6)
    table(f"{suite}: installed, MB", flown.machine.run("du -sm /usr/lib/dappled | cut -f1").strip())
    pictures = {hashlib.sha256(pattern(number, SIZE)).hexdigest() for number in range(1, 21)}
    assert set(flown.frames().values()) == pictures
    assert sorted(flown.frames()) == sorted(flown.station.captured) == list(range(20))
    said = flown.machine.run("systemd-analyze security dappled --no-pager | tail -n 2")
    exposure = float(said.split("dappled.service: ")[1].split()[0])
    table(f"{suite}: exposure", exposure)
    assert exposure <= 1.5
    assert flown.shown("NRestarts") == "0"
    doctor = flown.machine.run("dappled doctor --config /etc/dappled/dappled.toml 2>&1 || true")
    assert "of user dappled runs here" in doctor
    assert "holds" not in doctor  # its own camera process is nobody who is in the way


def test_a_daemon_with_a_mask_is_ready_soon_and_takes_a_photograph(
    scene: Make, table: Callable[[str, object], None]
) -> None:
    flown = scene()
    flown.configure(more='[mask]\nprofile = "mask-2"\n')
    for turn in range(3):
        began = time.monotonic()
        table(f"with a mask: READY=1, s from the start of the unit, start {turn + 1}", flown.start())
        accepted_s = flown.station.accepted() - began
        table(f"with a mask: a photograph is accepted, s from the start of the unit, start {turn + 1}", accepted_s)
        flown.station.until(lambda it: len(it.captured) == len(it.accepted_s), "an announced image")
        flown.machine.run("systemctl stop dappled")
    assert len(flown.frames()) == len(flown.station.captured) >= 3
    assert flown.shown("NRestarts") == "0"


def test_what_is_killed_comes_back_and_its_flight_stays(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.begin()
    flown.station.shoot()
    flown.machine.run(
        "was=$(pgrep -f '[g]photo2.process') && kill -KILL $was && "
        "until is=$(pgrep -f '[g]photo2.process') && test $is != $was; do sleep 0.1; done"
    )
    flown.begin()
    flown.photograph()
    flown.machine.run(
        "systemctl kill -s KILL --kill-whom=main dappled && "
        "until test $(systemctl show -P NRestarts dappled) = 1; do sleep 0.2; done"
    )
    flown.begin()
    flown.photograph()
    assert flown.shown("NRestarts") == "1"
    assert flown.kept() >= len(flown.station.captured) >= 3


def test_a_read_only_root_leaves_a_camera_that_answers_and_says_why(scene: Make) -> None:
    flown = scene(spoils=True)
    flown.configure()
    flown.machine.run("echo u >/proc/sysrq-trigger; until touch /root/x 2>&1 | grep -q Read-only; do sleep 0.2; done")
    flown.machine.run("systemctl start dappled")
    flown.station.until(lambda it: any("NO PHOTOGRAPHS" in text for text in it.texts), "why there is none")
    flown.station.request()
    flown.station.until(lambda it: it.refused_s, "a refusal")
    assert flown.shown("NRestarts") == "0"


def test_half_a_gigabyte_of_memory_records_every_frame(scene: Make, table: Callable[[str, object], None]) -> None:
    flown = scene(memory_mb=512)
    flown.configure()
    flown.begin()
    for _ in range(60):
        flown.station.shoot()
    assert len(flown.frames()) == len(flown.station.captured) == 60
    table(
        "most memory of the service in a machine of 512 MB, MB",
        int(flown.machine.run(f"cat {CGROUP}/memory.peak")) / 1e6,
    )
    assert flown.shown("NRestarts") == "0"
