"""Photographs by the way flown, from the settings or a ground station's command to the tags of a flight."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.decode.geometry import metres_per_radian
from dappled.flight import LedgerReader
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import Simulation, World
from tests.system.flying import Flying, eventually, flying, settings_of, told

APART_M = 12.0


def by_distance(flight: Path) -> tuple[list[str], list[float]]:
    """(who asked for each photograph by distance, how far apart their tags are in m)."""
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        shots = [row.shot for row in ledger.shots() if row.shot.cause.kind == "distance"]
        poses = ledger.poses()
    apart = []
    for one, other in pairwise(poses[shot.index] for shot in shots):
        assert one.latitude_rad is not None
        assert one.longitude_rad is not None
        assert other.latitude_rad is not None
        assert other.longitude_rad is not None
        north_m, east_m = metres_per_radian(one.latitude_rad, one.altitude_msl_m or 0.0)
        apart.append(
            math.hypot(
                (other.latitude_rad - one.latitude_rad) * north_m, (other.longitude_rad - one.longitude_rad) * east_m
            )
        )
    return [one.cause.source for one in shots], apart


def trigger(daemon: Flying, distance: str) -> int:
    """`dappled trigger --distance`, from a ground station of its own."""
    return main(["trigger", "--url", f"udpout:127.0.0.1:{daemon.service.links.port(2)}", "--distance", distance])


def until_settled(daemon: Flying) -> int:
    """How many photographs there are, none on its way."""
    eventually(lambda: len(daemon.settled) == len(daemon.shots), "every photograph on its way has ended")
    return len(daemon.shots)


@pytest.mark.long
def test_photographs_by_distance_begin_by_height_and_end_and_change_on_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = settings_of(
        tmp_path,
        mavlink={"url": "udpin:127.0.0.1:0"},
        pose={"wait_ms": 700},
        decode={"enabled": False},
        trigger={"distance_m": APART_M, "from_height_m": 5.0},
    )
    with Simulation(World(), settings, tmp_path) as simulated, flying(simulated) as daemon:
        daemon.until_ready()
        eventually(lambda: len(daemon.shots) >= 4, "four photographs by themselves", 60)
        assert trigger(daemon, "off") == 0
        first = until_settled(daemon)
        assert trigger(daemon, f"{2 * APART_M:g}") == 0
        eventually(lambda: len(daemon.shots) >= first + 3, "three photographs on command", 60)
        assert trigger(daemon, "off") == 0
        second = until_settled(daemon)
        assert trigger(daemon, "settings") == 0
        eventually(lambda: len(daemon.shots) >= second + 2, "two photographs by the settings", 60)
        assert trigger(daemon, "off") == 0
        until_settled(daemon)
        folder = daemon.service.folder
    assert capsys.readouterr().out.splitlines() == [
        "no more photographs",
        "a photograph every 24 m, until --distance off",
        "no more photographs",
        "photographs by the camera's own settings: they go on until --distance off",
        "no more photographs",
    ]
    sources, apart = by_distance(folder)
    assert set(sources[:first]) == {"settings"}
    assert {source.partition(":")[0] for source in sources[first:]} == {"mavlink"}
    assert apart[1 : first - 1] == pytest.approx([APART_M] * (first - 2), abs=1.5)
    assert apart[first : second - 1] == pytest.approx([2 * APART_M] * (second - first - 1), abs=1.5)
    assert apart[second:] == pytest.approx([APART_M] * (len(apart) - second), abs=1.5)
    assert not any(event.startswith("refused") for event in told(folder))


def test_settings_without_a_series_refuse_to_begin_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body:
        settings = settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": "udpin:127.0.0.1:0"})
        with flying(settings) as daemon:
            daemon.until_ready()
            url = f"udpout:127.0.0.1:{daemon.service.links.port(0)}"
            assert main(["trigger", "--url", url, "--distance", "settings"]) == 1
            assert "no photos: set trigger.distance_m or overlap" in capsys.readouterr().err
            assert main(["trigger", "--url", url, "--distance", "5"]) == 0
            eventually(lambda: "there is no position" in daemon.problems, "why none is taken is told")
            assert main(["trigger", "--url", url, "--distance", "off"]) == 0
            eventually(lambda: "there is no position" not in daemon.problems, "nothing is wanted any more")
            assert daemon.shots == []
