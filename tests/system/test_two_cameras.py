"""Two cameras on one vehicle: a daemon each, as `dappled@left` and `dappled@right`, with one autopilot between them."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main, status
from dappled.errors import DappledError
from dappled.flight import LedgerReader, flight_report
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import free_port
from tests.daemon.camera_protocol.rig import Peer
from tests.simulated.vehicle import VehicleProcess
from tests.standing import codes
from tests.waiting import eventually

BYTES = {"left": 50_000, "right": 60_000}  # so that a frame shows which body it is of


def settings_of(folder: Path, name: str) -> Path:
    """The settings of a camera's daemon, as in /etc/dappled."""
    return folder / "dappled" / f"{name}.toml"


@contextmanager
def serving(
    name: str, component: int, folder: Path, runtime: Path, autopilot: int
) -> Iterator[subprocess.Popen[bytes]]:
    """`dappled run` as the unit of this name runs it, with a body of its own, from the end of the block ended."""
    with SimulatedBody.start(BodyOptions(picture=f"pattern:{BYTES[name]}:CR2", serial=name)) as body:
        (home := folder / f"dappled-{name}").mkdir()
        settings_of(folder, name).write_text(
            f'[camera]\nport = "{body.port}"\n[record]\nmin_free_mb = 0\ndirectory = "{home}/flights"\n'
            f'[pose]\nwait_ms = 0\n[mavlink]\nurl = "udpin:127.0.0.1:{autopilot}"\ncomponent_id = {component}\n'
        )
        runtime.mkdir(mode=0o700)
        of_unit = {"HOME": str(home), "RUNTIME_DIRECTORY": str(runtime)}
        daemon = subprocess.Popen(
            [sys.executable, "-m", "dappled", "run", "--config", str(settings_of(folder, name))],
            env=os.environ | of_unit,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield daemon
        finally:
            daemon.kill()
            daemon.wait()


def frames(folder: Path, name: str) -> list[int]:
    """The sizes of the frames that this camera's daemon made safe."""
    ledgers = [*(folder / f"dappled-{name}" / "flights").glob("*/flight.sqlite")]
    if not ledgers:
        return []
    with LedgerReader.open(ledgers[0]) as ledger:
        return [frame.size for frame in ledger.frames()]


@pytest.mark.slow
def test_each_trigger_is_one_frame_of_the_camera_that_it_is_for(
    tmp_path: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(status, "SERVICE_FOLDER", sockets / "dappled")
    (tmp_path / "dappled").mkdir()

    def says(*words: str) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        code = main([*words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    ports = {name: free_port(socket.SOCK_DGRAM) for name in ("left", "right", "ground")}
    urls = [f"--url=udpout:127.0.0.1:{ports[name]}" for name in BYTES] + [f"--url=udpin:127.0.0.1:{ports['ground']}"]
    autopilot = [*VehicleProcess.COMMAND, *urls]
    with ExitStack() as stack:
        daemons = [
            stack.enter_context(serving(name, 100 + number, tmp_path, sockets / f"dappled-{name}", ports[name]))
            for number, name in enumerate(BYTES)
        ]
        vehicle = subprocess.Popen([*autopilot, "--camera=mavlink", "--camera=mavlink"], stdin=subprocess.PIPE)
        stack.callback(vehicle.communicate)  # closes its standard input, which ends it
        with Peer(ports["ground"]) as station:
            asked = dict.fromkeys(BYTES, 0)

            def photograph(camera: int, *names: str) -> None:
                """The autopilot is asked to trigger this camera; 0: all."""
                station.command(2000, camera, 0, 1, 0, target=(1, 1))
                for name in names:
                    asked[name] += 1
                eventually(
                    lambda: all(len(frames(tmp_path, name)) >= asked[name] for name in BYTES),
                    f"frames {asked}: {[frames(tmp_path, name) for name in BYTES]}",
                    60,
                )

            eventually(
                lambda: all(is_ready(settings_of(tmp_path, name)) for name in BYTES), "both cameras are ready", 60
            )
            for camera, names in ((1, ["left"]), (2, ["right"]), (2, ["right"]), (0, ["left", "right"]), (1, ["left"])):
                photograph(camera, *names)
        for name in BYTES:
            file = str(settings_of(tmp_path, name))
            _, record = says("status", "--config", file)
            assert Path(record["disk"]["folder"]).parent == tmp_path / f"dappled-{name}" / "flights"
            assert record["shots"]["safe"] == asked[name]
            _, judged = says("doctor", "--config", file)
            assert judged["flight"] == record["flight"]
            assert not [one for one in judged["checks"] if one["subject"]["kind"] == "settings"]
        for daemon in daemons:
            daemon.send_signal(signal.SIGTERM)
        assert [daemon.wait(60) for daemon in daemons] == [0, 0]
    for name, size in BYTES.items():
        assert frames(tmp_path, name) == [size] * asked[name]
        (flight,) = (path.parent for path in (tmp_path / f"dappled-{name}" / "flights").glob("*/flight.sqlite"))
        balance = flight_report.balance(flight)
        assert balance.balanced
        assert balance.by_source == {"mavlink:1/1": 3}
        code, report = says("flight", "report", "--config", str(settings_of(tmp_path, name)))
        assert (code, report["flight"]) == (0, flight.name)


def is_ready(settings: Path) -> bool:
    """Whether the daemon with these settings says that its camera is ready and its autopilot is heard."""
    try:
        record = status.health(status.stream_endpoint(settings), 5)
    except DappledError:
        return False
    return record["camera"]["state"] == "ready" and not any(code.startswith("link.") for code in codes(record))
