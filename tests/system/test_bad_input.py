"""Bad input at every door of the running daemon: one clear sentence, the record whole, and the next shot works."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from dappled.cli import main
from dappled.config.settings import Settings
from dappled.daemon.service import Service
from dappled.drivers.mavlink import LinkError
from dappled.errors import DappledError
from dappled.findings import Subject
from dappled.flight import FlightsLock, LedgerReader, flight_report
from dappled.flight.checks import flight_check
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.scene.masked_camera import reference_camera
from tests.standing import words
from tests.system.flying import Flying, assert_whole, flying, settings_of, told
from tests.waiting import eventually

FOCAL_LENGTH = b"\x0a\x92\x05\x00"  # EXIF tag 37386, a rational: as it stands in a little-endian folder
MASKED = {"camera": {"profile": "reference-36mm"}, "mask": {"profile": "reference-5x5"}}


@pytest.fixture
def body() -> Iterator[SimulatedBody]:
    """A body whose pictures are no pictures: made safe all the same."""
    with SimulatedBody.start(BodyOptions(picture="pattern:100000:dng")) as one:
        yield one


@pytest.fixture(scope="session")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A masked frame that decodes."""
    path = tmp_path_factory.mktemp("frame") / "good.dng"
    path.write_bytes(reference_camera(1, scale=0.5, scene="white").bench_frame().file)
    return path


@pytest.fixture
def here(sockets: Path, tmp_path: Path) -> Path:
    """A folder of this test's own whose name is short enough for sockets."""
    folder = sockets / tmp_path.name[-12:]
    folder.mkdir()
    return folder


def before(body: SimulatedBody, here: Path, **tables: dict[str, Any]) -> Settings:
    """Settings for a daemon before this body."""
    camera = {"port": body.port, **tables.pop("camera", {})}
    return settings_of(here, camera=camera, **tables)


def flights(here: Path) -> list[Path]:
    return sorted(path for path in (here / "flights").glob("*-*") if path.is_dir())


def raises_sentence(settings: Settings) -> str:
    """What a daemon that can't start says; it leaves nothing behind."""
    with pytest.raises(DappledError) as caught:
        Service(settings).start()
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert "Traceback" not in sentence
    return sentence


