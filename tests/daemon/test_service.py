"""The whole daemon with a fake camera: what its parts tell each other when one of them is in trouble."""

from __future__ import annotations

import logging
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.config import settings as configuration
from dappled.config.settings import (
    DecodeSettings,
    MaskSettings,
    PoseSettings,
    PublishSettings,
    RecordSettings,
    Settings,
)
from dappled.daemon import flight_control
from dappled.daemon import service as module
from dappled.daemon.flight_handover import FlightHandover
from dappled.daemon.health import go_no_go, resources
from dappled.daemon.health.standing import in_record
from dappled.daemon.navigation import UtcCorrection
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.service import AGAIN_NS, PeriodicTask, Service
from dappled.drivers.camera import CameraError, Identity, Setting, SettingsChanged, StateChanged
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.findings import told as findings_told
from dappled.flight import FlightError, LedgerReader, Recording, flight_report, layout
from dappled.flight.checks import flight_check
from tests.daemon.camera_protocol.rig import Peer
from tests.daemon.fakes import CallingObserver, FakeCamera, good
from tests.daemon.test_settings_check import MASK, calibration
from tests.standing import codes, problems, words
from tests.waiting import eventually

S = 10**9


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    """The camera that every daemon of this test gets."""
    one = FakeCamera()
    monkeypatch.setattr(module, "open_camera", lambda _: one)
    return one


@pytest.fixture
def settings(tmp_path: Path) -> Iterator[Settings]:
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:
        yield configuration.resolve(
            Settings(
                record=RecordSettings(directory=str(tmp_path / "flights"), min_free_mb=0),
                pose=PoseSettings(0.0),
                publish=PublishSettings(slices=f"ipc://{sockets}/s"),
            )
        )


def started(settings: Settings, shots: list[PendingShot]) -> Service:
    service = Service(settings, observer=CallingObserver(finished=shots.append))
    service.start()
    eventually(lambda: service.health()["camera"]["state"] == "ready", "the camera is ready")
    return service


def told(flight: Path) -> list[str]:
    """The ledger's events, as "kind: text"."""
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        return [f"{event.kind}: {event.words}" for event in ledger.events()]


def test_a_wish_goes_to_the_end_and_can_be_looked_up_in_the_next_flight(camera: FakeCamera, settings: Settings) -> None:
    shots: list[PendingShot] = []
    service = started(settings, shots)
    assert service.request(CaptureRequest("test", "console", 1)).index == 0
    eventually(lambda: shots, "the shot's end")
    assert service.requested == 1
    service.stop()
    assert flight_check.check(service.folder).intact
    assert camera.stopped
    after = started(settings, shots)
    found = after.parts.control.lookup(0)
    assert found is not None
    assert (found.ok, found.url) == (True, "frames/000000.dng")
    assert after.request(CaptureRequest("test", "console", 1)).index == 1
    after.stop()


def test_triggers_lost_in_the_last_seconds_of_a_flight_are_in_its_ledger(
    camera: FakeCamera, settings: Settings
) -> None:
    """They wait 2.5 s for a second link; the flight ended before, and the counts agreed."""
    service = started(settings, [])
    numbers = service.parts.autopilot.numbers["CAMERA_FEEDBACK"]
    for number in (10, 14):
        numbers.heard(number, service._clock.monotonic_ns(), lambda: "noticed here")
    service.stop()
    assert "lost trigger: trigger 11 to 13: became no shot, noticed here" in told(service.folder)
    assert not flight_report.balance(service.folder).balanced


def test_an_old_flight_that_was_moved_away_is_unknown(camera: FakeCamera, settings: Settings) -> None:
    shots: list[PendingShot] = []
    first = started(settings, shots)
    first.request(CaptureRequest("test", "console", 1))
    eventually(lambda: shots, "the shot's end")
    first.stop()
    second = started(settings, shots)
    first.folder.rename(first.folder.parent.parent / "moved")
    assert second.parts.control.lookup(0) is None
    assert second.parts.control.lookup(99) is None
    second.stop()


