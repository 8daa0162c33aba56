"""What real bodies do, against the running daemon: each fault a test, by its name.

Always: each shot ends once, as a frame or as failed with a reason, and the record is whole (`flying` looks at that);
nothing else in the daemon stands still meanwhile; and the body is back in service soon after it is able to be.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dappled.daemon.health.standing import in_record
from dappled.daemon.pipeline.capture import PendingShot
from dappled.findings import Code, named
from dappled.flight import LedgerReader
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.mocks.body.eos450d import thumbnail
from tests.standing import codes, words
from tests.system.flying import Flying, flying, settings_of, told
from tests.waiting import eventually

SIZE = 2_000_001
STALL_S = 2.4
"""libgphoto2 holds an interpreter for 2.5 s and more where it stands still; this machine may be busy for a while."""


@pytest.fixture
def here(sockets: Path, tmp_path: Path) -> Path:
    """A folder of this test's own whose name is short enough for sockets."""
    folder = sockets / tmp_path.name[-12:]
    folder.mkdir()
    return folder


def a_body(**options: Any) -> SimulatedBody:
    return SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2", **options))


@contextmanager
def daemon_before(here: Path, *bodies: SimulatedBody, **camera: Any) -> Iterator[Flying]:
    """A daemon before these bodies, and a watch over its standing still; one good shot is behind it."""
    ports = ",".join(body.port for body in bodies)
    camera = {"port": ports, "file_timeout_s": 20, **camera}
    with flying(settings_of(here, camera=camera)) as daemon, never_still(daemon):
        assert daemon.shoot().problem is None
        yield daemon


@contextmanager
def never_still(daemon: Flying) -> Iterator[None]:
    """Somebody asks the daemon for its health all the time: each answer must come, and soon."""
    done = threading.Event()
    longest_s = 0.0

    def ask() -> None:
        nonlocal longest_s
        while not done.is_set():
            began = time.monotonic()
            daemon.service.health()
            done.wait(0.005)
            longest_s = max(longest_s, time.monotonic() - began)

    asker = threading.Thread(target=ask, name="asker")
    asker.start()
    try:
        yield
    finally:
        done.set()
        asker.join()
    assert longest_s < STALL_S, f"the daemon stood still for {longest_s:.2f} s"


def wished(daemon: Flying) -> int:
    """A shot is on its way to the camera."""
    decision = daemon.request()
    assert decision.outcome == "shot", decision.reason
    assert decision.index is not None
    return decision.index


def fired(daemon: Flying, index: int) -> None:
    """Wait until the shot was fired."""

    def was() -> bool:
        with LedgerReader.open(daemon.service.folder / "flight.sqlite") as ledger:
            row = ledger.shot(index)
        return row is not None and row.fired_called_monotonic_ns is not None

    eventually(was, f"shot {index} fired")


def ended(daemon: Flying, index: int) -> PendingShot:
    """The end of a shot."""
    eventually(lambda: any(one.shot.index == index for one in daemon.shots), f"shot {index} ended")
    return next(one for one in daemon.shots if one.shot.index == index)


def is_frame(daemon: Flying, index: int, release: int) -> None:
    """The shot's frame is, or becomes, what the body's n-th release made."""

    def frame() -> Path | None:
        with LedgerReader.open(daemon.service.folder / "flight.sqlite") as ledger:
            found = ledger.frame(index)
        return None if found is None else daemon.service.folder / found.name

    eventually(frame, f"the frame of shot {index}")
    path = frame()
    assert path is not None
    assert path.read_bytes() == pattern(release, SIZE)


def back_in_service(daemon: Flying, body: SimulatedBody) -> None:
    """The body is ready again, and its next shot is its own."""
    eventually(lambda: daemon.camera == "ready", f"ready again: {daemon.problems}")
    pending = daemon.shoot()
    assert pending.problem is None
    assert pending.doubt is None
    is_frame(daemon, pending.shot.index, body.releases)


