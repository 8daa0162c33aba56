"""`dappled trigger`: whom it asks."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.cli import main


class AskedError(Exception):
    """Where the ground station would have called."""


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Path | None]]:
    found: list[tuple[str, Path | None]] = []

    class Client:
        def __init__(self, url: str, *, key_file: Path | None) -> None:
            found.append((url, key_file))
            raise AskedError

    monkeypatch.setattr("dappled.cli.trigger.GroundClient", Client)
    return found


@pytest.mark.parametrize(
    ("links", "wanted"),
    [
        ('url = "udpin:0.0.0.0:14551"', ("udpout:127.0.0.1:14551", None)),
        ('url = ["/dev/ttyAMA0,921600", "tcpin:127.0.0.1:5760"]', ("tcp:127.0.0.1:5760", None)),
        ('url = ["udpout:10.0.0.1:1", "udpin:10.0.0.2:2"]\nkeys = ["", "r.key"]', ("udpout:10.0.0.2:2", Path("r.key"))),
        ('url = "udpin:127.0.0.1:2"\nkeys = ["r.key"]', ("udpout:127.0.0.1:2", Path("r.key"))),
    ],
)
def test_the_link_of_the_daemon_s_settings_is_called(
    tmp_path: Path, called: list[tuple[str, Path | None]], links: str, wanted: tuple[str, Path | None]
) -> None:
    (tmp_path / "d.toml").write_text(f"[mavlink]\n{links}\n")
    with pytest.raises(AskedError):
        main(["--debug", "trigger", "--config", str(tmp_path / "d.toml")])
    ((url, key),) = called
    assert (url, key and Path(key.name)) == wanted


def test_a_file_without_a_link_that_listens_is_told(
    tmp_path: Path, called: list[tuple[str, Path | None]], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "d.toml").write_text('[mavlink]\nurl = "/dev/ttyAMA0,921600"\n')
    assert main(["trigger", "--config", str(tmp_path / "d.toml")]) == 1
    assert "names no link that listens" in capsys.readouterr().err
    assert called == []


@pytest.mark.parametrize("wrong", ["0", "-3", "nan", "inf", "10001", "far"])
def test_a_distance_that_can_not_be_flown_is_told(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["trigger", f"--distance={wrong}"])
    assert ended.value.code == 2
    assert "neither a distance" in capsys.readouterr().err
