"""Hostile bytes at the doors that C libraries guard: the daemon goes on, whatever becomes of them."""

from __future__ import annotations

import random
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.body.ptp import init_command_ack
from dappled.mocks.scene.masked_camera import reference_camera
from tests.system.flying import flying, settings_of
from tests.waiting import eventually


@contextmanager
def liar(seed: int) -> Iterator[int]:
    """A PTP/IP body that shakes hands properly and then answers everything with noise. Its TCP port."""
    chance = random.Random(seed)  # noqa: S311  # noise, no secret
    ended = threading.Event()

    def talk(one: socket.socket) -> None:
        with one, suppress(OSError):
            one.settimeout(0.2)
            while not ended.is_set():
                try:
                    heard = one.recv(65536)
                except TimeoutError:
                    continue
                if not heard:
                    return
                if heard[4:8] == b"\x01\0\0\0" and chance.random() < 0.8:
                    one.sendall(init_command_ack(1, bytes(16), "noise"))
                elif chance.random() < 0.7:  # a plausible head, its length often a lie
                    body = chance.randbytes(chance.randint(0, 300))
                    length = len(body) + 8 if chance.random() < 0.6 else chance.getrandbits(chance.choice([8, 16, 31]))
                    one.sendall(length.to_bytes(4, "little") + chance.randint(1, 14).to_bytes(4, "little") + body)
                else:
                    one.sendall(chance.randbytes(chance.randint(1, 4000)))

    def listen(server: socket.socket) -> None:
        server.settimeout(0.2)
        while not ended.is_set():
            with suppress(OSError):
                one, _ = server.accept()
                threading.Thread(target=talk, args=[one], daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as server:
        listener = threading.Thread(target=listen, args=[server], daemon=True)
        listener.start()
        yield server.getsockname()[1]
        ended.set()
        listener.join(60)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))])
def test_a_body_that_answers_with_noise(seed: int, tmp_path: Path) -> None:
    """PTP answers are parsed in the camera's process; it may die of them, the daemon says so and refuses requests."""
    with liar(seed) as port, flying(settings_of(tmp_path, camera={"port": f"ptpip:127.0.0.1:{port}:{port}"})) as daemon:
        eventually(lambda: daemon.camera in ("absent", "faulted"), "the noise is no camera")
        decision = daemon.request()
        assert decision.outcome != "shot"
        assert decision.reason
        threading.Event().wait(3.0)  # let it try again and again
        assert daemon.service.healthy()
        assert daemon.shots == []


@pytest.mark.slow
def test_raw_files_of_noise_end_no_flight(tmp_path: Path) -> None:
    """A body whose files are damaged raw files: each is recorded as it came, none ends the decode stage."""
    good = reference_camera(1, scale=0.5).expose(0.0, 1).file
    chance = random.Random(5)  # noqa: S311  # as above
    for turn in range(3):
        bad = bytearray(good[: chance.randint(200, len(good))])
        for _ in range(200):
            bad[chance.randrange(min(len(bad), 4000))] = chance.randrange(256)
        picture = tmp_path / f"{turn}.dng"
        picture.write_bytes(bad)
        options = BodyOptions(picture=str(picture))
        tables = {"mask": {"profile": "reference-5x5"}, "record": {"directory": str(tmp_path / f"flights{turn}")}}
        with (
            SimulatedBody.start(options) as body,
            flying(settings_of(tmp_path, camera={"port": body.port}, **tables)) as daemon,
        ):
            pending = daemon.shoot()
            assert pending.frame is not None
            assert (daemon.service.folder / pending.frame.name).read_bytes() == bytes(bad)
            assert daemon.service.healthy()
