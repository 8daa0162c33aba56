"""A recorded flight, or a folder of frames, through the pipeline again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from PIL import Image

from dappled import codec
from dappled.cli import main
from dappled.config.settings import PoseSettings, Settings
from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import PendingShot, PendingShots, ShotEnds
from dappled.daemon.pipeline.pipeline import Decoding, Pipeline
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.verdicts import Judge
from dappled.daemon.replay import replay
from dappled.daemon.replay.replay import RecordedTelemetry, ReplayProgress
from dappled.drivers.camera import Arrival, CameraEvent, Fired, Identity, Noticed, ShotFailed, StateChanged
from dappled.drivers.replay import ReplayCamera
from dappled.errors import DappledError
from dappled.findings import Code, Subject, finding, named, told
from dappled.flight import Cause, FlightError, Shot, TimeSource
from tests.daemon.fakes import FakeCamera, FakeDecoder, failed, fired, good, rig
from tests.drivers.mavlink import logs_here
from tests.drivers.mavlink.true_logs import written
from tests.simulated.finepix import picture
from tests.waiting import eventually


def record(flights: Path) -> Path:
    """A flight of two frames, with a failed shot between."""
    with rig(flights, lambda shot: [fired(shot), failed(shot)] if shot == 1 else good(shot)) as one:
        for number in range(3):
            one.request(number)
            one.ended(number)
    return one.flight.folder.path


def again(flight: Path, pace: replay.Pace | None = None) -> list[str]:
    """The verdict of a replay."""
    recording = replay.of_flight(flight)
    verifier = replay.verifier(recording)
    ended: list[PendingShot] = []

    class Progress(ReplayProgress):
        def finished(self, pending: PendingShot) -> None:
            ended.append(pending)
            super().finished(pending)

    progress = Progress()
    camera = ReplayCamera(recording.files, Identity("dappled", "recording", "", ""))
    shots = PendingShots(camera)
    judge = Judge(PoseSettings().mount, on_gimbal=False)
    decoding = Decoding(ShotEnds(shots, verifier, progress), FakeDecoder(), None, capacity=100, judge=judge)
    telemetry = RecordedTelemetry(Settings(pose=PoseSettings(0.0)), recording.telemetry, recording.horizons)
    pipeline = Pipeline(decoding, telemetry, BodyLatency(60.0, 15.0), Names("test", "mask", "geometric"))
    pipeline.start()
    try:
        replay.play(recording, shots, progress, time=replay.clock(recording), pace=pace, timeout_s=60)
    finally:
        pipeline.stop(5)
    assert len(ended) == len(recording.shots)
    # the fake's frames are no raw files
    return [str(named(one)) for one in verifier.verdict() if one.facts.get("kind") != "unreadable"]


def test_the_same_flight_gives_the_same(tmp_path: Path) -> None:
    flight = record(tmp_path)
    assert again(flight) == []
    assert again(flight, replay.as_recorded(1e5)) == []


@pytest.mark.parametrize("data", [b"frame 3", b"frame", b""])
def test_a_changed_frame_is_told_and_ends(tmp_path: Path, data: bytes) -> None:
    flight = record(tmp_path)
    (flight / "frames" / "000002.dng").write_bytes(data)
    assert any("000002.dng is not the file that was recorded" in text for text in again(flight))


def test_a_missing_frame_is_told_and_ends(tmp_path: Path) -> None:
    flight = record(tmp_path)
    (flight / "frames" / "000002.dng").unlink()
    assert any("000002.dng can't be read" in text for text in again(flight))


LATE = finding(Code.FRAME_UNCONFIRMED, Subject("frame", 0), shot=0)


def test_what_was_told_of_a_shot_in_flight_is_no_difference(tmp_path: Path) -> None:
    """A driver that never says when it fired, and a file that may be another shot's: both go into the tag."""

    def untold(shot: int) -> list[CameraEvent | Exception]:
        (_, arrival) = good(shot)
        assert isinstance(arrival, Arrival)
        rival = finding(Code.FRAME_RIVAL_PICTURE, Subject("frame", 0), picture="IMG_0007.CR2")
        return [dataclasses.replace(arrival, facts={"doubt": codec.plain(LATE)}), Noticed(rival, 5)]

    with rig(tmp_path, untold) as one:
        one.request(0)
        one.ended(0)
        eventually(lambda: any(text.startswith("later doubt: ") for text in one.events()), "the later doubt")
        told = one.flight.ledger.tag(0)
        assert told is not None
        assert (told.time_source, told.doubts) == (TimeSource.REQUEST, (LATE,))
        assert {event.kind for event in one.flight.ledger.events()} >= {"untimed", "doubt"}
    assert again(one.flight.folder.path) == []


