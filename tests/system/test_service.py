"""The daemon as systemd runs it: told when it is ready, fed, reloaded, ended; the unit itself; the installed tree."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from pymavlink import mavutil

from dappled.daemon.camera_protocol.ground_client import GroundClient
from dappled.drivers.mavlink import mavlink
from dappled.mocks.simulation import free_port
from tests.standing import problems
from tests.system.conftest import dappled
from tests.tools import tool
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[2]
ANALYZE = shutil.which("systemd-analyze") or ""
analyze = pytest.mark.skipif(not ANALYZE, reason="no systemd-analyze on this machine")


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(30)
        yield listener


RECORD = '[record]\ndirectory = "flights"\nmin_free_mb = 1\n'
HANGING = """
import sys, threading
from pathlib import Path
from dappled.cli import main
from dappled.daemon.service import Service

step, flag = Service.step, Path(sys.argv[1])

def until_told(self):
    step(self)
    while flag.exists():
        threading.Event().wait(0.1)

Service.step = until_told
sys.exit(main(sys.argv[2:]))
"""
"""The daemon, its working loop standing still while a file is there; all its other threads go on."""
LOADED = """
import sys
from pathlib import Path
from dappled.cli import main
from dappled.daemon import after_ready
from dappled.daemon.health.systemd import Notifier

ready, load, folder = Notifier.ready, after_ready.load, Path(sys.argv[1])

def told(self, monotonic_ns):
    (folder / "at-ready").write_text(" ".join(sys.modules))
    ready(self, monotonic_ns)

def loaded():
    load()
    (folder / "later").write_text(" ".join(sys.modules))

Notifier.ready, after_ready.load = told, loaded
sys.exit(main(sys.argv[2:]))
"""
"""The daemon, which writes down what is loaded when it is ready, and when the rest is."""


@contextmanager
def serving(
    manager: socket.socket, folder: Path, settings: str = RECORD, program: Sequence[str] = ("-m", "dappled")
) -> Iterator[subprocess.Popen[str]]:
    """The daemon with no camera at all, as a service."""
    (folder / "dappled.toml").write_text(settings, encoding="utf-8")
    told = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "400000", "RUNTIME_DIRECTORY": str(folder / "r")}
    (folder / "r").mkdir(mode=0o700)
    command = [sys.executable, *program, "run", "--config", str(folder / "dappled.toml")]
    daemon = subprocess.Popen(command, env=os.environ | told, stderr=subprocess.PIPE, text=True)
    try:
        yield daemon
    finally:
        daemon.kill()
        daemon.wait()
        assert daemon.stderr is not None
        daemon.stderr.close()


@pytest.fixture
def served(manager: socket.socket, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    with serving(manager, tmp_path) as daemon:
        yield daemon


def until(manager: socket.socket, wanted: Callable[[str], bool]) -> str:
    """The first message that is wanted; the socket's time-out is the deadline."""
    while True:
        message = manager.recv(4096).decode()
        if wanted(message):
            return message


def test_systemd_hears_of_a_whole_life(manager: socket.socket, served: subprocess.Popen[str], tmp_path: Path) -> None:
    assert until(manager, lambda text: not text.startswith("STATUS")) == "READY=1"
    assert "the camera is" in until(manager, lambda text: "the camera is" in text)  # no body here: said, not fatal
    until(manager, "WATCHDOG=1".__eq__)
    until(manager, "WATCHDOG=1".__eq__)
    settings = tmp_path / "dappled.toml"
    settings.write_text('[record]\ndirectory = "elsewhere"\nmin_free_mb = 2\n', encoding="utf-8")
    served.send_signal(signal.SIGHUP)
    until(manager, lambda text: text.startswith("RELOADING=1\nMONOTONIC_USEC="))
    assert until(manager, lambda text: text == "READY=1" or text.startswith("STOPPING")) == "READY=1"
    settings.write_text("[record\n", encoding="utf-8")
    served.send_signal(signal.SIGHUP)
    until(manager, "READY=1".__eq__)
    served.send_signal(signal.SIGTERM)
    until(manager, "STOPPING=1".__eq__)
    assert served.wait(60) == 0
    said = served.communicate()[1]
    assert "reload: record.min_free_mb is 2 now (was 1)" in said
    assert "takes a restart" in said
    assert "reload: the settings stay as they are:" in said


