"""Two vehicles on the links, in two places: frames are tagged with the place of the one that carries the camera."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.config import settings as configuration
from dappled.config.settings import MavlinkSettings, PoseSettings, PublishSettings, RecordSettings, Settings
from dappled.daemon import service as module
from dappled.daemon.camera_protocol import own_autopilot
from dappled.daemon.camera_protocol.own_autopilot import SystemIdentity
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation.clocks import ExposureTime
from dappled.daemon.navigation.navigation import Navigation, Telemetry, recorded_vehicles
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.replay import replay
from dappled.daemon.replay.replay import RecordedTelemetry
from dappled.daemon.service import Service
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.errors import DappledError
from dappled.flight import digest, recording
from tests.daemon.camera_protocol.rig import Peer
from tests.daemon.fakes import CallingObserver, FakeCamera
from tests.waiting import eventually

OURS, THEIRS = 1, 2
PLACES_DEG = {OURS: 47, THEIRS: 10}
START_US = 1_790_000_000 * 10**6


def position(system: int, boot_ms: int) -> MavlinkMessage:
    place = PLACES_DEG[system] * 10**7
    return mavlink.MAVLink_global_position_int_message(boot_ms, place, 8 * 10**7, 500_000, 100_000, 0, 0, 0, 0)


def packets(seconds: int) -> Iterator[tuple[int, int, MavlinkMessage]]:
    """Both at ten a second; theirs is the first, and booted a minute earlier."""
    for step in range(seconds * 10):
        for turn, system in enumerate((THEIRS, OURS)):
            message = position(system, 1000 + step * 100 + (60_000 if system == THEIRS else 0))
            message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=1))
            yield step * 2 + turn, START_US + step * 100_000 + turn, message


def test_telemetry_turns_to_the_camera_s_own_vehicle_and_a_replay_turns_with_it() -> None:
    telemetry = Telemetry()
    noted: list[tuple[int, int]] = []
    live = {}
    for number, stamp_us, message in packets(10):
        if number == 60:
            noted.append((telemetry.follow(OURS), OURS))
        telemetry.feed(number, stamp_us, message)
        if number in (40, 60, 61, 80, 150):
            live[number + 1] = telemetry.pose_at(stamp_us * 1000 - 10**8, 0)
    assert noted == [(60, OURS)]
    seen = {limit: round(math.degrees(pose.latitude_rad or 0)) for limit, pose in live.items()}
    assert seen == {41: 0, 61: 47, 62: 47, 81: 47, 151: 47}  # of two, none counts until one is the camera's
    again = Telemetry(vehicles=noted)
    for number, stamp_us, message in packets(10):
        again.feed(number, stamp_us, message)
        if number + 1 in live:
            assert digest(again.pose_at(live[number + 1].utc_ns, 0)) == digest(live[number + 1])


def test_what_is_heard_alone_counts_until_another_is_heard() -> None:
    telemetry, seen = Telemetry(), []
    for number, stamp_us, message in packets(4):
        if number % 2 or number >= 40:  # ours alone at first
            telemetry.feed(number, stamp_us, message)
        if number in (39, 41, 79):
            seen.append(telemetry.pose_at(stamp_us * 1000 - 10**8, 0).latitude_rad is not None)
    assert seen == [True, False, False]
    telemetry.follow(OURS)
    number, stamp_us, message = list(packets(5))[81]
    telemetry.feed(number, stamp_us, message)
    early = telemetry.pose_at(START_US * 1000 + 10**9, 0)  # nothing of it was forgotten
    assert round(math.degrees(early.latitude_rad or 0)) == PLACES_DEG[OURS]


def test_following_the_vehicle_that_is_followed_already_forgets_nothing() -> None:
    told, untold = Telemetry(), Telemetry()
    for number, stamp_us, message in (one for one in packets(4) if one[0] % 2):  # ours alone
        if number == 41:
            told.follow(OURS)
        told.feed(number, stamp_us, message)
        untold.feed(number, stamp_us, message)
    utc_ns = START_US * 1000 + 1_500_000_000
    assert digest(told.pose_at(utc_ns, 0)) == digest(untold.pose_at(utc_ns, 0))
    assert told.pose_at(utc_ns, 0).source == "interpolated"


def test_a_change_of_vehicle_that_could_not_be_recorded_is_recorded_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = recording.begin(tmp_path, SystemClock())
    navigation = Navigation(LiveSettings(Settings()), SystemClock(), flight, utc_known=True)

    def full(key: str, value: object) -> None:
        raise DappledError("the disk is full")

    try:
        navigation.belongs_to(None)
        with monkeypatch.context() as patched:
            patched.setattr(flight.ledger, "set_fact", full)
            with pytest.raises(DappledError):
                navigation.belongs_to(OURS)
        assert recorded_vehicles(flight.ledger) == []
        for _ in range(3):
            navigation.belongs_to(OURS)
        assert recorded_vehicles(flight.ledger) == [(0, OURS)]
    finally:
        flight.close()


@pytest.mark.parametrize(
    ("heard", "vehicle"), [((), None), ((7,), 7), ((2, 1), 1), ((2, 3), 1)], ids=["none", "one", "ours too", "others"]
)
def test_whose_telemetry_counts(heard: tuple[int, ...], vehicle: int | None) -> None:
    one = SystemIdentity(1, 0)
    for system in heard:
        message = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=1))
        one.heard(message, 0, 10**9)
    assert one.vehicle() is None
    one.decide(4 * 10**9)
    assert one.vehicle() == vehicle


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Settings]:
    monkeypatch.setattr(module, "open_camera", lambda _: FakeCamera())
    monkeypatch.setattr(own_autopilot, "LISTEN_NS", 5 * 10**8)
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:
        yield configuration.resolve(
            Settings(
                mavlink=MavlinkSettings(url=("udpin:127.0.0.1:0",), system_id=OURS),
                record=RecordSettings(directory=str(tmp_path / "flights"), min_free_mb=0),
                pose=PoseSettings(1000.0),
                publish=PublishSettings(slices=f"ipc://{sockets}/s"),
            )
        )


def test_the_daemon_tags_with_the_place_of_its_own_vehicle(settings: Settings) -> None:
    shots: list[PendingShot] = []
    service = Service(settings, observer=CallingObserver(finished=shots.append))
    service.start()
    loop = threading.Thread(target=service.run)
    loop.start()
    over = threading.Event()
    peers = [Peer(service.parts.links.port(0), system, 1) for system in (THEIRS, OURS)]

    def speak() -> None:
        boot_ms = 1000
        while not over.wait(0.02):
            boot_ms += 20
            for peer, system in zip(peers, (THEIRS, OURS), strict=True):
                peer.heartbeat()
                peer.send(position(system, boot_ms))

    speaking = threading.Thread(target=speak)
    speaking.start()
    try:
        eventually(lambda: service.parts.component.vehicle, "it is decided whose camera this is")
        eventually(lambda: (service.health()["vehicle"] or {}).get("latitude_deg") == pytest.approx(47), "our place")
        service.request(CaptureRequest("test", "console", 1))
        eventually(lambda: shots, "the shot's end")
    finally:
        over.set()
        speaking.join(60)
        service.ask_to_stop()
        loop.join(60)
        service.stop()
        for peer in peers:
            peer.__exit__(None, None, None)
    tag = shots[0].tag
    assert tag is not None
    assert math.degrees(tag.pose.latitude_rad or 0) == pytest.approx(47)
    recorded = replay.of_flight(service.folder)
    assert [system for _, system in recorded.vehicles] == [OURS]
    exposure = ExposureTime(tag.utc_ns, tag.utc_sigma_ns, tag.time_source)
    for vehicles, same in ((recorded.vehicles, True), ((), False)):
        again = RecordedTelemetry(settings, recorded.telemetry, recorded.horizons, vehicles)
        _, pose = again.pose(0, replace(exposure))
        assert (digest(pose) == recorded.expected[0].pose_sha256) is same
