"""A FinePix S5200 before the running daemon: fired by a wire or by the autopilot, its files brought after landing."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main
from dappled.drivers.gphoto2 import client
from dappled.drivers.mavlink import mavlink
from dappled.drivers.wired import shutter_line
from dappled.flight import LedgerReader, flight_report
from dappled.flight.checks import flight_check
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.mocks.simulation import free_port
from dappled.testing import content, until_shot_ends, until_state
from tests.simulated.finepix import FinePix
from tests.standing import problems, words
from tests.system.flying import Flying, flying, settings_of
from tests.waiting import eventually

Wrong = tuple[list[str], str]


@pytest.fixture
def here(sockets: Path, tmp_path: Path) -> Path:
    """A folder of this test's own whose name is short enough for sockets."""
    folder = sockets / tmp_path.name[-12:]
    folder.mkdir()
    return folder


@pytest.fixture
def body(tmp_path: Path) -> FinePix:
    return FinePix(tmp_path, write_s=0.0, clock_offset_s=3600.0)


@contextmanager
def by_wire(here: Path, body: FinePix, monkeypatch: pytest.MonkeyPatch, **camera: Any) -> Iterator[tuple[Flying, Path]]:
    monkeypatch.setattr(shutter_line, "request_output", body.request)
    table = {"driver": "fujifilm", "shutter": "gpio:/dev/gpiochip0:17", "port": "", "options": {"hold_ms": 5}, **camera}
    with flying(settings_of(here, camera=table)) as daemon:
        daemon.until_ready()
        yield daemon, daemon.service.folder


def shoot(daemon: Flying, body: FinePix, count: int) -> None:
    for _ in range(count):
        before = body.pressed
        pending = daemon.shoot()
        assert pending.follows
        assert pending.where is not None
        assert body.pressed == before + 1
    eventually(lambda: len(list(body.card.rglob("*.RAF"))) == body.made, "the files on the card")


