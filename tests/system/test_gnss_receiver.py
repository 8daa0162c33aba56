"""A u-blox receiver on a serial port: its marks time the frames of a flight, and its stream comes out of it for PPK."""

from __future__ import annotations

import json
import os
import pty
import time
import tty
from contextlib import ExitStack
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.drivers.gnss import recorded
from dappled.flight import LedgerReader, TimeSource, log_reading
from dappled.mocks.simulation import Simulation, World
from dappled.workers import Loop
from tests.drivers.gnss.test_ubx import NEW_FALLING, UTC_BASE, VALID, mark, message
from tests.needs import without
from tests.standing import codes
from tests.system.conftest import dappled
from tests.system.flying import flying, settings_of
from tests.waiting import eventually

FRAMES = 3
GPS_EPOCH_S, WEEK_S = 315_964_800, 604_800


class Receiver:
    """Sends raw measurements, and a mark for each time that the simulated body has exposed."""

    def __init__(self, descriptor: int, truth: Path, start_monotonic_ns: int) -> None:
        self._descriptor, self._truth = descriptor, truth
        self._start_utc_ns = start_monotonic_ns + time.time_ns() - time.monotonic_ns()
        self.sent = b""
        self.loop = Loop("receiver", self._run)
        self.loop.start()

    def _run(self) -> None:
        told: set[str] = set()
        while not self.loop.stopping.wait(0.05):
            self._send(message((0x02, 0x15), os.urandom(400)))
            for path in sorted(self._truth.glob("*.json")):
                if path.name in told:
                    continue
                try:
                    times = json.loads(path.read_text())
                except ValueError:
                    continue  # it is still written
                told.add(path.name)
                self._mark(self._start_utc_ns + round((times["trigger_t_s"] + times["latency_s"]) * 1e9))

    def _mark(self, utc_ns: int) -> None:
        week, second = divmod(utc_ns // 10**9 - GPS_EPOCH_S, WEEK_S)
        ns = utc_ns % 10**9
        edge = (week, second * 1000 + ns // 10**6, ns % 10**6)
        self._send(message((0x0D, 0x03), mark(NEW_FALLING | VALID | UTC_BASE, rising=(0, 0, 0), falling=edge)))

    def _send(self, data: bytes) -> None:
        os.write(self._descriptor, data)
        self.sent += data


def recorded_bytes(flight: Path) -> int:
    packets = (packet for _, _, packet in log_reading.read_telemetry(flight / "telemetry.tlog"))
    return sum(map(len, recorded.stream(packets)))


@pytest.mark.alone
@pytest.mark.long
def test_marks_time_the_frames_and_the_stream_comes_out_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The body's latency is 60 ± 15 ms, and nothing but the receiver can tell by how much."""
    truth = tmp_path / "truth"
    truth.mkdir()
    try:
        near, far = pty.openpty()
    except OSError as error:
        without(f"there are no pseudo terminals here ({error}): mount devpts at /dev/pts")
    tty.setraw(far)
    settings = settings_of(tmp_path, gnss={"port": os.ttyname(far)}, pose={"wait_ms": 5000}, decode={"enabled": False})
    simulation = Simulation(World(seed=8, truth=truth), settings, tmp_path)
    with ExitStack() as stack:
        stack.callback(os.close, near)
        stack.callback(os.close, far)
        simulated = stack.enter_context(simulation)
        receiver = Receiver(near, truth, simulation.start_monotonic_ns)
        stack.callback(receiver.loop.stop, 5.0)
        with flying(simulated) as daemon:
            daemon.until_ready()
            eventually(
                lambda: daemon.service.parts.navigation.telemetry.utc_correction() is not None, "the autopilot's UTC"
            )
            for _ in range(1 + FRAMES):  # that marks come is known with the first one
                daemon.shoot()
            folder = daemon.service.folder
            assert not [code for code in codes(daemon.service.health()) if code.startswith("gnss.")]
            receiver.loop.stop(5.0)
            eventually(lambda: recorded_bytes(folder) == len(receiver.sent), "every byte is in the log")
    with LedgerReader.open(folder / "flight.sqlite") as ledger:
        tags = ledger.tags()
    start_utc_ns = receiver._start_utc_ns
    for index, path in list(enumerate(sorted(truth.glob("*.json"))))[1:]:
        exposed_ns = start_utc_ns + round(json.loads(path.read_text())["mid_exposure_t_s"] * 1e9)
        assert tags[index].time_source == TimeSource.RECEIVER_MARK
        assert abs(tags[index].utc_ns - exposed_ns) < 4 * 10**6
        assert tags[index].utc_sigma_ns < 10**7  # without the mark it is more than the body's 15 ms
        assert abs(tags[index].utc_ns - exposed_ns) < 2 * tags[index].utc_sigma_ns
    output = tmp_path / "rover.ubx"
    assert main(["flight", "gnss", str(folder), "-o", str(output)]) == 0
    assert output.read_bytes() == receiver.sent
    said = capsys.readouterr().out
    assert f"{1 + FRAMES} of time marks" in said
    assert "in doubt" not in said
    assert main(["flight", "gnss", str(folder), "-o", str(output)]) != 0
    verified = dappled("replay", str(folder), "--verify", timeout_s=150)
    assert verified.returncode == 0, verified.stderr


def test_a_flight_without_a_receiver_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with flying(settings_of(tmp_path)) as daemon:
        folder = daemon.service.folder
        eventually(lambda: daemon.camera == "absent" or daemon.problems, "it runs")
        (folder / "keep").touch()
    assert main(["flight", "gnss", str(folder), "-o", str(tmp_path / "rover.ubx")]) == 1
    assert "name its port in gnss.port" in capsys.readouterr().err
    assert not (tmp_path / "rover.ubx").exists()
