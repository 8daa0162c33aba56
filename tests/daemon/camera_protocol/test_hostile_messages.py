"""A link that loses, doubles, reorders and lies, and machines that are not ours: never a crash, never a double or a
phantom shot, memory bounded."""

from __future__ import annotations

import itertools
import math
import random
import resource
import socket
import struct
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import SystemClock
from dappled.drivers.mavlink import Unsigned
from dappled.drivers.mavlink import signing as mavlink_signing
from dappled.drivers.mavlink.framing import Framer, mavlink
from dappled.drivers.mavlink.links import Packet
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from tests.daemon.camera_protocol.rig import Camera, Peer
from tests.daemon.camera_protocol.test_component import Rig
from tests.waiting import eventually

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
FLOOD = Path(__file__).parent / "flood.py"


@dataclass(frozen=True)
class Way:
    """What a link does to packets: shares that are lost and doubled, the most that one is late; how many links."""

    loss: float
    doubles: float
    late_s: float
    links: int


WAYS = st.builds(
    Way, st.sampled_from([0.0, 0.2, 0.6]), st.sampled_from([0.0, 0.3]), st.sampled_from([0.0, 0.05, 0.4]),
    st.integers(1, 2),
)  # fmt: skip


def arrivals(way: Way, gap_s: float, confirms: bool, seed: int) -> list[tuple[float, int, int, bytes]]:
    """(when, order, link, packet) of 12 numbered requests, each sent four times every 500 ms on every link."""
    chance = random.Random(seed)  # noqa: S311  # a test's dice
    packers = [mavlink.MAVLink(None, srcSystem=255, srcComponent=190) for _ in range(way.links)]
    sent = sorted((request * gap_s + 0.5 * again, request + 1, again) for request in range(12) for again in range(4))
    come: list[tuple[float, int, int, bytes]] = []
    for at_s, sequence, again in sent:
        for link, packer in enumerate(packers):
            confirmation = again if confirms else 0
            message = mavlink.MAVLink_command_long_message(1, 100, 2000, confirmation, 0, 0, 1, sequence, 0, 0, 0)
            raw = message.pack(packer)
            packer.seq = (packer.seq + 1) % 256
            for _ in range(2 if chance.random() < way.doubles else 1):
                if chance.random() >= way.loss:
                    come.append((at_s + chance.uniform(0, way.late_s), len(come), link, raw))
    return sorted(come)


@given(WAYS, st.sampled_from([0.05, 0.2, 1.5]), st.booleans(), st.integers(0, 2**32))
def test_loss_duplication_and_reordering_make_exactly_one_shot_of_every_wish_that_came(
    way: Way, gap_s: float, confirms: bool, seed: int
) -> None:
    rig = Rig(capacity=1000)
    rig.tick(4)
    now, times, seen = 0.0, defaultdict[int, list[float]](list), dict[tuple[bytes, int], float]()
    for at_s, _, link, raw in arrivals(way, gap_s, confirms, seed):
        rig.clock.advance(at_s - now)
        now = at_s
        message = mavlink.MAVLink(None).decode(bytearray(raw))
        # The network's copy of a packet is answered, and nothing else.
        if all(at_s - came_s > (0.5 if at == link else 2.5) for (of, at), came_s in seen.items() if of == raw):
            times[int(message.param4)].append(at_s)
        seen[raw, link] = at_s
        rig.component.on_packet(Packet(0, 0, link, message, raw))
    # Who does not count its repeats (confirmation 0) is forgotten after 1.2 s in which none of them came.
    forgotten = sum(b - a > 1.2 for came in times.values() for a, b in pairwise(came)) if not confirms else 0
    assert len(rig.fired) == len(set(rig.fired)) == len(times) + forgotten


