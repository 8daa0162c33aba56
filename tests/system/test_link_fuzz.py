"""A flood of strangers on a signed port: no message of the station is lost, and the disk stays free."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.drivers.mavlink import make_key, mavlink, read_key
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from dappled.drivers.mavlink.signing import EPOCH_UNIX_S
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import free_port
from tests.daemon.camera_protocol.rig import Peer

ROOT = Path(__file__).parents[2]
NICE = -5  # the unit's; who may not have it runs without
ACK_MS = 50.0
LATE_MS = 1000.0  # for one acknowledgement in 20, on a machine whose cores are all busy
BYTES_A_MINUTE = 1_000_000
WARM_UP_S = 5.0
EACH_S = 0.2


@contextlib.contextmanager
def daemon(folder: Path) -> Iterator[int]:
    """The daemon in a process of its own with a signed port, in front of a simulated body."""
    make_key(folder / "key")
    port = free_port()
    with SimulatedBody.start(BodyOptions(picture="pattern:100001:cr2")) as body, tempfile.TemporaryDirectory() as short:
        (folder / "dappled.toml").write_text(
            f'[camera]\nport = "{body.port}"\n[mavlink]\nurl = "udpin:127.0.0.1:{port}"\nkeys = "key"\n'
            '[record]\ndirectory = "flights"\nmin_free_mb = 0\n[pose]\nwait_ms = 0\n'
            f'[publish]\nslices = "ipc://{short}/s"\nask = "ipc://{short}/a"\n'
        )
        run = ["nice", "-n", str(NICE), sys.executable, "-m", "dappled", "run", "--config", "dappled.toml"]
        with (folder / "stderr").open("w") as errors:
            process = subprocess.Popen(
                run, cwd=folder, stdout=subprocess.DEVNULL, stderr=errors, text=True, start_new_session=True
            )
        with contextlib.suppress(OSError):  # the kernel weighs sessions first; in the unit CPUWeight does that
            Path(f"/proc/{process.pid}/autogroup").write_text(str(NICE), encoding="ascii")
        try:
            yield port
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(60)
            finally:
                process.kill()
    assert process.returncode == 0, (folder / "stderr").read_text()


def signed(peer: Peer, key: bytes) -> None:
    peer.packer.signing.secret_key, peer.packer.signing.sign_outgoing = key, True
    peer.packer.signing.timestamp = round((time.time() - EPOCH_UNIX_S) * UNITS_PER_S)


def recorded(peer: Peer) -> list[bytes]:
    """Genuine packets, sent here: heartbeats until the camera is heard, and some commands."""
    sent: list[bytes] = []
    deadline = time.monotonic() + 60
    while peer.count("HEARTBEAT") == 0:
        assert time.monotonic() < deadline
        sent.append(peer.packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))
        peer.raw(sent[-1])
        with contextlib.suppress(AssertionError, ConnectionRefusedError):  # it is not there yet
            peer.until(lambda message: message.get_type() == "HEARTBEAT", "the camera", 0.5)
    for number in range(10):
        sent.append(peer.packed(mavlink.MAVLink_command_long_message(1, 100, 512, 0, 262, 0, 0, 0, number, 0, 0)))
        peer.raw(sent[-1])
        peer.ack(512)
    return sent


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize(
    ("seconds", "a_second", "timed"),
    [(5, 1000, False), pytest.param(200, 5000, True, marks=[pytest.mark.long, pytest.mark.timeout(400)])],
)
def test_strangers_cost_a_signed_station_no_message_and_no_disk(
    tmp_path: Path, seconds: int, a_second: int, timed: bool
) -> None:
    with daemon(tmp_path) as port, Peer(port) as station:
        signed(station, read_key(tmp_path / "key"))
        (tmp_path / "recorded").write_text("\n".join(raw.hex() for raw in recorded(station)))
        program = [sys.executable, "-m", "tests.drivers.mavlink.strangers", str(port), str(tmp_path / "recorded")]
        flood = subprocess.Popen(
            ["nice", "-n", "10", *program, str(a_second), str(seconds + WARM_UP_S)],  # noqa: S607  # where PATH has it
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        log = next((tmp_path / "flights").glob("*/telemetry.tlog"))
        try:
            time.sleep(WARM_UP_S)  # it has made its datagrams, and sends
            before, began, waits = log.stat().st_size, time.monotonic(), list[float]()
            photographs = 0
            while time.monotonic() - began < seconds:
                asked = time.monotonic()
                if len(waits) % 20 == 0:
                    photographs += 1
                    station.heartbeat()
                    station.command(2000, 0, 0, 1, photographs)
                    assert station.ack(2000) == mavlink.MAV_RESULT_ACCEPTED
                else:
                    station.command(512, 262)
                    assert station.ack(512) == mavlink.MAV_RESULT_ACCEPTED
                waits.append(1e3 * (time.monotonic() - asked))
                time.sleep(EACH_S)
            minutes = (time.monotonic() - began) / 60
            grown = log.stat().st_size - before
            while station.count("CAMERA_IMAGE_CAPTURED") < photographs:
                station.one("CAMERA_IMAGE_CAPTURED")
            sent = int(flood.communicate(timeout=60)[0])
        finally:
            flood.kill()
            flood.wait()
        waits.sort()
        usual = waits[-1 - len(waits) // 20]
        print(  # noqa: T201  for people who run with -s
            f"{sent / (seconds + WARM_UP_S):.0f} datagrams a second: acknowledgements {waits[len(waits) // 2]:.1f} ms, "
            f"95 % within {usual:.1f}, 99 % within {waits[-1 - len(waits) // 100]:.1f}, "
            f"the slowest of {len(waits)} {waits[-1]:.1f}; "
            f"{grown / minutes / 1e6:.2f} MB a minute"
        )
        assert sent > a_second * seconds / (2 if timed else 20), "the flood was none"
        assert grown / minutes <= BYTES_A_MINUTE
        if timed:
            assert waits[-1] <= LATE_MS
            assert usual <= ACK_MS
        ended = [message for message in station.heard if message.get_type() == "CAMERA_IMAGE_CAPTURED"]
        assert [message.capture_result for message in ended] == [1] * photographs
