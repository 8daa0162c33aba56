"""The package in a whole machine: systemd as PID 1, a body and a ground station outside of it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable

import pytest

from dappled.mocks.body.body import pattern
from tests.machine.conftest import SIZE, Scene

pytestmark = [pytest.mark.long, pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(3600)]
Make = Callable[..., Scene]


def test_the_package_is_ready_soon_records_every_byte_and_is_confined(
    scene: Make, record_property: Callable[..., None]
) -> None:
    flown = scene()
    flown.configure()
    began = time.monotonic()
    flown.begin()
    record_property("ready_s", round(time.monotonic() - began, 1))
    for _ in range(20):
        flown.station.shoot()
    pictures = {hashlib.sha256(pattern(number, SIZE)).hexdigest() for number in range(1, 21)}
    assert set(flown.frames().values()) == pictures
    assert sorted(flown.frames()) == sorted(flown.station.captured) == list(range(20))
    said = flown.machine.run("systemd-analyze security dappled --no-pager | tail -n 2")
    assert float(said.split("dappled.service: ")[1].split()[0]) <= 1.5
    assert flown.shown("NRestarts") == "0"
    doctor = flown.machine.run("dappled doctor --config /etc/dappled/dappled.toml 2>&1 || true")
    assert "of user dappled runs here" in doctor
    assert "holds" not in doctor  # its own camera process is nobody who is in the way


def test_half_a_gigabyte_of_memory_records_every_frame(scene: Make) -> None:
    flown = scene(memory_mb=512)
    flown.configure()
    flown.begin()
    for _ in range(60):
        flown.station.shoot()
    assert len(flown.frames()) == len(flown.station.captured) == 60
    assert flown.shown("NRestarts") == "0"


def test_a_read_only_root_leaves_a_camera_that_answers_and_says_why(scene: Make) -> None:
    flown = scene()
    flown.configure()
    flown.machine.run("echo u >/proc/sysrq-trigger; until touch /root/x 2>&1 | grep -q Read-only; do sleep 0.2; done")
    flown.machine.run("systemctl start dappled")
    flown.station.until(lambda it: any("NO PHOTOGRAPHS" in text for text in it.texts), "why there is none")
    flown.station.request()
    flown.station.until(lambda it: it.refused_s, "a refusal")
    assert flown.shown("NRestarts") == "0"