def test_fired_by_a_wire_and_picked_up_after_landing(
    here: Path, body: FinePix, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with by_wire(here, body, monkeypatch) as (daemon, flight):
        shoot(daemon, body, 3)
        body.focal_length_mm = 12.6
        shoot(daemon, body, 1)
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        assert ledger.following() == {0, 1, 2, 3}
        reasons = {row.reason for row in ledger.shots()}
    assert "flight pickup" in str(reasons)
    pickup = ["flight", "pickup", str(flight), "--from", str(body.card), "--json"]
    assert main([*pickup, "--dry-run"]) == 0
    assert (flight_report.balance(flight).frames, flight_report.balance(flight).following) == (0, 4)
    assert main(["flight", "report", str(flight)]) == 0
    assert "4 of the failed still have their files in the camera" in capfd.readouterr().out
    assert main(pickup) == 0
    told = json.loads(capfd.readouterr().out)
    assert [pair["index"] for pair in told["pairs"]] == [0, 1, 2, 3]
    assert abs(told["camera_clock_minus_utc_s"] - 3600) < 2
    assert len(told["zooms"]) == 1
    assert told["zooms"][0]["facts"]["focal_length_mm"] == 12.6
    balance = flight_report.balance(flight)
    assert (balance.safe, balance.failed, balance.tagged) == (4, 0, 4)
    assert flight_check.check(flight).problems == ()
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        assert ledger.following() == set()
        for index, frame in enumerate(ledger.frames()):
            assert frame.camera_name == f"DSCF{index + 1:04d}.RAF"
        assert [tag.focal_length_mm for tag in ledger.tags().values()] == [6.3, 6.3, 6.3, 12.6]
    assert main(pickup) == 0  # again: nothing is left to do
    assert json.loads(capfd.readouterr().out)["there_already"] == 4
    assert main(["replay", str(flight), "--verify"]) == 0, capfd.readouterr().err


def test_a_missing_file_leaves_doubt_that_a_person_settles(
    here: Path, body: FinePix, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    body.misses = frozenset({2})
    with by_wire(here, body, monkeypatch) as (daemon, flight):
        shoot(daemon, body, 3)  # within a second or so: times alone can't tell
    pickup = ["flight", "pickup", str(flight), "--from", str(body.card)]
    assert main(pickup) == 1
    told = capfd.readouterr()
    out = told.out
    assert "in doubt:" in told.err
    assert "--pair" in out
    truth = {0: "DSCF0001.RAF", 2: "DSCF0002.RAF"}
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        sure = {frame.index: frame.camera_name for frame in ledger.frames()}
    assert sure.items() <= truth.items()
    said = [word for index, name in truth.items() if index not in sure for word in ("--pair", f"{index}={name}")]
    assert main([*pickup, *said]) == 1  # shot 1 never gets a file
    assert "has no file" in capfd.readouterr().out
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        assert {frame.index: frame.camera_name for frame in ledger.frames()} == truth
    assert flight_check.check(flight).problems == ()


@pytest.mark.parametrize(
    "case",
    [(["--pair", "99=DSCF0001.RAF"], "shot 99"), (["--pair", "0=nothing.RAF"], "nothing.RAF"),
     (["--by-order"], "needs as many files as shots: 1 shot, 0 files"), (["--from", "/no/such"], "/no/such")],
)  # fmt: skip
def test_a_wrong_wish_is_one_sentence(
    here: Path, body: FinePix, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], case: Wrong
) -> None:
    words, said = case
    body.misses = frozenset({1})
    with by_wire(here, body, monkeypatch) as (daemon, flight):
        shoot(daemon, body, 1)
        assert main(["flight", "pickup", str(flight), "--from", str(body.card)]) == 1
        assert "still being recorded" in capfd.readouterr().err
    assert main(["flight", "pickup", str(flight), "--from", str(body.card), *words]) == 2
    assert said in capfd.readouterr().err.splitlines()[-1]


def test_a_card_that_appears_in_flight_brings_its_frames_into_the_flight(
    here: Path, body: FinePix, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dappled.drivers.wired.sources.MOUNTS", body.mounts)
    monkeypatch.setattr("dappled.drivers.wired.sources.PLACES", body.places)
    with by_wire(here, body, monkeypatch, pickup="storage") as (daemon, flight):
        shoot(daemon, body, 3)
        body.plug()
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            eventually(lambda: len(ledger.tags()) == 3, "all frames recorded and tagged")
            assert [frame.camera_name for frame in ledger.frames()] == [f"DSCF000{n}.RAF" for n in (1, 2, 3)]
            assert ledger.following() == set()


class Pixhawk:
    """An autopilot at the other end of a UDP link: its relay is wired to the body's contact."""

    def __init__(self, port: int, relay: Callable[[bool], None]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(0.05)
        self._speech = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._relay = relay
        self._stop = threading.Event()
        self.captured: list[tuple[int, int, str]] = []
        self._thread = threading.Thread(target=self._run, name="pixhawk")
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._socket.send(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(self._speech))
            try:
                messages = self._speech.parse_buffer(self._socket.recv(65536)) or []
            except OSError:
                continue  # nothing came, or the daemon is not there yet
            self._hear(messages)

    def _hear(self, messages: list[Any]) -> None:
        for message in messages:
            if message.get_type() == "COMMAND_LONG" and message.command == 181:
                self._relay(message.param2 == 1)
            elif message.get_type() == "CAMERA_IMAGE_CAPTURED":
                self.captured.append((message.image_index, message.capture_result, message.file_url))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()


def test_fired_by_the_autopilot_s_relay_and_the_ground_station_is_told(here: Path, body: FinePix) -> None:
    port = free_port()
    camera = {"driver": "fujifilm", "shutter": "relay:0", "port": "", "options": {"hold_ms": 5}}
    settings = settings_of(here, camera=camera, mavlink={"url": f"udpin:127.0.0.1:{port}"})
    pixhawk = Pixhawk(port, body.contact)
    try:
        with flying(settings) as daemon:
            daemon.until_ready()
            link = daemon.service.health
            eventually(lambda: "nothing was heard" not in str(problems(link())), "the autopilot is heard")
            pending = daemon.shoot()
            while "autopilot" in words(pending.problem):  # its heartbeat was not there yet
                pending = daemon.shoot()
            assert pending.follows
            index = pending.shot.index
            eventually(lambda: (index, 1, "") in pixhawk.captured, "263: exposed, and no file yet")
            assert body.pressed == 1
    finally:
        pixhawk.close()


@contextmanager
def other_hand(body: SimulatedBody) -> Iterator[Callable[[int], None]]:
    """Somebody else fires a body whose files lie on its card."""
    camera = client.open_camera({"port": body.port})
    camera.start()
    until_state(camera, "ready")

    def press(number: int) -> None:
        camera.fire(number)
        content(until_shot_ends(camera, number)[-1])  # type: ignore[arg-type]  # an Arrival, or the test fails there

    try:
        yield press
    finally:
        camera.stop()


def outside(here: Path, body: SimulatedBody, pickup: str) -> Any:
    return settings_of(here, camera={"driver": "fujifilm", "shutter": "outside", "port": "", "pickup": pickup})


@pytest.mark.slow
def test_files_are_picked_up_over_ptp_after_landing(here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:200001:cr2", pairs=True, clock_offset_s=-7200.0)) as body:
        with other_hand(body) as press, flying(outside(here, body, "later")) as daemon:
            flight = daemon.service.folder
            for number in range(3):
                daemon.shoot(happened=True)
                press(number)
        assert main(["flight", "pickup", str(flight), "--from", body.port, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert [(pair["index"], pair["file"][-12:]) for pair in told["pairs"]] == [
        (0, "IMG_0001.CR2"), (1, "IMG_0002.CR2"), (2, "IMG_0003.CR2"),
    ]  # fmt: skip
    assert flight_check.check(flight).problems == ()
    assert (flight_report.balance(flight).safe, flight_report.balance(flight).companions) == (3, 3)
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        for frame in ledger.frames():
            assert (flight / frame.name).read_bytes() == pattern(frame.index + 1, 200_001)


@pytest.mark.slow
def test_files_are_picked_up_over_ptp_in_flight(here: Path) -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:200001:cr2")) as body,
        flying(outside(here, body, body.port)) as daemon,
    ):
        body.fault("unplug")  # while it is fired it is no camera on the bus
        eventually(lambda: daemon.camera == "ready", "the line is open")
        body.fault("clear")
        with other_hand(body) as press:
            for number in range(3):
                daemon.shoot(happened=True)
                press(number)
        with LedgerReader.open(daemon.service.folder / "flight.sqlite") as ledger:
            eventually(lambda: len(ledger.tags()) == 3, "all frames recorded and tagged")
            assert [frame.camera_name for frame in ledger.frames()] == [f"IMG_000{n}.CR2" for n in (1, 2, 3)]