def test_unplugged_while_idle(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("unplug")
        eventually(lambda: daemon.camera == "absent", "the camera is absent")
        decision = daemon.request()
        assert decision.outcome == "refused"
        assert "absent" in decision.words
        body.fault("clear")
        back_in_service(daemon, body)


@pytest.mark.slow
def test_unplugged_in_mid_exposure(here: Path) -> None:
    with a_body(delay_s=0.7) as body, daemon_before(here, body) as daemon:
        index = wished(daemon)
        fired(daemon, index)
        body.fault("unplug")
        eventually(lambda: daemon.camera == "absent", "the camera is absent")
        body.fault("clear")
        assert ended(daemon, index).problem is None  # its file lay on the card
        is_frame(daemon, index, 2)
        back_in_service(daemon, body)


@pytest.mark.slow
def test_unplugged_in_mid_download(here: Path) -> None:
    with a_body() as body, daemon_before(here, body, file_timeout_s=120) as daemon:
        body.fault("unplug-transfer")
        index = wished(daemon)
        eventually(lambda: daemon.camera == "absent", "the camera is absent")
        body.fault("clear")
        assert ended(daemon, index).problem is None
        is_frame(daemon, index, 2)
        back_in_service(daemon, body)


@pytest.mark.long
def test_unplugged_for_good(here: Path) -> None:
    with a_body() as body, daemon_before(here, body, file_timeout_s=2) as daemon:
        body.fault("unplug-transfer")
        index = wished(daemon)
        assert "no file came" in words(ended(daemon, index).problem)
        body.fault("clear")
        is_frame(daemon, index, 2)  # it comes after all
        back_in_service(daemon, body)
        with LedgerReader.open(daemon.service.folder / "flight.sqlite") as ledger:
            assert ledger.strays() == []


@pytest.mark.slow
def test_silence(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("silence")
        index = wished(daemon)
        assert ended(daemon, index).problem
        eventually(lambda: daemon.camera in ("faulted", "absent"), "the camera is out of service")
        body.fault("clear")
        back_in_service(daemon, body)


@pytest.mark.long
def test_busy_for_10_s(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("busy 10")
        index = wished(daemon)
        assert "busy" in words(ended(daemon, index).problem)
        eventually(lambda: daemon.camera == "ready", "the camera takes shots")
        again = wished(daemon)
        assert ended(daemon, again).problem in ("", ended(daemon, index).problem)
        body.fault("clear")
        back_in_service(daemon, body)


@pytest.mark.slow
def test_event_lost_though_the_file_is_on_the_card(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("no-event")
        index = wished(daemon)
        assert ended(daemon, index).problem is None
        is_frame(daemon, index, 2)
        back_in_service(daemon, body)


@pytest.mark.long
def test_two_bodies_of_one_model(here: Path) -> None:
    with (
        a_body(serial="0000000001") as other,
        a_body(serial="0000000002") as body,
        daemon_before(here, other, body, serial="0000000002") as daemon,
    ):
        body.fault("unplug")
        eventually(lambda: daemon.camera == "absent", "the wanted body is absent")
        assert "0000000001" in daemon.problems
        assert daemon.request().outcome == "refused"
        body.fault("clear")
        back_in_service(daemon, body)
        assert other.releases == 0


@pytest.mark.slow
def test_the_body_comes_back_with_another_address(here: Path) -> None:
    with a_body(addresses=2, delay_s=0.7) as body, daemon_before(here, body) as daemon:
        index = wished(daemon)
        fired(daemon, index)
        body.ask("move")
        assert ended(daemon, index).problem is None
        is_frame(daemon, index, 2)
        back_in_service(daemon, body)


@pytest.mark.slow
def test_crash_of_the_camera_process(here: Path) -> None:
    with a_body(delay_s=5.0) as body, daemon_before(here, body) as daemon:  # killed before its file on any machine
        process = camera_process(body)
        index = wished(daemon)
        fired(daemon, index)
        os.kill(process, signal.SIGKILL)
        assert "process" in words(ended(daemon, index).problem)
        is_frame(daemon, index, 2)  # the next process brings it
        back_in_service(daemon, body)


def test_card_full(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("full")
        index = wished(daemon)
        assert "card" in words(ended(daemon, index).problem)
        body.fault("clear")
        back_in_service(daemon, body)


@pytest.mark.long
@pytest.mark.parametrize("hours", [1, -1])
def test_clock_of_the_body_wrong_by_an_hour(here: Path, hours: int) -> None:
    """Nothing goes by the body's clock but what its own files say of each other."""
    with a_body(clock_offset_s=3600 * hours, delay_s=0.7) as body, daemon_before(here, body) as daemon:
        index = wished(daemon)
        fired(daemon, index)
        os.kill(camera_process(body), signal.SIGKILL)  # the file is found by the body's clock
        is_frame(daemon, index, 2)
        back_in_service(daemon, body)
        flight = daemon.service.folder
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            requests = {row.shot.index: row.shot.wished_utc_ns for row in ledger.shots()}
            tags = ledger.tags()
        for number, tag in tags.items():
            assert abs(tag.utc_ns - requests[number]) < 60 * 10**9
    assert not [text for text in told(flight) if text.startswith("doubt")]


@pytest.mark.slow
def test_autofocus_fails(here: Path) -> None:
    with a_body() as body, daemon_before(here, body) as daemon:
        body.fault("no-focus")
        index = wished(daemon)
        assert "focus" in words(ended(daemon, index).problem)
        eventually(lambda: daemon.camera == "ready", "ready again")
        index = wished(daemon)
        assert ended(daemon, index).problem is None
        is_frame(daemon, index, 3)


def test_raw_and_jpeg(here: Path) -> None:
    """No fault, but once two files made two frames."""
    with a_body(pairs=True) as body, daemon_before(here, body) as daemon:
        flight = daemon.service.folder

        def companions() -> int:
            with LedgerReader.open(flight / "flight.sqlite") as ledger:
                return len(ledger.companions())

        eventually(lambda: companions() == 1, "the JPEG in the record")
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            (jpeg,) = ledger.companions()
            assert ledger.strays() == []
        assert (flight / jpeg.name).read_bytes() == thumbnail(1)


def camera_process(body: SimulatedBody) -> int:
    """The process that holds this body, a child of ours."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if b"dappled.drivers.gphoto2.process" in words and body.port.split(",")[0].encode() in words:
                return int(entry.name)
    raise AssertionError("there is no camera process")


@pytest.mark.long
def test_a_body_that_is_not_as_planned(here: Path) -> None:
    """Set by the computer where the body lets it, else no-go; a dial turned in flight is told before the next shot."""

    def says(daemon: Flying, words: str) -> bool:
        found = [str(named(one)) for one in in_record(daemon.service.health()) if one.code == Code.BODY_SETTING_WRONG]
        return any(words in one for one in found) if words else not found

    with a_body() as body:
        for turned in ("drive 1", "power-off 60", "mirror 0"):
            body.ask(f"turn {turned}")
        with daemon_before(here, body) as daemon:
            eventually(
                lambda: not any(code.startswith("body.") for code in codes(daemon.service.health())), "as planned"
            )
            for turned, words in (
                ("dial 2", "exposure mode: it is AV, not manual as planned"),
                ("dial 3", ""),
                ("focus 0", "focus mode: it is One Shot"),
                ("focus 3", ""),
                ("mirror 1", "mirror lock-up: it is on"),
                ("mirror 0", ""),
                ("drive 0x10", "drive mode: it is Timer 10 sec"),
                ("drive 0", ""),
            ):
                body.ask(f"turn {turned}")
                eventually(partial(says, daemon, words), turned)
            body.ask("turn room 3")
            body.ask("turn battery 0")
            assert daemon.shoot().problem is None
            low = {"body.card_filling", "body.battery_low"}
            eventually(lambda: low <= set(codes(daemon.service.health())), "what runs out")
        assert body.releases == 2
