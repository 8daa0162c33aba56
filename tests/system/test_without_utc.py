"""A daemon on a machine that thinks it is 1970: UTC comes from the autopilot, in mid-flight."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.config.settings import Settings, resolve
from dappled.daemon.service import Service
from dappled.flight import ImageIndex, flight_report
from dappled.flight.checks import flight_check
from dappled.mocks.simulation import Simulation, World
from dappled.products.geotags import geotags
from dappled.products.mounting import Mounting
from tests.standing import problems
from tests.system.conftest import dappled

SECOND_NS = 10**9


@pytest.mark.slow
def test_a_flight_learns_utc_and_replays(tmp_path: Path, sockets: Path) -> None:
    settings = resolve(Settings())
    settings = replace(
        settings,
        record=replace(settings.record, directory=str(tmp_path / "flights")),
        publish=replace(settings.publish, slices=f"ipc://{sockets}/without-utc", ask=""),
        decode=replace(settings.decode, enabled=False),
    )
    simulation = Simulation(World(seed=4, truth=None), settings, tmp_path)
    with simulation as simulated:
        service = Service(simulated, clock=SystemClock(utc_minus_monotonic_ns=0))
        service.start()
        assert "UTC is not known yet" in "".join(problems(service.health()))
        try:
            service.run(lambda: service.health()["camera"]["state"] == "ready")
            station = simulation.ground_station(1)
            service.run(lambda: not station.running())
            until = time.monotonic() + 60
            service.run(lambda: service.parts.navigation.utc.learnt is not None or time.monotonic() > until)
            assert "UTC" not in "".join(problems(service.health()))
        finally:
            service.stop()
        code, _ = station.wait(60)
    assert code == 0
    assert service.folder.name.startswith("boot")
    assert flight_check.check(service.folder).problems == ()
    began_utc_ns = flight_report.balance(service.folder).began_utc_ns
    assert began_utc_ns is not None
    assert 0 < time.time_ns() - began_utc_ns < 300 * SECOND_NS
    with ImageIndex(tmp_path / "flights") as index:
        assert index.flights() == {service.folder.name: began_utc_ns}
    (placed,), _ = geotags.read(service.folder, geotags.PlacedBy(Mounting()))
    assert placed.utc_ns is not None
    assert abs(time.time_ns() - placed.utc_ns) < 300 * SECOND_NS
    assert placed.tag.utc_ns < 10**17  # as it was stamped: nothing is stamped anew
    done = dappled("replay", str(service.folder), "--verify")
    assert done.returncode == 0, done.stdout + done.stderr
    listed = dappled("flight", "list", str(service.folder.parent))
    assert time.strftime("%Y-%m-%d", time.gmtime(began_utc_ns // SECOND_NS)) in listed.stdout
