"""`dappled run` in this very process, in front of a camera that needs no rendering."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.cli import run as verb
from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome
from dappled.flight import flight_report
from dappled.mocks.simulation import free_port
from tests.daemon.fakes import eventually

LONG_S = "120"  # a bound, never waited for


class Ground(threading.Thread):
    """A ground station that asks for one frame as soon as it hears the camera; then `after`."""

    def __init__(self, port: int, after: Callable[[], None] = lambda: None) -> None:
        super().__init__(daemon=True)
        self._url, self._after = f"udpout:127.0.0.1:{port}", after
        self.outcomes: list[Outcome] = []

    def run(self) -> None:
        with GroundClient(self._url) as client:
            client.find_camera(60.0)
            self.outcomes = client.capture(1, 0.0, timeout_s=60.0, on_outcome=lambda _: None)
        self._after()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def config(tmp_path: Path, port: int) -> Path:
    path = tmp_path / "dappled.toml"
    path.write_text(
        '[camera]\ndriver = "simulated"\n[camera.options]\npicture = "pattern:100000:dng"\n'
        f'[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n'
        f'[record]\ndirectory = "{tmp_path}/flights"\nmin_free_mb = 0\n'
        f'[publish]\nslices = "ipc://{tmp_path}/s"\n'
        "[decode]\nenabled = false\n[pose]\nwait_ms = 0\n"
    )
    return path


def test_it_ends_when_it_has_its_frames(
    config: Path, port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ground = Ground(port)
    ground.start()
    assert main(["run", "--config", str(config), "--frames", "1", "--for", LONG_S, "--json"]) == 0
    ground.join(60)
    said = capsys.readouterr()
    assert json.loads(said.out)["index"] == 0
    assert said.err.splitlines()[-1] == "1 shot: 1 frame safe, 0 decoded, 0 with a problem"
    (flight,) = flight_report.list_flights(tmp_path / "flights")
    assert f"flight {flight.path}" in said.err
    assert flight.balance is not None
    assert flight.balance.balanced
    assert flight.balance.closed


def test_time_that_runs_out_before_the_frames_is_a_failure(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--config", str(config), "--frames", "1", "--for", "0"]) == 1
    assert "0 shots" in capsys.readouterr().err


@pytest.fixture
def signals() -> Iterator[dict[signal.Signals, object]]:
    """Handlers of our own, so that a signal that comes too late ends nothing but the test."""
    ours = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield {number: signal.getsignal(number) for number in ours}
    for number, before in ours.items():
        signal.signal(number, before)


def test_a_hang_up_reads_the_settings_again_and_a_signal_ends_it(
    config: Path,
    port: int,
    signals: dict[signal.Signals, object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    said: list[str] = []
    monkeypatch.setattr(verb, "remark", lambda text, *_, **__: said.append(text))

    def after() -> None:
        os.kill(os.getpid(), signal.SIGHUP)
        eventually(lambda: any(text.startswith("reload") for text in said), "the settings are read again")
        os.kill(os.getpid(), signal.SIGTERM)

    ground = Ground(port, after)
    ground.start()
    assert main(["run", "--config", str(config), "--for", LONG_S]) == 0
    ground.join(60)
    assert capsys.readouterr().out.startswith("000000  ")
    assert "reload: nothing has changed" in said
    assert {number: signal.getsignal(number) for number in signals} == signals
