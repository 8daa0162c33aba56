"""One vehicle on two ports: each station has each report once; none is lost where a port dies or does not forward.

The vehicle is a model: what it gets on a port it forwards, or not, to its other ports and to its radio, behind which a
ground station is. As ArduPilot, it returns nothing of the camera's to a port on which it has heard the camera. A port
that is down takes packets, and loses them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dappled.daemon.camera_protocol.camera_status import Captured
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink, pack
from tests.daemon.camera_protocol.test_component import Rig
from tests.simulated.vehicle import Forwarded, PortRelay

STEP_S, WARM_UP_S, LAST_S = 0.1, 4.0, 16.0
SETTLED_S = 6.5  # so long after an outage both ports have the same heartbeats again
RADIO, DIRECT = (255, 190), (254, 190)


class Vehicle(Rig):
    """The camera on two ports of one vehicle. `down` are (port, from, to) in seconds; `refuses`: a port that is down
    takes no packets either. `direct`: another station sends to the UDP port that is link 1, and to nothing else."""

    def __init__(
        self,
        forwards: Sequence[bool],
        down: Sequence[tuple[int, float, float]] = (),
        *,
        refuses: bool = False,
        direct: tuple[int, int] | None = None,
        station: tuple[int, int] | None = RADIO,
    ) -> None:
        super().__init__()
        self.forwards, self.down, self.refuses, self.direct, self.station = forwards, down, refuses, direct, station
        self.at_station: Counter[int] = Counter()
        self.at_direct: Counter[int] = Counter()
        self.at_autopilot: Counter[int] = Counter()
        self.now_s = 0.0
        self.packers = {True: mavlink.MAVLink(None, *RADIO), False: mavlink.MAVLink(None, *(direct or DIRECT))}
        self.packers[False].seq = 77

    def is_up(self, port: int, at_s: float | None = None) -> bool:
        now_s = self.now_s if at_s is None else at_s
        return not any(one == port and since <= now_s < until for one, since, until in self.down)

    def send(self, message: MavlinkMessage, link: int | None = None, *, without: int | None = None) -> bool:
        taken = False
        for port in range(len(self.forwards)) if link is None else (link,):
            if port == without or (self.refuses and not self.is_up(port)):
                continue
            taken = True
            if self.is_up(port) and message.get_type() == "CAMERA_IMAGE_CAPTURED":
                self.at_autopilot[message.image_index] += 1
                self.at_station[message.image_index] += self.forwards[port]
                self.at_direct[message.image_index] += port == 1
        return taken

    def step(self) -> None:
        """What the vehicle sends in a tenth of a second."""
        if round(self.now_s / STEP_S) % 10 == 0:
            for port in range(len(self.forwards)):
                if self.is_up(port):
                    self.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), (1, 1), port)
            if self.station is not None:
                self.beat([port for port, forwards in enumerate(self.forwards) if forwards], radio=True)
            if self.direct is not None:
                self.beat([1], radio=False)
        self.telemetry()
        self.tick(STEP_S)
        self.now_s += STEP_S

    def telemetry(self) -> None:
        for port in range(len(self.forwards)):
            if self.is_up(port):
                self.hear(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0), (1, 1), port)

    def beat(self, ports: Sequence[int], *, radio: bool) -> None:
        """A station's heartbeat comes over these ports: the same packet."""
        message = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
        raw = pack(message, self.packers[radio], version_1=False)
        for port in ports:
            if self.is_up(port):
                self.component.on_packet(Packet(0, 0, port, message, raw))

    def fly(self, reports_s: Sequence[float]) -> None:
        """Report an image at each of these times, which rise."""
        left = list(enumerate(reports_s))
        while self.now_s < LAST_S + 3:
            while left and left[0][1] <= self.now_s:
                assert self.component.announce(Captured(left.pop(0)[0], ok=True)) or self.refuses
            self.step()


def test_a_report_is_sent_on_one_port_where_both_lead_to_the_same_stations() -> None:
    """Without an echo of our own, and however slow the reports are."""
    vehicle = Vehicle((True, True))
    vehicle.fly([WARM_UP_S, 5.03, 7.0, 7.01, 12.5])
    assert vehicle.at_station == dict.fromkeys(range(5), 1)
    assert vehicle.at_autopilot == dict.fromkeys(range(5), 1)


@pytest.mark.parametrize("direct", [DIRECT, RADIO])
@pytest.mark.parametrize("station", [RADIO, None])
def test_a_station_on_an_autopilots_own_udp_port_has_every_report(
    direct: tuple[int, int], station: tuple[int, int] | None
) -> None:
    """A relay of the autopilot and a ground station send to one port; the station has no radio, perhaps the same id."""
    vehicle = Vehicle((True, True), direct=direct, station=station)
    vehicle.fly([WARM_UP_S, 5.03, 7.0, 12.5])
    assert all(vehicle.at_direct[index] == 1 for index in range(4))
    assert all(vehicle.at_station[index] >= 1 for index in range(4))
    if station == RADIO and direct == DIRECT:  # both are known: the port that reaches both is enough
        assert vehicle.at_station == dict.fromkeys(range(4), 1)