def test_what_only_frames_need_is_loaded_once_it_is_ready(manager: socket.socket, tmp_path: Path) -> None:
    """On a small computer READY goes with the pages of what is loaded before it."""
    readers = {"PIL", "rawpy", "tifffile"}
    settings = f'{RECORD}[mask]\nprofile = "mask-2"\n[mavlink]\nurl = "udpin:127.0.0.1:{free_port()}"\n'
    later = tmp_path / "later"
    with serving(manager, tmp_path, settings, ("-c", LOADED, str(tmp_path))):
        until(manager, lambda _: later.exists() and bool(later.read_text()))  # the watchdog is fed all the time
    at_ready = set((tmp_path / "at-ready").read_text().split())
    assert not at_ready & (readers | {"difflib", "gpiod", "scipy", "usb", "xml"})
    assert len(at_ready) < 550
    assert readers < set(later.read_text().split())


@pytest.mark.slow
def test_a_service_whose_disk_takes_no_flight_answers_and_says_why_until_it_does(
    manager: socket.socket, tmp_path: Path
) -> None:
    (tmp_path / "flights").symlink_to("/proc/there-is-none")
    port = free_port()
    settings = f'{RECORD}[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n'
    with serving(manager, tmp_path, settings) as daemon, GroundClient(f"udpout:127.0.0.1:{port}") as ground:
        until(manager, "READY=1".__eq__)
        assert "no photographs: cannot make" in until(manager, lambda text: text.startswith("STATUS="))
        until(manager, "WATCHDOG=1".__eq__)
        assert ground.find_camera(60)[1] == mavlink.MAV_COMP_ID_CAMERA
        refused, _ = ground.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1)
        assert refused == mavlink.MAV_RESULT_FAILED
        (tmp_path / "flights").unlink()
        (tmp_path / "flights").mkdir()
        until(manager, lambda text: "the camera is" in text)  # of a flight: it has begun
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(60) == 0
    assert [one.name for one in (tmp_path / "flights").iterdir() if one.is_dir()]


@pytest.mark.slow
def test_a_stopped_process_is_not_fed(manager: socket.socket, served: subprocess.Popen[str]) -> None:
    until(manager, "WATCHDOG=1".__eq__)
    served.send_signal(signal.SIGSTOP)
    manager.settimeout(1)
    with pytest.raises(TimeoutError):  # what was sent before it stood still, and then nothing
        until(manager, lambda _: False)
    served.send_signal(signal.SIGCONT)
    manager.settimeout(30)
    until(manager, "WATCHDOG=1".__eq__)


@pytest.mark.slow
def test_a_loop_that_hangs_is_not_fed_by_other_threads(manager: socket.socket, tmp_path: Path) -> None:
    flag = tmp_path / "hang"
    with serving(manager, tmp_path, program=("-c", HANGING, str(flag))):
        until(manager, "WATCHDOG=1".__eq__)
        flag.touch()
        manager.settimeout(2)
        with pytest.raises(TimeoutError):  # what was sent before it stood still, and then nothing
            until(manager, lambda _: False)
        flag.unlink()
        manager.settimeout(30)
        until(manager, "WATCHDOG=1".__eq__)


@pytest.mark.slow
def test_what_the_watchdog_kills_tells_where_its_threads_stood(
    manager: socket.socket, served: subprocess.Popen[str]
) -> None:
    # While a thread imports, its frames come and go, and who writes down where it stands may read one that is gone.
    eventually(lambda: "rawpy" in Path(f"/proc/{served.pid}/maps").read_text(), "what frames need is loaded")
    for _ in range(3):
        until(manager, "WATCHDOG=1".__eq__)
    served.send_signal(signal.SIGABRT)
    said = served.communicate()[1]
    assert served.returncode == -signal.SIGABRT
    assert "Current thread" in said
    assert "daemon/service.py" in said