@given(
    st.sampled_from(["CAMERA_TRIGGER", "DO_DIGICAM_CONTROL"]),
    st.lists(st.floats(0.35, 3.0), min_size=1, max_size=12),
    st.floats(0, 2.0),
    st.sampled_from([0.0, 0.3, 0.6]),
    st.integers(0, 2**32),
)
def test_a_trigger_that_nobody_answers_is_one_shot_over_two_links_of_which_one_is_two_seconds_behind(
    kind: str, gaps_s: list[float], behind_s: float, loss: float, seed: int
) -> None:
    chance = random.Random(seed)  # noqa: S311  # a test's dice
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    come: list[tuple[float, int, int, bytes]] = []
    now, requests = 0.0, set[int]()
    # Two without a number that come within 0.3 s are taken for one: the radio's 0.4 s must not bring them so close.
    apart_s = 0.4 if kind == "DO_DIGICAM_CONTROL" else 0.0
    for number, gap_s in enumerate(gaps_s):
        now += gap_s + apart_s
        packer.seq = 7 * number
        message = mavlink.MAVLink_camera_trigger_message(number, number)
        if kind == "DO_DIGICAM_CONTROL":  # ArduPilot's CAM1_TYPE 5: no number of its own
            message = mavlink.MAVLink_command_long_message(0, 0, 203, 0, 0, 0, 0, 0, 1, 0, 0)
        raw = message.pack(packer)
        for link, late_s in enumerate((0.0, behind_s)):
            for _ in range(2 if chance.random() < 0.3 else 1):
                # Without a number a trigger that only the slow link brought may be taken for a part of another.
                if kind == "DO_DIGICAM_CONTROL" or chance.random() >= loss:
                    come.append((now + late_s + chance.uniform(0, 0.4), len(come), link, raw))
                    requests.add(number)
    rig = Rig(capacity=1000)
    rig.tick(4)
    now = 0.0
    for at_s, _, link, raw in sorted(come):
        rig.clock.advance(at_s - now)
        now = at_s
        rig.component.on_packet(Packet(0, 0, link, mavlink.MAVLink(None).decode(bytearray(raw)), raw))
    assert len(rig.fired) == len(requests)


HEARD = [0, 76, 75, 112, 180, 110, 320, 321, 323, 111, 33, 30, 31, 24, 2, 77, 253, 20, 4]


@given(
    st.lists(
        st.tuples(st.sampled_from(HEARD) | st.integers(0, 2**24 - 1), st.binary(max_size=255), st.booleans()),
        min_size=1,
        max_size=12,
    )
)
def test_any_payload_of_any_length_in_a_sound_packet_crashes_nothing(packets: list[tuple[int, bytes, bool]]) -> None:
    rig = Rig()
    rig.tick(4)
    for number, payload, version_1 in packets:
        raw = sound(number % 256 if version_1 else number, payload, version_1=version_1)
        for framed in Framer().datagram(raw):
            rig.component.on_packet(Packet(0, 0, 0, framed.message, raw))
    rig.tick(1)
    for message in rig.sent:
        message.pack(mavlink.MAVLink(None))


def sound(number: int, payload: bytes, *, version_1: bool = False, source: tuple[int, int] = (1, 1)) -> bytes:
    """A packet with this payload and the right checksum, whatever the payload's length should be."""
    known = mavlink.mavlink_map.get(number)
    if version_1:
        header = bytes([0xFE, len(payload), 0, *source, number])
    else:
        header = bytes([0xFD, len(payload), 0, 0, 0, *source]) + number.to_bytes(3, "little")
    crc = mavlink.x25crc(header[1:] + payload + bytes([known.crc_extra if known else 0])).crc
    return header + payload + struct.pack("<H", crc)