def test_the_street_hears_the_recordings_clock(tmp_path: Path) -> None:
    recording = replay.of_flight(record(tmp_path))
    clock = replay.clock(recording)
    first, last = recording.shots[0], recording.shots[-1]
    assert (clock.utc_ns(), clock.monotonic_ns()) == (first.wished_utc_ns, first.wished_monotonic_ns)
    camera = ReplayCamera(recording.files, Identity("dappled", "recording", "", ""), clock)
    camera.start()
    ready = camera.next_event(1)
    assert isinstance(ready, StateChanged)
    assert ready.monotonic_ns == first.wished_monotonic_ns
    clock.advance_to(last.wished_utc_ns)
    camera.fire(1)  # it failed
    fired, failed = camera.next_event(1), camera.next_event(1)
    assert isinstance(fired, Fired)
    assert isinstance(failed, ShotFailed)
    assert failed.monotonic_ns == last.wished_monotonic_ns


def test_pace() -> None:
    slept: list[float] = []
    wait = replay.as_recorded(2.0, slept.append)
    shots = [Shot(i, Cause("t", "k"), ns, ns) for i, ns in enumerate((0, 3_000_000_000, 2_000_000_000))]
    for shot, before in zip(shots, [None, *shots], strict=False):
        wait(shot, before)
    assert slept == [1.5, 0.0]


def test_what_is_no_flight(tmp_path: Path) -> None:
    with pytest.raises(FlightError):
        replay.of_flight(tmp_path / "nothing")
    with rig(tmp_path) as one:
        pass
    with pytest.raises(DappledError, match="holds no frames"):
        replay.of_flight(one.flight.folder.path)


def test_a_folder_of_frames(tmp_path: Path) -> None:
    for name in ("b.png", "a.png", "notes.txt"):
        (tmp_path / name).write_bytes(name.encode())
    found = replay.of_folder(tmp_path, "*", None, 1_000, 2.0)
    assert [one.camera_name for one in found.files] == ["a.png", "b.png"]
    assert [shot.wished_utc_ns for shot in found.shots] == [1_000, 2_000_001_000]


def test_a_folder_s_frames_stand_by_time_or_as_cameras_count(tmp_path: Path) -> None:
    for name in ("IMG_0001.png", "IMG_0002.png", "IMG_9998.png", "IMG_9999.png"):
        (tmp_path / name).write_bytes(b"undated")
    found = replay.of_folder(tmp_path, "*", None, 0, 1.0)
    assert [one.camera_name[4:8] for one in found.files] == ["9998", "9999", "0001", "0002"]
    assert found.findings == ()
    for name, taken_s in (("frame_2.RAF", 120), ("frame_10.RAF", 130), ("frame_11.RAF", 60)):
        (tmp_path / name).write_bytes(picture(1, 6.3, taken_s))
    found = replay.of_folder(tmp_path, "*.RAF", None, 0, 1.0)
    assert [one.camera_name for one in found.files] == ["frame_11.RAF", "frame_2.RAF", "frame_10.RAF"]
    said = "picture frame_11.RAF: its name comes after frame_10.RAF, but it was taken 70 s earlier, and time counts"
    assert [str(told(one)) for one in found.findings] == [said]


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (
            b"ULog\x01\x12\x35\x01",
            "log.x (holds no messages|is damaged as a log of PX4|.*needs pyulog)",
        ),
        (b"\xa3\x95\x80\x80Y", "log.x (holds no fix|is damaged as a log of ArduPilot)"),
    ],
)
@pytest.mark.parametrize("start_utc_ns", [None, 1_000])
def test_an_autopilot_s_own_log_that_can_t_be_read_is_refused(
    tmp_path: Path, start: bytes, words: str, start_utc_ns: int | None
) -> None:
    (tmp_path / "a.png").write_bytes(b"a")
    (tmp_path / "log.x").write_bytes(start + bytes(500))
    with pytest.raises(DappledError, match=words):
        replay.of_folder(tmp_path, "*.png", tmp_path / "log.x", start_utc_ns, 1.0)


