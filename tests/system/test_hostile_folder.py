"""No command and no child process runs what lies in the current folder, whoever filled it."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import dappled
from dappled.cli import VERBS
from dappled.drivers.child_process import start_child
from dappled.mocks.autopilot.ground_station import GroundStation
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.products.batch.workers import in_processes
from dappled.products.exports import h5_reader
from tests.products.batch.test_batch import answer, job

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).parent / "dappled"
TAKEN = """
dappled numpy scipy PIL zmq json argparse logging socket signal subprocess multiprocessing asyncio uvicorn h5py
starlette pymavlink gphoto2 rawpy tifffile tomllib dataclasses random tempfile runpy sqlite3 sitecustomize
usercustomize site encodings codecs os io gpiod zarr pyulog
"""


class HostileFolder:
    """A folder whose modules, named as those that dappled loads, tell that they were run."""

    def __init__(self, path: Path) -> None:
        self.path, self._ran = path, path / "ran"
        for name in TAKEN.split():
            text = f"open({str(self._ran)!r}, 'a').write({name!r} + ' ')\nraise SystemExit(66)\n"
            (path / f"{name}.py").write_text(text, encoding="utf-8")

    def call(self, *command: str | Path, timeout_s: float = 120, **more: str) -> subprocess.CompletedProcess[str]:
        """Run a command here, with a home and settings of its own."""
        words = [str(word) for word in command]
        inside = {**os.environ, "HOME": str(self.path), **more}
        return subprocess.run(
            words, cwd=self.path, env=inside, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
            timeout=timeout_s,
        )  # fmt: skip

    @property
    def ran(self) -> str:
        """The names of the modules that were run."""
        return self._ran.read_text(encoding="utf-8") if self._ran.exists() else ""


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> HostileFolder:
    monkeypatch.chdir(tmp_path)
    return HostileFolder(tmp_path)


def a_process_with_a_channel() -> None:
    process, channel = start_child("json.tool", quiet=True)
    process.wait(60)
    channel.close()


def a_reader_of_hdf5() -> None:
    Path("empty.h5").touch()
    with pytest.raises(ValueError, match=r"HDF5|file signature|Unable"):
        h5_reader.read(Path("empty.h5"), ["views"], "attributes")


def a_ground_station() -> None:
    code, _ = GroundStation.start("udpout:127.0.0.1:9", 0, timeout_s=1.0).wait(60)
    assert code != 66


def a_body() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2")) as body:
        assert body.releases == 0


def a_worker() -> None:
    assert [one.frame for one in in_processes([job("one")], answer, 1)] == ["one"]


def tool(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "tools")
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("start", [a_process_with_a_channel, a_reader_of_hdf5])
def test_a_child_takes_no_module_from_the_current_folder(hostile: HostileFolder, start: Callable[[], None]) -> None:
    start()
    assert hostile.ran == ""


@pytest.mark.slow
@pytest.mark.parametrize("start", [a_ground_station, a_body, a_worker])
def test_nor_does_a_simulated_one(hostile: HostileFolder, start: Callable[[], None]) -> None:
    start()
    assert hostile.ran == ""


@pytest.mark.parametrize("installed", [True, False], ids=["make install", "package"])
def test_the_installed_command_takes_none_either(
    hostile: HostileFolder, monkeypatch: pytest.MonkeyPatch, *, installed: bool
) -> None:
    wrapper = hostile.path / "wrapper"
    home = "" if installed else Path(dappled.__file__).parents[1]
    wrapper.write_text(tool("install", monkeypatch).COMMAND.format(home=home, python=sys.executable), encoding="utf-8")
    wrapper.chmod(0o755)
    done = hostile.call(wrapper, "--version", PYTHONPATH=f"{hostile.path}:")
    assert hostile.ran == ""
    assert done.stdout == f"dappled {dappled.__version__}\n"


FEW = ("run", "decode", "depth", "watch", "trigger", "flight offload", "geotag", "batch", "mask kit")


@pytest.mark.slow
@pytest.mark.parametrize(
    "verb", [*FEW, *(pytest.param(verb, marks=pytest.mark.long) for verb in VERBS if verb not in FEW)]
)
def test_no_verb_takes_a_module_from_the_current_folder(hostile: HostileFolder, verb: str) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):  # `run` and `open` go on
        hostile.call(COMMAND, *verb.split(), timeout_s=6)
    assert hostile.ran == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    ["run --simulate --frames 1 --seed 3", "doctor --json", "open nothing.h5", "views empty.h5 -o views.png", "plan"],
)
def test_nor_do_the_processes_that_verbs_start(hostile: HostileFolder, words: str) -> None:
    Path("empty.h5").touch()
    hostile.call(COMMAND, *words.split())
    assert hostile.ran == ""
