"""`dappled run` in this very process, in front of a camera that needs no rendering."""

from __future__ import annotations

import configparser
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.cli import run as verb
from dappled.cli.command_line import parser
from dappled.config import settings as configuration
from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome
from dappled.daemon.grounded import answer_meanwhile
from dappled.drivers.mavlink import make_key
from dappled.errors import DappledError
from dappled.flight import FlightsLock, LedgerReader, flight_report
from dappled.mocks.autopilot.autopilot import Autopilot
from dappled.mocks.simulation import free_port
from tests.system.conftest import dappled, tells_of_no_problem
from tests.waiting import eventually

HELD_UP = 0.2  # of the objects of the process may be looked at while it flies
LONG_S = "120"  # a bound, never waited for


class Ground(threading.Thread):
    """A ground station that asks for frames as soon as it hears the camera; then `after`."""

    def __init__(self, port: int, after: Callable[[], None] = lambda: None, frames: int = 1) -> None:
        super().__init__(daemon=True)
        self._frames = frames
        self._url, self._after = f"udpout:127.0.0.1:{port}", after
        self.outcomes: list[Outcome] = []

    def run(self) -> None:
        with GroundClient(self._url) as client:
            client.find_camera(60.0)
            self.outcomes = client.capture(self._frames, 0.0, timeout_s=60.0, on_outcome=lambda _: None)
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


