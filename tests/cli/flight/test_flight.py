"""`dappled flight`: what is said of recorded flights, and the exit codes."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.flight import Recording, Result, layout, recording, seal_key, seals
from dappled.flight.ledger import Ledger
from tests.flight.makers import CARD_FULL, deliver, flip, request, tag
from tests.standing import failure

START_UTC_NS = 1_795_256_103_000_000_000  # 2026-11-21T10:15:03Z


def fly(flights: Path) -> Recording:
    """Shot 0 safe, tagged and decoded, shot 1 failed."""
    begun = recording.begin(flights, RecordedClock(START_UTC_NS), {"camera": {"driver": "none"}})
    for index in range(2):
        request(begun, index)
    begun.ledger.add_tag(tag(deliver(begun, 0, bytes(2_000_000))))
    begun.ledger.add_result(Result(0, "ab", 12, 13, "geometric", "predicted"))
    begun.ledger.failed(1, failure("no file came"))
    return begun


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    return tmp_path / "flights"


@pytest.fixture
def closed(flights: Path) -> Path:
    begun = fly(flights)
    begun.close()
    return begun.folder.path


def lines(words: list[str], capsys: pytest.CaptureFixture[str], code: int = 0) -> list[str]:
    assert main(["flight", *words]) == code
    return capsys.readouterr().out.splitlines()


def test_a_list_has_a_line_for_each_flight_good_or_bad(
    closed: Path, flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = fly(flights)
    bad = flights / "20261121T090000Z-00000000"
    bad.mkdir()
    (bad / "flight.sqlite").write_text("no ledger")
    said = {line.split()[0]: line for line in lines(["list", str(flights)], capsys)}
    still.close()
    assert said[closed.name].endswith("2026-11-21 10:15  1 frame, 1 failed, 2.0 MB")
    assert said[still.folder.name].endswith("(open)")
    assert "ledger" in said[bad.name]


def test_the_folder_and_the_last_flight_come_from_the_settings(
    closed: Path, flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "dappled.toml"
    config.write_text(f'[record]\ndirectory = "{flights}"\n')
    assert closed.name in lines(["list", "--config", str(config)], capsys)[0]
    assert lines(["show", "--config", str(config)], capsys)[0] == closed.name


def test_without_a_name_it_is_the_last_flight_with_shots_and_that_is_said(
    closed: Path, flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A start without a camera leaves a flight without shots behind."""
    for hour in (1, 2):
        recording.begin(flights, RecordedClock(START_UTC_NS + hour * 3600 * 10**9)).close()
    config = tmp_path / "dappled.toml"
    config.write_text(f'[record]\ndirectory = "{flights}"\n')
    for action in ("show", "check", "report"):
        assert main(["flight", action, "--config", str(config)]) == 0
        told = capsys.readouterr()
        assert told.err == f"flight {closed}, the last with shots; 2 later flights without a shot skipped\n"
        assert closed.name in told.out
    assert [line.split("  ")[2] for line in lines(["list", str(flights)], capsys)] == [
        "1 frame, 1 failed, 2.0 MB", "no shot", "no shot",
    ]  # fmt: skip


