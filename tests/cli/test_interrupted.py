"""^C at any moment: no traceback, exit 130, and 0 for a `run` that has ended in order."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dappled.__main__ import INTERRUPTED
from dappled.cli import VERBS, main
from dappled.mocks.simulation import free_port

# Sends itself a SIGINT as soon as a module begins to load, as a person's ^C may come at any time.
_INTERRUPTS_ITSELF = """
import os, signal, sys
from importlib.abc import MetaPathFinder
wanted = sys.argv.pop(1)
class Watch(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == wanted:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Watch())
from dappled.__main__ import main
sys.exit(main())
"""


SAID = ("simulating ", "flight ", "stream ", "console ")


@pytest.mark.parametrize("module", ["dappled.cli", "numpy", "dappled.cli.config"])
def test_an_interruption_while_modules_load_ends_without_a_word(module: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _INTERRUPTS_ITSELF, module, "config", "show"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (INTERRUPTED, "", "")


# The same for `python -m`, where a stop comes while text is made into code, as it is for each dataclass.
_STOPS_ITSELF = """
import sys
from importlib.abc import MetaPathFinder
class Watch(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "dappled.mocks.simulation":
            exec("import os, signal; os.kill(os.getpid(), signal.SIGTERM)")
sys.meta_path.insert(0, Watch())
"""


def test_a_stop_while_code_is_made_has_the_exit_code_of_an_interruption(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(_STOPS_ITSELF)
    done = subprocess.run(
        [sys.executable, "-m", "dappled", "run", "--simulate"], cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (INTERRUPTED, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("pages", [24, *(pytest.param(few, marks=pytest.mark.long) for few in (0, 1))])
def test_a_run_ends_in_order_with_pages_open(tmp_path: Path, pages: int) -> None:
    port = free_port(socket.SOCK_STREAM)
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:
        said = _interrupted(tmp_path, sockets, port, pages)
    text = "".join(said)
    assert "Traceback" not in text
    assert "died" not in text
    assert said[-1].startswith("0 shots")


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder with a short name, for ipc sockets."""
    with tempfile.TemporaryDirectory(prefix="dpl-") as folder:
        yield Path(folder)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
@pytest.mark.parametrize("moment", ["simulating ", *(pytest.param(one, marks=pytest.mark.long) for one in SAID[1:])])
def test_a_start_is_interrupted(tmp_path: Path, short: Path, moment: str, sent: signal.Signals) -> None:
    """As soon as it has said this."""
    (tmp_path / "d.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "ipc://{short}/s"\n[console]\nbind = "127.0.0.1:0"\n'
    )
    with subprocess.Popen(
        [sys.executable, "-m", "dappled", "run", "--simulate", "--config", "d.toml"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            assert process.stderr is not None
            said = []
            for line in process.stderr:
                said.append(line)
                if line.startswith(moment):
                    break
            os.killpg(process.pid, sent)
            err = "".join([*said, process.communicate(timeout=100)[1]])
        finally:
            process.kill()
    told = f"{process.returncode}, {err}"
    assert process.returncode in (0, INTERRUPTED), told
    assert "Traceback" not in err, told
    assert "died" not in err, told


def _interrupted(tmp_path: Path, sockets: str, port: int, pages: int) -> list[str]:
    """What a run says that is interrupted when so many pages are open."""
    (tmp_path / "d.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "ipc://{sockets}/s"\n'
        f'[console]\nbind = "127.0.0.1:{port}"\n'
    )
    with (
        ExitStack() as stack,
        subprocess.Popen(
            [sys.executable, "-m", "dappled", "run", "--simulate", "--config", "d.toml"],
            cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
        ) as process,
    ):  # fmt: skip
        stack.callback(process.kill)
        assert process.stderr is not None
        said: list[str] = []
        for line in process.stderr:
            said.append(line)
            if line.startswith("camera ready"):
                break
        reader = threading.Thread(target=said.extend, args=[process.stderr])
        reader.start()
        for _ in range(pages):
            page = stack.enter_context(socket.create_connection(("127.0.0.1", port), 60))
            page.sendall(f"GET /api/events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            assert page.recv(12) == b"HTTP/1.1 200"
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the whole group
        assert process.wait(100) == 0
        reader.join(60)
    return said


REFERENCE = ["--camera", "reference-36mm", "--mask", "reference-5x5"]
PRINTING = [
    ["config", "show"],
    ["config", "show", "--json"],
    ["profiles"],
    ["profiles", "--json"],
    ["completion", "bash"],
    ["mask", "table", "--camera", "canon-eos-450d", "--mask", "mask-2"],
    ["carriers", "--shape", "1388", "1844", *REFERENCE, "--focal-length", "50"],
]


@pytest.mark.parametrize("words", PRINTING, ids=lambda words: " ".join(words[:3]))
def test_a_reader_that_has_gone_ends_a_command_quietly(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """As with `dappled … | head -1`."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        assert main(words) == 1
        monkeypatch.undo()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("verb", VERBS)
def test_help_comes_on_a_narrow_terminal_and_without_colour_where_none_is_wanted(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")
    with pytest.raises(SystemExit) as ended:
        main([*verb.split(), "--help"])
    assert ended.value.code == 0
    told = capsys.readouterr()
    assert "\x1b" not in told.out + told.err
    assert told.out.startswith("usage: dappled")


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["watch", "trigger"])
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_command_that_waits_ends_at_once_without_a_traceback(verb: str, sent: signal.Signals, tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="dpl-") as sockets:
        udp = f"udpout:127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
        where = {"watch": [f"ipc://{sockets}/s"], "trigger": ["--url", udp]}[verb]
        process = subprocess.Popen(
            [sys.executable, "-m", "dappled", verb, *where],
            cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert process.stderr is not None
        assert process.stderr.readline().startswith("waiting for a ")
        process.send_signal(sent)
        out, err = process.communicate(timeout=100)
    assert process.returncode == (INTERRUPTED if sent == signal.SIGINT else -signal.SIGTERM)
    assert (out, err) == ("", "")
