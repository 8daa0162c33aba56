"""Run a call of the command line: read it, check it, do it, print what came of it, and give the exit code."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from dappled.cli import rendering
from dappled.cli.command_line import Call, check, read
from dappled.daemon.health import systemd
from dappled.errors import CallError, DappledError

_FLIGHTS = ("run", "replay", "flight", "geotag")
"""Verbs that write flights, which hold pictures and where they were taken."""


def run(words: Sequence[str], loaded: Callable[[], object] | None) -> int:
    """Run the call; returns the exit code. `loaded` is called when all modules are there and the verb begins."""
    call = read(words)
    _log(call)
    begun = False
    output = rendering.TerminalOutput(call.path, as_json=call.verb.json)
    try:
        if loaded is not None:
            loaded()
        check(call.verb)
        begun = True
        with _own_files(call.path):
            report = call.verb.run(output)
        code = rendering.told(call.verb, report, output)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return rendering.INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader is gone: end quietly
        return rendering.FAILED
    except Exception as error:
        if call.debug:
            raise
        wrong_call = isinstance(error, CallError) or (not begun and getattr(error, "exit_code", 1) == 2)
        usage = call.usage if wrong_call else ""
        rendering.failed(call.path, _sentences(error, call.path), as_json=call.verb.json, usage=usage)
        return error.exit_code if isinstance(error, DappledError) else rendering.FAILED
    finally:
        output.close()
    return code


@contextmanager
def _own_files(path: str) -> Iterator[None]:
    """Context in which a verb that writes flights makes no file that every user may read."""
    before = os.umask(0o077)
    os.umask(before | 0o007 if path.partition(" ")[0] in _FLIGHTS else before)
    try:
        yield
    finally:
        os.umask(before)


def _log(call: Call) -> None:
    """Set up the log: on standard error, or in the journal for a service."""
    quiet = logging.INFO if call.path == "run" and "JOURNAL_STREAM" in os.environ else logging.WARNING
    logging.basicConfig(level=logging.DEBUG if call.debug else quiet, handlers=[systemd.handler()])
    logging.getLogger("PIL").setLevel(logging.INFO)
    logging.captureWarnings(True)  # of libraries, about arithmetic or their future: for the log, not for a person
    logged = call.debug or quiet < logging.WARNING
    logging.getLogger("py.warnings").setLevel(logging.NOTSET if logged else logging.ERROR)


def _sentences(error: Exception, path: str) -> Sequence[str]:
    """What a person is told of an error."""
    if isinstance(error, DappledError):
        return error.sentences
    if isinstance(error, OSError):
        return [f"{error.filename}: {error.strerror or error}" if error.filename else f"{error.strerror or error}"]
    if isinstance(error, MemoryError):
        wanted = f" ({error})" if str(error) else ""
        return [f"not enough memory{wanted}: close other programs, or use a machine with more memory"]
    return [f"unexpected {type(error).__name__}: {error} (run `dappled --debug {path} …`)"]