def test_a_flight_without_a_shot_is_no_success(
    flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begun = recording.begin(flights, RecordedClock(START_UTC_NS))
    begun.close()
    flight = str(begun.folder.path)
    assert lines(["report", flight], capsys, code=1)[-1] == "NO SHOT in this flight: there are no counts to compare"
    assert main(["flight", "report", flight, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["balanced"] is None
    (config := tmp_path / "dappled.toml").write_text(f'[record]\ndirectory = "{flights}"\n')
    assert main(["flight", "report", "--config", str(config)]) == 1
    assert f"no flight in {flights} has a shot" in capsys.readouterr().err


def test_what_a_simulation_recorded_here_is_found_without_a_file(
    closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert lines(["report"], capsys)[0] == closed.name
    assert closed.name in lines(["list"], capsys)[0]


def test_no_flight_yet_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flight", "list", str(tmp_path)]) == 0
    assert f"no flights in {tmp_path}" in capsys.readouterr().err
    config = tmp_path / "dappled.toml"
    config.write_text(f'[record]\ndirectory = "{tmp_path}"\n')
    assert main(["flight", "show", "--config", str(config)]) == 1
    assert f"there is no flight in {tmp_path} yet" in capsys.readouterr().err


def test_every_shot_is_shown_with_what_became_of_it(closed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name, first, second = lines(["show", str(closed)], capsys)
    assert name == closed.name
    assert first.split() == [
        *("0", "00:00:00.000", "mavlink:255/190", "safe", "frames/000000.cr2", "2.0", "MB"),
        *("41.6311134", "-91.5414669", "215.1", "m", "12/13", "carriers"),
    ]
    assert second.endswith("failed  no file came")
    assert main(["flight", "show", str(closed), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [line["row"]["state"] for line in told["lines"]] == ["safe", "failed"]


def test_check_ends_with_the_verdict(closed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lines(["check", str(closed)], capsys)[-1].startswith(f"{closed.name}: consistent: 1 file, 2.0 MB")
    flip(closed / "frames" / "000000.cr2", 1000)
    said = lines(["check", str(closed)], capsys, code=1)
    assert said[0].startswith("wrong: ")
    assert "000000.cr2" in said[0]
    assert "NOT INTACT" in said[-1]
    assert main(["flight", "check", str(closed), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["intact"] is False


def test_check_insists_on_a_key(flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, other = str(tmp_path / "seal.key"), str(tmp_path / "other.key")
    assert main(["keys", "seal", key]) == main(["keys", "seal", other]) == 0
    begun = recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=seal_key.load(Path(key)))
    begun.close()
    flight = str(begun.folder.path)
    name = seal_key.load(Path(key)).name
    assert f"intact, sealed with key {name}" in lines(["check", flight, "--key", key], capsys)[-1]
    assert (
        f"not with the given key {seal_key.load(Path(other)).name}"
        in lines(["check", flight, "--key", other], capsys, code=1)[-1]
    )
    assert "--key FILE verifies it" in lines(["check", flight], capsys)[-1]
    (config := tmp_path / "dappled.toml").write_text('[record]\nseal_key = "seal.key"\n')
    assert f"intact, sealed with key {name}" in lines(["check", flight, "--config", str(config)], capsys)[-1]
    assert main(["flight", "check", flight, "--key", key, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["vouched"] == "signed"


def test_report_adds_up(closed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = lines(["report", str(closed)], capsys)
    assert said[0] == closed.name
    assert said[-3].split() == ["2", "shots:", "1", "safe,", "1", "failed,", "0", "open"]
    assert said[-2].split() == ["1", "frame,", "2.0", "MB:", "1", "tagged,", "1", "decoded"]
    assert said[-1] == "the counts agree"
    assert main(["flight", "report", str(closed), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["balanced"] is True
    assert told["sources"][0]["shots"] == 2


def test_counts_that_do_not_balance_are_a_failure(closed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(sqlite3.connect(closed / "flight.sqlite")) as ledger:
        ledger.execute("DELETE FROM frames")
        ledger.commit()
    said = lines(["report", str(closed)], capsys, code=1)
    assert said[-1].startswith("THE COUNTS DO NOT AGREE")


@pytest.mark.disk
def test_no_file_of_a_copied_flight_is_for_every_user_of_the_machine(closed: Path, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        assert main(["flight", "offload", str(tmp_path / "disk"), str(closed), "--same-device"]) == 0
    finally:
        after = os.umask(before)
    assert after == 0
    copied = [tmp_path / "disk" / closed.name, *(tmp_path / "disk" / closed.name).rglob("*")]
    assert len(copied) > 5
    assert {one for one in copied if one.stat().st_mode & 0o007} == set()


@pytest.mark.disk
def test_offload_says_what_it_did(closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    disk = tmp_path / "disk"
    said = lines(["offload", str(disk), str(closed), "--same-device"], capsys)
    count = sum(path.is_file() for path in (disk / closed.name).rglob("*"))
    assert said[0].startswith(
        f"{disk / closed.name}: {count} files copied and verified, 0 already there; read back from "
    )
    assert main(["flight", "offload", str(disk), str(closed), "--same-device", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["copied"], told["there_already"], told["pruned"]) == (0, count, 0)
    assert main(["flight", "offload", str(disk), str(closed)]) == 1
    assert "insist with --same-device" in capsys.readouterr().err


def test_a_flight_is_signed_later_by_its_owner(
    closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seal_key.make(tmp_path / "key")
    name = seal_key.load(tmp_path / "key").name
    words = ["seal", str(closed), "--key", str(tmp_path / "key")]
    for _ in range(2):  # the second call has nothing to do
        note, verdict = lines(words, capsys)
        assert note.startswith("note:  seal 2 was signed later, by hand (flight seal)")
        assert f"intact, sealed with key {name}" in verdict
    (closed / "notes.txt").write_bytes(b"windy")  # a file of somebody's own is no fault, and not signed along
    assert lines(["check", str(closed), "--key", str(tmp_path / "key")], capsys)[-1] == verdict
    seals.seal(layout.open_folder(closed), RecordedClock(START_UTC_NS), seals.Occasion.RUN)
    assert (
        "up to seal 2, then not signed" in lines(["check", str(closed), "--key", str(tmp_path / "key")], capsys, 1)[-1]
    )
    assert f"intact, sealed with key {name}" in lines(words, capsys)[-1]


def test_what_a_check_notes_before_the_owner_signs_is_noted_ever_after(
    closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Anybody can add a row and its link, and change a sidecar meanwhile: a signature must not make that vanish."""
    seal_key.make(tmp_path / "key")
    words = [str(closed), "--key", str(tmp_path / "key")]
    (closed / "frames" / "000000.xmp").write_bytes(b"<x:xmpmeta/>")
    seals.seal(layout.open_folder(closed), RecordedClock(START_UTC_NS), seals.Occasion.GEOTAG)
    lines(["seal", *words], capsys)
    with Ledger(closed / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.add_event("opened again", CARD_FULL)
    (closed / "frames" / "000000.xmp").write_bytes(b"<x:forged/>")
    assert any("frames/000000.xmp was changed" in line for line in lines(["check", *words], capsys, 1))
    for verb in ("seal", "check"):
        said = lines([verb, *words], capsys)
        assert any("frames/000000.xmp was changed" in line for line in said[:-1]), said


def test_what_is_not_intact_or_not_closed_is_not_signed(
    flights: Path, closed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seal_key.make(tmp_path / "key")
    before = (closed / "seals.jsonl").read_bytes()
    flip(closed / "frames" / "000000.cr2", 1000)
    assert main(["flight", "seal", str(closed), "--key", str(tmp_path / "key")]) == 1
    assert "is not intact (frames/000000.cr2 was changed: its SHA-256 is not the ledger's)" in capsys.readouterr().err
    assert (closed / "seals.jsonl").read_bytes() == before
    assert main(["flight", "seal", str(closed)]) == 2
    assert "no key is named to sign with: give --key FILE" in capsys.readouterr().err
    still = fly(flights)
    copy = shutil.copytree(still.folder.path, tmp_path / "killed" / still.folder.name)
    still.close()
    assert main(["flight", "seal", str(copy), "--key", str(tmp_path / "key")]) == 1
    assert "was never closed, and can't be sealed: the next `dappled run` closes it" in capsys.readouterr().err


def test_the_name_of_a_file_forges_no_verdict(closed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (closed / f"a\r\n{closed.name}: intact, sealed with key 1a2b3c4d: 1 file\udcff\x1b[2K").write_bytes(b"x")
    note, verdict = lines(["check", str(closed)], capsys)
    assert note.startswith(
        rf"note:  a\r\n{closed.name}: intact, sealed with key 1a2b3c4d: 1 file\udcff\x1b[2K was added"
    )
    assert "consistent" in verdict