def test_random_bytes_and_torn_packets_on_a_real_link_cost_no_sound_one() -> None:
    chance = random.Random(5)  # noqa: S311  # a test's dice
    with Camera() as camera, Peer(camera.links.port(0)) as peer:
        for request in range(1, 6):
            whole = peer.packed(mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, request, 0, 0, 0))
            for _ in range(40):
                peer.raw(chance.randbytes(chance.randrange(1, 300)))
                peer.raw(whole[: chance.randrange(1, len(whole))])
                broken = bytearray(whole)
                broken[chance.randrange(10, len(whole))] ^= chance.randrange(1, 256)
                peer.raw(bytes(broken))
            peer.raw(whole)
            assert peer.ack(2000) == ACCEPTED
            camera.idle()
        assert [cause.sequence for cause in camera.causes] == [1, 2, 3, 4, 5]
        assert camera.failures() == 0
        assert camera.links.statistics()[0].packets_bad > 100


def test_nan_in_every_parameter_of_every_command_crashes_nothing_and_fires_nothing_unasked() -> None:
    nan = math.nan
    with Camera() as camera, Peer(camera.links.port(0)) as peer:
        for name in (203, 510, 511, 512, 521, 522, 525, 526, 527, 529, 530, 531, 532, 2001, 2002, 2003, 206, 214):
            peer.command(name, nan, nan, nan, nan, nan, nan, nan)
            peer.ack(name)
        assert camera.causes == []
        assert camera.failures() == 0


def test_foreign_systems_and_a_second_autopilot_are_heard_and_not_obeyed() -> None:
    with Camera(settled=False) as camera, Peer(camera.links.port(0)) as gcs:
        with Peer(camera.links.port(0), 1, 1) as ours, Peer(camera.links.port(0), 2, 1) as other:
            ours.heartbeat()
            other.heartbeat()
            gcs.heartbeat()
            assert gcs.one("HEARTBEAT").get_srcSystem() == 1  # two autopilots: what is configured stands
            other.send(mavlink.MAVLink_camera_trigger_message(1, 1))
            for target in ((2, 100), (1, 101), (7, 0)):
                gcs.command(2000, 0, 0, 1, 9, target=target)
            other.send(mavlink.MAVLink_command_ack_message(2000, 0))
            ours.send(mavlink.MAVLink_camera_trigger_message(1, 4))
            camera_idle(camera, gcs)
        assert [(cause.source, cause.sequence) for cause in camera.causes] == [("mavlink:1/1", 4)]


def test_an_autopilot_that_boots_again_is_followed_and_fires_nothing_by_that() -> None:
    with Camera() as camera, Peer(camera.links.port(0), 1, 1) as autopilot:
        seen = camera.telemetry.statistics
        for start_ms, reboots in ((500_000, 0), (1_000, 1)):
            began = time.monotonic()
            while seen().positions <= 5 or seen().reboots < reboots:
                assert time.monotonic() - began < 60
                boot_ms = start_ms + int((time.monotonic() - began) * 1e3)
                autopilot.send(
                    mavlink.MAVLink_global_position_int_message(boot_ms, 471234567, 85432100, 5000, 5000, 0, 0, 0, 0)
                )
                time.sleep(0.02)
        autopilot.send(mavlink.MAVLink_camera_trigger_message(1, 1))
        camera_idle(camera, autopilot)
        assert [cause.kind for cause in camera.causes] == ["CAMERA_TRIGGER"]


