"""One rule of exit codes for every verb: 0 done, 1 failed or in doubt (which --anyway accepts), 2 a wrong call, 130."""

from __future__ import annotations

import json

import pytest

from dappled import cli, codec
from dappled.cli import VERBS, calling
from dappled.cli.command_line import verb_class
from dappled.cli.verb import Doubtable, Report
from dappled.errors import CallError, DappledError
from dappled.findings import Code, Finding, Level, Subject, finding
from tests.cli.test_all_verbs import CALLS

ENDS: list[tuple[Report | BaseException, int]] = [
    (Report(), 0),
    (Report(findings=[finding(Code.FRAME_CLIPPED, Subject("frame", 7), Level.NOTE, share=0.02)]), 0),
    (Report(failed=True), 1),
    (DappledError("the disk is full"), 1),
    (CallError("name the frames"), 2),
    (KeyboardInterrupt(), 130),
]
DOUBT: Finding = finding(Code.FRAME_CLIPPED, Subject("frame", 7), share=0.02)


def ended(verb: str, monkeypatch: pytest.MonkeyPatch, end: Report | BaseException, *more: str) -> int:
    """The exit code of a verb whose work ends so."""

    def run(*_: object) -> Report:
        if isinstance(end, BaseException):
            raise end
        return end

    monkeypatch.setattr(calling, "check", lambda _: None)  # the arguments name no files
    monkeypatch.setattr(verb_class(verb), "run", run)
    return cli.main([*verb.split(), *CALLS[verb], *more])


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_ends_by_one_rule(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert [ended(verb, monkeypatch, end) for end, _ in ENDS] == [code for _, code in ENDS]
    capsys.readouterr()
    assert ended(verb, monkeypatch, Report(findings=[DOUBT])) == 1
    said = capsys.readouterr().err
    assert said.startswith("in doubt: frame 7: ")
    assert ("--anyway" in said) == issubclass(verb_class(verb), Doubtable)
    if issubclass(verb_class(verb), Doubtable):
        assert ended(verb, monkeypatch, Report(findings=[DOUBT]), "--anyway") == 0
    capsys.readouterr()
    assert ended(verb, monkeypatch, Report({"a": 1}, findings=[DOUBT]), "--json") == 1
    assert json.loads(capsys.readouterr().out) == {"a": 1, "findings": [codec.plain(DOUBT)]}
