"""All verbs: a reader that has gone, a narrow terminal, no colour, SIGTERM and ^C. A new verb must be added here.

One process loads every verb and forks for each call, so that a call costs no start of Python.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from dappled.cli import VERBS

pytestmark = pytest.mark.slow
BODY = ["--camera", "canon-eos-450d"]
MASK = [*BODY, "--mask", "mask-2"]
CALLS: dict[str, list[str]] = {
    "run": ["--config", "none.toml"],
    "replay": ["none"],
    "doctor": ["--config", "none.toml"],
    "status": ["--config", "none.toml"],
    "open": ["none"],
    "watch": ["tcp://127.0.0.1:5599", "--timeout", "0.1"],
    "keys make": ["a/b"],
    "keys show": ["none.toml"],
    "keys token": ["none/token"],
    "keys seal": ["none/key"],
    "trigger": ["--key", "none.key"],
    "mavlink key": ["none/key"],
    "decode": ["none.dng", "--mask", "mask-2", "-o", "f.zarr"],
    "picture": ["none.cr2", "--mask", "mask-2", "-o", "p.dng"],
    "carriers": ["--shape", "1388", "1844", *MASK, "--focal-length", "50"],
    "calibrate": ["none.dng", "--mask", "mask-2", "-o", "c.toml"],
    "views": ["none.zarr", "-o", "v.png"],
    "refocus": ["none.zarr", "--alpha", "1", "-o", "r.png"],
    "depth": ["none.zarr", "-o", "d.npz"],
    "export": ["none.zarr", "--as", "npz", "-o", "e.npz"],
    "mask make": ["none.toml", "-o", "none/m.png"],
    "mask table": MASK,
    "mask diffraction": ["--mask", "mask-2"],
    "mask design": [*BODY, "--altitude", "100"],
    "mask plan": [*BODY, "--altitude", "100", "--speed", "5"],
    "mask kit": ["none/kit", "--camera", "none.toml"],
    "plan": [*BODY, "--altitude", "100", "--speed", "5"],
    "flight list": ["--config", "none.toml"],
    "flight show": ["none"],
    "flight check": ["none"],
    "flight report": ["none"],
    "flight seal": ["none"],
    "flight offload": ["none", "there"],
    "flight coverage": ["none"],
    "flight gnss": ["none"],
    "flight pickup": ["none", "--from", "card"],
    "geotag": ["none"],
    "georeference": ["none"],
    "terrain volume": ["none", "none"],
    "terrain contours": ["none", "-o", "c.geojson"],
    "batch": ["none", "-o", "out"],
    "hand-over": ["odm", "http://127.0.0.1:9", "none"],
    "config check": ["none.toml"],
    "config show": [],
    "init": ["none/dappled.toml"],
    "completion": ["bash"],
    "profiles": [],
}
"""What each verb is called with: it ends by itself, well or with a sentence."""

# Reads calls as JSON, a line each, and answers each with its exit code (negative: a signal), output and errors.
_FORKS = """
import gc, importlib, json, os, signal, sys, tempfile
from dappled import __main__ as program
from dappled.cli import VERBS, calling
for module, _ in VERBS.values():
    importlib.import_module(f"dappled.cli.{module.partition(':')[0]}")
gc.freeze()
for line in sys.stdin:
    call = json.loads(line)
    out, err = tempfile.TemporaryFile(), tempfile.TemporaryFile()
    if (child := os.fork()) == 0:
        if call["closed"]:
            read, write = os.pipe()
            os.close(read)
            os.dup2(write, 1)
        else:
            os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.environ.update(call["environment"])
        if call["signal"]:
            def counted(frame, event, argument):
                left.append(event)
                if len(left) == 40:
                    sys.setprofile(None)
                    os.kill(os.getpid(), call["signal"])
            left, begun = [], []
            before = signal.signal
            def restored(number, handler):  # the verb begins: from here on its calls are counted
                found = before(number, handler)
                if handler is signal.default_int_handler and not begun:
                    begun.append(True)
                    sys.setprofile(counted)
                return found
            signal.signal = restored
        sys.argv = ["dappled", *call["words"]]
        sys.exit(program.main())
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    said = []
    for file in (out, err):
        file.seek(0)
        said.append(file.read().decode())
    print(json.dumps([code, *said]), flush=True)
"""


class Forks:
    """The process that forks. `call` gives (exit code, output, errors)."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def call(
        self, words: list[str], *, closed: bool = False, sent: int = 0, **environment: str
    ) -> tuple[int, str, str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        told: dict[str, Any] = {"words": words, "closed": closed, "signal": sent, "environment": environment}
        self._process.stdin.write(json.dumps(told) + "\n")
        self._process.stdin.flush()
        code, out, err = json.loads(self._process.stdout.readline())
        return code, out, err


@pytest.fixture(scope="module")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    folder = tmp_path_factory.mktemp("verbs")
    with subprocess.Popen(
        [sys.executable, "-c", _FORKS], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Forks(process)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(60) == 0


def test_no_verb_is_left_out() -> None:
    assert set(CALLS) == set(VERBS)


FEW = ("run", "decode", "watch", "flight offload")
EACH = [*FEW, *(pytest.param(name, marks=pytest.mark.long) for name in CALLS if name not in FEW)]


def well(told: tuple[int, str, str]) -> tuple[int, str, str]:
    """What a command told, if it is fit for a person: a documented exit code, no traceback, no escape sequences."""
    code, out, err = told
    assert code in (0, 1, 2), told
    for word in ("Traceback", "Exception ignored", "BrokenPipe", "Broken pipe", "\x1b"):
        assert word not in out + err, told
    return told


@pytest.mark.parametrize("name", EACH)
def test_a_narrow_terminal_without_colour_and_a_reader_that_has_gone(forks: Forks, name: str) -> None:
    words = [*name.split(), *CALLS[name]]
    usual, out, _ = well(forks.call(words, COLUMNS="40", NO_COLOR="1"))
    code, _, err = well(forks.call(words, closed=True))
    assert code == (1 if out else usual)
    if out and not usual:
        assert err == ""
    code, told, _ = well(forks.call([*name.split(), "--help"], COLUMNS="40", NO_COLOR="1"))
    assert code == 0
    assert told.startswith("usage: dappled")


HOSTILE = "none\x1b[2J\x9b2J\u202e\u2028\r\nFORGED"


@pytest.mark.parametrize("name", CALLS)
def test_names_of_files_move_no_cursor_and_begin_no_line(forks: Forks, name: str) -> None:
    words = [*name.split(), *(word.replace("none", HOSTILE) for word in CALLS[name])]
    _, out, err = forks.call(words)
    lines = (out + err).split("\n")
    assert all(one.isprintable() and not one.startswith("FORGED") for one in lines), (out, err)


SIGINT, SIGTERM = 2, 15


@pytest.mark.parametrize("sent", [SIGINT, SIGTERM])
@pytest.mark.parametrize("name", EACH)
def test_a_signal_as_it_begins_ends_it_without_a_traceback(forks: Forks, name: str, sent: int) -> None:
    code, _, err = forks.call([*name.split(), *CALLS[name]], sent=sent)
    assert "Traceback" not in err
    assert "Exception ignored" not in err
    assert code in ({130} if sent == SIGINT else {-SIGTERM, 130} if name == "run" else {-SIGTERM})
