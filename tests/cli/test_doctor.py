"""`dappled doctor` as a person calls it."""

from __future__ import annotations

import json
import os
import pwd
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from dappled import codec
from dappled.cli import main
from dappled.config import settings as configuration
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers import usb_bus
from dappled.drivers.usb_bus import CANON, UsbBody
from dappled.findings import Code, Subject, finding
from tests.daemon.health.test_go_no_go import WELL as FACTS
from tests.system.conftest import dappled

ABSENT = codec.plain(finding(Code.CAMERA_ABSENT, Subject("camera"), reason="no body")) | {"age_s": 0.0}
WELL = {**FACTS, "camera": {"state": "ready", "reason": ""}, "findings": []}


def test_on_a_machine_without_any_camera_it_ends_with_what_to_do_next(capfd: pytest.CaptureFixture[str]) -> None:
    if usb_bus.bodies():
        pytest.skip("there is a camera on this machine")
    assert main(["doctor"]) == 1
    out = capfd.readouterr().out.splitlines()
    assert len(out) <= 24  # one screen
    assert out[-1].startswith("next: connect the camera")
    assert main(["doctor", "--json"]) == 1
    told = json.loads(capfd.readouterr().out)
    assert told["next"].startswith("connect the camera")
    assert {one["level"] for one in told["checks"]} <= {"note", "caution", "stop"}


def settings(folder: Path, picture: str) -> Path:
    path = folder / "dappled.toml"
    path.write_text(
        f'[camera]\ndriver = "simulated"\n[camera.options]\npicture = "{picture}"\n'
        f'[record]\ndirectory = "{folder}/flights"\n'
    )
    return path


def test_with_a_camera_that_is_ready_it_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--config", str(settings(tmp_path, "pattern:1000:dng"))]) == 0
    assert "--test-shot" in capfd.readouterr().out.splitlines()[-1]
    assert not (tmp_path / "flights").exists()