# --- settings: exit 2, because the call is wrong


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("[camera]\nprot = 'usb:'", ["line 2", "prot", "port"]),
        ("[camra]\n", ["camra", "camera"]),
        ("[camera]\ndriver = 'gphoto3'", ["gphoto3", "gphoto2"]),
        ("[camera]\nprofile = 'canon-eos-451d'\n[mask]\nprofile = 'mask-1'", ["canon-eos-451d", "canon-eos-450d"]),
        ("[mask]\nprofile = 'mask-9'", ["mask-9", "mask-5"]),
        ("[decode]\nwhite = 'no.png'\n[mask]\nprofile = 'mask-1'", ["no.png"]),
        ("[mavlink]\nurl = 'udpin:nonsense'", ["udpin:nonsense"]),
        ("[publish]\nslices = 'tcp://0.0.0.0:5555'", ["0.0.0.0", "without keys", "dappled keys make"]),  # noqa: S104  # which must not work
        ("[camera\n", ["not valid TOML"]),
    ],
)
def test_wrong_settings_are_named(
    toml: str, words: list[str], tmp_path: Path, here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "dappled.toml"
    table = f"\n[record]\ndirectory = '{here}/flights'\n"
    endpoint = "" if "[publish]" in toml else f"[publish]\nslices = 'ipc://{here}/s'\n"
    file.write_text(toml + table + endpoint)
    assert main(["run", "--config", str(file), "--for", "0"]) in (1, 2)
    err = capfd.readouterr().err
    assert err.count("\n") == 1
    for word in words:
        assert word in err
    assert not flights(here)
    assert not (here / "s").exists()


@pytest.mark.parametrize("toml", ["[camera]\nprot = 1", "[camera]\ndriver = 'no'", "[record]\ndirectory = '/dev/null'"])
def test_a_wrong_file_exits_2(tmp_path: Path, here: Path, toml: str) -> None:
    file = tmp_path / "dappled.toml"
    file.write_text(f"{toml}\n[publish]\nslices = 'ipc://{here}/s'\n")
    assert main(["run", "--config", str(file), "--for", "0"]) == 2


def test_a_failure_exits_1(tmp_path: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "dappled.toml"
    file.write_text(f"[record]\ndirectory = '{here}/flights'\n[publish]\nslices = 'ipc://{here}/s'\n")
    with FlightsLock(here / "flights"):
        assert main(["run", "--config", str(file), "--for", "0"]) == 1
    assert "another dappled" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--frames", "0"], ["run", "--for", "nan"], ["run", "--for", "-1"], ["replay", ".", "--rate", "0"],
        ["replay", ".", "--start", "noon"], ["watch", "--count", "x"], ["trigger", "--count", "0"], ["fly"], [],
    ],
)  # fmt: skip
def test_a_wrong_call_exits_2(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "Traceback" not in capfd.readouterr().err


# --- the camera


def test_no_camera_on_the_bus(here: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:jpg")) as gone:
        settings = before(gone, here)
    with flying(settings) as daemon:
        eventually(lambda: "the camera is absent" in daemon.problems, "a problem that names the camera")
        assert gone.port in daemon.problems
        decision = daemon.request()
        assert decision.outcome == "refused"
        assert "absent" in decision.words
    assert not daemon.shots


@pytest.mark.slow
def test_without_a_camera_run_ends_0_when_its_time_is_over(here: Path, tmp_path: Path) -> None:
    file = tmp_path / "dappled.toml"
    file.write_text(
        f"[camera]\nport = 'ptpip:127.0.0.1:9:9'\n[record]\ndirectory = '{here}/flights'\n"
        f"[publish]\nslices = 'ipc://{here}/s'\n"
    )
    done = dappled_run(file, "--for", "1.5")
    assert done.returncode == 0
    assert "caution: no MAVLink link is configured" in done.stderr
    assert "Traceback" not in done.stderr
    (flight,) = flights(here)
    assert_whole(flight)
    assert not (here / "s").exists()
    assert not (here / "s.ask").exists()


def test_a_camera_that_another_program_holds_is_taken_when_it_is_free(body: SimulatedBody, here: Path) -> None:
    body.fault("refuse")
    with flying(before(body, here)) as daemon:
        eventually(lambda: "another program" in daemon.problems, "a problem that says who holds it")
        assert "another program" in str(daemon.request().reason)
        body.fault("clear")
        assert daemon.shoot().frame is not None


@pytest.mark.parametrize(
    "fault", ["drop-transfer", *(pytest.param(one, marks=pytest.mark.slow) for one in ("busy 0.3", "short"))]
)
def test_a_fault_that_passes_costs_no_frame(body: SimulatedBody, here: Path, fault: str) -> None:
    with flying(before(body, here)) as daemon:
        daemon.until_ready()
        body.fault(fault)
        for _ in range(2):
            assert daemon.shoot().frame is not None


def test_an_event_that_is_lost_costs_no_frame(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here)) as daemon:
        daemon.until_ready()
        body.fault("no-event")
        assert daemon.shoot().frame is not None


def test_a_camera_that_refuses_fails_one_shot(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here)) as daemon:
        daemon.until_ready()
        body.fault("error")
        failed = daemon.shoot()
        assert failed.frame is None
        assert failed.problem
        assert daemon.shoot().frame is not None
        assert daemon.settled == [(0, False), (1, True)]


def test_a_camera_that_is_gone_mid_shot_comes_back(here: Path) -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:100000:dng", delay_s=0.3)) as body,
        flying(before(body, here)) as daemon,
    ):
        daemon.until_ready()
        index = daemon.request().index
        eventually(lambda: body.releases == 1, "the release")
        body.fault("drop")
        eventually(lambda: any(index == done for done, _ in daemon.settled), "the end of the shot")
        assert daemon.shoot().frame is not None


