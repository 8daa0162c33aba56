"""What autopilots and ground stations say, byte for byte, and what the camera makes of it: frames and answers."""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.drivers.mavlink import mavlink
from tests.daemon.camera_protocol.rig import Camera, Peer
from tests.waiting import eventually

SCRIPTS = Path(__file__).parent / "scripts"
NOW_NS = 1_800_000_000 * 10**9
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED


@dataclass(frozen=True)
class Line:
    """One packet of a script."""

    at_s: float
    link: int
    raw: bytes


def read(name: str) -> list[Line]:
    lines = [line.partition("#")[0].split() for line in (SCRIPTS / name).read_text().splitlines()]
    return [Line(int(ms) / 1e3, int(link), bytes.fromhex(raw)) for ms, link, raw in (each for each in lines if each)]


class Stage:
    """A camera whose clock goes by the script, so that a slow machine changes nothing."""

    def __init__(self, links: int, exposure_s: float = 0.005) -> None:
        self.clock = RecordedClock(NOW_NS, NOW_NS - 10**12)
        self.camera = Camera(urls=["udpin:127.0.0.1:0"] * links, exposure_s=exposure_s, clock=self.clock)

    def play(self, lines: Sequence[Line]) -> list[Peer]:
        """Send them, each link from a peer of its own; the peers, with all that came back."""
        camera = self.camera
        with ExitStack() as stack:
            stack.enter_context(camera)
            peers = {at: stack.enter_context(Peer(camera.links.port(at), 1, 1)) for at in {line.link for line in lines}}
            for sent, line in enumerate(lines, 1):
                while self.clock.utc_ns() < NOW_NS + round(line.at_s * 1e9):
                    camera.idle()
                    self.clock.advance(0.05)
                    threading.Event().wait(0.005)  # for the shutter's own thread, which waits for this clock
                peers[line.link].raw(line.raw)
                eventually(lambda sent=sent: camera.received() == sent, "the packet")  # type: ignore[misc]  # a default
            self.clock.advance(1)
            for turn in range(2):  # what comes before the answers to these was the script's, and what followed from it
                for link, peer in peers.items():
                    peer.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 261, turn, 0, 0, 0, 0, link)
                    peer.one("MESSAGE_INTERVAL")
                camera.idle()
            assert camera.failures() == 0
            return list(peers.values())


@pytest.mark.parametrize(
    ("script", "kinds"),
    [
        ("px4-triple.txt", ["CAMERA_TRIGGER"] * 3),
        ("px4-retries.txt", ["CAMERA_TRIGGER"]),
        ("ardupilot-cam1-type-5.txt", ["DO_DIGICAM_CONTROL"] * 3),
        ("mission-planner.txt", ["DO_DIGICAM_CONTROL"] * 2),
    ],
)
def test_every_trigger_is_one_frame(script: str, kinds: list[str]) -> None:
    lines = read(script)
    stage = Stage(links=len({line.link for line in lines}))
    peers = stage.play(lines)
    assert [cause.kind for cause in stage.camera.causes] == kinds
    assert sorted(stage.camera.done) == list(range(len(kinds)))
    assert [peer.count("CAMERA_IMAGE_CAPTURED") for peer in peers] == [len(kinds)] * len(peers)  # on every link
    counts = stage.camera.shutter.statistics()
    assert (counts.shots, counts.refused) == (len(kinds), 0)


def test_every_command_is_answered_though_its_frame_was_asked_for_before() -> None:
    (peer,) = Stage(1).play(read("px4-retries.txt"))
    assert [m.result for m in peer.heard if m.get_type() == "COMMAND_ACK" and m.command == 2000] == [ACCEPTED] * 3


def test_mission_planner_is_answered_in_version_1_with_every_message_it_asks_for() -> None:
    (peer,) = Stage(1).play(read("mission-planner.txt"))
    for kind in ("CAMERA_SETTINGS", "STORAGE_INFORMATION", "CAMERA_CAPTURE_STATUS", "COMMAND_ACK"):
        assert peer.count(kind) >= 1
    first = next(m for m in peer.heard if m.get_type() == "COMMAND_ACK")
    assert first.get_msgbuf()[0] == mavlink.PROTOCOL_MARKER_V1


def test_a_single_shot_does_not_end_an_interval_and_a_stop_does() -> None:
    stage = Stage(1)
    (peer,) = stage.play(read("ardupilot-cam1-type-6.txt"))
    causes = stage.camera.causes
    assert [one.sequence for one in causes if one.kind == "IMAGE_START_CAPTURE"] == [1, 2, 3]
    assert [one.kind for one in causes] == [*["IMAGE_START_CAPTURE"] * 2, "interval", "IMAGE_START_CAPTURE", "interval"]
    assert stage.camera.shutter.statistics().interval_s is None
    assert [m.result for m in peer.heard if m.get_type() == "COMMAND_ACK"] == [ACCEPTED] * 6  # two are ours
    assert peer.count("CAMERA_IMAGE_CAPTURED") == len(causes)