def test_a_folder_without_what_was_named(tmp_path: Path) -> None:
    with pytest.raises(DappledError, match="matches"):
        replay.of_folder(tmp_path, "*.png", None, 0, 1.0)
    (tmp_path / "a.png").write_bytes(b"a")
    with pytest.raises(DappledError, match="no such telemetry"):
        replay.of_folder(tmp_path, "*", tmp_path / "no.tlog", None, 1.0)
    (tmp_path / "empty.tlog").write_bytes(b"")
    with pytest.raises(DappledError, match="holds no position"):
        replay.of_folder(tmp_path, "*.png", tmp_path / "empty.tlog", None, 1.0)


def test_the_only_telemetry_beside_the_frames_is_theirs(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"a")
    assert replay.of_folder(tmp_path, "*", None, 5, 1.0).telemetry is None
    (tmp_path / "flight.tlog").write_bytes(b"")
    assert replay.of_folder(tmp_path, "*", None, 5, 1.0).telemetry == tmp_path / "flight.tlog"
    (tmp_path / "other.tlog").write_bytes(b"")
    with pytest.raises(DappledError, match=r"holds 2 \.tlog files"):
        replay.of_folder(tmp_path, "*", None, 5, 1.0)
    given = replay.of_folder(tmp_path, "*", tmp_path / "other.tlog", 5, 1.0)
    assert given.telemetry == tmp_path / "other.tlog"


@pytest.fixture
def logs_read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a process for each."""
    monkeypatch.setattr("dappled.drivers.reader_process.read", logs_here.read)


def photographed(folder: Path, *taken: str) -> Path:
    (folder / "frames").mkdir()
    for number, time in enumerate(taken, 1):
        exif = Image.Exif()
        exif[306] = time
        Image.new("RGB", (16, 16)).save(folder / "frames" / f"{number}.jpg", exif=exif)
    return folder / "frames"


@pytest.mark.usefixtures("logs_read_here")
@pytest.mark.parametrize(
    ("taken", "words", "off_s"),
    [
        (("2026:11:21 10:15:03", "2026:11:21 10:15:04"), [], 0),
        (("2026:11:21 15:45:03", "2026:11:21 15:45:04"), [], 0),  # in another zone
        (("2026:11:21 10:16:14", "2026:11:21 10:16:15"), [], 71),
        (("2026:11:21 05:14:01", "2026:11:21 05:14:02"), [], -62),
        (("2026:11:21 10:16:14", "2026:11:21 10:16:15"), ["--start", "2026-11-21T10:15:05Z"], 0),
        (("2026:11:21 10:15:03", "2026:11:21 10:15:07"), [], 3),
        (("2026:11:21 10:15:03", "2026:11:21 10:15:07"), ["--interval", "4"], 0),
        (("2020:01:01 00:00:00", "2020:01:01 00:00:04"), ["--start", "2026-11-21T10:15:04Z"], 3),
    ],
)
def test_pictures_that_say_another_time_than_where_they_are_placed_are_in_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], taken: tuple[str, str], words: list[str], off_s: int
) -> None:
    """The first was placed at the telemetry's first position, whatever it said itself."""
    frames = photographed(tmp_path, *taken)
    for log in written(tmp_path):
        assert main(["replay", str(frames), "--telemetry", str(log), *words]) == bool(off_s)
        said = capsys.readouterr().err
        assert (f"by its EXIF, in any time zone, it was taken {off_s:+d} s from" in said) == bool(off_s)


def test_a_shot_that_never_ends_is_given_up(tmp_path: Path) -> None:
    flight = record(tmp_path)
    recording = replay.of_flight(flight)

    class Deaf(PendingShots):
        def fire(self, shot: Shot) -> None:
            """Never happens."""

    with pytest.raises(DappledError, match="did not come to an end"):
        replay.play(
            recording, Deaf(FakeCamera()), ReplayProgress(), time=replay.clock(recording), pace=None, timeout_s=0.01
        )