def test_in_flight_who_computes_gives_way_to_who_acknowledges(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's own 5 ms count for each call of the system on the way to an answer."""
    found, before = [], sys.getswitchinterval()
    monkeypatch.setattr(verb, "flights", lambda _settings, _fly: found.append(sys.getswitchinterval()))
    main(["run", "--config", str(config)])
    assert [one <= 0.001 for one in found] == [True]
    assert sys.getswitchinterval() == before


def test_what_is_loaded_before_a_flight_is_not_looked_at_for_cycles_in_flight(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A collection of everything takes 60 ms, in which no command is answered."""
    shares = []

    def fly(_settings: object, _fly: object) -> None:
        shares.append(len(gc.get_objects()) / gc.get_freeze_count())

    monkeypatch.setattr(verb, "flights", fly)
    main(["run", "--config", str(config)])
    assert gc.get_freeze_count() == 0
    assert [share <= HELD_UP for share in shares] == [True]


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
    assert [one for one in (tmp_path / "flights").rglob("*") if one.stat().st_mode & 0o007] == []


def test_frames_that_could_not_be_decoded_are_said_and_a_run_ends_regularly_with_all_of_them_safe(
    config: Path, port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    masked = '[camera]\nprofile = "reference-36mm"\n'
    text = config.read_text().replace("[decode]\nenabled = false\n", '[mask]\nprofile = "reference-5x5"\n')
    config.write_text(text.replace("[camera]\n", masked))
    ground = Ground(port, frames=3)
    ground.start()
    assert main(["run", "--config", str(config), "--frames", "3", "--for", LONG_S]) == 0
    ground.join(60)
    assert capsys.readouterr().err.splitlines()[-1] == "3 shots: 3 frames safe, 0 decoded, 3 with a problem"
    (flight,) = flight_report.list_flights(tmp_path / "flights")
    assert flight.balance is not None
    assert flight.balance.balanced


@pytest.mark.long
def test_a_run_beside_loaded_cores_tells_of_no_problem(tmp_path: Path) -> None:
    load = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        done = dappled("run", "--simulate", "--frames", "4", "--for", "300", cwd=tmp_path, timeout_s=360)
    finally:
        for one in load:
            one.kill()
            one.wait()
    assert done.returncode == 0, done.stderr
    tells_of_no_problem(done.stdout, done.stderr, 4)


def test_time_that_runs_out_before_the_frames_is_a_failure(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--config", str(config), "--frames", "1", "--for", "0"]) == 1
    assert "0 shots" in capsys.readouterr().err


@pytest.mark.slow
def test_a_flight_without_a_mask_loads_nothing_that_decodes(config: Path) -> None:
    """It takes a small computer seconds, in which there is no camera."""
    code = f"import sys; from dappled.cli import main; main(['run', '--config', {str(config)!r}, '--for', '0'])"
    done = subprocess.run(
        [sys.executable, "-c", code + "; print(*sys.modules)"], capture_output=True, text=True, timeout=100, check=True
    )
    assert not {"scipy", "dappled.drivers.raw.darkroom"} & set(done.stdout.split())


def _grounded(config: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The reasons that a service of these settings answers on its links with, until it is ended."""
    reasons: list[str] = []

    def answer(_settings: object, reason: str, _until: object) -> None:
        reasons.append(reason)
        raise DappledError("it was ended")

    monkeypatch.setenv("NOTIFY_SOCKET", "@dappled-nobody-listens")
    monkeypatch.setattr(verb, "answer_meanwhile", answer)
    assert main(["run", "--config", str(config), "--for", "0"]) == 1
    return reasons


def test_a_service_waits_for_work_in_its_flights_and_leaves_the_links_to_who_records_there(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two cameras at one address the second would refuse what the first one takes."""
    with FlightsLock(tmp_path / "flights"):
        assert _grounded(config, monkeypatch) == []
    with FlightsLock(tmp_path / "flights", "geotags flights in"):
        assert [" geotags flights in " in one for one in _grounded(config, monkeypatch)] == [True]


def test_a_service_whose_signing_times_can_t_be_kept_answers_too(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are beside the flights. Where the root is read-only, /tmp is no place for others."""
    make_key(tmp_path / "link.key")
    (tmp_path / "flights").symlink_to("/proc/there-is-none")
    text = config.read_text().replace("[mavlink]\n", f'[mavlink]\nkeys = "{tmp_path}/link.key"\n')
    config.write_text(text)
    assert len(_grounded(config, monkeypatch)) == 1
    monkeypatch.setattr(tempfile, "tempdir", "/proc/there-is-none")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    answer_meanwhile(configuration.load(config), "the disk is gone", lambda: True)


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


@pytest.mark.parametrize(("words", "what"), [([], None), (["--simulate"], "all"), (["--simulate", "camera"], "camera")])
def test_a_bare_simulate_simulates_all(words: list[str], what: str | None) -> None:
    assert parser("run").parse_args(["run", *words]).simulate == what


def test_a_simulated_camera_without_a_link_to_an_autopilot_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "dappled.toml"
    file.write_text("")
    assert main(["run", "--simulate", "camera", "--config", str(file)]) == 2
    assert "set [mavlink] url in --config FILE" in capsys.readouterr().err
    with pytest.raises(SystemExit) as wrong:
        main(["run", "--simulate", "autopilot"])
    assert wrong.value.code == 2


@pytest.mark.long
def test_a_simulated_camera_flies_with_the_autopilot_that_the_settings_lead_to(
    tmp_path: Path, port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another process stands for ArduPilot in software in the loop. How well it knows its attitude is not known."""
    file = tmp_path / "dappled.toml"
    file.write_text(
        f'[record]\ndirectory = "{tmp_path}/flights"\nmin_free_mb = 0\n[publish]\nslices = "ipc://{tmp_path}/s"\n'
        f'[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n'
    )
    autopilot = Autopilot.start(f"udpout:127.0.0.1:{port}", seed=3, start_monotonic_ns=time.monotonic_ns())
    try:
        assert main(["run", "--simulate", "camera", "--config", str(file), "--frames", "2", "--for", LONG_S]) == 0
    finally:
        autopilot.stop()
    assert "simulating a masked camera and a ground station" in capsys.readouterr().err
    (folder,) = (path for path in (tmp_path / "flights").iterdir() if path.is_dir())
    with LedgerReader.open(folder / "flight.sqlite") as ledger:
        poses = list(ledger.poses().values())
    assert [pose.source for pose in poses] == ["interpolated"] * 2
    assert [pose.attitude_sigma_rad for pose in poses] == [None, None]


def restarted(code: int) -> bool:
    """Whether systemd starts the service again after this exit code, by the rules as they are written in its unit."""
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(Path(__file__).parents[2] / "systemd" / "dappled.service", encoding="utf-8")
    rules = unit["Service"]
    assert rules["Restart"] == "on-failure"
    fine = {0, *map(int, rules["SuccessExitStatus"].split())}
    return code not in fine | set(map(int, rules["RestartPreventExitStatus"].split()))


def test_a_regular_end_is_not_restarted_whatever_its_cautions_and_a_wrong_configuration_neither(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not restarted(main(["run", "--config", str(config), "--for", "0"]))
    assert "caution: " in capsys.readouterr().err  # nobody is heard, and nothing is decoded
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[camera]\ndrivr = 1\n")
    assert not restarted(main(["run", "--config", str(wrong)]))
    assert restarted(1)
