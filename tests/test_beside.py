"""`pytest --beside`: each test once, what is made once a file once, a process that dies, and an early end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests import beside

ROOT = Path(__file__).parents[1]
TESTS = """
import os
import pytest

@pytest.fixture(scope="module")
def made():
    with open("made", "a") as file:
        file.write(__name__ + "\\n")
    yield
    with open("ended", "a") as file:
        file.write(__name__ + "\\n")

@pytest.mark.parametrize("number", range(4))
def test_each(number, made, tmp_path):
    with open("ran", "a") as file:
        file.write(f"{__name__} {number} {os.getpid()}\\n")
    print("said by", number)
"""


def run(folder: Path, *words: str) -> tuple[int, str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.beside", "-p", "no:cacheprovider", "--beside=2", "-q", *words],
        cwd=folder,
        env=environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def lines(folder: Path, name: str) -> list[str]:
    return (folder / name).read_text(encoding="utf-8").splitlines()


def test_each_test_runs_once_in_some_process_and_a_failure_and_a_death_are_told(tmp_path: Path) -> None:
    (tmp_path / "test_one.py").write_text(TESTS + "\ndef test_dies():\n    os._exit(3)\n", encoding="utf-8")
    (tmp_path / "test_two.py").write_text(TESTS + "\n    assert number != 1, 'wrong'\n", encoding="utf-8")
    code, said = run(tmp_path)
    assert code == 1
    assert sorted(line.rpartition(" ")[0] for line in lines(tmp_path, "ran")) == [
        f"test_{file} {number}" for file in ("one", "two") for number in range(4)
    ]
    processes = {line.split()[2] for line in lines(tmp_path, "ran")}
    assert len(processes) > 1
    assert str(os.getpid()) not in processes
    assert "2 failed, 7 passed" in said
    assert "its process ended with 3" in said
    assert "said by 1" in said
    assert "said by 2" not in said
    assert set(lines(tmp_path, "ended")) >= {"test_two"}  # what is made once a file is ended, too


def test_at_the_first_failure_it_may_end(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"test_{name}.py").write_text(TESTS + "\n    assert number\n", encoding="utf-8")
    code, said = run(tmp_path, "-x")
    assert code == 1
    assert len(lines(tmp_path, "ran")) < 8, said
    assert sorted(lines(tmp_path, "made")) == sorted(lines(tmp_path, "ended"))


def test_tests_that_no_process_asked_for_are_no_success(tmp_path: Path) -> None:
    dies = "import os\nos.register_at_fork(after_in_child=lambda: os._exit(4))\n"
    (tmp_path / "conftest.py").write_text(dies, encoding="utf-8")
    (tmp_path / "test_one.py").write_text(TESTS, encoding="utf-8")
    code, said = run(tmp_path)
    assert code == 2
    assert "4 tests were not run" in said


def test_a_process_goes_on_with_its_file() -> None:
    waiting = beside.Waiting(["a", "a", "a", "b", "b", "c"])
    assert waiting.next("") == (0, "a")
    assert waiting.next("") == (3, "b")  # another process
    assert waiting.next("a") == (1, "a")
    assert waiting.next("b") == (4, "b")
    assert waiting.next("b") == (5, "c")
    assert waiting.next("a") == (2, "a")
    assert waiting.next("a") is None


def test_where_no_file_is_left_it_helps_where_most_is_left() -> None:
    waiting = beside.Waiting(["a", "b", "b", "b"])
    assert waiting.next("") == (0, "a")
    assert waiting.next("") == (1, "b")
    assert waiting.next("a") == (2, "b")
    assert waiting.next("b") == (3, "b")
    assert waiting.next("b") is None
