"""`dappled status` in front of a stream, and which stream it finds."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dappled import codec
from dappled.cli import main, status
from dappled.cli.status import is_listening, stream_endpoint
from dappled.daemon.health.standing import ALL_IS_WELL
from dappled.daemon.stream.publisher import Publisher
from dappled.errors import DappledError
from dappled.flight.flight_mask import FlightMask
from tests.daemon.health.test_metrics import HEALTH


@pytest.fixture
def stream(tmp_path: Path) -> Iterator[str]:
    """A publisher that says the same health again and again."""
    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, f"ipc://{tmp_path}/a", high_water_mark=8)
    publisher.start("20261121T101503Z-1a2b3c4d", lambda _request, _reply: None)
    ended = threading.Event()

    def say() -> None:
        while not ended.wait(0.02):
            publisher.publish("health", {"utc_ns": 1, **HEALTH})

    speaker = threading.Thread(target=say)
    speaker.start()
    yield endpoint
    ended.set()
    speaker.join()
    publisher.stop()


def test_one_screen_says_how_it_is(stream: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", stream, "--timeout", "20"]) == 0
    said = capsys.readouterr().out
    assert "camera    faulted: it hangs" in said
    assert "udpin:0.0.0.0:14560: 1200 in, 34 out, 2 bad, 0 unsent; signed: 9 good, 3 forged, 1 replayed" in said
    assert "disk      unknown, /x" in said
    assert "shots     8 taken, 7 on disk, 3 refused, 3 lost" in said
    assert "stop      the camera is faulted: it hangs" in said


@pytest.mark.parametrize("there", [True, False])
def test_a_mask_that_fell_out_is_no_go(there: bool) -> None:
    flight = FlightMask()
    for index, nats in enumerate((120.0, -3.0 if there else -16.0)):
        flight.add(index, nats)
    rows = [{**codec.plain(one), "age_s": 0.0} for one in flight.unseen]
    *_, verdict, line = status.screen({"flight": "one", **HEALTH, "findings": rows})
    assert (verdict == ALL_IS_WELL) is there
    word = "note" if there else "caution"
    assert line.startswith(f"{word:9} the mask is seen in 1 of 2 frames, and can't be seen in 1")


def test_the_record_itself_as_json(stream: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", stream, "--timeout", "20", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["flight"] == "20261121T101503Z-1a2b3c4d"
    assert told["shots"] == HEALTH["shots"]


def test_nobody_there_is_said_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", f"ipc://{tmp_path}/nobody", "--timeout", "0.2"]) == 1
    assert "no daemon was heard on" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "service"), [("dappled", "dappled"), ("left", "dappled@left")])
def test_who_is_not_there_is_named(
    name: str, service: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(status, "SERVICE_FOLDER", tmp_path / "run" / "dappled")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    (tmp_path / "dappled").mkdir()
    (file := tmp_path / "dappled" / f"{name}.toml").write_text("", encoding="utf-8")
    assert main(["status", "--config", str(file), "--timeout", "0.2"]) == 1
    assert f"(systemctl status {service})" in capsys.readouterr().err


# --- which daemon is asked when the call names none


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's own runtime folder, empty."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "dappled").mkdir()
    return tmp_path / "dappled"


@contextmanager
def listening(path: Path) -> Iterator[None]:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))
        one.listen()
        yield


def test_without_a_service_it_is_the_user_s_own(own: Path, tmp_path: Path) -> None:
    assert stream_endpoint(None, tmp_path / "no service") == f"ipc://{own}/slices"


def test_a_service_is_found_where_no_daemon_of_the_user_s_own_answers(own: Path, tmp_path: Path) -> None:
    service = tmp_path / "service"
    service.mkdir()
    with listening(own / "slices"):
        assert is_listening(f"ipc://{own}/slices")
        assert stream_endpoint(None, service) == f"ipc://{own}/slices"
    assert not is_listening(f"ipc://{own}/slices")  # what a killed daemon leaves behind
    assert stream_endpoint(None, service) == f"ipc://{service}/slices"


def test_the_settings_of_one_camera_of_several_lead_to_its_own_service(own: Path, tmp_path: Path) -> None:
    """`dappled@left` beside `dappled`: the other one's state would be a wrong answer."""
    service, settings = tmp_path / "run" / "dappled", tmp_path / "etc" / "dappled"
    settings.mkdir(parents=True)
    for name in ("dappled", "left"):
        (settings / f"{name}.toml").write_text("", encoding="utf-8")
    service.mkdir(parents=True)
    assert stream_endpoint(settings / "dappled.toml", service) == f"ipc://{service}/slices"
    assert stream_endpoint(settings / "left.toml", service) == f"ipc://{own}/slices"  # it does not run
    (tmp_path / "run" / "dappled-left").mkdir()
    assert stream_endpoint(settings / "left.toml", service) == f"ipc://{service}-left/slices"
    with listening(own / "slices"):  # of whichever camera
        assert stream_endpoint(settings / "left.toml", service) == f"ipc://{service}-left/slices"


def test_settings_that_name_an_endpoint_are_obeyed(own: Path, tmp_path: Path) -> None:
    (tmp_path / "dappled.toml").write_text('[publish]\nslices = "tcp://127.0.0.1:5555"\n', encoding="utf-8")
    assert stream_endpoint(tmp_path / "dappled.toml", tmp_path) == "tcp://127.0.0.1:5555"
    assert not is_listening("tcp://127.0.0.1:5555")


def test_who_may_not_ask_the_service_is_told_how_to(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may look everywhere
    with pytest.raises(DappledError, match="usermod -aG dappled"):
        stream_endpoint(None, tmp_path)