@pytest.mark.parametrize("unsigned", ["refuse", "listen"])
def test_forged_replayed_and_unsigned_packets_fire_nothing_on_a_signed_link(tmp_path: Path, unsigned: Unsigned) -> None:
    mavlink_signing.make_key(tmp_path / "key")
    signing = mavlink_signing.open_signing([tmp_path / "key"], tmp_path / "time", SystemClock(), unsigned)
    key = mavlink_signing.read_key(tmp_path / "key")
    with Camera(signing=signing) as camera, Peer(camera.links.port(0)) as gcs:
        port = camera.links.port(0)

        def sign(peer: Peer, secret: bytes) -> None:
            peer.packer.signing.secret_key, peer.packer.signing.sign_outgoing = secret, True
            now = time.time() - mavlink_signing.EPOCH_UNIX_S
            peer.packer.signing.timestamp = round(now * UNITS_PER_S)

        fire = mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, 1, 0, 0, 0)
        sign(gcs, key)
        good = gcs.packed(fire)
        gcs.raw(good)
        assert gcs.ack(2000) == ACCEPTED
        with Peer(port) as attacker, Peer(port) as stranger:
            for _ in range(50):
                attacker.raw(good)  # replayed
            sign(attacker, bytes(32))
            for sequence in range(2, 30):  # forged with a wrong key, and from far in the future
                attacker.packer.signing.timestamp += 10**9
                attacker.send(mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, sequence, 0, 0, 0))
                stranger.send(mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, sequence, 0, 0, 0))
            gcs.command(2000, 0, 0, 1, 99)  # the true one is still believed: nobody moved the time
            assert gcs.ack(2000) == ACCEPTED
        camera.idle()
        assert [cause.sequence for cause in camera.causes] == [1, 99]
        counts = camera.links.statistics()[0].signing
        assert counts is not None
        assert (counts.good, counts.forged, counts.replayed) == (2, 28, 50)
        assert counts.unsigned_refused + counts.unsigned_taken == 28
        assert all(m.get_msgbuf()[2] & 1 for m in gcs.heard), "something went out unsigned"


@pytest.mark.parametrize("known", [False, True], ids=["no time here", "time known here"])
@pytest.mark.parametrize("clock_off_s", [-365 * 86400, -3600, 0, 3600])
def test_a_station_with_a_wrong_clock_is_taken_once_it_has_heard_the_camera(
    tmp_path: Path, clock_off_s: int, known: bool
) -> None:
    mavlink_signing.make_key(tmp_path / "key")
    key = mavlink_signing.read_key(tmp_path / "key")
    signing = mavlink_signing.open_signing([tmp_path / "key"], tmp_path / "time", SystemClock())
    with Camera(signing=signing) as camera:
        if known:
            camera.links.clock_known()
        for system, off_s in ((255, clock_off_s), (254, 0)):  # the second with the right clock, whatever the first had
            with Peer(camera.links.port(0), system) as station:
                signer = station.packer.signing
                signer.secret_key, signer.sign_outgoing = key, True
                now = time.time() - mavlink_signing.EPOCH_UNIX_S
                signer.timestamp = round((now + off_s) * UNITS_PER_S)
                listener = mavlink.MAVLink(None)  # as programs have it: one object signs, hears, and learns the time
                listener.signing = signer
                station.decode = listener.decode
                station.heartbeat()
                station.one("HEARTBEAT")
                station.command(2000, 0, 0, 1, 1)
                assert station.ack(2000) == ACCEPTED
        camera.idle()
        assert [cause.source for cause in camera.causes] == ["mavlink:255/190", "mavlink:254/190"]


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_a_client_that_dies_in_the_middle_of_a_packet_leaves_the_camera_to_the_next(kind: str) -> None:
    with Camera(urls=[f"{kind}:127.0.0.1:0"]) as camera:
        port = camera.links.port(0)
        packer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        for sequence in (1, 2, 3):
            whole = mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, sequence, 0, 0, 0).pack(packer)
            packer.seq += 1
            sort = socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM
            with socket.socket(socket.AF_INET, sort) as client:
                client.connect(("127.0.0.1", port))
                client.sendall(whole)
                eventually(lambda wanted=sequence: len(camera.causes) == wanted, "the shot")  # type: ignore[misc]  # a default
                client.sendall(whole[:9])
                if kind == "tcpin":  # reset, as a machine that loses power
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        camera.idle()
        assert [cause.sequence for cause in camera.causes] == [1, 2, 3]
        assert camera.failures() == 0


