"""Every error that a person may meet is one sentence on the command line, and never a traceback."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterator

import pytest

import dappled
from dappled import cli
from dappled.config.schema import ConfigError
from dappled.errors import CallError, DappledError

INTERNAL = {  # caught where they arise, and told as another error or as an event
    "dappled.bounds.claims.ClaimError",
    "dappled.codec.CodecError",
    "dappled.drivers.child_process.ChannelError",
    "dappled.durable.NoPlainFileError",
    "dappled.drivers.gphoto2.protocol.SessionError",
    "dappled.drivers.mavlink.ulog_reader.FieldsError",
    "dappled.drivers.raw.reading.UnfitFileError",
    "dappled.mocks.body.ptp.MalformedPacketError",
}


def error_classes() -> Iterator[type[Exception]]:
    """All exception classes that dappled defines."""
    for found in pkgutil.walk_packages(dappled.__path__, "dappled."):
        if found.name == "dappled.__main__":
            continue
        module = importlib.import_module(found.name)
        for _, one in inspect.getmembers(module, inspect.isclass):
            if issubclass(one, Exception) and one.__module__ == found.name:
                yield one


def full_name(one: type) -> str:
    return f"{one.__module__}.{one.__qualname__}"


CLASSES = sorted(set(error_classes()), key=full_name)


def test_every_error_for_a_person_is_of_the_family() -> None:
    strangers = {
        full_name(one)
        for one in CLASSES
        if not issubclass(one, DappledError) and not any(full_name(base) in INTERNAL for base in one.__mro__)
    }
    assert strangers == set()
    assert len(CLASSES) > 10


def ended(monkeypatch: pytest.MonkeyPatch, error: BaseException, *flags: str) -> int:
    """The exit code of `dappled profiles` when it meets the error."""

    def run(*_: object) -> None:
        raise error

    monkeypatch.setattr("dappled.cli.config.ListProfiles.run", run)
    return cli.main([*flags, "profiles"])


@pytest.mark.parametrize("one", [c for c in CLASSES if issubclass(c, DappledError)], ids=full_name)
def test_it_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], one: type[DappledError]
) -> None:
    error = one.__new__(one)  # some want more than a sentence
    if isinstance(error, ConfigError):
        ConfigError.__init__(error, "the disk is full; free some space")
    else:
        Exception.__init__(error, "the disk is full; free some space")
    assert ended(monkeypatch, error) == one.exit_code
    out, err = capfd.readouterr()
    assert out == ""
    assert err.endswith("dappled profiles: the disk is full; free some space\n")
    assert err.count("\n") == (2 if issubclass(one, CallError) else 1)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied", "/root/x"), "/root/x: Permission denied"),
        (OSError("odd"), "odd"),
        (MemoryError(), "not enough memory: close other programs, or use a machine with more memory"),
        (MemoryError("Unable to allocate 20.0 GiB"), "not enough memory (Unable to allocate 20.0 GiB): close other"),
        (ZeroDivisionError("bug"), "unexpected ZeroDivisionError: bug"),
    ],
)
def test_other_errors_are_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    assert ended(monkeypatch, error) == 1
    err = capfd.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_debug_shows_where_it_came_from(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DappledError, match="why"):
        ended(monkeypatch, DappledError("why"), "--debug")


def test_with_json_an_error_is_json_too(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def run(*_: object) -> None:
        raise DappledError("the disk is full; free some space")

    monkeypatch.setattr("dappled.cli.config.ListProfiles.run", run)
    assert cli.main(["profiles", "--json"]) == 1
    out, err = capfd.readouterr()
    assert json.loads(out) == {"error": "the disk is full; free some space"}
    assert err == "dappled profiles: the disk is full; free some space\n"


@pytest.mark.parametrize(
    ("words", "meant"), [(["rn"], "run"), (["flight", "reprot"], "report"), (["config", "chek", "x"], "check")]
)
def test_a_word_that_is_nearly_right_is_guessed(
    words: list[str], meant: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    assert f"did you mean {meant!r}?" in capfd.readouterr().err
