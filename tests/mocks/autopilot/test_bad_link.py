"""A ground station over a bad radio, and ground stations that misbehave: every wish is one shot all the same."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from dappled.mocks.autopilot.ground_station import GroundStation
from tests.daemon.camera_protocol.rig import Camera
from tests.simulated.bad_link import BadLink, LinkFaults
from tests.simulated.rude_station import station
from tests.waiting import eventually


@pytest.mark.parametrize(
    "faults",
    [LinkFaults(loss=0.1, doubles=0.3, late_s=0.1), LinkFaults(garbage=0.5, torn=0.1, late_s=0.05)],
    ids=["loses, doubles, reorders", "spoils"],
)
def test_a_bad_radio_makes_no_photograph_twice_and_loses_no_report(faults: LinkFaults) -> None:
    """A wish whose four requests are all lost is told as not answered; that is the radio's right."""
    with Camera() as camera, BadLink(camera.links.port(0), faults) as radio:
        ground = GroundStation.start(f"udpout:127.0.0.1:{radio.port}", 4, timeout_s=60)
        code, lines = ground.wait(100)
        camera.idle()
        had = [line["index"] for line in lines if line["ok"]]
        assert len(set(had)) == len(had) >= (4 if code == 0 else 0)
        assert all(line["ok"] or "no answer" in str(line["reason"]) for line in lines)
        assert len({cause.sequence for cause in camera.causes}) == len(camera.causes) >= len(had)
        assert camera.failures() == 0


@pytest.mark.parametrize("manners", [["deaf"], ["nan"], ["deaf", "nan"]])
def test_a_ground_station_without_manners_gets_one_photograph_a_wish(manners: Sequence[str]) -> None:
    with Camera() as camera:
        ground = station(manners).start(camera.url, 3)
        code, lines = ground.wait(100)
        assert (code, [line["index"] for line in lines]) == (0, [0, 1, 2])
        assert len({cause.sequence for cause in camera.causes}) == len(camera.causes) == 3
        assert camera.failures() == 0


def test_a_ground_station_that_dies_leaves_the_camera_to_the_next() -> None:
    with Camera() as camera:
        dying = station(["dies"]).start(camera.url, 3)
        assert dying.wait(100)[0] != 0
        eventually(lambda: len(camera.causes) == 1, "its wish")
        camera.idle()
        code, lines = GroundStation.start(camera.url, 1, timeout_s=60).wait(100)
        assert (code, [line["index"] for line in lines]) == (0, [1])