@pytest.mark.parametrize(
    "seconds", [3, pytest.param(60, marks=[pytest.mark.long, pytest.mark.alone, pytest.mark.timeout(180)])]
)
def test_five_thousand_messages_a_second_drown_no_wish_and_fill_no_memory(seconds: int) -> None:
    with Camera() as camera, Peer(camera.links.port(0)) as gcs:
        gcs.heartbeat()
        gcs.one("HEARTBEAT")
        flood = subprocess.Popen([sys.executable, str(FLOOD), str(camera.links.port(0)), "5000", str(seconds)])
        try:
            eventually(lambda: camera.received() > 2000, "the flood")
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            requests = 0
            while not requests or flood.poll() is None:
                requests += 1
                ask(camera, gcs, requests)
                gcs.heard.clear()
                time.sleep(0.1)
        finally:
            flood.kill()
            code = flood.wait()
        assert code == 0, "the flood did not end by itself"
        grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        assert [cause.sequence for cause in camera.causes] == list(range(1, requests + 1))
        assert camera.failures() == 0
        # Every packet that was sent was handled, or the kernel says itself that its buffer was full.
        sent = 5000 * seconds
        eventually(lambda: camera.received() + dropped(camera.links.port(0)) >= sent, f"all {sent} packets")
        if seconds > 3:  # with nothing beside it
            lost = dropped(camera.links.port(0))
            assert lost < sent / 2, f"the kernel dropped {lost} of {sent} packets"
        assert grown_mb < 40


def ask(camera: Camera, gcs: Peer, sequence: int) -> None:
    """Ask for a photograph as ground stations do, again each half second while no answer comes, until it is taken.

    An answer doesn't tell which request it is to, and one to the request before may come late: the shot tells.
    """
    until = time.monotonic() + 60
    for confirmation in itertools.count():
        gcs.command(2000, 0, 0, 1, sequence, confirmation=min(confirmation, 255))
        with suppress(AssertionError):  # the kernel's buffer overflowed
            gcs.until(lambda m: m.get_type() == "COMMAND_ACK" and m.result == ACCEPTED, "ack", 0.5)
        camera.idle()
        if camera.causes and camera.causes[-1].sequence == sequence:
            return
        assert time.monotonic() < until, f"request {sequence} was drowned"


def dropped(port: int) -> int:
    """Datagrams that the kernel threw away because nobody fetched them in time (/proc/net/udp)."""
    lines = [line.split() for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]]
    (drops,) = [int(fields[-1]) for fields in lines if int(fields[1].rpartition(":")[2], 16) == port]
    return drops


def camera_idle(camera: Camera, peer: Peer) -> None:
    """All that was sent before is handled, and every shot has ended."""
    peer.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 262)
    peer.one("MESSAGE_INTERVAL")
    camera.idle()


def test_a_signed_request_that_two_links_bring_is_one_shot_and_answered_on_both(tmp_path: Path) -> None:
    """And what a thief sends again is none."""
    mavlink_signing.make_key(tmp_path / "key")
    key = mavlink_signing.read_key(tmp_path / "key")
    signing = mavlink_signing.open_signing([tmp_path / "key"] * 2, tmp_path / "time", SystemClock())
    with (
        Camera(urls=["udpin:127.0.0.1:0"] * 2, signing=signing) as camera,
        Peer(camera.links.port(0)) as near,
        Peer(camera.links.port(1)) as far,
        Peer(camera.links.port(1)) as thief,
    ):
        signer = near.packer.signing
        signer.secret_key, signer.sign_outgoing = key, True
        signer.timestamp = round((time.time() - mavlink_signing.EPOCH_UNIX_S) * UNITS_PER_S)
        fire = near.packed(mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, 7, 0, 0, 0))
        near.raw(fire)
        assert near.ack(2000) == ACCEPTED
        far.raw(fire)
        assert far.ack(2000) == ACCEPTED
        for _ in range(5):
            thief.raw(fire)

        def replayed() -> int:
            counts = camera.links.statistics()[1].signing
            assert counts is not None
            return counts.replayed

        eventually(lambda: replayed() == 5, "the thief's packets")
        camera.idle()
        assert [cause.sequence for cause in camera.causes] == [7]
