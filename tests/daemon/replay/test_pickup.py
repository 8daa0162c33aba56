"""What a person may say of files that are brought after landing, and what is refused before anything is recorded."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from dappled import durable
from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.daemon.replay import pickup
from dappled.daemon.replay.pickup import Choice
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.sources import parse_source
from dappled.errors import DappledError
from dappled.findings import Code, Finding
from dappled.flight import Cause, LedgerReader, Shot, recording
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import request, shot
from tests.simulated.finepix import picture
from tests.standing import failure


def test_a_file_is_no_frame_of_a_shot_that_never_fired(tmp_path: Path) -> None:
    """Shot 0 was fired and its file stayed at the camera; shot 1 found no camera."""
    flight = recording.begin(tmp_path / "flights", RecordedClock(START_UTC_NS))
    request(flight, 0)
    flight.journal.note(shot(1))
    flight.ledger.add_shot(shot(1))
    flight.ledger.follows(0, failure("its file stays at the camera"))
    flight.ledger.failed(1, failure("the camera was absent"))
    flight.close()
    card = tmp_path / "card"
    card.mkdir()
    (card / "DSCF0001.RAF").write_bytes(b"a frame")
    source = parse_source(str(card), PtpSource)
    with pytest.raises(DappledError, match=r"shot 1 never fired, according to the flight: the camera was absent$"):
        pickup.propose(flight.folder.path, source, Choice(pairs={1: "DSCF0001.RAF"}))
    proposal = pickup.propose(flight.folder.path, source, Choice(pairs={0: "DSCF0001.RAF"}))
    assert [index for index, _ in proposal.pairs] == [0]
    assert proposal.reasons[0].code is Code.PICKUP_AS_TOLD


T0_S = 1_700_000_000


class Landed:
    """A closed flight of shots that were fired at given seconds after T0, whose files are on cards."""

    def __init__(self, folder: Path, fired_s: Sequence[float]) -> None:
        self._folder = folder
        flight = recording.begin(folder / "flights", RecordedClock(START_UTC_NS))
        for index, at_s in enumerate(fired_s):
            utc_ns = round((T0_S + at_s) * 1e9)
            flight.ledger.add_shot(Shot(index, Cause("test", "test"), utc_ns, utc_ns - T0_S * 10**9))
            flight.ledger.fired(index, round(at_s * 1e9), round(at_s * 1e9))
            flight.ledger.follows(index, failure("its file stays at the camera"))
        flight.close()
        self.path = flight.folder.path

    def card(self, name: str, pictures: Mapping[str, float | None]) -> Path:
        """A card of pictures and when each was taken, seconds after T0; None: its file has no time."""
        card = self._folder / name
        card.mkdir()
        for number, (file, taken_s) in enumerate(pictures.items()):
            bare = f"{name} {file}".encode().ljust(20_000)
            (card / file).write_bytes(bare if taken_s is None else picture(100 + number, 6.3, T0_S + taken_s))
        return card

    def pickup(self, card: Path, *words: str) -> int:
        return main(["flight", "pickup", str(self.path), "--from", str(card), *words])

    def frames(self) -> dict[int, bytes]:
        with LedgerReader.open(self.path / "flight.sqlite") as ledger:
            return {frame.index: (self.path / frame.name).read_bytes() for frame in ledger.frames()}

    def events(self, kind: str) -> list[tuple[int | None, Finding | None]]:
        with LedgerReader.open(self.path / "flight.sqlite") as ledger:
            return [(event.index, event.finding) for event in ledger.events() if event.kind == kind]


def test_a_second_card_that_numbers_from_1_again_is_brought_too(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    names = [f"DSCF000{number}.RAF" for number in (1, 2, 3)]
    flight = Landed(tmp_path, [0, 7, 19, 60, 66, 80])
    first = flight.card("first", dict(zip(names, (0.5, 7.5, 19.5), strict=True)))
    second = flight.card("second", dict(zip(names, (60.5, 66.5, 80.5), strict=True)))
    for name in names:  # all RAFs of this body have one size
        assert (first / name).stat().st_size == (second / name).stat().st_size
        os.utime(second / name, ns=(0, (first / name).stat().st_mtime_ns))
    assert flight.pickup(first) == 1
    assert "3 frames brought, 0 already there, 3 missing" in capfd.readouterr().out
    assert flight.pickup(second, "--pair", "3=DSCF0001.RAF") == 0
    told = capfd.readouterr()
    out = told.out
    assert "3 frames brought, 0 already there, 0 missing" in out
    assert "note: the camera's memory card was changed" in told.err
    expected = [(card / name).read_bytes() for card in (first, second) for name in names]
    assert flight.frames() == dict(enumerate(expected))
    (noticed,) = [found for _, found in flight.events("noticed")]
    assert noticed is not None
    assert noticed.code is Code.CARD_CHANGED
    for card in (first, second):
        assert flight.pickup(card) == 0
        assert "0 frames brought, 3 already there, 0 missing" in capfd.readouterr().out


def test_a_telemetry_that_can_t_be_read_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    flight = Landed(tmp_path, [0])
    card = flight.card("card", {"DSCF0001.RAF": 0.5})
    (flight.path / "telemetry.tlog").write_bytes(bytes(100))
    monkeypatch.setattr(durable, "plain_file", full)
    assert flight.pickup(card, "--pair", "0=DSCF0001.RAF") == 1
    assert "telemetry.tlog can't be read: No space left on device" in capfd.readouterr().err


def full(path: str, flags: int) -> int:
    """An opener on a disk that refuses."""
    if path.endswith(".tlog"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
    return os.open(path, flags)


def test_a_renamed_copy_is_there_already_and_no_other_shot_s(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    flight = Landed(tmp_path, [0, 7])
    card = flight.card("card", {"DSCF0001.RAF": 0.5})
    assert flight.pickup(card, "--pair", "0=DSCF0001.RAF") == 1
    (card / "DSCF0001.RAF").rename(card / "COPY.RAF")
    assert flight.pickup(card) == 1
    assert "0 frames brought, 1 already there, 1 missing" in capfd.readouterr().out
    assert flight.pickup(card, "--pair", "1=COPY.RAF") == 2
    assert "its bytes are the frame of shot 0 already" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pair", "0=A.RAF", "--pair", "1=A.RAF"], "the same file is named for shot 0"),
        (["--pair", "0=A.RAF", "--pair", "0=B.RAF"], "2 files are named for shot 0"),
        (["--pair", "9=A.RAF"], "shot 9 is not in the flight"),
        (["--pair", "0=C.RAF"], "0 new files have this name"),
        (["--by-order"], "needs as many files as shots: 3 shots, 2 files"),
        (["--from", "none"], "there is no such folder"),
    ],
)
def test_a_choice_that_contradicts_the_flight_is_a_wrong_call(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    flight = Landed(tmp_path, [0, 7, 19])
    card = flight.card("card", {"A.RAF": None, "B.RAF": None})
    assert flight.pickup(card, *words) == 2
    assert said in capfd.readouterr().err.splitlines()[-1]
    assert flight.frames() == {}


def test_a_clock_that_was_set_between_two_cards_is_a_doubt_of_each_frame(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    flight = Landed(tmp_path, [0, 7, 19, 60, 64, 84])
    first = flight.card("first", {"DSCF0001.RAF": 0.5, "DSCF0002.RAF": 7.5, "DSCF0003.RAF": 19.5})
    second = flight.card("second", {"DSCF0001.RAF": 3660.5, "DSCF0002.RAF": 3664.5, "DSCF0003.RAF": 3684.5})
    assert flight.pickup(first) == 1
    assert flight.events("doubt") == []
    assert flight.pickup(second) == 1
    assert "in doubt: frame 3: by the body's clock it was taken +3600 s away" in capfd.readouterr().err
    assert [index for index, _ in flight.events("doubt")] == [3, 4, 5]
    assert flight.frames() == {
        n: (card / f"DSCF000{k}.RAF").read_bytes()
        for n, (card, k) in enumerate((card, k) for card in (first, second) for k in (1, 2, 3))
    }


def test_by_order_counts_as_cameras_do_where_files_have_no_time(tmp_path: Path) -> None:
    flight = Landed(tmp_path, [0, 5, 10, 15])
    names = ["IMG_0001.RAF", "IMG_0002.RAF", "IMG_9998.RAF", "IMG_9999.RAF"]
    card = flight.card("card", dict.fromkeys(names))
    assert flight.pickup(card, "--by-order") == 0
    assert flight.frames() == {n: (card / names[at]).read_bytes() for n, at in enumerate((2, 3, 0, 1))}


@pytest.mark.parametrize(
    ("taken_s", "doubted", "said"),
    [
        ([0.5, 5.5, 25.5, 30.5], [2], "frame 2: by the body's clock it was taken +15 s away from its shot"),
        ([30.5, 0.5, 5.5, 10.5], [], "picture B.RAF: its name comes after A.RAF, but it was taken 30 s earlier"),
    ],
)
def test_by_order_against_the_times_is_told(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], taken_s: list[float], doubted: list[int], said: str
) -> None:
    flight = Landed(tmp_path, [0, 5, 10, 30])
    card = flight.card("card", dict(zip(("A.RAF", "B.RAF", "C.RAF", "D.RAF"), taken_s, strict=True)))
    assert flight.pickup(card, "--by-order", "--dry-run", "--anyway") == 0
    assert flight.pickup(card, "--by-order") == 1
    assert f"in doubt: {said}" in capfd.readouterr().err
    by_time = sorted(zip(taken_s, "ABCD", strict=True))
    assert flight.frames() == {n: (card / f"{name}.RAF").read_bytes() for n, (_, name) in enumerate(by_time)}
    assert [index for index, _ in flight.events("doubt")] == doubted
    with LedgerReader.open(flight.path / "flight.sqlite") as ledger:
        assert [index for index, tag in ledger.tags().items() if tag.doubts] == doubted
