"""The machine is built once; dappled is installed in it from its own package, once for each state of the source."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from dappled.mocks.body.body import BodyOptions, SimulatedBody
from tests.machine.uml import HERE, Machine, Station, copy, own_network, station

ROOT = Path(__file__).parents[2]
PACKAGED = ("src", "systemd", "tools/deb.py", "tools/install.py", "requirements-onboard.lock")
SIZE = 2_000_000
FLIGHTS = "/var/lib/dappled/flights"


@pytest.fixture(scope="session")
def built() -> Path:
    done = subprocess.run(
        [sys.executable, ROOT / "tools/machine/build.py"], stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        pytest.skip("no whole machine can be built here: see what tools/machine/build.py says")
    return Path(done.stdout.strip())


@pytest.fixture(scope="session")
def package(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of this state of the source."""
    names = subprocess.run(
        ["/usr/bin/git", "ls-files", *PACKAGED], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    state = hashlib.sha256(b"".join((ROOT / name).read_bytes() for name in names.split()))
    made = built / f"package-{state.hexdigest()[:16]}.deb"
    if not made.exists():
        folder = tmp_path_factory.mktemp("package")
        make = [sys.executable, ROOT / "tools/deb.py", "--arch=amd64", "--suite=bookworm", "--out", folder]
        subprocess.run([str(word) for word in make], check=True, stdout=sys.stderr)
        for older in built.glob("package-*"):
            older.unlink()
        (found,) = folder.glob("*.deb")
        copy(found, made)
    return made


@pytest.fixture(scope="session")
def installed(built: Path, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A disk on which the package was installed while the machine ran."""
    disk = built / package.with_suffix("").name.replace("package", "installed")
    if disk.exists():
        return disk
    folder = tmp_path_factory.mktemp("install")
    with own_network():
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

    def frames(self) -> dict[int, str]:
        """The hash of each shot's frame, of all flights."""
        listed = self.machine.run(f"cd {FLIGHTS} && sha256sum */frames/*.cr2 2>/dev/null || true").split()
        return {
            int(name.rpartition("/")[2].partition(".")[0]): found
            for found, name in zip(listed[::2], listed[1::2], strict=True)
        }


@pytest.fixture
def scene(built: Path, installed: Path, tmp_path: Path) -> Iterator[Callable[..., Scene]]:
    """Makes the scene: a machine with so much memory that is on, a body, and a station. `disks`: it has these, too."""
    with ExitStack() as stack:
        stack.enter_context(own_network())

        def made(
            memory_mb: int = 1024, body: BodyOptions | None = None, disks: Sequence[Path] = (), usb: Path | None = None
        ) -> Scene:
            root = f"{tmp_path / 'written'},{installed}"
            machine = Machine(built, [root, *disks], tmp_path / "console", memory_mb, usb)
            stack.callback(machine.cut)
            machine.start()
            options = body or BodyOptions(picture=f"pattern:{SIZE}:cr2", bind=HERE)
            return Scene(machine, stack.enter_context(SimulatedBody.start(options)), stack.enter_context(station()))

        yield made


_ROWS: list[tuple[str, str]] = []


@pytest.fixture
def table() -> Callable[[str, object], None]:
    """Enters a line in the table that is printed in the end: what was measured, and the value."""
    return lambda what, value: _ROWS.append((what, str(value)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for what, value in _ROWS:
        terminalreporter.write_line(f"{what:<60} {value}")
