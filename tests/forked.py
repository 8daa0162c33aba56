"""The processes of dappled that default tests start are forked from one that has their modules loaded.

`python -m dappled…` takes a core for 0.2 to 1 s before it does anything, and there are hundreds in a run of tests. So
one process a test run (a worker's) loads the modules of each program when it is first asked for, and forks itself for
each start: a process with an id, descriptors, limits, environment, folder and arguments of its own, whose parent is the
tests' process. Slow and long tests start theirs from nothing; so does a process that was forked.

Run as a program it is that process; its argument is the descriptor of the socket that it is asked by.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import importlib
import inspect
import json
import os
import resource
import runpy
import socket
import subprocess
import sys
import threading
import time
import traceback
from contextlib import suppress
from typing import Any, NoReturn

_PYTHON = sys.executable  # a test may put another program in its place, which is then started
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER, <linux/prctl.h>
_MESSAGE_BYTES = 200_000
_ROOM_BYTES = 4096  # for the words of a command, which /proc shows
# What Python and libraries read as they are loaded: a process that is to have another of these is started from nothing.
_AT_START = ("PYTHON", "LD_", "MALLOC_", "GLIBC_", "OPENBLAS", "OMP_", "COV", "VCAMERADIR")
_LIMITS = [getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_")]
# What programs load only once they know what to do.
_LATER = {
    "dappled.daemon.pipeline.decode_worker": ("dappled.drivers.raw.darkroom",),
    "dappled.mocks.body.body": ("dappled.config.profiles", "dappled.mocks.scene.masked_camera"),
}


class Forks:
    """Starts the project's processes by forks where it is `on`."""

    def __init__(self) -> None:
        self.on = False
        self._lock = threading.Lock()
        self._asked: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._loaded_in: dict[str, str] = {}
        self._start = subprocess.Popen._execute_child  # type: ignore[attr-defined]  # there is no other place
        self._takes = inspect.signature(self._start)

    def install(self) -> None:
        """From here on `subprocess.Popen` asks this object first."""
        ours = self

        def start(process: subprocess.Popen[Any], *given: Any) -> None:
            told = ours._takes.bind(process, *given).arguments
            if not (ours.on and _forkable(told, ours._loaded_in) and ours._fork(process, told)):
                ours._start(process, *given)

        subprocess.Popen._execute_child = start  # type: ignore[attr-defined]  # as above

    def close(self) -> None:
        """End the process that forks."""
        if self._asked is not None and self._process is not None:
            self._asked.close()
            self._process.wait(60)
            self._asked = self._process = None

    @property
    def begun(self) -> bool:
        """Whether the process that forks runs."""
        return self._asked is not None

    def begin(self) -> None:
        """Start the process that forks."""
        self._loaded_in = _at_start(os.environ)
        self._asked, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            words = [sys.executable, "-P", __file__, str(there.fileno()), " " * _ROOM_BYTES]
            self._process = subprocess.Popen(words, pass_fds=(there.fileno(),), stdin=subprocess.DEVNULL)

    def _fork(self, process: Any, told: dict[str, Any]) -> bool:
        ends = [
            told["p2cread"] if told["p2cread"] != -1 else 0,
            told["c2pwrite"] if told["c2pwrite"] != -1 else 1,
            told["errwrite"] if told["errwrite"] != -1 else 2,
        ]
        kept = sorted(told["pass_fds"])
        call = {
            "words": [os.fsdecode(word) for word in told["args"]],
            "environment": dict(told["env"] or os.environ),
            "folder": os.path.join(os.getcwd(), told["cwd"] or ""),
            "limits": [resource.getrlimit(limit) for limit in _LIMITS],
            "kept": kept,
            "session": bool(told["start_new_session"]),
            "group": told["process_group"],
            "parent": os.getpid(),
        }
        with self._lock:
            assert self._asked is not None
            _prctl(_SUBREAPER, 1)  # who has lost its parent is ours
            try:
                socket.send_fds(self._asked, [json.dumps(call).encode()], [*ends, *kept])
                answer = json.loads(self._asked.recv(_MESSAGE_BYTES))
            finally:
                _prctl(_SUBREAPER, 0)
        process.pid, process._child_created = answer["process"], True
        process._close_pipe_fds(*(told[name] for name in _ENDS))
        return True


_ENDS = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _module(words: list[str]) -> str:
    """The module that a command runs with this Python; "" for another command."""
    if len(words) > 2 and words[0] == _PYTHON:
        name, *_ = [word for word in words[1:4] if word != "-P"][1:] or [""]
        if "-m" in words[1:3] and name.partition(".")[0] == "dappled":
            return name
    return ""


def _forkable(told: dict[str, Any], loaded_in: dict[str, str]) -> bool:
    """Whether a fork would be the same process as one whose modules were loaded in its own environment."""
    if not isinstance(told["args"], list) or not _module([os.fsdecode(word) for word in told["args"]]):
        return False
    if told["preexec_fn"] or told["shell"] or told["executable"] or not told["close_fds"]:
        return False
    if _at_start(os.environ if told["env"] is None else told["env"]) != loaded_in:
        return False
    return told["cwd"] is None or os.path.isdir(told["cwd"])


