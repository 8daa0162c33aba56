"""Tests that run in forked workers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TESTS = """
import os
from pathlib import Path

import pytest

HERE = Path(__file__).parent
COLLECTED_BY = os.getpid()


@pytest.fixture(scope="session")
def shared():
    yield
    (HERE / f"ended by {os.getpid()}").touch()


@pytest.mark.parametrize("number", range(12))
def test_each(number, shared, tmp_path):
    assert os.getpid() != COLLECTED_BY
    with (HERE / f"run by {os.getpid()}").open("a") as file:
        file.write(f"{number}\\n")
    print("printed by", number)
    if number == 4:
        os._exit(3)
    assert number != 9
"""

CONFTEST = """
from pathlib import Path

from tests import beside

HERE = Path(__file__).parent


def note(name):
    with (HERE / name).open("a") as file:
        file.write("x")


def pytest_configure(config):
    config.pluginmanager.register(beside.Beside(2, lambda: note("started"), lambda: note("ended")))
"""


def run(folder: Path, *more: str) -> str:
    (folder / "test_them.py").write_text(TESTS)
    (folder / "conftest.py").write_text(CONFTEST)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        *more,
        f"--rootdir={folder}",
        str(folder),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout


def test_each_test_is_run_once_and_a_worker_that_dies_fails_its_own_alone(tmp_path: Path) -> None:
    out = run(tmp_path)
    ran = [line for file in tmp_path.glob("run by *") for line in file.read_text().split()]
    assert sorted(map(int, ran)) == [*range(12)]
    assert "2 failed, 10 passed" in out
    assert "the process that ran it ended: 3\n" in out
    assert "test_them.py::test_each[4]\n" in out
    assert "assert 9 != 9\n" in out
    assert "[worker " in out
    assert "printed by 9" in out
    assert "printed by 8" not in out
    assert (tmp_path / "started").read_text() == "xxx"  # one in the place of the one that died
    assert (tmp_path / "ended").read_text() == "xx"
    runners = {file.name.rpartition(" ")[2] for file in tmp_path.glob("run by *")}
    enders = {file.name.rpartition(" ")[2] for file in tmp_path.glob("ended by *")}
    assert enders < runners
    assert len(runners - enders) == 1


def test_the_first_failure_may_end_them_all(tmp_path: Path) -> None:
    out = run(tmp_path, "-x")
    assert "1 failed" in out
    assert "stopping after 1 failures" in out
    began = {file.name.rpartition(" ")[2] for file in tmp_path.glob("run by *")}
    ended = {file.name.rpartition(" ")[2] for file in tmp_path.glob("ended by *")}
    assert len(began - ended) <= 1  # the one that died
