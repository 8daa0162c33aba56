"""Print what verbs tell: results as text or JSON, findings, errors, bars; and give the exit code."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from dappled import codec, findings
from dappled.cli.verb import Doubtable, Report, Verb
from dappled.findings import Level
from dappled.shown import say
from dappled.workers import Loop

if TYPE_CHECKING:
    from tqdm import tqdm

Item = TypeVar("Item")
DONE, FAILED, INTERRUPTED = 0, 1, 130
_AFTER_S = 1.0  # of work, a bar is drawn, and as often again
_STOP_S = 1.0


class TerminalOutput:
    """The `Output` of a verb that was called by these words."""

    def __init__(self, path: str, *, as_json: bool) -> None:
        self._path, self._as_json = path, as_json
        self._bar: tqdm[Any] | None = None
        self._ticks = Loop("bar", lambda: None)
        self._drawing = threading.Lock()  # or a bar is drawn between lines
        self._what = ""

    def row(self, values: Mapping[str, Any], *lines: str) -> None:
        self._print([json.dumps(values)] if self._as_json else lines)

    def remark(self, text: str) -> None:
        self._print([text], error=True)

    def warn(self, text: str) -> None:
        self.remark(f"dappled {self._path}: {text}")

    def each(self, items: Sequence[Item], unit: str = "frame") -> Iterator[Item]:
        with self.bar(len(items), unit) as add:
            for item in items:
                yield item
                add(1)

    @contextmanager
    def bar(self, total: int | None, unit: str, what: str = "") -> Iterator[Callable[[int], object]]:
        if not sys.stderr.isatty():
            yield lambda _: None
            return
        self.close()
        bar = self._begun(total, unit, what)
        try:
            yield bar.update
        finally:
            self.close()

    def show(self, what: str, done: int, total: int) -> None:
        if not sys.stderr.isatty():
            return
        if self._bar is None or what != self._what:
            self.close()
            self._bar, self._what = self._begun(total, "step", what), what
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Take the bar off the terminal."""
        if self._bar is not None:
            self._ticks.stop(_STOP_S)  # before the bar goes: it would be drawn again
            self._bar.close()
            self._bar = None

    def _begun(self, total: int | None, unit: str, what: str) -> tqdm[Any]:
        from tqdm import tqdm  # noqa: PLC0415  # no bar, no wait for it

        scaled = unit == "B"
        self._bar = tqdm(
            total=total,
            unit=unit,
            desc=what or None,
            delay=_AFTER_S,
            leave=False,
            unit_scale=scaled,
            file=sys.__stderr__,
        )
        self._ticks = Loop("bar", partial(self._tick, self._bar, over := threading.Event()), over)
        self._ticks.start()
        return self._bar

    def _tick(self, bar: tqdm[Any], over: threading.Event) -> None:
        """Draw the bar each second, also while the first of its units takes minutes."""
        while not over.wait(_AFTER_S):
            with self._drawing:
                bar.delay = 0  # it is drawn, and so taken off at the end
                bar.refresh()

    def _print(self, lines: Sequence[str], *, error: bool = False) -> None:
        with self._drawing:
            if self._bar is not None:
                self._bar.clear()
            for line in lines:
                say(line, error=error)


def told(verb: Verb, report: Report, output: TerminalOutput) -> int:
    """Print a report; returns the exit code."""
    output.close()
    if verb.json:
        if report.values is not None:
            for line in json.dumps(_with_findings(report), indent=2).split("\n"):
                say(line)
    else:
        for line in report.lines:
            say(line)
    for one in findings.in_order(report.findings):
        output.remark(f"{'in doubt' if one.level > Level.NOTE else one.level.word}: {findings.told(one)}")
    if findings.worst(report.findings) > Level.NOTE and not getattr(verb, "anyway", False):
        if isinstance(verb, Doubtable):
            extent = f", {report.extent}" if report.extent else ""
            output.warn(f"done, but in doubt{extent}: see above; --anyway accepts that")
        return FAILED
    return FAILED if report.failed else DONE


def _with_findings(report: Report) -> Any:
    if not report.findings or not isinstance(report.values, dict) or {"doubts", "findings"} & set(report.values):
        return report.values
    return {**report.values, "findings": [codec.plain(one) for one in findings.in_order(report.findings)]}


def failed(path: str, sentences: Sequence[str], *, as_json: bool, usage: str = "") -> None:
    """Say what went wrong, a line for each sentence: a person on standard error, and with --json a program too, as
    {"error": …}; a wrong call with the verb's usage."""
    if usage:
        say(usage, error=True)
    for before, one in zip([f"dappled {path}: ", *[""] * len(sentences)], sentences or [""], strict=False):
        say(before + one, error=True)
    if as_json:
        say(json.dumps({"error": "\n".join(sentences)}))