def test_qgroundcontrols_sequence() -> None:
    """Heartbeat, 259 by 512 (and by 521, as older ones), settings by PARAM_EXT and their file by FTP, 260, 261, 262;
    the shutter button, its status until idle, and the photograph for the map."""
    with Camera(first=7) as camera, Peer(camera.links.port(0)) as qgc:
        qgc.heartbeat()
        beat = qgc.one("HEARTBEAT")
        assert (beat.type, beat.autopilot, beat.get_srcComponent()) == (mavlink.MAV_TYPE_CAMERA, 8, 100)
        for ask in ((512, 259.0), (521, 1.0)):
            qgc.command(*ask)
            assert qgc.ack(int(ask[0])) == ACCEPTED
            information = qgc.one("CAMERA_INFORMATION")
        assert information.flags & mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
        assert information.cam_definition_uri == "mftp://[;comp=100]/camera.xml"

        xml = download(qgc, "/camera.xml")
        assert f'version="{information.cam_definition_version}"'.encode() in xml
        qgc.send(mavlink.MAVLink_param_ext_request_list_message(1, 100))
        (value,) = [qgc.one("PARAM_EXT_VALUE")]
        assert (value.param_id, value.param_count) == ("CAM_ISO", 1)
        assert b'name="CAM_ISO"' in xml

        for message, kind in ((260.0, "CAMERA_SETTINGS"), (261.0, "STORAGE_INFORMATION")):
            qgc.command(512, message)
            assert qgc.ack(512) == ACCEPTED
            told = qgc.one(kind)
        assert told.status == mavlink.STORAGE_STATUS_READY
        qgc.command(527, 1.0)
        assert qgc.ack(527) == ACCEPTED
        assert qgc.one("CAMERA_CAPTURE_STATUS").image_status == 0

        qgc.command(2000, 0.0, 0.0, 1.0, 0.0)
        assert qgc.ack(2000) == ACCEPTED
        photo = qgc.one("CAMERA_IMAGE_CAPTURED")
        assert (photo.image_index, photo.capture_result) == (7, 1)
        idle = qgc.until(lambda m: m.get_type() == "CAMERA_CAPTURE_STATUS" and m.image_status == 0, "idle, unasked")
        assert idle.image_count == 8
        assert camera.failures() == 0


def test_a_refused_press_is_denied_in_words_and_the_button_is_freed_by_a_status() -> None:
    with Camera(capacity=1) as camera, Peer(camera.links.port(0)) as qgc:
        camera.hung = True
        qgc.heartbeat()
        qgc.one("HEARTBEAT")
        for sequence, result in ((1, ACCEPTED), (2, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)):
            qgc.command(2000, 0, 0, 1, sequence)
            assert qgc.ack(2000) == result
        assert "1 shot waiting for the camera" in qgc.one("STATUSTEXT").text
        qgc.one("CAMERA_CAPTURE_STATUS")


def test_every_photograph_of_an_earlier_run_can_be_asked_for_failures_too() -> None:
    with Camera(fails=[1]) as first, Peer(first.links.port(0)) as qgc:
        qgc.heartbeat()
        qgc.one("HEARTBEAT")
        for sequence in (1, 2, 3):
            qgc.command(2000, 0, 0, 1, sequence)
            qgc.one("CAMERA_IMAGE_CAPTURED")
        first.idle()
        done = dict(first.done)
    with Camera(first=3, done=done) as again, Peer(again.links.port(0)) as qgc:
        qgc.heartbeat()
        qgc.one("HEARTBEAT")
        for index in (0, 1, 2):
            qgc.command(512, 263, index)
            assert qgc.ack(512) == ACCEPTED
            told = qgc.one("CAMERA_IMAGE_CAPTURED")
            assert (told.image_index, told.capture_result) == (index, int(index != 1))
        qgc.command(2002, 3)
        assert qgc.ack(2002) == mavlink.MAV_RESULT_DENIED
        qgc.command(2000, 0, 0, 1, 1)
        assert qgc.one("CAMERA_IMAGE_CAPTURED").image_index == 3


def download(peer: Peer, path: str) -> bytes:
    """A file over MAVLink FTP, as QGroundControl's manager fetches it: open, bursts, terminate."""
    sequence = 0

    def ask(opcode: int, data: bytes = b"", *, session: int = 0, size: int | None = None, offset: int = 0) -> None:
        nonlocal sequence
        length = len(data) if size is None else size
        payload = struct.pack("<HBBBBBxI", sequence, session, opcode, length, 0, 0, offset) + data
        sequence += 1
        peer.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 100, list(payload.ljust(251, b"\0"))))

    def heard() -> tuple[int, int, bool, bytes]:
        raw = bytes(peer.one("FILE_TRANSFER_PROTOCOL").payload)
        _, session, opcode, size, _, complete, _ = struct.unpack_from("<HBBBBBxI", raw)
        assert opcode == 128, f"refused: {raw[12]}"
        return session, size, bool(complete), raw[12 : 12 + size]

    ask(4, path.encode())
    session, _, _, opened = heard()
    (size,) = struct.unpack("<I", opened)
    got = b""
    while len(got) < size:
        ask(15, session=session, size=239, offset=len(got))
        complete = False
        while not complete:
            _, _, complete, part = heard()
            got += part
    ask(1, session=session)
    heard()
    assert len(got) == size
    return got