@pytest.mark.slow
def test_what_is_amiss_is_told_in_every_place(manager: socket.socket, tmp_path: Path) -> None:
    """systemd's status line, MAVLink's heartbeat and text, the stream and `dappled status`, and the console."""
    links, pages = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    rest = f'[mavlink]\nurl = "udpin:127.0.0.1:{links}"\n[console]\nbind = "127.0.0.1:{pages}"\n'
    settings, deadline = tmp_path / "dappled.toml", time.monotonic() + 60
    with (
        serving(manager, tmp_path, RECORD + rest) as daemon,
        closing(mavutil.mavlink_connection(f"udpout:127.0.0.1:{links}", source_system=255)) as ground,
    ):
        until(manager, "READY=1".__eq__)
        heard = listening(ground, deadline)
        assert any(one.get_type() == "HEARTBEAT" for one in heard)  # the link is up: what comes now is heard
        settings.write_text(RECORD.replace("= 1", "= 9000000") + rest, encoding="utf-8")
        daemon.send_signal(signal.SIGHUP)
        text = "the disk is nearly full"
        assert any(one.get_type() == "STATUSTEXT" and text in one.text for one in heard)
        critical = mavutil.mavlink.MAV_STATE_CRITICAL
        assert any(one.get_type() == "HEARTBEAT" and one.system_status == critical for one in heard)
        until(manager, lambda told: told.startswith("STATUS=") and text in told)
        asked = dappled("status", f"ipc://{tmp_path}/r/slices", "--timeout", "30")
        assert f"stop      {text}" in asked.stdout, asked.stderr
        with httpx.Client(base_url=f"http://127.0.0.1:{pages}", timeout=30) as page:
            eventually(lambda: page.get("/api/state").json()["health"], "the console has heard of the health")
            state = page.get("/api/state").json()
            assert any(text in problem for problem in problems(state["health"]))
            assert re.search(r'^dappled_finding{code="disk.nearly_full"} 2', page.get("/metrics").text, re.MULTILINE)
        with closing(mavutil.mavlink_connection(f"udpout:127.0.0.1:{links}", source_system=254)) as late:
            heard = listening(late, time.monotonic() + 60)  # it missed what was said before
            assert any(one.get_type() == "STATUSTEXT" and text in one.text for one in heard)


def listening(ground: Any, deadline: float) -> Iterator[Any]:
    """What the camera sends to a ground station that is there."""
    while time.monotonic() < deadline:
        ground.mav.heartbeat_send(6, 8, 0, 0, 4)
        message = ground.recv_match(blocking=True, timeout=0.2)
        if message is not None and message.get_srcComponent() == 100:
            yield message


@pytest.fixture(params=["dappled.service", "dappled@.service"])
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The unit of the only camera, and the template of one of several, as they are installed."""
    files = tool("install").service_files(Path("/usr"), Path("/etc"), Path("/bin/true"))
    path = tmp_path / str(request.param)
    path.write_text(files[Path("/usr/lib/systemd/system") / path.name], encoding="utf-8")
    return path


@analyze
def test_the_unit_is_one_that_systemd_understands(unit: Path) -> None:
    verified = subprocess.run([ANALYZE, "verify", unit], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")


@analyze
def test_the_unit_exposes_little(unit: Path) -> None:
    words = [ANALYZE, "security", "--offline=yes", "--threshold=16", str(unit)]
    judged = subprocess.run(words, capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout[-300:]


def test_two_cameras_share_no_folder_no_settings_and_no_memory() -> None:
    """`dappled@.service`: what the only camera's unit names once, the template names for each camera."""
    files = tool("install").service_files(Path("/usr"), Path("/opt/etc"), Path("/usr/bin/dappled"))
    only, each = (files[Path(f"/usr/lib/systemd/system/dappled{at}.service")] for at in ("", "@"))
    assert "ExecStart=/usr/bin/dappled run --config /opt/etc/dappled/%i.toml\n" in each
    shared = set(only.splitlines()) & set(each.splitlines())
    for name in ("ExecStart", "StateDirectory", "RuntimeDirectory", "Environment", "MemoryMax"):
        assert not [line for line in shared if line.startswith(f"{name}=")]
    assert "RuntimeDirectory=dappled-%i\n" in each  # not in /run/dappled, which goes with the other service
    assert len(only.splitlines()) == len(each.splitlines())


