"""Drivers that are a shutter line and a pickup, against a body with a contact and a card, and folders."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled.clock import RecordedClock, SystemClock
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    Companion,
    Deferred,
    Fired,
    Identity,
    Noticed,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.raw.raw_file import read_exif
from dappled.drivers.replay import RecordedShot, ReplayCamera
from dappled.drivers.wired import composed, folder, fujifilm, matching
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.shutter_line import GpioLine, HalfPressedLine, OutsideLine
from dappled.drivers.wired.sources import FolderSource, FoundFile, StorageSource
from dappled.findings import Code
from dappled.mocks import simulated
from dappled.mocks.body.body import pattern
from dappled.mocks.body.eos450d import thumbnail
from dappled.testing import (
    CameraContract,
    Rig,
    arrived,
    content,
    failed,
    of_shots,
    until,
    until_shot_ends,
    until_state,
)
from tests.simulated.finepix import FinePix, picture

WHO = Identity("FUJIFILM", "FinePix S5200", "", "gpio")
FAST = ComposedSettings(file_s=20.0, hold_s=0.01, poll_s=0.02, retry_s=0.02)
T0 = 1_700_000_000.0


@pytest.fixture
def body(tmp_path: Path) -> FinePix:
    return FinePix(tmp_path, write_s=0.0, wall_s=lambda: T0)


def standing_clock() -> RecordedClock:
    """A clock that the test moves: 1000 s after T0, and 1000 s monotonic."""
    return RecordedClock(round((T0 + 1000.0) * 1e9), round(T0 * 1e9))


def line(body: FinePix) -> GpioLine:
    return GpioLine("/dev/gpiochip0", 17, request=body.request)


class TestContractOfAWireAndAFolder(CameraContract):
    """The fujifilm driver whose card is a folder that can be reached in flight."""

    @pytest.fixture
    def rig(self, body: FinePix) -> Iterator[Rig]:
        camera = ComposedCamera(WHO, line(body), FolderSource(body.card), FAST)
        yield Rig(camera, lambda number: picture(number, 6.3, T0), loose=True)
        camera.stop()


class TestContractOfAWireAndMassStorage(CameraContract):
    """The fujifilm driver: each shot is deferred, and its file follows from the mounted card."""

    @pytest.fixture
    def rig(self, body: FinePix) -> Iterator[Rig]:
        body.plug()
        plan = ComposedSettings(follows="it follows", hold_s=0.01, poll_s=0.02)
        clock = SystemClock(round(T0 * 1e9) - time.monotonic_ns())
        camera = ComposedCamera(WHO, line(body), StorageSource(body.mounts, body.places), plan, clock)
        yield Rig(camera, lambda number: picture(number, 6.3, T0), loose=True, follows=True)
        camera.stop()


class _OtherProgram:
    """Fires and fills a folder, whenever the line is pressed."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._made = folder, 0

    def open(self) -> None: ...
    def let_go(self) -> None: ...
    def close(self) -> None: ...

    def press(self) -> None:
        self._made += 1
        part = self._folder / ".part"
        part.write_bytes(pattern(self._made, 100_000))
        part.rename(self._folder / f"shot_{self._made:03d}.dng")


class TestContractOfTheFolder(CameraContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig]:
        camera = ComposedCamera(WHO, _OtherProgram(tmp_path), FolderSource(tmp_path), FAST)
        yield Rig(camera, lambda number: pattern(number, 100_000), loose=True)
        camera.stop()


class TestContractOfTheSimulatedCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        camera = simulated.open_camera({"picture": "pattern:100000:dng"})
        yield Rig(camera, lambda number: pattern(number, 100_000), loose=True)
        camera.stop()


class TestContractOfReplay(CameraContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig]:
        shots = []
        for number, shot in enumerate((7, 3, 4, 5, 1, 0, 2, 9), 1):
            path = tmp_path / f"{shot:06d}.dng"
            place = {7: 1, 3: 1, 4: 2, 5: 3, 1: 1}.get(shot, number)
            path.write_bytes(pattern(place, 50_000))
            shots.append(RecordedShot(shot, path, f"IMG_{number:04d}.DNG", (10, 20), 30))
        camera = ReplayCamera(shots, Identity("dappled", "recording", "", ""))
        yield Rig(camera, lambda number: pattern(number, 50_000), recorded=True)
        camera.stop()