def _at_start(environment: Any) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(_AT_START)}


# --- in the process that forks

_AT_FIRST = dict(os.environ)  # what modules add as they are loaded, each of its children has too


def _load(words: list[str]) -> None:
    """Load what a command needs, once."""
    module = _module(words)
    later = _LATER.get(module, ())
    if module == "dappled":
        from dappled.cli import VERBS  # noqa: PLC0415  # as it is asked for

        rest = words[words.index("-m") + 2 :]
        verb = next((" ".join(rest[:n]) for n in (2, 1) if " ".join(rest[:n]) in VERBS), None)
        later = (f"dappled.cli.{VERBS[verb][0].partition(':')[0]}",) if verb else ()
        later += ("dappled.mocks.simulation",) if verb == "run" else ()
    for name in (module, *later):
        with suppress(Exception):  # the command says so itself
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


def _serve(asked: socket.socket) -> dict[str, Any] | None:
    """Fork for each call. In the child that is to be the process: what it was called with; None at the end."""
    loaded = set[str]()
    while True:
        raw, fds, _, _ = socket.recv_fds(asked, _MESSAGE_BYTES, 64)
        if not raw:
            return None
        call: dict[str, Any] = json.loads(raw)
        kind = " ".join(call["words"][1:6]).partition(" --")[0]
        if kind not in loaded:
            loaded.add(kind)
            _load(call["words"])
        read, write = os.pipe()
        if (middle := os.fork()) == 0:  # it ends at once: its child falls to the tests' process, which asked for that
            if (process := os.fork()) == 0:
                os.close(read)
                os.close(write)
                asked.detach()
                _become(call, fds)
                return call
            os.write(write, str(process).encode())
            os._exit(0)
        os.waitpid(middle, 0)
        answer = {"process": int(os.read(read, 20))}
        for fd in (read, write, *fds):
            os.close(fd)
        asked.send(json.dumps(answer).encode())


def _become(call: dict[str, Any], fds: list[int]) -> None:
    """Be the process that was asked for, up to its first module."""
    while os.getppid() != call["parent"]:
        time.sleep(0.0002)  # the kernel tells nobody that a process has another parent
    wanted = [0, 1, 2, *call["kept"]]
    high = max(wanted) + 1
    copies = [fcntl.fcntl(fd, fcntl.F_DUPFD, high) for fd in fds]
    for copy, fd in zip(copies, wanted, strict=True):
        os.dup2(copy, fd)
    for low, above in zip(sorted(wanted), [*sorted(wanted)[1:], os.sysconf("SC_OPEN_MAX")], strict=True):
        os.closerange(low + 1, min(above, 65536))
    if call["session"]:
        os.setsid()
    if call["group"] >= 0:
        os.setpgid(0, call["group"])
    for limit, pair in zip(_LIMITS, call["limits"], strict=True):
        if resource.getrlimit(limit) != tuple(pair):
            resource.setrlimit(limit, tuple(pair))
    os.chdir(call["folder"])
    set_by_modules = {name: value for name, value in os.environ.items() if _AT_FIRST.get(name) != value}
    os.environ.clear()
    os.environ.update(set_by_modules | call["environment"])
    for name, fd in (("stdin", 0), ("stdout", 1), ("stderr", 2)):
        lines = name == "stderr" or os.isatty(fd)
        errors = "backslashreplace" if name == "stderr" else getattr(sys, name).errors
        stream = open(fd, "r" if fd == 0 else "w", encoding=getattr(sys, name).encoding, errors=errors, closefd=False)  # noqa: SIM115  # for the life of the process
        if fd:
            stream.reconfigure(line_buffering=lines)
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    words = call["words"]
    sys.orig_argv, sys.argv = words, ["-m", *words[words.index("-m") + 2 :]]
    sys.path[0:0] = [] if "-P" in words[1:3] else [call["folder"]]
    _show(words)


def _show(words: list[str]) -> None:
    """Let /proc/…/cmdline tell the command."""
    with open("/proc/self/stat", encoding="ascii") as file:
        begin, end = map(int, file.read().rpartition(")")[2].split()[45:47])
    shown = b"\0".join(map(os.fsencode, words))[: end - begin - 1]
    ctypes.memmove(begin, shown.ljust(end - begin, b"\0"), end - begin)


def _run(program: str) -> NoReturn:
    """As `python -m` does, and to the end of its threads and of what it asked for at exit. Python itself is not taken
    apart: that touches, so copies, all that was loaded."""
    for name in (program, f"{program}.__main__"):  # it is run as a program, and not the module that was loaded
        if not hasattr(sys.modules.get(name), "__path__"):
            sys.modules.pop(name, None)
    code = 0
    try:
        runpy._run_module_as_main(program)  # type: ignore[attr-defined]  # there is no public one
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
    except Exception:  # noqa: BLE001  # as Python does
        traceback.print_exc()
        code = 1
    threading._shutdown()  # type: ignore[attr-defined]  # as above
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code & 0xFF)


if __name__ == "__main__":
    if (called := _serve(socket.socket(fileno=int(sys.argv[1])))) is not None:
        _run(_module(called["words"]))