def test_a_test_shot_that_is_no_picture_is_no_go(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = settings(tmp_path, "pattern:1000:dng")
    assert main(["doctor", "--config", str(path), "--test-shot", "--keep", str(tmp_path / "kept")]) == 1
    out = capfd.readouterr().out
    assert out.splitlines()[-1] == "NO GO"
    assert "it can't be read as a picture" in out
    assert len(list((tmp_path / "kept").rglob("frames/*.dng"))) == 1


def test_a_camera_that_can_t_be_had_is_not_fired(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "dappled.toml"
    path.write_text('[camera]\nport = "usb:099,099"\n')
    assert main(["doctor", "--config", str(path), "--latency", "3"]) == 1
    out = capfd.readouterr().out
    assert "NO GO    camera" in out
    assert "no shot was fired" in out


def test_latency_is_measured_without_a_hot_shoe_as_far_as_it_can_be(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--config", str(settings(tmp_path, "pattern:1000:dng")), "--latency", "2", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)["latency"]
    assert told["to_exposure"] is None
    for name in ("wish_to_trigger", "trigger_call", "to_file", "recorded"):
        assert told[name]["shots"] == 2
        assert told[name]["low"] <= told[name]["median"] <= told[name]["high"]


def test_bodies_that_come_and_go_are_told(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    body = UsbBody(1, 5, CANON, 0x3145, "PTP", "EOS 450D")
    looks = iter([[], [body], [body], []])

    def bodies() -> list[UsbBody]:
        try:
            return next(looks)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(
        "dappled.cli.doctor.time.sleep", lambda seconds: None
    )  # first: it imports what is replaced next
    monkeypatch.setattr(usb_bus, "bodies", bodies)
    assert main(["doctor", "--watch"]) == 130
    assert [line.split("  ")[0] for line in capfd.readouterr().out.splitlines()] == ["here", "gone"]


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Callable[[dict[str, Any]], Path]]:
    """A daemon as far as its health is heard; gives settings that lead to it."""
    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, f"ipc://{tmp_path}/a", high_water_mark=8)
    publisher.start("20261121T101503Z-1a2b3c4d", lambda _request, _reply: None)
    ended = threading.Event()
    speakers: list[threading.Thread] = []

    def say(health: dict[str, Any]) -> None:
        while not ended.wait(0.02):
            publisher.publish("health", health)

    def begin(health: dict[str, Any]) -> Path:
        speakers.append(threading.Thread(target=say, args=[health]))
        speakers[-1].start()
        config = tmp_path / "dappled.toml"
        config.write_text(f'[publish]\nslices = "{endpoint}"\n', encoding="utf-8")
        return config

    yield begin
    ended.set()
    for speaker in speakers:
        speaker.join()
    publisher.stop()


def test_beside_a_running_daemon_it_asks_that_one(
    running: Callable[[dict[str, Any]], Path], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dappled.cli.doctor.HEAR_S", 60.0)
    config = str(running(WELL))
    assert main(["doctor", "--config", config]) == 0
    out = capfd.readouterr().out.splitlines()
    assert out[0] == "a daemon runs here, flight 20261121T101503Z-1a2b3c4d; it reports"
    assert out[-2].startswith("caution  settings    ")  # there is no flight.toml to compare with
    assert out[-1] == "GO, with the cautions above"
    assert main(["doctor", "--config", config, "--test-shot"]) == 1
    assert "holds the camera: stop it first" in capfd.readouterr().err


def test_a_running_daemon_without_a_camera_is_no_go(
    running: Callable[[dict[str, Any]], Path], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dappled.cli.doctor.HEAR_S", 60.0)
    config = str(running(WELL | {"camera": {"state": "absent", "reason": "no body"}, "findings": [ABSENT]}))
    assert main(["doctor", "--config", config, "--json"]) == 1
    told = json.loads(capfd.readouterr().out)
    assert told["verdict"] == "no-go"
    first = told["checks"][0]
    assert (first["code"], first["level"], first["facts"]) == ("camera.absent", "stop", {"reason": "no body"})
    assert told["next"]


@pytest.fixture
def flown(
    running: Callable[[dict[str, Any]], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Path, dict[str, Any]]:
    """The settings file of a running daemon, and the settings that its flight.toml is to hold."""
    monkeypatch.setattr("dappled.cli.doctor.HEAR_S", 60.0)
    config = running(WELL | {"disk": WELL["disk"] | {"folder": str(tmp_path)}})
    return config, configuration.to_tables(configuration.load(config))


def test_a_file_that_the_daemon_was_not_started_with_is_told_by_its_differences(
    flown: tuple[Path, dict[str, Any]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config, recorded = flown
    recorded["record"]["min_free_mb"] = 4  # when it began; the health record says what it is now
    (tmp_path / "flight.toml").write_text(tomli_w.dumps({"settings": recorded}))
    assert main(["doctor", "--config", str(config)]) == 0
    assert "settings" not in capfd.readouterr().out
    config.write_text(config.read_text() + '[mask]\nprofile = "mask-2"\n[camera]\nmax_pending = 3\n')
    assert main(["doctor", "--config", str(config)]) == 1
    out = capfd.readouterr().out.splitlines()
    assert [line for line in out if "settings" in line.split()[:3]] == [
        f"NO GO    settings    camera.max_pending is 3 in {config}, the daemon has 2",
        f'NO GO    settings    mask.profile is "mask-2" in {config}, the daemon has ""',
    ]
    assert out[-1].startswith("NO GO; next: restart the daemon with this file")  # not "GO" under lines of NO GO


def test_a_daemon_that_simulates_is_a_caution_not_a_list_of_differences(
    flown: tuple[Path, dict[str, Any]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config, recorded = flown
    recorded["camera"] |= {"port": "ptpip:127.0.0.1:9:9", "profile": "canon-eos-450d"}
    recorded["record"]["min_free_mb"] = 4
    (tmp_path / "flight.toml").write_text(tomli_w.dumps({"settings": recorded, "camera": {"serial": "SIM00000001"}}))
    assert main(["doctor", "--config", str(config)]) == 0
    out = capfd.readouterr().out.splitlines()
    assert [line for line in out if "settings" in line] == [
        f"caution  settings    the daemon simulates: camera and calibration of {config} are not in use"
    ]
    assert out[-1] == "GO, with the cautions above"
    config.write_text(config.read_text() + '[record]\ndirectory = "elsewhere"\n')
    assert main(["doctor", "--config", str(config)]) == 1  # what a simulation leaves as it is still counts
    assert "record.directory is" in capfd.readouterr().out


def test_another_user_s_daemon_is_not_reported_as_one_s_own(
    running: Callable[[dict[str, Any]], Path], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dappled.cli.doctor.HEAR_S", 60.0)
    config = str(running(WELL))
    monkeypatch.setattr("dappled.cli.status.os.getuid", lambda: 4711)  # the daemon's is this process' own
    assert main(["doctor", "--config", config]) == 0
    who = pwd.getpwuid(os.geteuid()).pw_name
    assert capfd.readouterr().out.startswith(f"not your own daemon but that of user {who} runs here, flight 2026")


@pytest.mark.slow
@pytest.mark.alone
def test_the_simulated_camera_is_go_and_its_latency_is_what_the_simulation_knows() -> None:
    done = dappled("doctor", "--simulate", "--test-shot", "--latency", "4", "--json", timeout_s=110)
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(done.stdout)
    assert told["verdict"] == "go"
    assert {one["subject"]["kind"] for one in told["test_shot"]} == {
        "focal length",
        "exposure",
        "carriers",
        "focus",
        "motion",
    }
    latency = told["latency"]
    assert latency["to_exposure"]["shots"] >= 2
    assert all(45 <= true_ms <= 75 for true_ms in latency["truth_ms"])
    assert latency["worst_error_ms"] < 45  # of times of 45 to 75
    assert latency["to_file"]["low"] > latency["to_exposure"]["high"]
