"""Tests in several processes, each forked from one that has collected them all: `pytest --workers N`.

To read the tests and what they import takes five seconds of a core: here once, and not in each process. A worker gets
tests as they stand in their files, two at a time, so that it knows which fixtures the next one has in common with this;
one that has nothing left to do takes over half of what another has before it. A worker that dies fails its test, and
another takes its place.
"""

from __future__ import annotations

import atexit
import os
import pickle
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe, wait
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

Action = Callable[[], object]


class Worker:
    """A process that runs tests, as the one that collected them sees it."""

    def __init__(
        self, number: int, session: pytest.Session, started: Action, ended: Action, others: list[Worker]
    ) -> None:
        self.number = number
        self.waiting = deque[int]()  # not told to it yet
        self.told = deque[int | None]()  # what it runs, and what comes next
        self.channel, there = Pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self.process = os.fork()
        if self.process == 0:
            self.channel.close()
            for other in others:
                other.channel.close()
            _work(number, session, there, started, ended)
        there.close()

    def tell(self, workers: list[Worker]) -> None:
        """Tell it the test after the next one; that there is none where nothing waits anywhere."""
        if not self.waiting:
            longest = max(workers, key=lambda one: len(one.waiting)).waiting
            for _ in range((len(longest) + 1) // 2):
                self.waiting.appendleft(longest.pop())
        if not self.told or self.told[-1] is not None:
            self.told.append(self.waiting.popleft() if self.waiting else None)
            self.channel.send(self.told[-1])


class Beside:
    """Runs what was collected in so many workers. `started` is called in each of them first, `ended` last."""

    def __init__(self, count: int, started: Action, ended: Action) -> None:
        self._count, self._started, self._ended = count, started, ended

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if session.testsfailed or session.config.option.collectonly or len(session.items) < 2:
            return None
        session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # made once, and not by each worker
        workers: list[Worker] = []
        try:
            self._run(session, workers)
        finally:
            for worker in workers:  # it ends with its channel
                worker.channel.close()
            codes = [os.waitstatus_to_exitcode(os.waitpid(worker.process, 0)[1]) for worker in workers]
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if any(codes):
            raise session.Failed(f"workers ended after their last test with {codes}")
        return True

    def _run(self, session: pytest.Session, workers: list[Worker]) -> None:
        for number in range(self._count):
            workers.append(Worker(number, session, self._started, self._ended, workers))
        each, more = divmod(len(session.items), self._count)
        indices = iter(range(len(session.items)))
        for worker in workers:
            worker.waiting.extend(next(indices) for _ in range(each + (worker.number < more)))
        for worker in workers * 2:
            worker.tell(workers)
        running = {worker.channel: worker for worker in workers}
        while running and not session.shouldfail:
            for channel in wait([*running]):
                assert isinstance(channel, Connection)
                worker = running[channel]
                kind, said = _heard(channel)
                if kind == "ended":
                    del running[channel]
                    if worker.told != deque([None]):
                        another = self._died(session, worker, workers)
                        running[another.channel] = another
                elif kind == "done":
                    worker.told.popleft()
                    worker.tell(workers)
                else:
                    _report(session.config, worker.number, kind, said)

    def _died(self, session: pytest.Session, worker: Worker, workers: list[Worker]) -> Worker:
        """Fail the test that it ran, and have another go on."""
        workers.remove(worker)
        _, status = os.waitpid(worker.process, 0)
        worker.channel.close()
        index = worker.told.popleft()
        assert index is not None
        item = session.items[index]
        why = f"the process that ran it ended: {os.waitstatus_to_exitcode(status)}"
        failed = pytest.TestReport(item.nodeid, item.location, {}, "failed", why, "call")
        session.config.hook.pytest_runtest_logreport(report=failed)
        another = Worker(worker.number, session, self._started, self._ended, workers)
        another.waiting.extend(one for one in worker.told if one is not None)
        another.waiting.extend(worker.waiting)
        workers.append(another)
        another.tell(workers)
        another.tell(workers)
        return another


def _heard(channel: Connection) -> tuple[str, Any]:
    try:
        heard: tuple[str, Any] = channel.recv()
        return heard
    except (EOFError, ConnectionResetError):
        return "ended", None


def _report(config: pytest.Config, number: int, kind: str, said: Any) -> None:
    if kind == "warned":
        config.hook.pytest_warning_recorded.call_historic(kwargs=said)
        return
    report = config.hook.pytest_report_from_serializable(config=config, data=said)
    # As xdist has it: -v, and what is said of a failure, tell who ran a test.
    report.node = SimpleNamespace(gateway=SimpleNamespace(id=number), _workerinfocache=f"[worker {number}]")
    config.hook.pytest_runtest_logreport(report=report)
    if report.when == "teardown":
        config.hook.pytest_runtest_logfinish(nodeid=report.nodeid, location=report.location)


class _Sender:
    """Tells the process that collected the tests what became of them."""

    def __init__(self, config: pytest.Config, channel: Connection) -> None:
        self._config, self._channel = config, channel

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        hook = self._config.hook
        self._channel.send(("report", hook.pytest_report_to_serializable(config=self._config, report=report)))

    def pytest_warning_recorded(self, warning_message: warnings.WarningMessage, when: str, nodeid: str) -> None:
        category, text = warning_message.category, str(warning_message.message)
        try:
            pickle.dumps(category(text))
        except (pickle.PickleError, TypeError, AttributeError):  # a kind that its own arguments make
            category, text = UserWarning, f"{category.__name__}: {text}"
        told = warnings.WarningMessage(category(text), category, warning_message.filename, warning_message.lineno)
        self._channel.send(("warned", {"warning_message": told, "when": when, "nodeid": nodeid, "location": None}))


def _work(number: int, session: pytest.Session, channel: Connection, started: Action, ended: Action) -> NoReturn:
    """Be a worker: run the tests that it is told, up to a None, and end the process."""
    code = 1
    try:
        config = session.config
        os.environ["PYTEST_XDIST_WORKER"] = f"gw{number}"  # as those of xdist, which `tests/shared.py` knows
        _take_its_own(config, number)
        config.pluginmanager.register(_Sender(config, channel))
        started()
        index = channel.recv()
        while index is not None:
            following = channel.recv()
            after = session.items[following] if following is not None else None
            config.hook.pytest_runtest_protocol(item=session.items[index], nextitem=after)
            channel.send(("done", None))
            index = following
        ended()
        atexit._run_exitfuncs()
        code = 0
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):  # the tests are over
        session._setupstate.teardown_exact(None)
        ended()
    except BaseException:  # noqa: BLE001  # whatever it is, it must not go on as the process that it was forked from
        traceback.print_exc()
    finally:
        channel.close()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _take_its_own(config: Any, number: int) -> None:
    """A worker prints no dots, keeps what tests print in files of its own, and their files in a folder of its own."""
    plugins = config.pluginmanager
    terminal = plugins.unregister(name="terminalreporter")
    plugins.register(SimpleNamespace(_tw=terminal._tw), "terminalreporter")  # pytest-timeout writes there
    capture = plugins.getplugin("capturemanager")
    capture.stop_global_capturing()
    capture.start_global_capturing()
    capture.suspend_global_capture()
    factory = config._tmp_path_factory
    factory._basetemp = factory.getbasetemp() / f"gw{number}"
    factory._basetemp.mkdir(mode=0o700, exist_ok=True)
    factory._next_number.clear()
