"""Runs tests in several processes that are forked once all tests were collected: `pytest --beside 3`.

To collect the default tests takes a core for a quarter of a minute, and workers of pytest-xdist each do it anew. Here
they are forks of the process that did: each asks it for the next test, and tells it how that went. A process goes on
with the file that it has begun, so that what is made once a file is mostly made once, and helps out in another's when
no file is left. One that dies is a failure of the test that it ran, and has a successor.
"""

from __future__ import annotations

import atexit
import os
import sys
import traceback
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn, cast

import pytest

FOLDER = "beside-"  # where a process has its files, beside those of the others

Report = pytest.TestReport


@dataclass
class Process:
    """One that runs tests: what it is asked and told by, and what it runs."""

    pid: int
    ours: Connection
    runs: int | None = None
    place: str = ""


class Waiting:
    """Which test is next. Nothing here knows what a test is: they are numbers, and each has a place."""

    def __init__(self, places: Sequence[str]) -> None:
        self._waiting: dict[str, deque[int]] = {}
        for number, place in enumerate(places):
            self._waiting.setdefault(place, deque()).append(number)
        self._fresh = deque(self._waiting)

    def left(self) -> int:
        """How many nobody has asked for yet."""
        return sum(map(len, self._waiting.values()))

    def next(self, place: str) -> tuple[int, str] | None:
        """The next test for a process whose last one was of `place`, and its place: from there, from a place that is
        not begun, else from where most are left; None at the end."""
        if not self._waiting.get(place):
            place = (
                self._fresh.popleft() if self._fresh else max(self._waiting, key=lambda one: len(self._waiting[one]))
            )
        left = self._waiting[place]
        return (left.popleft(), place) if left else None


def pytest_addoption(parser: pytest.Parser) -> None:
    """As `-n` of pytest-xdist."""
    words = "run tests in N processes, forked once all are collected"
    parser.addoption("--beside", type=int, default=0, metavar="N", help=words)


def pytest_configure(config: pytest.Config) -> None:
    """Run tests in processes where that is asked for."""
    if config.option.beside > 1:
        config.pluginmanager.register(Beside(config.option.beside))


class Beside:
    """The plug-in of the process that collects."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._processes: list[Process] = []
        self._begun = 0

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Run the tests in processes; pytest itself refuses what was not collected whole."""
        items, config = session.items, session.config
        count = min(self._count, len(items))
        if count < 2 or config.option.collectonly or session.testsfailed:
            return None
        waiting = Waiting([item.nodeid.partition("::")[0] for item in items])
        base = config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # made once, before there are several
        try:
            for _ in range(count):
                self._begin(session, base)
            while self._processes:
                for ours in wait([process.ours for process in self._processes]):
                    process = next(one for one in self._processes if one.ours is ours)
                    self._hear(session, process, waiting, base)
        finally:
            for process in self._processes:
                with suppress(OSError):
                    os.kill(process.pid, 15)
                os.waitpid(process.pid, 0)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if session.shouldstop:
            raise session.Interrupted(session.shouldstop)
        if left := waiting.left():
            raise session.Interrupted(f"{left} tests were not run: each process ended before it asked for one")
        return True

    def _begin(self, session: pytest.Session, base: Any) -> None:
        ours, theirs = Pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self._begun += 1
        if (pid := os.fork()) == 0:
            for one in (*(process.ours for process in self._processes), ours):
                one.close()
            _run(session, theirs, base / f"{FOLDER}{self._begun}")
        theirs.close()
        self._processes.append(Process(pid, ours))

    def _hear(self, session: pytest.Session, process: Process, waiting: Waiting, base: Any) -> None:
        hook = session.config.hook
        try:
            told = process.ours.recv()
        except (EOFError, ConnectionError):
            self._processes.remove(process)
            process.ours.close()
            _, status = os.waitpid(process.pid, 0)
            if process.runs is not None:
                item = session.items[process.runs]
                words = f"its process ended with {os.waitstatus_to_exitcode(status)}"
                hook.pytest_runtest_logreport(report=Report(item.nodeid, item.location, {}, "failed", words, "call"))
                self._begin(session, base)
            return
        if told is None:
            over = session.shouldfail or session.shouldstop
            following = None if over else waiting.next(process.place)
            if process.runs is not None:
                item = session.items[process.runs]
                hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
            process.runs, process.place = following or (None, "")
            process.ours.send(process.runs)
        else:
            report = hook.pytest_report_from_serializable(config=session.config, data=told)
            hook.pytest_runtest_logreport(report=report)


class _Tells:
    """The plug-in of a process that runs tests, instead of what writes to a terminal."""

    def __init__(self, config: pytest.Config, asked: Connection) -> None:
        self._config, self._asked = config, asked
        self._tw = config.get_terminal_writer()  # for what asks pytest where to write

    def pytest_runtest_logreport(self, report: Report) -> None:
        self._asked.send(self._config.hook.pytest_report_to_serializable(config=self._config, report=report))


class _Later:
    """Stands for the test after this one, which is only asked for when this one is over: pytest wants to know then what
    may be kept for it."""

    def __init__(self, items: list[pytest.Item], asked: Connection) -> None:
        self._items, self._asked = items, asked
        self.item: pytest.Item | None = None

    def listchain(self) -> list[Any]:
        self._asked.send(None)
        number = self._asked.recv()
        self.item = None if number is None else self._items[number]
        return self.item.listchain() if self.item else []


def _run(session: pytest.Session, asked: Connection, folder: Any) -> NoReturn:
    """The life of a process that runs tests."""
    config = session.config
    try:
        capture = config.pluginmanager.getplugin("capturemanager")
        capture.stop_global_capturing()  # its file is the others' too
        capture.start_global_capturing()
        capture.suspend_global_capture()
        tells = _Tells(config, asked)
        config.pluginmanager.unregister(name="terminalreporter")
        config.pluginmanager.register(tells, "terminalreporter")
        folder.mkdir()
        config.option.maxfail = 0  # when it is enough, the process that was asked says so
        config._tmp_path_factory._basetemp = folder  # type: ignore[attr-defined]  # there is no other place
        later = _Later(session.items, asked)
        later.listchain()
        while (item := later.item) is not None:
            later.item = None
            config.hook.pytest_runtest_protocol(item=item, nextitem=cast(pytest.Item, later))
        config._ensure_unconfigure()
        atexit._run_exitfuncs()
    except BaseException:  # noqa: BLE001  # nothing may go on as the process that collects
        traceback.print_exc(file=sys.__stderr__)
        os._exit(70)
    os._exit(0)
