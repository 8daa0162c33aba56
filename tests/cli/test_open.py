"""`dappled open`: one command shows a light field on a page of this machine, and nothing else."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from dappled.cli import main
from dappled.products.exports import light_files
from tests.daemon.console.test_offline import light_field


@pytest.mark.slow  # a whole process: 4 s
def test_a_light_field_is_served_until_the_command_is_interrupted(tmp_path: Path) -> None:
    """Also beside a browser that keeps the terminal until it is left."""
    path, seen, left = tmp_path / "a.npz", tmp_path / "seen", tmp_path / "left"
    light_files.save(path, light_field())
    words = [sys.executable, "-m", "dappled", "open", str(path)]
    browser = tmp_path / "browser"
    browser.write_text(
        f"#!{sys.executable}\nimport pathlib, sys, time, urllib.request\n"
        f"pathlib.Path({str(seen)!r}).write_bytes(urllib.request.urlopen(sys.argv[1], timeout=30).read())\n"
        f"for _ in range(600):\n    pathlib.Path({str(left)!r}).exists() and sys.exit()\n    time.sleep(0.1)\n"
    )
    browser.chmod(0o755)
    environment = {**os.environ, "BROWSER": f"{browser} %s"}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment) as command:
        try:
            assert command.stdout is not None
            line = command.stdout.readline()
            found = re.search(r"a\.npz: 1 frame at (http://127\.0\.0\.1:\d+)/", line)
            assert found, line
            with httpx.Client(base_url=found[1], timeout=60) as page:
                assert "dappled" in page.get("/").text
                assert page.get("/api/frames/0/views.json").json()["source"] == "the file"
                body = {"sequence": 1, "token": "", "elapsed_ms": 0}
                answer = page.post("/api/shoot", json=body, headers={"origin": found[1]})
                assert answer.status_code == 409
                assert answer.json()["error"] == "this is a recording: nothing can be fired or set"
            until = time.monotonic() + 60
            while not seen.exists() and time.monotonic() < until:
                time.sleep(0.05)
        finally:
            command.send_signal(signal.SIGINT)
        assert command.wait(60) == 130
        left.touch()
    assert b"dappled" in seen.read_bytes()


@pytest.mark.long  # the example is flown: 20 s
def test_the_example_is_small_and_whole_or_not_there(tmp_path: Path) -> None:
    """Without a name: three frames with their truth, in 5 MB; interrupted while it is made, nothing is kept."""
    words = [sys.executable, "-m", "dappled", "open", "--no-browser", "--json"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as command:
        assert command.stderr is not None
        assert "making the example flight" in command.stderr.readline()
        command.send_signal(signal.SIGINT)
        command.communicate(timeout=60)
        assert command.returncode != 0
    assert not [path for path in tmp_path.glob("dappled/*") if not path.name.startswith(".")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment) as command:
        try:
            assert command.stdout is not None
            said = json.loads(command.stdout.readline())
            assert said["frames"] == 3
            with httpx.Client(base_url=said["url"], timeout=60) as page:
                assert page.get("/api/frames/2/views.jpg").content.startswith(b"\xff\xd8")
        finally:
            command.send_signal(signal.SIGINT)
        assert command.wait(60) == 130
    (example,) = [path for path in (tmp_path / "dappled").iterdir() if not path.name.startswith(".")]
    files = [path for path in example.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 5_000_000
    assert len(list((example / "truth").glob("*.npz"))) == 3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["FIELD", "--mask", "mask-2"], "is decoded already: leave mask out"),
        (["FIELD", "--bind", "0.0.0.0:0"], "would be open to the network without a token"),
        (["FIELD", "--bind", "here"], "must be host:port"),
    ],
)
def test_what_can_t_be_opened_is_one_sentence(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    light_files.save(tmp_path / "a.npz", light_field())
    named = {"FIELD": str(tmp_path / "a.npz")}
    assert main(["open", "--no-browser", *(named.get(word, word) for word in words)]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("dappled open: ")
    assert says in said.err
    assert said.err.count("\n") == 1
