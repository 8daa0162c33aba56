"""A process that was forked is as one that was started."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

from dappled.drivers.python_command import python_module

BODY = "dappled.mocks.body.body"
COMMAND = python_module(BODY, '{"picture": "pattern:1000:jpg"}')


def asked(*words: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = python_module("dappled", *words)
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)


def test_words_output_exit_code_and_folder_are_its_own(tmp_path: Path) -> None:
    (tmp_path / "dappled.toml").write_text("[record]\ndirectory = 7\n", encoding="utf-8")
    told = asked("--version")
    assert (told.returncode, told.stdout[:8], told.stderr) == (0, "dappled ", "")
    wrong = asked("config", "check", "dappled.toml", folder=tmp_path)
    assert wrong.returncode == 2
    assert "dappled.toml" in wrong.stdout + wrong.stderr


def test_it_is_a_child_with_the_limits_and_descriptors_that_it_was_given() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, hard))
    try:
        with subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0) as body:
            assert body.stdout is not None
            assert body.stdout.readline().startswith(b"port ")
            own = Path(f"/proc/{body.pid}")
            status = dict(line.split(":\t", 1) for line in (own / "status").read_text().splitlines() if ":\t" in line)
            assert int(status["PPid"]) == os.getpid()
            assert os.getpgid(body.pid) == body.pid
            shown = (own / "cmdline").read_bytes().split(b"\0")
            assert shown[:4] == [word.encode() for word in (sys.executable, "-P", "-m", BODY)]
            (core,) = [line for line in (own / "limits").read_text().splitlines() if line.startswith("Max core")]
            assert core.split()[4] == "0"
            ends = {os.readlink(one) for one in (own / "fd").iterdir() if one.is_symlink()}
            assert sum(one.startswith("pipe:") for one in ends) == 2
            body.send_signal(signal.SIGKILL)
            assert body.wait(60) == -signal.SIGKILL
    finally:
        resource.setrlimit(resource.RLIMIT_CORE, (soft, hard))