def test_a_disk_that_can_t_be_asked_refuses_in_words(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = started(settings, [])

    def refuse(_: Path) -> int:
        raise FlightError("cannot ask for the free space of the disk")

    with monkeypatch.context() as broken:
        broken.setattr(layout, "disk_space", refuse)
        decision = service.request(CaptureRequest("test", "console", 1))
    assert decision.words == "no photo: cannot ask for the free space of the disk"
    service.stop()
    assert not camera.fired


@pytest.mark.parametrize("free", [layout.DiskSpace(10**12, 0, 10**12, 3), layout.DiskSpace(10**12, 0, 9000)])
def test_a_disk_without_inodes_or_room_for_the_journal_refuses_in_words(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch, free: layout.DiskSpace
) -> None:
    service = started(settings, [])
    with monkeypatch.context() as full:
        full.setattr(layout, "disk_space", lambda _: free)
        decision = service.request(CaptureRequest("test", "console", 1))
        said = "\n".join(problems(service.health()))
    assert (decision.outcome, decision.reason) == ("refused", free.shortage(0))
    assert ("only 3 more files" in said) == (free.files == 3)
    service.stop()
    assert not camera.fired


def test_too_little_memory_refuses_in_words_as_long_as_that_is_fresh(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = started(settings, [])
    with monkeypatch.context() as small:
        small.setattr(resources, "look", lambda: resources.ResourcesLeft(500, 10**7))
        service.parts.control.look()
    decision = service.request(CaptureRequest("test", "console", 1))
    said = "too little memory is left for a photograph: 10 MB; end other programs"
    assert decision.words == f"no photo: {said}"
    assert said in problems(service.health())
    monkeypatch.setattr(flight_control, "LOOK_VALID_NS", 0)
    assert service.request(CaptureRequest("test", "console", 2)).accepted
    service.stop()


def test_a_flight_that_closes_badly_is_kept(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a shot in the journal there is telemetry still, and perhaps a photograph that somebody took by hand."""
    service = started(settings, [])
    really = Recording.close

    def refuse(recording: Recording) -> None:
        really(recording)  # nothing is left open for the tests after this one
        raise FlightError("the disk went away")

    with monkeypatch.context() as broken:
        broken.setattr(Recording, "close", refuse)
        with pytest.raises(FlightError, match="the disk went away"):
            service.stop()
    assert (service.folder / "flight.sqlite").exists()
    assert (service.folder / "telemetry.tlog").exists()


def test_without_a_mask_decoding_is_off(camera: FakeCamera, settings: Settings) -> None:
    service = started(settings, [])
    assert not service.parts.shots.decoding
    service.stop()


def test_a_start_that_fails_late_leaves_nothing(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise DappledError("not today")

    with monkeypatch.context() as broken:
        broken.setattr(module, "Component", refuse)
        service = Service(settings)
        with pytest.raises(DappledError, match="not today"):
            service.start()
    root = Path(settings.record.directory)
    assert [path.name for path in root.iterdir() if path.is_dir()] == []
    assert not Path(settings.publish.slices.removeprefix("ipc://")).exists()
    started(settings, []).stop()


def test_a_camera_that_can_t_begin_leaves_no_thread_behind(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise CameraError("no such port")

    before = set(threading.enumerate())
    with monkeypatch.context() as broken:
        broken.setattr(camera, "start", refuse)
        with pytest.raises(CameraError, match="no such port"):
            Service(settings).start()
    eventually(lambda: not {thread.name for thread in set(threading.enumerate()) - before}, "every thread has ended")
    assert camera.stopped
    assert [path.name for path in Path(settings.record.directory).iterdir() if path.is_dir()] == []


def test_stop_twice_and_before_start_is_harmless(camera: FakeCamera, settings: Settings) -> None:
    Service(settings).stop()
    service = started(replace(settings), [])
    service.stop()
    service.stop()


def test_a_believed_clock_that_the_satellites_contradict_is_a_problem(camera: FakeCamera, settings: Settings) -> None:
    service = started(replace(settings, record=replace(settings.record, utc="system")), [])
    try:
        assert "clock" not in "".join(problems(service.health()))
        service.parts.navigation.utc.look(UtcCorrection(-3600 * 10**9, 10**7, "SYSTEM_TIME"))
        assert "this machine's clock is +3600 s away" in "".join(problems(service.health()))
    finally:
        service.stop()


def test_another_component_with_our_ids_is_a_problem(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two daemons of which one forgot its component id: the pilot and the health record name where it sends from."""
    service = started(replace(settings, mavlink=replace(settings.mavlink, url=("udpin:127.0.0.1:0",))), [])
    try:
        service.parts.autopilot.identity.settled = True  # as after three seconds
        said = list[str]()
        monkeypatch.setattr(service.parts.component, "say", lambda text, *_, **__: said.append(text))
        with Peer(service.parts.links.port(0), 1, settings.mavlink.component_id) as twin:
            twin.packer.seq = 200
            twin.heartbeat()
            eventually(lambda: "sends as 1/100 too, which is this camera" in stepped(service), "the other camera")
            assert f"127.0.0.1:{twin.socket.getsockname()[1]}" in stepped(service)
            service._publish_health()
            assert any("sends as 1/100 too" in text for text in said)
    finally:
        service.stop()


def test_a_lens_that_was_zoomed_between_two_frames_is_told(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots: list[PendingShot] = []
    service = started(settings, shots)
    try:
        service.request(CaptureRequest("test", "console", 1))
        eventually(lambda: shots, "the shot's end")
        (pending,) = shots
        component, said = service.parts.component, list[str]()
        assert pending.tag is not None
        monkeypatch.setattr(component, "say", lambda text, *_, **__: said.append(text))
        for length_mm in (35.0, None, 35.0, 55.0):
            pending.tag = replace(pending.tag, focal_length_mm=length_mm)
            service.parts.events.tagged(pending)
        assert said == ["image 0 was zoomed from 35 to 55 mm: is it calibrated?"]
    finally:
        service.stop()


def stepped(service: Service) -> str:
    """What the health record says after a turn of the working loop."""
    service.step()
    return "; ".join(problems(service.health()))


def test_a_battery_that_runs_empty_is_told_until_there_is_another(camera: FakeCamera, settings: Settings) -> None:
    service = started(settings, [])
    try:
        camera.say(SettingsChanged((Setting("battery", "Low"),), 1))
        eventually(lambda: "battery is nearly empty: Low" in stepped(service), "the battery")
        camera.say(SettingsChanged((Setting("battery", "100%"),), 2))
        eventually(lambda: "battery" not in stepped(service), "another battery")
    finally:
        service.stop()


class LateClock(SystemClock):
    """It can be put forward."""

    late_ns = 0

    def monotonic_ns(self) -> int:
        return super().monotonic_ns() + self.late_ns


def test_a_service_that_stood_still_tells_so_for_a_minute_and_in_the_ledger(
    camera: FakeCamera, settings: Settings
) -> None:
    clock = LateClock()
    service = Service(settings, clock=clock)
    service.start()
    try:
        service.step()
        clock.late_ns += 4 * S
        assert "stood still" not in stepped(service)
        clock.late_ns += 9 * S
        assert "the service stood still for 9 s" in stepped(service)
        clock.late_ns += 61 * S
        assert Code.SERVICE_STOOD_STILL not in codes(service.health())
    finally:
        service.stop()
    assert any("the service stood still for 9 s" in one for one in told(service.folder))


def test_another_mask_ends_the_flight_between_two_frames(camera: FakeCamera, settings: Settings) -> None:
    after, shots = FlightHandover(settings), list[PendingShot]()
    service = Service(settings, observer=CallingObserver(finished=shots.append), after=after)
    service.start()
    eventually(lambda: service.health()["camera"]["state"] == "ready", "the camera is ready")
    parameters = service.parts.parameters
    camera.script = lambda _: []
    assert service.request(CaptureRequest("test", "console", 1)).index == 0
    with pytest.raises(CameraError, match="1 shot under way"):
        parameters.change("LF_MASK", "mask-3")
    for event in good(0):
        assert not isinstance(event, Exception)
        camera.say(event)
    eventually(lambda: shots, "the shot's end")
    service.parts.shutter.start_interval(CaptureRequest("test", "console", 2), 3600, 0)
    camera.script = good
    with pytest.raises(CameraError, match="stop the interval first"):
        parameters.change("LF_MASK", "mask-3")
    service.parts.shutter.stop_interval()
    for event in good(1):
        assert not isinstance(event, Exception)
        camera.say(event)
    eventually(lambda: service.parts.shutter.statistics().pending == 0, "the interval's shot's end")
    assert parameters.change("LF_MASK", "mask-3")
    assert "next flight begins" in service.request(CaptureRequest("test", "console", 3)).words
    service.run()  # ends by itself
    service.stop()
    assert after.next == replace(settings, mask=MaskSettings("mask-3"))
    assert "next flight: mask mask-3 from there on, by the ground station" in told(service.folder)


def test_a_viewer_s_thread_that_dies_is_told_and_ends_no_flight(
    camera: FakeCamera, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = started(settings, [])
    try:
        with monkeypatch.context() as broken:
            broken.setattr(service.parts.answers, "dead_threads", lambda: ["answers"])
            assert "thread answers: it has ended: restart dappled" in problems(service.health())
            assert service.healthy()
            broken.setattr(service.parts.pipeline, "dead_threads", lambda: ["capture"])
            assert not service.healthy()
    finally:
        service.stop()


def test_a_camera_driver_s_thread_that_dies_is_reported(
    settings: Settings, camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    dead: list[str] = []
    monkeypatch.setattr(camera, "dead_threads", lambda: dead, raising=False)
    service = started(settings, [])
    try:
        assert service.healthy()
        dead.append("gphoto2")
        assert not service.healthy()
        assert "thread gphoto2: it has ended: restart dappled" in problems(service.health())
    finally:
        service.stop()


def test_every_turn_or_at_its_own_pace() -> None:
    done: list[str] = []
    tasks = [PeriodicTask("each"), PeriodicTask("slow", every_ns=S)]
    for now_ns in (5 * S, 5 * S + 1, 6 * S - 1, 6 * S):
        for task in tasks:
            task.turn(partial(done.append, task.name), now_ns)
    assert (done.count("each"), done.count("slow")) == (4, 2)


@pytest.mark.parametrize("error", [DappledError("the disk is full"), RuntimeError("a bug")])
def test_one_that_fails_is_tried_again_and_told_once(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    tries: list[int] = []
    broken = True

    def do() -> None:
        tries.append(1)
        if broken:
            raise error

    task = PeriodicTask("events")
    with caplog.at_level(logging.WARNING):
        for now_ns in (S, S + 1, S + AGAIN_NS - 1, S + AGAIN_NS, S + 2 * AGAIN_NS):
            task.turn(do, now_ns)
    assert len(tries) == 3
    assert len(caplog.records) == 1
    assert task.failing is not None
    assert str(error) in str(findings_told(task.failing))
    broken = False
    task.turn(do, 10 * S)
    task.turn(do, 10 * S)
    assert [len(tries), task.failing] == [5, None]
    broken = True
    with caplog.at_level(logging.WARNING):
        task.turn(do, 11 * S)
    assert len(caplog.records) == 2


def test_a_calibration_of_another_camera_is_no_go_before_the_first_shot_and_refuses_none(
    camera: FakeCamera, settings: Settings, tmp_path: Path
) -> None:
    """The body says who it is when it is connected: only then can its frames' size be compared."""
    settings = replace(
        settings,
        mask=MaskSettings(MASK),
        decode=DecodeSettings(calibration=str(calibration(tmp_path / "c.toml"))),
    )
    shots: list[PendingShot] = []
    service = started(settings, shots)
    assert decoding(service) == []
    other = Identity("FUJIFILM", "FinePix S5200", "", "usb:")
    camera.say(StateChanged("ready", "", 1, other))
    eventually(lambda: decoding(service) == ["decode.misfit"], "no-go")
    assert go_no_go.state(in_record(service.health())) == "no-go"
    assert any(
        text.startswith("frames can't be decoded: the calibration is for frames of ")
        for text in problems(service.health())
    )
    assert service.request(CaptureRequest("test", "console", 1)).accepted
    camera.say(StateChanged("ready", "", 1, Identity("Canon", "Canon EOS 450D", "", "usb:")))
    eventually(lambda: decoding(service) == [], "the right camera")
    service.stop()


def test_frames_that_do_not_decode_are_a_caution_then_no_go_and_are_recorded(
    camera: FakeCamera, settings: Settings
) -> None:
    settings = replace(settings, mask=MaskSettings(MASK), decode=DecodeSettings(enabled=True))
    shots: list[PendingShot] = []
    service = started(settings, shots)
    for index, state in enumerate(
        ["failed", "failed", "failing", "failing"]
    ):  # the fake camera's files are no pictures
        assert service.request(CaptureRequest("test", "console", index)).accepted
        eventually(lambda: len(shots) == index + 1, "the shot's end")  # noqa: B023  # called before the next turn
        assert words(shots[-1].problem).startswith("not decoded")
        assert f"decode.{state}" in decoding(service)
    assert any(text.startswith("decoding fails: the last 4 frames") for text in problems(service.health()))
    service.stop()
    assert flight_check.check(service.folder).intact
    assert len(list((service.folder / "frames").iterdir())) == 4


def decoding(service: Service) -> list[str]:
    """The codes of what stands in the way of decoding."""
    return [code for code in codes(service.health()) if code.startswith("decode.")]
