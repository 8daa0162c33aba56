"""A daemon dies while a safe frame waits for its pose: `dappled geotag` tags the frame, and a replay agrees."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.clock import TimeOfDayClock
from dappled.config import settings as configuration
from dappled.config.settings import MavlinkSettings, PoseSettings, PublishSettings, RecordSettings, Settings
from dappled.daemon import service as module
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.service import Service
from dappled.drivers.mavlink import mavlink
from dappled.flight import FlightsLock, LedgerReader, TimeSource, layout, recovery
from dappled.flight.checks import flight_check
from tests.daemon.camera_protocol.rig import Peer
from tests.daemon.fakes import CallingObserver, FakeCamera
from tests.waiting import eventually


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Settings]:
    monkeypatch.setattr(module, "open_camera", lambda _: FakeCamera())
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:
        yield configuration.resolve(
            Settings(
                mavlink=MavlinkSettings(url=("udpin:127.0.0.1:0",)),
                record=RecordSettings(directory=str(tmp_path / "flights"), min_free_mb=0),
                pose=PoseSettings(10_000.0),  # the wait for a later position that the kill falls into
                publish=PublishSettings(slices=f"ipc://{sockets}/s"),
            )
        )


@pytest.fixture
def killed(settings: Settings, tmp_path: Path) -> Path:
    """What stands on the disk when a daemon is killed: one frame tagged, one safe and waiting for its pose."""
    shots: list[PendingShot] = []
    service = Service(settings, observer=CallingObserver(finished=shots.append))
    service.start()
    loop = threading.Thread(target=service.run)
    loop.start()
    boot_ms = 1000
    left = tmp_path / "left" / service.folder.name
    with Peer(service.parts.links.port(0), 1, 1) as autopilot:

        def heard(until: object) -> bool:
            nonlocal boot_ms
            boot_ms += 20
            autopilot.heartbeat()
            autopilot.send(
                mavlink.MAVLink_global_position_int_message(
                    boot_ms, 47 * 10**7, 8 * 10**7, 500_000, 100_000, 0, 0, 0, 0
                )
            )
            return bool(until)

        try:
            eventually(lambda: heard(service.parts.component.vehicle), "whose camera this is")
            eventually(lambda: heard(service.health()["vehicle"]), "a position")
            service.request(CaptureRequest("test", "console", 1))
            eventually(lambda: heard(shots), "the first shot's end")
            service.request(CaptureRequest("test", "console", 2))
            eventually(lambda: _safe(service.folder) == 2, "the second frame is safe")
            assert len(shots) == 1
            shutil.copytree(service.folder, left)
            eventually(lambda: heard(len(shots) == 2), "the second shot's end")
        finally:
            service.ask_to_stop()
            loop.join(60)
            service.stop()
    return left


def _safe(flight: Path) -> int:
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        return len(ledger.frames())


def tags(flight: Path) -> list[int]:
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        return sorted(ledger.tags())


def test_a_frame_that_a_kill_left_untagged_is_tagged_by_geotag(
    killed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recovery.recover_flight(layout.open_folder(killed), TimeOfDayClock())
    assert tags(killed) == [0]
    assert main(["geotag", str(killed), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["tagged_late"], told["without_tag"], told["placed"]) == ([1], [], 2)
    with LedgerReader.open(killed / "flight.sqlite") as ledger:
        late = ledger.tag(1)
        assert {event.kind for event in ledger.events() if event.index == 1} >= {"tagged late", "unreadable"}
    assert late is not None
    assert math.degrees(late.pose.latitude_rad or 0) == pytest.approx(47)
    assert late.time_source == TimeSource.TRIGGER_CALL
    assert flight_check.check(killed).problems == ()
    assert main(["replay", str(killed), "--verify"]) == 0
    assert main(["geotag", str(killed), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.partition("\n{")[2].join(("{", "")))["tagged_late"] == []


def test_without_the_ledger_s_times_the_wish_s_time_stands(killed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for suffix in ("-wal", "-shm"):
        (killed / f"flight.sqlite{suffix}").unlink(missing_ok=True)
    (killed / "flight.sqlite").write_bytes(b"rotten" * 1000)
    recovery.recover_flight(layout.open_folder(killed), TimeOfDayClock())
    assert tags(killed) == []
    assert main(["geotag", str(killed)]) == 0
    assert "tagged 2 frames that the recording had left without a tag" in capsys.readouterr().err
    with LedgerReader.open(killed / "flight.sqlite") as ledger:
        assert {tag.time_source for tag in ledger.tags().values()} == {TimeSource.REQUEST}
    assert main(["replay", str(killed), "--verify"]) == 0


def test_while_a_daemon_records_there_nothing_is_written_into_a_flight(
    killed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recovery.recover_flight(layout.open_folder(killed), TimeOfDayClock())
    before = sorted(killed.rglob("*"))
    with FlightsLock(killed.parent):
        assert main(["geotag", str(killed)]) == 1
        (said,) = capsys.readouterr().err.splitlines()  # once
        assert "stop it, or work on a copy of the flight" in said
        assert main(["geotag", str(killed), "--output", str(killed.parent / "elsewhere")]) == 0
    assert "frames without a tag stay without one: another dappled" in capsys.readouterr().err
    assert tags(killed) == [0]
    assert sorted(killed.rglob("*")) == before
