"""What the MAVLink camera says over several runs of the whole daemon, and what a pilot is told."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
import tomllib
from contextlib import ExitStack
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.config.schema import ConfigError
from dappled.daemon.camera_protocol.parameters import code
from dappled.drivers.mavlink import mavlink
from dappled.drivers.mavlink import signing as mavlink_signing
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from dappled.drivers.mavlink.signing import EPOCH_UNIX_S
from dappled.findings import Code, Subject
from dappled.flight import LedgerReader
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import Simulation, World, free_port
from tests.daemon.camera_protocol.rig import Peer
from tests.simulated.vehicle import VehicleProcess
from tests.system.conftest import dappled
from tests.system.flying import Flying, flying, settings_of, told
from tests.waiting import eventually

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
URL = "udpin:127.0.0.1:0"


def ground(daemon: Flying) -> Peer:
    daemon.until_ready()
    return Peer(daemon.service.parts.links.port(0))


def shoot(peer: Peer, sequence: int) -> tuple[int, int]:
    peer.command(2000, 0, 0, 1, sequence)
    assert peer.ack(2000) == ACCEPTED
    ended = peer.one("CAMERA_IMAGE_CAPTURED")
    return ended.image_index, ended.capture_result


def test_indices_go_on_and_every_photograph_of_an_earlier_flight_can_be_asked_for(tmp_path: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body:
        settings = settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": URL})
        with flying(settings) as daemon, ground(daemon) as peer:
            peer.heartbeat()
            assert shoot(peer, 1) == (0, 1)
            body.fault("error")
            assert shoot(peer, 2) == (1, 0)
            assert "image 1 failed" in peer.one("STATUSTEXT").text
        with flying(settings) as daemon, ground(daemon) as peer:
            peer.heartbeat()
            assert shoot(peer, 1) == (2, 1)
            for index, ok, url in ((0, 1, "frames/000000.cr2"), (1, 0, ""), (2, 1, "frames/000002.cr2")):
                peer.command(512, 263, index)
                assert peer.ack(512) == ACCEPTED
                old = peer.one("CAMERA_IMAGE_CAPTURED")
                assert (old.image_index, old.capture_result, old.file_url) == (index, ok, url)
            peer.command(512, 262)
            assert peer.one("CAMERA_CAPTURE_STATUS").image_count == 3


def test_a_signed_link_through_a_restart(tmp_path: Path) -> None:
    mavlink_signing.make_key(tmp_path / "radio.key")
    key = mavlink_signing.read_key(tmp_path / "radio.key")
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body:
        settings = settings_of(
            tmp_path, camera={"port": body.port}, mavlink={"url": URL, "keys": [str(tmp_path / "radio.key")]}
        )
        old = b""
        for run, fresh in ((0, True), (1, False)):
            with flying(settings) as daemon, ground(daemon) as peer:
                signing = peer.packer.signing
                signing.secret_key, signing.sign_outgoing = key, True
                signing.timestamp = (time.time_ns() // 10_000) - EPOCH_UNIX_S * UNITS_PER_S
                if fresh:
                    old = peer.packed(mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, 7, 0, 0, 0))
                peer.raw(old)  # good the first time, replayed after the restart
                assert shoot(peer, 8) == ((0, 1) if fresh else (2, 1))
                if fresh:
                    assert peer.one("CAMERA_IMAGE_CAPTURED").image_index == 1
                counts = daemon.service.parts.links.statistics()[0].signing
                assert counts is not None
                assert counts.replayed == run
        with flying(settings) as daemon:  # and dappled's own ground station, with the same key
            daemon.until_ready()
            url = f"udpout:127.0.0.1:{daemon.service.parts.links.port(0)}"
            assert main(["trigger", "--url", url, "--key", str(tmp_path / "radio.key")]) == 0
    assert (tmp_path / "flights" / ".mavlink-signing").stat().st_mode & 0o777 == 0o600


def test_a_pilot_is_told_of_a_camera_that_went_and_came_back(tmp_path: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body:
        settings = settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": URL})
        with flying(settings) as daemon, ground(daemon) as peer:
            peer.heartbeat()
            body.fault("unplug")
            said = peer.until(lambda m: m.get_type() == "STATUSTEXT" and "the camera is" in m.text, "camera gone")
            assert said.severity <= mavlink.MAV_SEVERITY_WARNING
            peer.command(2000, 0, 0, 1, 1)
            assert peer.ack(2000) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
            body.fault("clear")
            peer.until(lambda m: m.get_type() == "STATUSTEXT" and "over: the camera is" in m.text, "camera back")
            daemon.until_ready()
            assert shoot(peer, 2) == (0, 1)
            folder = daemon.service.folder
        with LedgerReader.open(folder / "flight.sqlite") as ledger:
            (refused,) = [event.finding for event in ledger.events() if event.kind == "refused"]
        assert refused is not None
        assert refused.code in {Code.CAMERA_ABSENT, Code.CAMERA_FAULTED}
        assert refused.subject == Subject("source", "mavlink:255/190")
        assert refused.facts["request"] == "IMAGE_START_CAPTURE"


@pytest.mark.slow
def test_a_station_behind_a_vehicle_on_two_ports_has_each_report_once(tmp_path: Path) -> None:
    """The autopilot forwards from both ports to the radio: each report came twice."""
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body, ExitStack() as stack:
        settings = settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": [URL, URL]})
        daemon = stack.enter_context(flying(settings))
        daemon.until_ready()
        first, second = (f"udpout:127.0.0.1:{daemon.service.parts.links.port(link)}" for link in (0, 1))
        radio = free_port()
        autopilot = VehicleProcess.start(
            first,
            seed=1,
            start_monotonic_ns=time.monotonic_ns(),
            more=["--forward", f"--url={second}", f"--url=udpin:127.0.0.1:{radio}"],
        )
        stack.callback(autopilot.stop)
        peer = stack.enter_context(Peer(radio))

        def both_are_heard() -> bool:
            return all(link.packets_in > 200 for link in daemon.service.parts.links.statistics())

        eventually(both_are_heard, "telemetry on both ports")
        reports = []
        for number in range(1, 5):
            peer.heartbeat()
            peer.until(lambda m: m.get_srcComponent() == 100 and m.get_type() == "HEARTBEAT", "the camera's heartbeat")
            reports.append(shoot(peer, number))
        peer.command(512, 262)
        peer.until(lambda m: m.get_type() == "CAMERA_CAPTURE_STATUS" and m.image_count == 4, "all four")
    assert reports == [(index, 1) for index in range(4)]
    indices = [m.image_index for m in peer.heard if m.get_type() == "CAMERA_IMAGE_CAPTURED"]
    assert sorted(set(indices)) == list(range(4))
    assert len(indices) < 8  # some may be repeated where a busy machine is late with telemetry


@pytest.mark.parametrize("keys", [["a", "b"], ["a", "b", "c"]])
def test_keys_that_do_not_match_the_links_are_refused_in_one_sentence(tmp_path: Path, keys: list[str]) -> None:
    settings = settings_of(tmp_path, mavlink={"url": URL, "keys": keys})
    with pytest.raises(ConfigError, match="name one for each link"), flying(settings):
        pass


@pytest.mark.slow
@pytest.mark.timeout(300)  # a replay comes after it
def test_decoding_is_switched_from_the_ground_and_the_flight_says_so(tmp_path: Path) -> None:
    settings = settings_of(tmp_path, mavlink={"url": URL})
    with Simulation(World(), settings, tmp_path) as simulated, flying(simulated) as daemon:
        daemon.until_ready()
        with Peer(daemon.service.parts.links.port(2)) as peer:
            peer.heartbeat()
            peer.one("HEARTBEAT")
            for value, decoded in (("off", False), ("on", True)):
                raw = code(value).to_bytes(4, "little")
                peer.send(mavlink.MAVLink_param_ext_set_message(1, 100, b"LF_DECODE", raw, 5))
                assert peer.one("PARAM_EXT_ACK").param_result == mavlink.PARAM_ACK_ACCEPTED
                pending = daemon.shoot()
                assert (pending.decoded is not None) == decoded
                assert pending.problem is None
            eventually(lambda: "decoding: off" in "\n".join(told(daemon.service.folder)), "the event")
            folder = daemon.service.folder
    assert "left: not decoded: decoding was switched off" in told(folder)
    verified = dappled("replay", str(folder), "--verify", timeout_s=150)
    assert verified.returncode == 0, verified.stderr
    assert verified.stdout.endswith("verified 2 frames: all hashes the same (1 left undecoded in flight)\n")


@pytest.mark.long  # its sibling without processes: tests/daemon/test_flight_handover.py
@pytest.mark.timeout(600)
def test_another_law_set_from_the_ground_begins_the_next_flight_and_both_verify(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "dappled.toml").write_text(
        f'[record]\ndirectory = "flights"\nmin_free_mb = 0\n[publish]\nslices = "ipc://{tmp_path}/s"\n'
        f'[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n'
    )
    command = [sys.executable, "-m", "dappled", "run", "--simulate", "--config", "dappled.toml"]
    daemon = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)

    def photograph() -> bool:
        return dappled("trigger", "--url", f"udpout:127.0.0.1:{port}", timeout_s=120).returncode == 0

    def flights() -> list[Path]:
        return sorted(path for path in (tmp_path / "flights").iterdir() if path.is_dir())

    try:
        eventually(photograph, "the first photograph", 120)
        with Peer(port) as peer:
            peer.heartbeat()
            peer.send(mavlink.MAVLink_param_ext_set_message(1, 100, b"LF_LAW", code("fd").to_bytes(4, "little"), 5))
            assert peer.one("PARAM_EXT_ACK").param_result == mavlink.PARAM_ACK_ACCEPTED
        eventually(lambda: len(flights()) == 2, "the next flight", 120)
        eventually(photograph, "a photograph of the next flight", 120)
        daemon.send_signal(signal.SIGTERM)
        _, err = daemon.communicate(timeout=120)
    finally:
        daemon.kill()
        daemon.communicate()
    assert daemon.returncode == 0, err
    assert "2 shots: 2 frames safe" in err
    for number, (flight, law) in enumerate(zip(flights(), ("geometric", "fd"), strict=True)):
        facts = tomllib.loads((flight / "flight.toml").read_text())
        assert facts["settings"]["decode"]["law"] == ("fd" if law == "fd" else "")
        assert ("law_decision" in facts) == (law == "fd")  # its frames show another law than the one that was set
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            assert [frame.index for frame in ledger.frames()] == [number]
            assert [result.law for result in ledger.results().values()] == ["geometric"]
        verified = dappled("replay", str(flight), "--verify", timeout_s=120)
        assert verified.returncode == 0, verified.stdout + verified.stderr
    assert "next flight: carrier law fd from there on, by the ground station" in told(flights()[0])