@pytest.mark.parametrize("forwards", [(False, False), (True, False), (False, True), (True, False, True)])
@pytest.mark.parametrize("station", [RADIO, None])
def test_without_a_proof_every_port_gets_it(forwards: tuple[bool, ...], station: tuple[int, int] | None) -> None:
    vehicle = Vehicle(forwards, station=station)
    vehicle.fly([WARM_UP_S, 8.0])
    assert vehicle.at_autopilot == dict.fromkeys(range(2), len(forwards))


def test_a_port_that_takes_nothing_is_passed_over_at_once_and_nothing_is_sent_twice() -> None:
    vehicle = Vehicle((True, True), [(0, 6.0, 99.0)], refuses=True)
    vehicle.fly([WARM_UP_S, 6.1, 9.0])
    assert vehicle.at_station == dict.fromkeys(range(3), 1)


def test_a_report_that_settles_while_the_daemon_stops_is_sent_on_the_port_that_lives() -> None:
    """The cable of port 0 came out less than 3 s ago: it takes packets, and loses them."""
    vehicle = Vehicle((True, True), [(0, 5.9, 99.0)])
    while vehicle.now_s < 7.0:
        vehicle.step()
    assert vehicle.component.announce(Captured(0, ok=True))
    vehicle.component.finish()
    assert vehicle.component.announce(Captured(1, ok=True))
    assert vehicle.at_station == {0: 1, 1: 1}


def test_a_report_that_the_second_port_does_not_take_is_sent_there_until_it_does() -> None:
    vehicle = Vehicle((True, True), [(0, 5.9, 99.0)])
    while vehicle.now_s < 6.0:
        vehicle.step()
    assert vehicle.component.announce(Captured(0, ok=True))
    vehicle.down, vehicle.refuses = [(0, 5.9, 99.0), (1, 6.0, 10.0)], True
    while vehicle.now_s < 14.0:
        vehicle.step()
    assert vehicle.at_station == {0: 1}


times = st.floats(WARM_UP_S, LAST_S).map(lambda at_s: round(at_s, 2))
outages = st.tuples(st.integers(0, 1), times, st.floats(0.5, 9.0)).map(lambda one: (one[0], one[1], one[1] + one[2]))


@given(
    st.tuples(st.booleans(), st.booleans()),
    st.lists(outages, max_size=3),
    st.lists(times, min_size=1, max_size=6),
    st.sampled_from([None, DIRECT, RADIO]),
)
@example((True, True), [(1, 4.0, 11.0)], [12.0], RADIO)  # two stations of one id, each heard once since the outage
def test_no_report_is_lost_and_none_comes_twice_without_need(
    forwards: tuple[bool, bool],
    down: list[tuple[int, float, float]],
    reports_s: list[float],
    direct: tuple[int, int] | None,
) -> None:
    vehicle = Vehicle(forwards, down, direct=direct)
    reports_s = sorted(reports_s)
    vehicle.fly(reports_s)

    def is_down(port: int, since_s: float, until_s: float) -> bool:
        return any(one == port and a < until_s and since_s < b for one, a, b in down)

    for index, at_s in enumerate(reports_s):
        steady = [port for port in (0, 1) if not is_down(port, at_s - 0.2, at_s + 2.5)]
        if any(forwards[port] for port in steady):
            assert vehicle.at_station[index] >= 1
        if direct is not None and 1 in steady and not is_down(0, at_s - SETTLED_S, at_s):
            assert vehicle.at_direct[index] >= 1
        calm = not any(is_down(port, at_s - SETTLED_S, at_s + 2.5) for port in (0, 1))
        if forwards == (True, True) and direct != RADIO and calm:
            assert vehicle.at_station[index] == 1
        assert vehicle.at_station[index] <= 2


@pytest.mark.parametrize("kind", ["HEARTBEAT", "CAMERA_IMAGE_CAPTURED"])
def test_the_simulated_autopilot_returns_no_heartbeat_to_a_port_of_its_sender(kind: str) -> None:
    """ArduPilot's MAVLink_routing::handle_heartbeat masks out the channels that are known sources."""
    sent: list[int] = []
    relay = PortRelay(3, lambda _, port: sent.append(port))
    if kind == "HEARTBEAT":
        message = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
    else:
        message = mavlink.MAVLink_camera_image_captured_message(0, 0, 1, 0, 0, 0, 0, [1, 0, 0, 0], 0, 1, b"")
    raw = pack(message, mavlink.MAVLink(None, 1, 100), version_1=False)
    for port in (0, 1, 0):
        relay(Forwarded(Packet(0, 0, port, message, raw)), port)
    assert sent == ([1, 2, 2, 2] if kind == "HEARTBEAT" else [1, 2, 0, 2, 1, 2])
