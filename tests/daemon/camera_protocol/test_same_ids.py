"""Another component that sends with our ids is told, with its source; our own packets that a router returns are not."""

from __future__ import annotations

from contextlib import suppress

import pytest

from dappled.clock import RecordedClock
from dappled.drivers.mavlink import mavlink
from dappled.findings import Code, told
from tests.daemon.camera_protocol.rig import Camera, Peer
from tests.waiting import eventually

OURS = (1, 100)
NOW_NS = 1_800_000_000 * 10**9


def beat(twin: Peer) -> None:
    """A heartbeat such as the camera's own."""
    kind = mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID
    twin.send(mavlink.MAVLink_heartbeat_message(*kind, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))


def address(peer: Peer) -> str:
    return "{}:{}".format(*peer.socket.getsockname())


def test_another_component_with_our_ids_is_named_while_it_is_heard() -> None:
    clock = RecordedClock(NOW_NS, NOW_NS)
    with Camera(clock=clock) as camera, Peer(camera.links.port(0), *OURS) as twin:
        twin.packer.seq = 200  # another number than the camera's own
        beat(twin)
        eventually(camera.component.findings, "the other camera")
        (found,) = camera.component.findings()
        assert found.code is Code.LINK_SAME_IDS
        assert str(told(found)) == (
            f"link 0: {address(twin)} of udpin:127.0.0.1:0 sends as 1/100 too, which is this camera: "
            "give one of them another mavlink.component_id"
        )
        with Peer(camera.links.port(0), *OURS) as third:  # one name for a link, so that the words stay
            third.packer.seq = 210
            beat(third)
            eventually(lambda: camera.received() == 2, "the third one")
        assert camera.component.findings() == [found]
        clock.advance(16)
        assert camera.component.findings() == []


@pytest.mark.parametrize("held_s", [0.0, 8.0])
@pytest.mark.parametrize("other_link", [False, True])
def test_our_own_packets_that_a_router_returns_are_not_another_component(held_s: float, *, other_link: bool) -> None:
    """Each as it came, at once or held by a radio, on the link that it was sent on or on another one."""
    clock = RecordedClock(NOW_NS, NOW_NS)
    with (
        Camera(urls=["udpin:127.0.0.1:0"] * 2, clock=clock) as camera,
        Peer(camera.links.port(0)) as here,
        Peer(camera.links.port(1)) as there,
    ):
        here.heartbeat()
        there.heartbeat()
        packets: list[bytes] = []
        here.socket.settimeout(0.05)

        def heartbeats() -> int:
            clock.advance(0.2)
            here.heartbeat()  # a peer that is silent is sent nothing
            with suppress(TimeoutError):
                packets.append(here.socket.recv(2048))
            return sum(raw[7:10] == bytes(3) for raw in packets)

        eventually(lambda: heartbeats() >= 3, "three heartbeats")
        before = camera.received()
        clock.advance(held_s)
        for raw in packets:
            (there if other_link else here).raw(raw)
        eventually(lambda: camera.received() >= before + len(packets), "what was returned")
        assert camera.component.findings() == []
        assert camera.failures() == 0
