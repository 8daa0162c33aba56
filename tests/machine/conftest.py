"""The machine is built once; dappled is installed in it from its own package, once for each state of the source.

Scenes that want the same machine, and leave it whole, share it.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path

import pytest

from dappled.mocks.body.body import BodyOptions, SimulatedBody
from tests.machine.uml import HERE, Machine, Network, Station, copy, station
from tests.simulated.usbip import UsbBody

ROOT = Path(__file__).parents[2]
PACKAGED = ("src", "systemd", "tools/deb.py", "tools/install.py", "requirements-onboard.lock")
SUITE = "bookworm"
SIZE = 2_000_000
FLIGHTS = "/var/lib/dappled/flights"


# The machine as it was when the package had been installed: nothing of an earlier scene.
ANEW = f"""
systemctl stop dappled
systemctl reset-failed
for port in 0 1 2 3; do usbip detach -p $port 2>/dev/null; done
until ! grep -qE '^[hs]s +[0-9]+ +00[56]' /sys/devices/platform/vhci_hcd.0/status 2>/dev/null; do sleep 0.1; done
until ! ls /sys/bus/usb/devices 2>/dev/null | grep -qx '1-[1-9]'; do sleep 0.1; done
rm -rf /var/lib/dappled/* && systemd-tmpfiles --create dappled.conf && test -d {FLIGHTS} || exit 1
journalctl -q --rotate
journalctl -q --vacuum-size=1
date -s @$now
"""


class Parts:
    """What a machine is made of, for each of Debian's releases; made when first asked for, where it is missing."""

    def __init__(self, folder: Callable[[], Path]) -> None:
        self._folder = folder

    @cache  # noqa: B019 (it lives as long as the session)
    def built(self, suite: str = SUITE) -> Path:
        """Kernel and disk."""
        return machine_part(f"--suite={suite}")

    @cache  # noqa: B019 (as above)
    def package(self, suite: str = SUITE) -> Path:
        """The package of this state of the source."""
        built = self.built(suite)
        made = built / f"package-{_state()}.deb"
        if not made.exists():
            folder = self._folder()
            make = [sys.executable, ROOT / "tools/deb.py", "--arch=amd64", f"--suite={suite}", "--out", folder]
            subprocess.run([str(word) for word in make], check=True, stdout=sys.stderr)
            for older in built.glob("package-*"):
                older.unlink()
            (found,) = folder.glob("*.deb")
            copy(found, made)
        return made

    @cache  # noqa: B019 (as above)
    def installed(self, suite: str = SUITE) -> Path:
        """A disk on which the package was installed while the machine ran."""
        built = self.built(suite)
        disk = built / f"installed-{_state()}"
        if disk.exists():
            return disk
        package, folder = self.package(suite), self._folder()
        with Network().inside():
            machine = Machine(built, [copy(built / "disk", folder / "disk")], folder / "console")
            try:
                machine.start()
                machine.put("/root/dappled.deb", package.read_bytes())
                machine.run("dpkg -i /root/dappled.deb && rm /root/dappled.deb", timeout_s=600)
                machine.off()
            finally:
                machine.cut()
        for older in built.glob("installed-*"):
            older.unlink()
        copy(folder / "disk", disk)
        return disk


@pytest.fixture(scope="session")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return Parts(lambda: tmp_path_factory.mktemp("part"))


def machine_part(*words: str) -> Path:
    """The folder that tools/machine/build.py made; skips where there is none."""
    build = [sys.executable, str(ROOT / "tools/machine/build.py"), *words]
    done = subprocess.run(build, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no whole machine is here: see what tools/machine/build.py {' '.join(words)} says")
    return Path(done.stdout.strip())


def _state() -> str:
    return hashlib.sha256(b"".join((ROOT / name).read_bytes() for name in _files(*PACKAGED))).hexdigest()[:16]


def _files(*below: str) -> list[str]:
    found = [path for name in below for path in (ROOT / name, *(ROOT / name).rglob("*"))]
    return sorted(str(path.relative_to(ROOT)) for path in found if path.is_file() and path.parent.name != "__pycache__")


class Scene:
    """One machine, one body, one ground station, each at its end of a wire."""

    def __init__(self, machine: Machine, body: SimulatedBody, station: Station) -> None:
        self.machine, self.body, self.station = machine, body, station

    def configure(self, port: str = "", more: str = "") -> None:
        """Settings of the service; those of the links and the camera are given. `port`: not over PTP/IP."""
        settings = (
            f'[camera]\nport = "{port or self.body.port}"\nfile_timeout_s = 120\n'
            f'[mavlink]\nurl = "udpout:{HERE}:14550"\n[record]\ndirectory = "{FLIGHTS}"\n{more}'
        )
        self.machine.put("/etc/dappled/dappled.toml", settings.encode())

    def start(self) -> float:
        """Start the service. Returns the seconds from the start of the unit to READY=1."""
        self.machine.run("systemctl start dappled")
        began_us, ready_us = (int(self.shown(f"{name}TimestampMonotonic")) for name in ("InactiveExit", "ActiveEnter"))
        return (ready_us - began_us) / 1e6

    def begin(self) -> None:
        """Start the service; return when its camera is ready."""
        self.machine.run(
            "systemctl start dappled && until systemctl show -P StatusText dappled | grep -q '^camera ready'; "
            "do sleep 0.2; done",
            timeout_s=240,
        )

    def shown(self, name: str) -> str:
        """A property of the service."""
        return self.machine.run(f"systemctl show -P {name} dappled").strip()

    def photograph(self) -> None:
        """One photograph; what is asked for while the camera is looked for anew may fail."""
        known = len(self.station.captured)
        for _ in range(10):
            self.station.request()
            try:
                return self.station.until(lambda it: len(it.captured) > known, "an announced image", timeout_s=10)
            except AssertionError:
                continue
        raise AssertionError(self.station)

    def kept(self) -> int:
        """How many frames all flights have."""
        return int(self.machine.run(f"ls {FLIGHTS}/*/frames/*.cr2 2>/dev/null | wc -l"))

    def frames(self) -> dict[int, str]:
        """The hash of each shot's frame, of all flights."""
        listed = self.machine.run(f"cd {FLIGHTS} && sha256sum */frames/*.cr2 2>/dev/null || true").split()
        return {
            int(name.rpartition("/")[2].partition(".")[0]): found
            for found, name in zip(listed[::2], listed[1::2], strict=True)
        }


class _Shared:
    """The machine that is on."""

    def __init__(self, parts: Parts, network: Network, folder: Callable[[], Path]) -> None:
        self._parts, self._folder = parts, folder
        self.network = network
        self._on: Machine | None = None
        self._kind: object = None

    def machine(self, memory_mb: int, disks: Sequence[Path], usb: Path | None, *, suite: str) -> Machine:
        """The one that is on, as if it had been started now, or another one."""
        kind = memory_mb, usb, suite
        if self._on is None or disks or kind != self._kind or not self._is_as_new(self._on):
            self.cut()
            folder, disk = self._folder(), self._parts.installed(suite)
            root = f"{folder / 'written'},{disk}"
            made = Machine(self._parts.built(suite), [root, *disks], folder / "console", memory_mb, usb)
            self._on, self._kind = made, kind
            try:
                self._on.start()
            except (OSError, AssertionError):
                self.cut()
                raise
            if usb is not None:
                self._on.put("/root/modules.tar", (usb / "modules.tar").read_bytes())
                self._on.run("tar -C /usr --no-same-owner -xf /root/modules.tar && depmod")
        return self._on

    def _is_as_new(self, machine: Machine) -> bool:
        try:
            machine.run(f"now={time.time():.0f}{ANEW}", timeout_s=60)
        except subprocess.SubprocessError:
            return False  # as a USB bus that does not let go of a body
        return True

    def said(self) -> str:
        """The end of the service's log."""
        if self._on is None:
            return ""
        with self.network.inside():
            return self._on.run("journalctl -u dappled --no-pager -n 50", check=False)

    def cut(self) -> None:
        """Nobody wants it any more."""
        if self._on is not None:
            self._on.cut()
            self._on = None


@pytest.fixture(scope="package")
def shared(parts: Parts, tmp_path_factory: pytest.TempPathFactory) -> Iterator[_Shared]:
    made = _Shared(parts, Network(), lambda: tmp_path_factory.mktemp("machine"))
    yield made
    made.cut()


@pytest.fixture
def scene(parts: Parts, shared: _Shared, request: pytest.FixtureRequest) -> Iterator[Callable[..., Scene]]:
    """Makes the scene: a machine with so much memory that is on, a body, and a station. `disks`: it has these, too.
    `spoils`: no other scene can have this machine afterwards."""
    failed = request.session.testsfailed
    unfit = False
    with ExitStack() as stack:

        def made(
            memory_mb: int = 1024,
            body: BodyOptions | None = None,
            disks: Sequence[Path] = (),
            usb: Path | None = None,
            *,
            suite: str = SUITE,
            spoils: bool = False,
        ) -> Scene:
            nonlocal unfit
            unfit = spoils or bool(disks)
            parts.installed(suite)  # what is fetched for it comes from outside
            stack.enter_context(shared.network.inside())
            machine = shared.machine(memory_mb, disks, usb, suite=suite)
            options = body or BodyOptions(picture=f"pattern:{SIZE}:cr2", bind=HERE)
            kind = SimulatedBody if usb is None else UsbBody
            return Scene(machine, stack.enter_context(kind.start(options)), stack.enter_context(station()))

        yield made
    broken = request.session.testsfailed > failed
    if broken:
        with suppress(subprocess.SubprocessError):
            sys.stderr.write(shared.said())
    if unfit or broken:
        shared.cut()


_ROWS: list[tuple[str, str]] = []


@pytest.fixture
def table() -> Callable[[str, object], None]:
    """Enters a line in the table that is printed in the end: what was measured, and the value."""
    return lambda what, value: _ROWS.append((what, str(value)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for what, value in _ROWS:
        terminalreporter.write_line(f"{what:<60} {value}")
