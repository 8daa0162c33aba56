"""The daemon killed (SIGKILL) around capture requests: the ground station hears what became of each, once."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink, pack
from dappled.flight import layout, log_reading
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import free_port
from dappled.workers import Loop
from tests.waiting import eventually

START_S = 60.0


class Ground:
    """A ground station and an autopilot on one socket, which outlives every daemon behind `port`."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.2)
        self._to = ("127.0.0.1", port)
        self._lock = threading.Lock()
        self._packers = {
            who: mavlink.MAVLink(None, srcSystem=who[0], srcComponent=who[1]) for who in ((255, 190), (1, 1))
        }
        self._sequence = 0
        self.accepted = 0
        self.outcomes: list[tuple[int, int]] = []
        self.texts: list[str] = []
        self.beats = 0
        self._loop = Loop("ground", self._run)
        self._loop.start()

    def close(self) -> None:
        self._loop.stop(5)
        self._socket.close()

    def shoot(self) -> None:
        """One request, numbered; the answer is counted in `accepted`."""
        self._sequence += 1
        self._send((255, 190), mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, self._sequence, 0, 0, 0))

    def ask(self, index: int) -> None:
        """Ask for an image by its index."""
        self._send((255, 190), mavlink.MAVLink_command_long_message(1, 100, 512, 0, 263, index, 0, 0, 0, 0, 0))

    def _send(self, who: tuple[int, int], message: MavlinkMessage) -> None:
        with self._lock:
            self._socket.sendto(pack(message, self._packers[who], version_1=False), self._to)

    def _run(self) -> None:
        parse = PacketParser()
        while not self._loop.stopping.is_set():
            self._send((255, 190), mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            self._send((1, 1), mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
            try:
                while not self._loop.stopping.is_set():
                    self._hear(parse(self._socket.recv(65536)))
            except TimeoutError:
                continue

    def _hear(self, message: MavlinkMessage | None) -> None:
        if message is None or message.get_srcComponent() != 100:
            return
        kind = message.get_type()
        if kind == "COMMAND_ACK" and message.command == 2000 and message.result == mavlink.MAV_RESULT_ACCEPTED:
            self.accepted += 1
        elif kind == "CAMERA_IMAGE_CAPTURED":
            self.outcomes.append((message.image_index, message.capture_result))
        elif kind == "STATUSTEXT" and message.chunk_seq == 0:
            self.texts.append(message.text)
        elif kind == "HEARTBEAT":
            self.beats += 1


@contextmanager
def daemon(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    with (folder / "log").open("ab") as log:
        running = subprocess.Popen(
            [sys.executable, "-m", "dappled", "run", "--config", "dappled.toml"], cwd=folder, stderr=log
        )
    try:
        yield running
    finally:
        running.kill()
        running.wait()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kills", [4, pytest.param(9, marks=pytest.mark.long)])
def test_every_accepted_request_has_one_outcome_at_the_ground_station_over_kills(tmp_path: Path, kills: int) -> None:
    dice = random.Random(17)  # noqa: S311  # kills anywhere between request and report, the same in each run
    port = free_port()
    ground = Ground(port)
    # two seconds an exposure: a kill that follows a request at once falls before its report on any machine
    options = BodyOptions(picture="pattern:20000000:CR2", card_bytes=8 << 30, delay_s=2.0)
    with SimulatedBody.start(options) as body:
        (tmp_path / "dappled.toml").write_text(
            f'[camera]\nport = "{body.port}"\n[record]\ndirectory = "flights"\nmin_free_mb = 0\n'
            f'[publish]\nslices = "ipc://{tmp_path}/s"\n[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n',
            encoding="utf-8",
        )
        try:
            for _ in range(kills):
                with daemon(tmp_path) as running:
                    accepted = ground.accepted

                    def first_accepted(before: int = accepted) -> bool:
                        ground.shoot()
                        threading.Event().wait(0.1)
                        return ground.accepted > before

                    eventually(first_accepted, "a request is accepted", START_S)
                    for _ in range(dice.randrange(6)):
                        ground.shoot()
                        threading.Event().wait(dice.uniform(0.0, 0.1))
                    threading.Event().wait(dice.choice((0.0, 0.05, 2.5)))  # the last: among the reports of the last run
                    running.send_signal(signal.SIGKILL)
                    running.wait()
            beats = ground.beats
            with daemon(tmp_path) as running:
                eventually(lambda: ground.beats > beats, "the last daemon's heartbeat", START_S)
                noted = [
                    shot.index
                    for flight in layout.flights(tmp_path / "flights")
                    for shot in log_reading.read_journal(flight.journal).shots
                ]
                eventually(lambda: {index for index, _ in ground.outcomes} >= set(noted), "an outcome of each", START_S)
                heard = list(ground.outcomes)
                failed = sorted(index for index, ok in heard if not ok)
                for index in failed:
                    ground.ask(index)
                eventually(
                    lambda: ground.outcomes[len(heard) :] == [(index, 0) for index in failed], "answers by index"
                )
                running.send_signal(signal.SIGTERM)
                assert running.wait(60) == 0
        finally:
            ground.close()
    assert sorted(noted) == list(range(len(noted)))
    assert len(noted) >= ground.accepted >= kills
    assert Counter(index for index, _ in heard) == Counter(noted)
    lost = [text for text in ground.texts if "lost when the daemon ended" in text]
    assert sum(int(text.split()[0]) for text in lost) == len(failed)
    assert failed, "no kill fell between a request and its report"