def test_a_greedy_decoder_does_not_slow_down_what_feeds_the_watchdog(unit: Path) -> None:
    """MemoryHigh= throttles the whole service: the watchdog ended it on a machine with 512 MB. At MemoryMax= the kernel
    ends the process with the highest score, the console's or the decoder's, and the service goes on."""
    lines = unit.read_text(encoding="utf-8").splitlines()
    assert not [line for line in lines if line.startswith("MemoryHigh=")]
    assert "OOMPolicy=continue" in lines


def test_kinds_of_devices_that_come_with_a_module_are_there_before_the_service_starts(unit: Path) -> None:
    """systemd looks up the kinds of DeviceAllow= once, when it starts the service; a port of a kind that comes later is
    refused until a restart."""
    lines = unit.read_text(encoding="utf-8").splitlines()
    for kind, module in (("ttyACM", "cdc_acm"), ("ttyUSB", "usbserial")):
        assert f"DeviceAllow=char-{kind} rw" in lines
        for what in ("Wants=", "After="):
            assert [line for line in lines if line.startswith(what) and f"modprobe@{module}.service" in line]


def test_the_unit_leaves_the_daemon_what_tells_whether_its_clock_can_be_believed(unit: Path) -> None:
    """/proc/sys (the boot's id) and /proc/device-tree (a board without a clock); ProtectClock= takes adjtimex away."""
    directives = unit.read_text(encoding="utf-8").splitlines()
    assert "ProcSubset=pid" not in directives
    assert "ProtectClock=yes" in directives


@pytest.mark.slow
def test_the_service_s_settings_are_good() -> None:
    words = [sys.executable, "-m", "dappled", "config", "check", str(ROOT / "systemd/dappled.toml")]
    assert subprocess.run(words, capture_output=True, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_installed_flown_and_removed(tmp_path: Path) -> None:
    """`make install` into an empty prefix, one flight with what it installed, and `make uninstall`."""
    prefix, home = tmp_path / "prefix", tmp_path / "home"
    home.mkdir()
    make = ["make", "-C", str(ROOT), f"PREFIX={prefix}", f"PYTHON={sys.executable}"]
    subprocess.run([*make, "install"], check=True, capture_output=True)
    unit = (prefix / "lib/systemd/system/dappled.service").read_text(encoding="utf-8")
    assert f"ExecStart={prefix}/bin/dappled run --config {prefix}/etc/dappled/dappled.toml" in unit
    size_mb = sum(path.lstat().st_size for path in prefix.rglob("*")) / 1e6
    assert size_mb <= 350
    flown = subprocess.run(
        [prefix / "bin/dappled", "run", "--simulate", "--frames", "1"],
        cwd=home,
        capture_output=True,
        text=True,
        check=False,
    )
    assert flown.returncode == 0, flown.stderr
    assert "1 shot: 1 frame safe, 1 decoded" in flown.stderr
    settings = prefix / "etc/dappled/dappled.toml"
    settings.write_text("# mine\n", encoding="utf-8")
    subprocess.run([*make, "install"], check=True, capture_output=True)
    assert settings.read_text(encoding="utf-8") == "# mine\n"
    subprocess.run([*make, "uninstall"], check=True, capture_output=True)
    assert [path for path in prefix.rglob("*") if path.is_file()] == [settings]