def test_a_body_that_dies_mid_shot_fails_the_shot(here: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:100000:dng", delay_s=5)) as body:
        with flying(before(body, here, camera={"file_timeout_s": 1.0})) as daemon:
            daemon.until_ready()
            assert daemon.request().outcome == "shot"
            eventually(lambda: body.releases == 1, "the release")
            body.stop()
            eventually(lambda: daemon.settled == [(0, False)], "the shot has failed")
            eventually(lambda: "the camera is" in daemon.problems, "a problem that names the camera")
            assert daemon.request().outcome == "refused"
        assert daemon.shots[0].problem


@pytest.mark.slow
def test_a_silent_camera_fails_the_shot(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here, camera={"file_timeout_s": 1.0})) as daemon:
        daemon.until_ready()
        body.fault("silence 15")
        assert daemon.request().outcome == "shot"
        eventually(lambda: daemon.settled, "the end of the shot", 60)
        body.fault("clear")
        assert daemon.shoot() is not None


# --- the frame


def photographed(picture: str | Path, here: Path, **tables: dict[str, Any]) -> tuple[Flying, Path]:
    """One shot of a file by the masked reference camera; the frame is safe, byte for byte."""
    with (
        SimulatedBody.start(BodyOptions(picture=str(picture))) as body,
        flying(before(body, here, **MASKED, **tables)) as daemon,
    ):
        pending = daemon.shoot()
        assert pending.frame is not None
        assert daemon.settled == [(0, True)]
        folder = daemon.service.folder
        if isinstance(picture, Path):
            assert (folder / pending.frame.name).read_bytes() == picture.read_bytes()
    return daemon, folder


def test_a_good_frame_decodes(frame: Path, here: Path) -> None:
    """What the cases below differ from; and without telemetry a tag says so."""
    daemon, _ = photographed(frame, here)
    (pending,) = daemon.shots
    assert pending.problem is None
    assert pending.decoded is not None
    assert (pending.decoded.carriers_found or 0) > 20
    assert pending.tag is not None
    assert pending.tag.pose.source == "none"
    assert pending.tag.pose.latitude_rad is None


@pytest.mark.slow
def test_a_raw_that_is_no_raw_is_kept_and_not_decoded(here: Path, caplog: pytest.LogCaptureFixture) -> None:
    daemon, flight = photographed("pattern:100000:dng", here)
    (pending,) = daemon.shots
    assert words(pending.problem).startswith("not decoded: ")
    assert "000000.dng" in words(pending.problem)
    assert pending.tag is not None
    assert pending.tag.focal_length_mm is None
    assert any(line.startswith("unreadable: ") and "000000.dng" in line for line in told(flight))
    assert any("not decoded: " in line for line in told(flight))
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize("share", [pytest.param(0.0001, marks=pytest.mark.slow), 0.5])
def test_a_truncated_raw_is_kept_and_not_decoded(frame: Path, here: Path, tmp_path: Path, share: float) -> None:
    cut = tmp_path / "cut.dng"
    data = frame.read_bytes()
    cut.write_bytes(data[: int(len(data) * share)])
    daemon, flight = photographed(cut, here)
    assert words(daemon.shots[0].problem).startswith("not decoded: ")
    assert "000000.dng" in words(daemon.shots[0].problem)
    assert any("not decoded: " in line for line in told(flight))


@pytest.mark.slow
def test_a_frame_of_another_size_than_its_profile_s(here: Path, tmp_path: Path) -> None:
    small = tmp_path / "small.dng"
    small.write_bytes(reference_camera(1, scale=0.2, scene="white").bench_frame().file)
    daemon, _ = photographed(small, here)
    problem = daemon.shots[0].problem
    assert problem is not None
    assert problem.subject == Subject("frame", 0)
    for word in ("not decoded", "reference-36mm", "556 × 738", "1388 × 1844"):
        assert word in words(problem)