def test_raw_and_jpeg_in_a_folder_are_one_frame(tmp_path: Path) -> None:
    camera = ComposedCamera(WHO, OutsideLine(), FolderSource(tmp_path), replace(FAST, pair_s=20.0))
    camera.start()
    try:
        until_state(camera, "ready")
        camera.fire(1)
        until(camera, lambda event: isinstance(event, Fired))
        (tmp_path / "A_0001.JPG").write_bytes(thumbnail(1))
        (tmp_path / "A_0001.CR2").write_bytes(pattern(1, 5000))
        events = until(camera, lambda event: isinstance(event, Companion))
        arrival, companion = [event for event in events if isinstance(event, Arrival | Companion)]
        assert (arrival.shot, arrival.name, companion.shot, companion.name) == (1, "A_0001.CR2", 1, "A_0001.JPG")
        assert (content(arrival), content(companion)) == (pattern(1, 5000), thumbnail(1))
    finally:
        camera.stop()


def test_a_file_that_is_still_written_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = FolderSource(tmp_path)
    listed, fired, pieces = source.list, threading.Event(), iter(range(60))

    def growing() -> list[FoundFile]:
        """Each look finds the file longer than the last one did, until it is whole."""
        if fired.is_set() and next(pieces, None) is not None:
            with (tmp_path / "slow.dng").open("ab") as file:
                file.write(bytes(1000))
        return listed()

    monkeypatch.setattr(source, "list", growing)
    camera = ComposedCamera(WHO, OutsideLine(), source, FAST)
    camera.start()
    try:
        until_state(camera, "ready")
        camera.fire(1)
        fired.set()
        assert len(content(arrived(camera, 1))) == 60_000
    finally:
        camera.stop()


def test_nothing_is_fired_before_the_first_look_says_which_files_are_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(composed, "_FIRST_LOOK_S", 0.02)
    (tmp_path / "old.dng").write_bytes(b"old")
    source = FolderSource(tmp_path)
    listed, asked, answered = source.list, threading.Event(), threading.Event()

    def slow() -> list[FoundFile]:
        asked.set()
        assert answered.wait(60)
        return listed()

    monkeypatch.setattr(source, "list", slow)
    camera = ComposedCamera(WHO, OutsideLine(), source, FAST)
    camera.start()
    try:
        assert asked.wait(60)
        until_state(camera, "starting")
        assert camera.next_event(0.3) is None
        camera.fire(1)
        assert of_shots(until_shot_ends(camera, 1)) == [(ShotFailed, 1)]
        answered.set()
        until_state(camera, "ready")
        camera.fire(2)
        until(camera, lambda event: isinstance(event, Fired))
        (tmp_path / "new.dng").write_bytes(b"new")
        arrival = until(camera, lambda event: isinstance(event, Arrival))[-1]
        assert isinstance(arrival, Arrival)
        assert (arrival.shot, content(arrival)) == (2, b"new")
    finally:
        answered.set()
        camera.stop()


def test_what_lay_there_before_is_left_alone_and_what_nobody_wished_for_has_no_shot(tmp_path: Path) -> None:
    (tmp_path / "old.dng").write_bytes(b"old")
    camera = ComposedCamera(WHO, OutsideLine(), FolderSource(tmp_path), FAST)
    camera.start()
    try:
        until_state(camera, "ready")
        time.sleep(0.1)  # a look at the folder; what it does not see is a stray below, and no test fails
        (tmp_path / "new.dng").write_bytes(b"new")
        arrival = until(camera, lambda event: isinstance(event, Arrival))[-1]
        assert isinstance(arrival, Arrival)
        assert (arrival.shot, content(arrival)) == (None, b"new")
    finally:
        camera.stop()


def test_no_file_fails_the_shot_and_a_late_one_is_told_by_the_camera_s_clock(tmp_path: Path) -> None:
    plan = ComposedSettings(file_s=0.5, hold_s=0.01, poll_s=0.02)
    clock = standing_clock()
    body = FinePix(tmp_path, write_s=0.0, wall_s=lambda: clock.utc_ns() / 1e9, clock_offset_s=3600.0)
    camera = ComposedCamera(WHO, OutsideLine(), FolderSource(body.card), plan, clock)
    camera.start()
    try:
        until_state(camera, "ready")
        camera.fire(1)
        body.contact(True)
        _closed(until_shot_ends(camera, 1))
        clock.advance(10)
        camera.fire(2)
        until(camera, lambda event: isinstance(event, Fired) and event.shot == 2)
        taken_s = clock.utc_ns() / 1e9
        clock.advance(20)
        failed(camera, 2)
        camera.fire(3)
        until(camera, lambda event: isinstance(event, Fired) and event.shot == 3)
        (body.card / "DCIM" / "late.RAF").write_bytes(picture(2, 6.3, taken_s + 3600))
        late = until(camera, lambda event: isinstance(event, Arrival))[-1]
        assert isinstance(late, Arrival)
        assert (late.shot, "doubt" in late.facts) == (2, False)
        late.blob.close()
        body.contact(True)
        _closed(until_shot_ends(camera, 3))
    finally:
        camera.stop()