@pytest.mark.slow
def test_a_frame_without_its_focal_length(frame: Path, here: Path, tmp_path: Path) -> None:
    data = frame.read_bytes()
    assert data.count(FOCAL_LENGTH) == 1
    without = tmp_path / "without.dng"
    without.write_bytes(data.replace(FOCAL_LENGTH, b"\x0b\x92\x05\x00"))
    daemon, _ = photographed(without, here)
    (pending,) = daemon.shots
    assert pending.tag is not None
    assert pending.tag.focal_length_mm is None
    assert pending.tag.f_number is not None
    assert "not decoded" in words(pending.problem)
    assert "focal length" in words(pending.problem)


@pytest.mark.slow
def test_a_decoder_that_is_killed_loses_one_decode_at_most(frame: Path, here: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture=str(frame))) as body, flying(before(body, here, **MASKED)) as daemon:
        assert daemon.shoot().decoded is not None
        kill_decoders()  # between two frames
        assert daemon.shoot().decoded is not None
        stopped = stop_decoders()
        index = daemon.request().index
        eventually(lambda: (index, True) in daemon.settled, "the frame is safe")
        eventually(lambda: daemon.service.health()["stages"][1]["waiting"], "the frame is with the decoder")
        for process in stopped:
            os.kill(process, signal.SIGKILL)
        eventually(lambda: len(daemon.shots) == 3, "the end of the third shot")
        assert "the decoder died (killed: Killed)" in words(daemon.shots[2].problem)
        assert daemon.shots[2].frame is not None
        assert daemon.shoot().decoded is not None


@pytest.mark.slow
def test_a_decoder_that_hangs_does_not_keep_the_daemon(frame: Path, here: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture=str(frame))) as body, flying(before(body, here, **MASKED)) as daemon:
        assert daemon.shoot().decoded is not None
        stop_decoders()
        daemon.request()
        eventually(lambda: (1, True) in daemon.settled, "the frame is safe")
    eventually(lambda: len(daemon.shots) == 2, "the end of the second shot")
    assert "not decoded" in words(daemon.shots[1].problem)


# --- links and endpoints


def test_an_endpoint_that_is_in_use(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here)) as daemon:
        other = before(body, here, record={"directory": str(here / "other")})
        sentence = raises_sentence(other)
        assert f"ipc://{here}/s is in use by another program" in sentence
        assert not (here / "other").exists()
        assert daemon.shoot().frame is not None


def test_a_mavlink_port_that_is_in_use(body: SimulatedBody, here: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        sentence = raises_sentence(before(body, here, mavlink={"url": f"udpin:127.0.0.1:{port}"}))
    assert f"port {port} is in use" in sentence
    assert not flights(here)
    assert not (here / "s").exists()
    assert issubclass(LinkError, DappledError)


@pytest.mark.slow
def test_a_subscriber_that_never_reads_costs_nothing(frame: Path, here: Path) -> None:
    context = zmq.Context()
    lazy = context.socket(zmq.SUB)
    lazy.setsockopt(zmq.RCVHWM, 1)
    lazy.setsockopt(zmq.SUBSCRIBE, b"")
    asker = context.socket(zmq.DEALER)
    asker.setsockopt(zmq.RCVHWM, 1)
    settings = {"publish": {"high_water_mark": 1, "preview_interval_s": 0.0}}
    try:
        with (
            SimulatedBody.start(BodyOptions(picture=str(frame))) as body,
            flying(before(body, here, **MASKED, **settings)) as one,
        ):
            lazy.connect(f"ipc://{here}/s")
            asker.connect(f"ipc://{here}/s.ask")
            for _ in range(3):
                pending = one.shoot()
                assert pending.problem is None
                asker.send(json.dumps({"get": "slices", "frame": pending.shot.index}).encode())
    finally:
        context.destroy(linger=0)


# --- the disk


def test_a_disk_that_is_nearly_full_refuses_new_shots(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here, record={"min_free_mb": 10_000_000})) as daemon:
        daemon.until_ready()
        decision = daemon.request()
        assert decision.outcome == "refused"
        assert "the disk is nearly full" in decision.words
        assert "the disk is nearly full" in daemon.problems
    assert not daemon.shots
    balance = flight_report.balance(daemon.service.folder)
    assert (balance.wishes, balance.refused) == (0, 1)  # a wish that was refused stands in the flight as well


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """The system refuses to let this process' files grow beyond `size` bytes (EFBIG, as a full disk would ENOSPC)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def small_disk(here: Path) -> Iterator[Path]:
    """A disk of 8 MB, where this user may make one."""
    folder = here / "disk"
    folder.mkdir()
    mount, umount = shutil.which("mount"), shutil.which("umount")
    if not mount or not umount:
        pytest.skip("the command mount is not installed: no small disk can be made")
    made = subprocess.run(
        [mount, "-t", "tmpfs", "-o", "size=8m", "dappled", str(folder)], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip("only root may mount a small disk")
    yield folder
    subprocess.run([umount, "-l", str(folder)], check=True)


def test_a_frame_that_the_disk_does_not_take_fails_its_shot_only(small_disk: Path, here: Path) -> None:
    flights, ballast = small_disk / "flights", small_disk / "ballast"
    flights.mkdir()
    with SimulatedBody.start(BodyOptions(picture="pattern:3000000:dng")) as body:
        with flying(before(body, here, record={"directory": str(flights)})) as daemon:
            daemon.until_ready()
            ballast.write_bytes(bytes(2_500_000))
            shots = [daemon.shoot() for _ in range(2)]
            ballast.unlink()
            shots.append(daemon.shoot())
            assert [pending.frame is not None for pending in shots] == [True, False, True]
            assert "cannot record IMG_0002.DNG as" in words(shots[1].problem)
            assert "the disk is full" in words(shots[1].problem)
            assert sorted(os.listdir(daemon.service.folder / "frames")) == ["000000.dng", "000002.dng"]
            assert body.card == ["IMG_0001.DNG", "IMG_0002.DNG", "IMG_0003.DNG"]
        assert len(flight_check.check(daemon.service.folder).problems) == 0


@pytest.mark.parametrize("inside", ["", "/deeper"])
def test_a_flights_folder_that_is_a_file(body: SimulatedBody, here: Path, inside: str) -> None:
    (here / "file").write_text("")
    sentence = raises_sentence(before(body, here, record={"directory": f"{here}/file{inside}"}))
    assert f"{here}/file" in sentence
    assert "record.directory" in sentence
    assert not (here / "s").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_flights_folder_that_can_t_be_written(body: SimulatedBody, here: Path) -> None:
    (here / "flights").mkdir(mode=0o500)
    assert "permission denied" in raises_sentence(before(body, here))


def test_a_read_only_disk(body: SimulatedBody, here: Path) -> None:
    sentence = raises_sentence(before(body, here, record={"directory": "/proc/dappled"}))
    assert "/proc/dappled" in sentence


@pytest.mark.slow
def test_a_decoder_s_input_that_vanishes_leaves_no_flight(body: SimulatedBody, here: Path, frame: Path) -> None:
    """The copy into the flight fails after the flight has begun."""
    white = here / "white.dng"
    white.write_bytes(frame.read_bytes())
    settings = before(body, here, decode={"white": str(white)}, **MASKED)
    with no_file_above(4_000_000):
        sentence = raises_sentence(settings)
    assert "can't be copied" in sentence
    assert not flights(here)
    assert not (here / "s").exists()
    with flying(settings) as daemon:  # and nothing is in the way of the next
        assert daemon.shoot().frame is not None


def test_two_daemons_on_one_flights_folder(body: SimulatedBody, here: Path) -> None:
    with flying(before(body, here)) as daemon:
        sentence = raises_sentence(before(body, here, publish={"slices": f"ipc://{here}/t"}))
        assert f"process {os.getpid()}" in sentence
        assert str(here / "flights") in sentence
        assert not (here / "t").exists()
        assert len(flights(here)) == 1
        assert daemon.shoot().frame is not None


# --- the process


def dappled_run(config: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dappled", "run", "--config", str(config), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


class Daemon:
    """`dappled run` in a process of its own, before a body, with an interval of shots asked for over MAVLink."""

    def __init__(self, body: SimulatedBody, here: Path, **record: Any) -> None:
        from dappled.daemon.camera_protocol.ground_client import GroundClient  # noqa: PLC0415  # only these two tests fly by radio
        from dappled.mocks.simulation import free_port  # noqa: PLC0415  # as above

        port = free_port()
        config = here / "dappled.toml"
        config.write_text(
            f"[camera]\nport = '{body.port}'\n[record]\ndirectory = '{here}/flights'\nmin_free_mb = 0\n"
            f"[publish]\nslices = 'ipc://{here}/s'\n[mavlink]\nurl = 'udpin:127.0.0.1:{port}'\n[pose]\nwait_ms = 0\n"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dappled", "run", "--config", str(config)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.ground = GroundClient(f"udpout:127.0.0.1:{port}")
        self.here = here

    def until_ready(self) -> None:
        assert self.process.stderr is not None
        assert any("camera ready" in line for line in self.process.stderr)
        self.ground.find_camera(60)

    def __enter__(self) -> Daemon:
        self.ground.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.ground.__exit__()
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate(timeout=60)


@pytest.mark.slow
def test_sigterm_in_the_middle_of_a_shot_finishes_the_frame(here: Path) -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:100000:dng", delay_s=0.7)) as body,
        Daemon(body, here) as daemon,
    ):
        daemon.until_ready()
        result, _ = daemon.ground.command(2000, 0, 0, 1, 1)
        assert result == 0
        eventually(lambda: body.releases == 1, "the release")
        daemon.process.send_signal(signal.SIGTERM)
        out, err = daemon.process.communicate(timeout=60)
        assert daemon.process.returncode == 0, err
        assert "1 shot: 1 frame safe" in err
        assert "000000" in out
    (flight,) = flights(here)
    assert_whole(flight)
    assert flight_report.balance(flight).safe == 1


@pytest.mark.slow
def test_a_killed_daemon_is_put_in_order_by_the_next(here: Path) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:100000:dng", delay_s=3.0)) as body:  # killed before its file
        with Daemon(body, here) as daemon:
            daemon.until_ready()
            (first,) = daemon.ground.capture(1, timeout_s=60)
            assert (first.index, first.ok) == (0, True)
            assert daemon.ground.command(2000, 0, 0, 1, 7)[0] == 0
            eventually(lambda: body.releases == 2, "the second release")
            daemon.process.kill()
            daemon.process.wait(60)
        (killed,) = flights(here)
        assert flight_check.check(killed).problems  # never closed
        with flying(before(body, here)) as after:
            assert after.shoot().shot.index == 2
            with LedgerReader.open(after.service.folder / "flight.sqlite") as ledger:
                assert any(killed.name in event.text for event in ledger.events() if event.kind == "recovery")
    assert_whole(killed)
    balance = flight_report.balance(killed)
    assert (balance.wishes, balance.safe, balance.failed) == (2, 1, 1)
    assert balance.closed


# --- helpers


def decoders() -> list[int]:
    """The decode processes that this process started."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):  # it has just ended
            continue
        if parent == os.getpid() and b"dappled.daemon.pipeline.decode_worker" in words:
            found.append(int(entry.name))
    return found


def kill_decoders() -> None:
    for process in decoders():
        os.kill(process, signal.SIGKILL)
        eventually(lambda: has_ended(process), "the decoder is gone")  # noqa: B023  # called within the turn


def has_ended(process: int) -> bool:
    """Whether the kernel has ended it with all of its threads; its parent may still have to take notice."""
    try:
        first = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        return first and len(list(Path(f"/proc/{process}/task").iterdir())) == 1  # the others end after it
    except OSError:
        return True


def stop_decoders() -> list[int]:
    """They hang, as far as anybody can tell."""
    found = decoders()
    assert found
    for process in found:
        os.kill(process, signal.SIGSTOP)
    return found