class Flight:
    """A Fujifilm by wire whose card is plugged when the test says so; its clocks are the test's."""

    def __init__(self, folder: Path) -> None:
        self.clock = standing_clock()
        self.body = FinePix(folder, write_s=0.0, wall_s=lambda: self.clock.utc_ns() / 1e9, clock_offset_s=-3600.0)
        self.card = self.body.card / "DCIM" / "100_FUJI"
        self.looks = 0
        source = StorageSource(self.body.mounts, self.body.places)
        listed = source.list

        def counted() -> list[FoundFile]:
            try:
                return listed()
            finally:
                self.looks += 1

        dated = source.taken_s
        self.read: list[str] = []

        def taken_s(found: FoundFile) -> float | None:
            self.read.append(found.base)
            return dated(found)

        source.list, source.taken_s = counted, taken_s  # type: ignore[method-assign]  # count only
        plan = ComposedSettings(follows="it follows", hold_s=0.001, poll_s=0.02)
        self.camera = ComposedCamera(WHO, line(self.body), source, plan, self.clock)

    def old(self, count: int, before_s: float = 86_400.0) -> None:
        """Pictures of another flight, 5 s apart."""
        for number in range(count):
            (self.card / f"OLD{number:04d}.RAF").write_bytes(picture(number, 6.3, T0 - before_s + 5 * number))

    def shoot(self, shot: int, after_s: float) -> None:
        self.clock.advance(after_s)
        self.camera.fire(shot)
        events = until(self.camera, lambda event: isinstance(event, Deferred))
        assert of_shots(events) == [(Fired, shot), (Deferred, shot)]
        until_state(self.camera, "ready")

    def written(self, count: int) -> None:
        deadline = time.monotonic() + 60
        while len(list(self.card.glob("DSCF*.RAF"))) < count:
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def brought(self, count: int) -> dict[int | None, str]:
        """The next so many arrivals: shot → name."""
        found: dict[int | None, str] = {}
        while len(found) < count:
            arrival = until(self.camera, lambda event: isinstance(event, Arrival))[-1]
            assert isinstance(arrival, Arrival)
            found[arrival.shot] = arrival.name
            arrival.blob.close()
        return found

    def brings_nothing(self) -> None:
        """For a dozen looks."""
        deadline, until_look = time.monotonic() + 60, self.looks + 12
        while self.looks < until_look:
            assert time.monotonic() < deadline
            event = self.camera.next_event(0.01)
            assert not isinstance(event, Arrival), event.name


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    made = Flight(tmp_path)
    yield made
    made.camera.stop()


def test_a_card_that_appears_after_many_shots_brings_them_all_in_order(flight: Flight) -> None:
    flight.camera.start()
    until_state(flight.camera, "ready")
    for shot, step_s in enumerate((3, 5, 4, 9, 3, 6)):
        flight.shoot(shot, step_s)
    flight.written(6)
    flight.old(60)
    flight.body.plug()
    assert flight.brought(6) == {shot: f"DSCF{shot + 1:04d}.RAF" for shot in range(6)}
    flight.brings_nothing()


def test_a_card_changed_in_flight_that_numbers_from_1_again_is_brought_too_and_told(flight: Flight) -> None:
    flight.body.plug()
    flight.camera.start()
    until_state(flight.camera, "ready")
    names = [f"DSCF{number:04d}.RAF" for number in (1, 2, 3)]
    told: list[Code] = []
    for first in (0, 3):
        flight.body.unplug()
        for shot, step_s in zip(range(first, first + 3), (5, 7, 11), strict=True):
            flight.shoot(shot, step_s)
        flight.written(3)
        for number, name in enumerate(names, first + 1):
            (flight.card / f"DSCF{number:04d}.RAF").rename(flight.card / name)
        flight.body.plug()
        found: dict[int | None, str] = {}
        while len(found) < 3:
            for event in until(flight.camera, lambda event: isinstance(event, Arrival)):
                if isinstance(event, Noticed):
                    told.append(event.finding.code)
                elif isinstance(event, Arrival):
                    found[event.shot] = event.name
                    event.blob.close()
        assert found == dict(enumerate(names, first))
        flight.body.unplug()
        flight.brings_nothing()
        for name in names:
            (flight.card / name).unlink()
    assert told == [Code.CARD_CHANGED]


def test_a_card_seen_before_the_flight_brings_what_is_sure_where_one_is_missing(flight: Flight) -> None:
    flight.old(60)
    flight.body.plug()
    flight.camera.start()
    until_state(flight.camera, "ready")
    flight.body.unplug()
    for shot, step_s in enumerate((3, 5, 4, 9, 3, 6)):
        flight.shoot(shot, step_s)
    flight.written(6)
    (flight.card / "DSCF0003.RAF").unlink()
    flight.body.plug()
    assert flight.brought(5) == {shot: f"DSCF{shot + 1:04d}.RAF" for shot in (0, 1, 3, 4, 5)}


@pytest.mark.parametrize("shots", [1, 2, 5])
@pytest.mark.parametrize("before_s", [3600.0, 86_400.0, 4 * 365 * 86_400.0])
def test_an_old_card_s_pictures_are_never_those_of_a_body_that_did_not_fire(
    flight: Flight, shots: int, before_s: float
) -> None:
    flight.old(1 if shots == 1 else 40, before_s)
    flight.body.misses = frozenset(range(1, 100))
    flight.camera.start()
    until_state(flight.camera, "ready")
    for shot in range(shots):
        flight.shoot(shot, 5)
    flight.body.plug()
    flight.brings_nothing()


def test_what_is_in_doubt_is_read_and_weighed_once(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    weighed = 0
    match = matching.match

    def counted(*arguments: Any, **known: Any) -> matching.Matching:
        nonlocal weighed
        weighed += 1
        return match(*arguments, **known)

    monkeypatch.setattr(matching, "match", counted)
    flight.old(5)
    flight.body.misses = frozenset({1})
    flight.camera.start()
    until_state(flight.camera, "ready")
    flight.shoot(0, 5)
    flight.body.plug()
    flight.brings_nothing()
    assert weighed == 1
    assert len(flight.read) == 5
    flight.shoot(1, 5)
    flight.written(1)
    flight.brings_nothing()
    assert weighed <= 3  # a shot more, a file more
    assert sorted(flight.read) == ["DSCF0001.RAF", *(f"OLD{number:04d}.RAF" for number in range(5))]


def test_another_card_than_before_the_flight_is_as_strange_as_any(flight: Flight) -> None:
    (flight.card / "DSCF9999.RAF").write_bytes(picture(1, 6.3, T0))
    flight.body.plug()
    flight.camera.start()
    until_state(flight.camera, "ready")
    flight.body.unplug()
    flight.body.misses = frozenset(range(1, 100))
    flight.shoot(0, 5)
    (flight.card / "DSCF9999.RAF").unlink()
    flight.old(1)
    flight.body.plug()
    flight.brings_nothing()


def test_the_half_press_leads_and_is_no_part_of_the_latency(body: FinePix) -> None:
    """The exposure's time is counted from the shutter's own contact."""
    pressed: list[tuple[str, int]] = []

    class Noted(OutsideLine):
        def __init__(self, name: str) -> None:
            self.name = name

        def press(self) -> None:
            pressed.append((self.name, time.monotonic_ns()))

        def let_go(self) -> None:
            pressed.append((f"{self.name} open", time.monotonic_ns()))

    both = HalfPressedLine(Noted("full"), Noted("half"), 0.1)
    camera = ComposedCamera(WHO, both, None, replace(FAST, follows="it follows"))
    camera.start()
    until_state(camera, "ready")
    camera.fire(1)
    fired = until(camera, lambda event: isinstance(event, Fired))[-1]
    assert isinstance(fired, Fired)
    until_state(camera, "ready")
    camera.stop()
    assert [name for name, _ in pressed] == ["half", "full", "full open", "half open"]
    assert pressed[0][1] + 90_000_000 < fired.called_monotonic_ns <= pressed[1][1]


class BadLine:
    """A shutter line whose calls raise what the test says."""

    def __init__(self) -> None:
        self.raises: dict[str, Exception] = {}
        self.calls: list[str] = []

    def _do(self, name: str) -> None:
        self.calls.append(name)
        if name in self.raises:
            raise self.raises[name]

    def open(self) -> None:
        self._do("open")

    def press(self) -> None:
        self._do("press")

    def let_go(self) -> None:
        self._do("let_go")

    def close(self) -> None:
        self._do("close")


@pytest.fixture
def bad() -> BadLine:
    return BadLine()


@pytest.fixture
def by_bad_line(bad: BadLine) -> Iterator[ComposedCamera]:
    camera = ComposedCamera(WHO, bad, None, ComposedSettings(follows="later", hold_s=0.01, retry_s=0.02))
    yield camera
    camera.stop()


@pytest.mark.parametrize(
    "error", [CameraError("stuck"), OSError("stuck"), TimeoutError("stuck"), AttributeError("stuck")]
)
def test_a_line_that_raises_anything_when_pressed_fails_that_shot_only(
    bad: BadLine, by_bad_line: ComposedCamera, error: Exception
) -> None:
    by_bad_line.start()
    until_state(by_bad_line, "ready")
    bad.raises["press"] = error
    by_bad_line.fire(1)
    assert "stuck" in failed(by_bad_line, 1)
    until_state(by_bad_line, "ready")
    assert bad.calls == ["open", "press", "close", "open"]  # taken anew: it may have been lost
    del bad.raises["press"]
    by_bad_line.fire(2)
    assert of_shots(until(by_bad_line, lambda event: isinstance(event, Deferred))) == [(Fired, 2), (Deferred, 2)]


@pytest.mark.parametrize(
    "error", [CameraError("stuck"), OSError("stuck"), TimeoutError("stuck"), AttributeError("stuck")]
)
def test_a_shutter_that_stays_pressed_is_faulted_until_it_is_let_go(
    bad: BadLine, by_bad_line: ComposedCamera, error: Exception
) -> None:
    by_bad_line.start()
    until_state(by_bad_line, "ready")
    bad.raises["let_go"] = error
    by_bad_line.fire(1)
    until_state(by_bad_line, "faulted")
    assert by_bad_line.identity == WHO
    by_bad_line.fire(2)
    deadline = time.monotonic() + 60
    while bad.calls.count("let_go") < 4:
        event = by_bad_line.next_event(0.01)
        assert time.monotonic() < deadline
        assert not (isinstance(event, StateChanged) and event.state == "ready")
        if isinstance(event, ShotFailed):
            assert "stays pressed" in event.reason
            assert event.shot == 2
    assert bad.calls.count("press") == 1
    assert bad.calls.count("close") >= 1
    bad.raises.clear()
    until_state(by_bad_line, "ready")
    assert bad.calls[-1] == "let_go"
    by_bad_line.fire(3)
    assert of_shots(until(by_bad_line, lambda event: isinstance(event, Deferred))) == [(Fired, 3), (Deferred, 3)]


def test_a_line_that_is_lost_is_opened_again_and_what_waited_is_not_fired_then(
    bad: BadLine, by_bad_line: ComposedCamera
) -> None:
    by_bad_line.start()
    until_state(by_bad_line, "ready")
    bad.raises = {"press": CameraError("the chip is gone"), "open": OSError("no chip")}
    for shot in (1, 2, 3):
        by_bad_line.fire(shot)
    ends = [until_shot_ends(by_bad_line, shot)[-1] for shot in (1, 2, 3)]
    assert all(isinstance(end, ShotFailed) for end in ends)
    bad.raises.clear()
    until_state(by_bad_line, "ready")
    assert bad.calls.count("press") == 1
    by_bad_line.fire(4)
    assert of_shots(until(by_bad_line, lambda event: isinstance(event, Deferred))) == [(Fired, 4), (Deferred, 4)]


def test_a_line_that_raises_anything_when_opened_is_tried_again(bad: BadLine, by_bad_line: ComposedCamera) -> None:
    bad.raises["open"] = RuntimeError("not yet")
    by_bad_line.start()
    assert "not yet" in until_state(by_bad_line, "faulted").reason
    bad.raises.clear()
    until_state(by_bad_line, "ready")


def test_a_source_that_breaks_in_any_way_is_told_and_its_shots_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = FolderSource(tmp_path)
    camera = ComposedCamera(WHO, OutsideLine(), source, ComposedSettings(file_s=0.2, hold_s=0.01, poll_s=0.02))
    camera.start()
    try:
        until_state(camera, "ready")

        def broken() -> list[FoundFile]:
            raise MemoryError("no more")

        with monkeypatch.context() as patch:
            patch.setattr(source, "list", broken)
            assert "no more" in until_state(camera, "faulted").reason
            camera.fire(1)
            assert of_shots(until_shot_ends(camera, 1)) == [(Fired, 1), (ShotFailed, 1)]
        until_state(camera, "ready")
        camera.fire(2)
        until(camera, lambda event: isinstance(event, Fired))
        (tmp_path / "2.dng").write_bytes(b"two")
        arrival = until(camera, lambda event: isinstance(event, Arrival))[-1]
        assert isinstance(arrival, Arrival)
        assert content(arrival) == b"two"
    finally:
        camera.stop()


def test_a_shot_without_a_file_says_what_was_wrong_with_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    folder.mkdir()
    camera = ComposedCamera(
        WHO, OutsideLine(), FolderSource(folder), ComposedSettings(file_s=0.2, hold_s=0.01, poll_s=0.02)
    )
    camera.start()
    try:
        until_state(camera, "ready")
        folder.rmdir()
        camera.fire(1)
        assert "card is not there" in failed(camera, 1)
    finally:
        camera.stop()


def test_a_line_that_another_program_holds_is_named_and_taken_when_it_is_free(body: FinePix) -> None:
    body.hold_line(True)
    camera = ComposedCamera(WHO, line(body), None, ComposedSettings(follows="later", hold_s=0.01, retry_s=0.02))
    camera.start()
    try:
        faulted = until_state(camera, "faulted")
        assert "/dev/gpiochip0" in faulted.reason
        camera.fire(1)
        assert of_shots(until_shot_ends(camera, 1)) == [(ShotFailed, 1)]
        body.hold_line(False)
        until_state(camera, "ready")
        camera.fire(2)
        assert of_shots(until(camera, lambda event: isinstance(event, Deferred))) == [(Fired, 2), (Deferred, 2)]
    finally:
        camera.stop()
    assert body.made == 1


def _closed(events: Sequence[object]) -> None:
    for event in events:
        if isinstance(event, Arrival):
            event.blob.close()


# --- settings


def test_a_fujifilm_without_a_shutter_line_says_which_there_are() -> None:
    with pytest.raises(CameraError, match="gpio:CHIP:LINE"):
        fujifilm.open_camera({})


@pytest.mark.parametrize(
    ("pickup", "words"), [("later", "flight pickup"), ("storage", "storage"), ("usb:", "usb:"), ("", "flight pickup")]
)
def test_a_fujifilm_says_how_its_files_will_come(pickup: str, words: str) -> None:
    camera = fujifilm.open_camera({"shutter": "outside", "pickup": pickup, "hold_ms": 1})
    camera.start()
    try:
        until_state(camera, "ready")
        camera.fire(1)
        told = until(camera, lambda event: isinstance(event, Deferred))[-1]
        assert isinstance(told, Deferred)
        assert words in told.reason
    finally:
        camera.stop()


@pytest.mark.parametrize(
    ("settings", "word"),
    [({}, "camera.pickup"), ({"pickup": "/no/such"}, "/no/such"), ({"pickup": "/tmp", "iso": 1}, "iso"),
     ({"pickup": "/tmp", "timeouts": {"file_s": 0}}, "file_s"), ({"pickup": "/tmp", "hold_ms": "x"}, "hold_ms"),
     ({"pickup": 5}, "pickup")],
)  # fmt: skip
def test_wrong_settings_of_a_folder_are_named(settings: dict[str, object], word: str) -> None:
    with pytest.raises(CameraError, match=word):
        folder.open_camera(settings)


def test_a_wrong_simulation_is_named() -> None:
    with pytest.raises(CameraError, match="colour"):
        simulated.open_camera({"colour": True})
    camera = simulated.open_camera({"picture": "nothing"})
    camera.start()
    faulted = until(camera, lambda event: isinstance(event, StateChanged) and event.state == "faulted")[-1]
    assert isinstance(faulted, StateChanged)
    assert "nothing" in faulted.reason
    camera.stop()


def test_the_mock_s_raf_tells_its_exposure(tmp_path: Path) -> None:
    path = tmp_path / "one.RAF"
    path.write_bytes(picture(1, 12.5, T0))
    with path.open("rb") as file:
        found = read_exif(file)
    assert (found.make, found.model, found.focal_length_mm) == ("FUJIFILM", "FinePix S5200", 12.5)
    assert found.taken == time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(T0))
