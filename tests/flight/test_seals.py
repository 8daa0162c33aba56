"""Seals: what they cover, who signed them, and what a crash or an attacker leaves of them."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from dappled import durable
from dappled.clock import RecordedClock
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.flight import (
    FlightError,
    FlightFolder,
    Ledger,
    LedgerReader,
    Recording,
    recording,
    seal_key,
    seals,
)
from dappled.flight.checks.flight_check import check
from dappled.key_files import KeyFileError
from tests.flight.checks.test_chain_check import attacked, fly
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import CARD_FULL, flip, words_of

SEED = 20261122
LATER = RecordedClock(START_UTC_NS + 10**12)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> FlightFolder:
    """A closed flight with rows in every table, a journal, telemetry, inputs and sidecars; seals 1 and 2. Not to be
    written to."""
    flights = tmp_path_factory.mktemp("sealed") / "flights"
    flight = recording.begin(flights, RecordedClock(START_UTC_NS), {"camera": {"driver": "none"}})
    (inputs := flight.folder.path / "inputs").mkdir()
    (inputs / "white.npy").write_bytes(b"what frames were decoded with" * 10)
    flight.note_inputs("inputs")
    folder = fly(flight)
    with seals.reopened(folder, LATER, seals.Occasion.GEOTAG):
        (folder.frames / "000000.cr2.xmp").write_bytes(b"<x:xmpmeta/>" * 20)
        (folder.path / "geotags").mkdir()
        (folder.path / "geotags/geo.txt").write_bytes(b"EPSG:4326\n")
    return folder


@pytest.fixture
def sealed(made: FlightFolder, flights: Path) -> FlightFolder:
    """A copy of it, in a flights folder of its own."""
    shutil.copytree(made.path.parent, flights)
    return FlightFolder(flights / made.path.name)


def key_file(folder: Path, name: str = "seal.key") -> Path:
    seal_key.make(folder / name)
    return folder / name


def reseal(folder: FlightFolder, **changes: object) -> None:
    """What an attacker without the key does: change the newest seal and compute its digests anew."""
    *before, last = folder.seals.read_bytes().splitlines(keepends=True)
    values = {name: value for name, value in json.loads(last).items() if name != "sha256"} | changes
    folder.seals.write_bytes(b"".join(before) + seals.Seal(**values).line() + b"\n")


def files(folder: FlightFolder) -> list[Path]:
    return sorted(path for path in folder.path.rglob("*") if path.is_file())


def test_a_sealed_flight_is_consistent_and_not_signed(sealed: FlightFolder) -> None:
    bytes_before = {path: path.read_bytes() for path in files(sealed)}
    report = check(sealed.path)
    assert (words_of(report.problems), words_of(report.notes)) == ((), ())
    assert report.vouched == "not signed"
    assert report.verdict.code is Code.SEAL_NOT_SIGNED
    assert {path: path.read_bytes() for path in files(sealed)} == bytes_before


def test_a_seal_covers_every_file_but_itself(sealed: FlightFolder) -> None:
    last = seals.read(sealed).last
    assert last is not None
    names = {path.relative_to(sealed.path).as_posix() for path in files(sealed)}
    assert last.files.keys() == names - {"seals.jsonl"}
    for name, (size, sha256) in last.files.items():
        path = sealed.path / name
        assert (path.stat().st_size, durable.hash_file(path)) == (size, sha256)
    assert (last.seal, last.why, last.flight) == (2, seals.Occasion.GEOTAG, sealed.name)


def flips(folder: FlightFolder, count: int, seed: int) -> list[str]:
    """Single bits flipped at random, over every file in turn; those that nothing named, and unexpected errors."""
    chosen, unnamed = random.Random(seed), []  # noqa: S311  chances, not secrets
    paths = files(folder)
    for number in range(count):
        path = paths[number % len(paths)]
        before = path.read_bytes()
        at, bit = chosen.randrange(len(before)), chosen.randrange(8)
        path.write_bytes(before[:at] + bytes([before[at] ^ 1 << bit]) + before[at + 1 :])
        where = f"{path.name}: bit {bit} of byte {at}"
        try:
            if not words_of(check(folder.path).problems):
                unnamed.append(where)
        except Exception as error:  # noqa: BLE001  any error but a finding is what is looked for
            unnamed.append(f"{where}: {error!r}")
        for leftover in folder.path.glob("flight.sqlite-*"):
            leftover.unlink()
        path.write_bytes(before)
    assert words_of(check(folder.path).problems) == ()
    return unnamed


def test_each_flipped_bit_of_any_file_is_named(sealed: FlightFolder) -> None:
    assert flips(sealed, 60, SEED) == []  # 400 more are slow


def test_each_flipped_bit_of_the_ledger_is_named(sealed: FlightFolder) -> None:
    chosen = random.Random(SEED)  # noqa: S311  chances, not secrets
    before, unnamed = sealed.ledger.read_bytes(), []
    places = [*range(0, 100, 3), *(chosen.randrange(len(before)) for _ in range(20))]
    for at in places:
        sealed.ledger.write_bytes(before[:at] + bytes([before[at] ^ 1 << chosen.randrange(8)]) + before[at + 1 :])
        unnamed += [] if words_of(check(sealed.path).problems) else [at]
        for leftover in sealed.path.glob("flight.sqlite-*"):
            leftover.unlink()
    assert unnamed == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 10))])
def test_each_of_many_flipped_bits_is_named(sealed: FlightFolder, seed: int) -> None:
    assert flips(sealed, 400, seed) == []


@dataclass(frozen=True)
class Attack:
    name: str
    do: Callable[[FlightFolder], object]
    words: str


def cut(path: Path, size: int) -> None:
    os.truncate(path, size)


def vacuum(folder: FlightFolder) -> None:
    with attacked(folder) as db:
        db.execute("VACUUM")


def cut_seal(folder: FlightFolder) -> None:
    folder.seals.write_bytes(folder.seals.read_bytes().splitlines(keepends=True)[0])


def unseal(folder: FlightFolder) -> None:
    with attacked(folder) as db:
        db.execute("DELETE FROM facts WHERE key = 'seals'")


ATTACKS = [
    Attack("no seals", lambda f: f.seals.unlink(), "seal 1 is missing"),
    Attack("the last seal cut off", cut_seal, "seal 2 is missing"),
    Attack("half a seal", lambda f: cut(f.seals, f.seals.stat().st_size - 20), "is torn"),
    Attack("garbage for seals", lambda f: f.seals.write_bytes(b"\xff\n\xfe{}[\n"), "line 1 of seals.jsonl was changed"),
    Attack("deep nesting", lambda f: f.seals.write_bytes(b"[" * 10**5 + b"\n"), "line 1 of seals.jsonl was changed"),
    Attack("seals that the ledger doesn't tell of", unseal, "the ledger does not tell of seal 2"),
    Attack("free pages", vacuum, "flight.sqlite was changed since seal 2"),
    Attack("a sidecar", lambda f: flip(f.frames / "000000.cr2.xmp", 3), "000000.cr2.xmp was changed since seal 2"),
    Attack("no list", lambda f: (f.path / "geotags/geo.txt").unlink(), "geotags/geo.txt is missing: seal 2 covers it"),
    Attack("another input", lambda f: (f.path / "inputs/dark.npy").write_bytes(b"x"), "inputs/dark.npy was added"),
    Attack("a shorter ledger", lambda f: cut(f.ledger, f.ledger.stat().st_size // 2), "damaged"),
    Attack("an empty ledger", lambda f: cut(f.ledger, 0), "not a dappled ledger"),
    Attack("a WAL", lambda f: f.ledger.with_name("flight.sqlite-wal").write_bytes(b"x" * 99), "holds 99 bytes"),
    Attack("another head", lambda f: reseal(f, head="0" * 64), "seal 2 contradicts the chain"),
    Attack("fewer links", lambda f: reseal(f, links=3), "seal 2 contradicts the chain"),
    Attack("a frame's digest", lambda f: reseal(f, files={}), "flight.sqlite was changed"),
    Attack("half a signature", lambda f: reseal(f, key="00000000"), "signed in part"),
    Attack("another flight's seal", lambda f: reseal(f, flight="20260101T000000Z-00000000"), "is of another flight"),
]


STRANGERS = [
    Attack("a link", lambda f: (f.path / "evil").symlink_to("/etc"), "evil is a link"),
    Attack("a hidden link", lambda f: (f.path / "inputs/.evil").symlink_to("/etc/passwd"), "inputs/.evil is a link"),
    Attack("a pipe", lambda f: os.mkfifo(f.path / "inputs/pipe"), "inputs/pipe is no file"),
    Attack("a half-written file", lambda f: (f.path / ".x.part").write_bytes(b"x"), ".x.part is a half-written file"),
    Attack("one in inputs", lambda f: (f.path / "inputs/.x.part").write_bytes(b"x"), "inputs/.x.part is a half-wr"),
    Attack("a hidden file", lambda f: (f.path / "inputs/.x").write_bytes(b"x"), "inputs/.x was added since seal 2"),
    Attack("a hidden frame", lambda f: (f.frames / ".x").write_bytes(b"x"), "frames/.x is in no row of the ledger"),
    Attack("a rollback journal", lambda f: beside(f, "-journal").write_bytes(b"x" * 9), "so the ledger was not opened"),
]


@pytest.mark.parametrize("attack", [*ATTACKS, *STRANGERS], ids=lambda attack: attack.name)
def test_an_attack_is_named(sealed: FlightFolder, attack: Attack) -> None:
    attack.do(sealed)
    problems = words_of(check(sealed.path).problems)
    assert any(attack.words in problem for problem in problems), problems


def beside(folder: FlightFolder, suffix: str) -> Path:
    return folder.ledger.with_name(folder.ledger.name + suffix)


@pytest.mark.parametrize(
    ("do", "words"),
    [
        (lambda f: (f.path / "inputs/new").mkdir(), "inputs/new is an empty folder"),
        (lambda f: (f.path / "mine").mkdir(), "mine is an empty folder, which no seal covers"),
        (lambda f: beside(f, "-shm").write_bytes(b"x" * 999), "flight.sqlite-shm stands beside the ledger"),
        (lambda f: beside(f, "-wal").touch(), "flight.sqlite-wal stands beside the ledger"),
        (lambda f: (f.path / ".mine").write_bytes(b"x"), ".mine was added since seal 2: no seal covers it"),
    ],
)
def test_what_harms_nothing_is_a_note(sealed: FlightFolder, do: Callable[[FlightFolder], object], words: str) -> None:
    do(sealed)
    report = check(sealed.path)
    assert words_of(report.problems) == ()
    assert any(words in note for note in words_of(report.notes)), words_of(report.notes)


def test_the_name_of_another_flight_is_wrong_and_a_name_of_ones_own_a_note(sealed: FlightFolder) -> None:
    other, own = (sealed.path.with_name(name) for name in ("20260101T000000Z-deadbeef", "the meadow"))
    said = f"the flight was recorded as {sealed.name}"
    shutil.copytree(sealed.path, own)
    sealed.path.rename(other)
    assert [said in text for text in words_of(check(other).problems)] == [True]
    assert (words_of(check(own).problems), [said in text for text in words_of(check(own).notes)]) == ((), [True])


def test_a_rollback_journal_changes_no_byte_of_the_ledger(sealed: FlightFolder) -> None:
    before = sealed.ledger.read_bytes()
    beside(sealed, "-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + b"\1" * 2000)
    assert not check(sealed.path).intact
    assert sealed.ledger.read_bytes() == before
    assert beside(sealed, "-journal").exists()


def test_a_file_of_ones_own_is_named_and_no_fault(sealed: FlightFolder) -> None:
    (sealed.path / "notes.txt").write_bytes(b"windy")
    report = check(sealed.path)
    assert words_of(report.problems) == ()
    assert words_of(report.notes) == ("notes.txt was added since seal 2: no seal covers it",)


def test_work_that_was_killed_leaves_rows_that_the_chain_vouches_for(sealed: FlightFolder) -> None:
    with Ledger(sealed.ledger, LATER) as writer:
        writer.add_event("opened again", CARD_FULL)
    (sealed.frames / "000001.cr2.xmp").write_bytes(b"<x:xmpmeta/>")
    report = check(sealed.path)
    assert words_of(report.problems) == ()
    assert any("opened again after seal 2 (geotag): 1 link of the chain" in note for note in words_of(report.notes))
    with seals.reopened(sealed, LATER, seals.Occasion.LATE_TAGS):
        pass
    assert (words_of(check(sealed.path).problems), words_of(check(sealed.path).notes)) == ((), ())
    with attacked(sealed) as db:
        db.execute("UPDATE events SET text = 'else' WHERE number = 1")
    assert "the row of events 1 was changed since dappled wrote it" in words_of(check(sealed.path).problems)


def test_a_crash_between_announcement_and_seal_is_told_and_sealed_again(
    sealed: FlightFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(path: Path, data: bytes) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as dying:
        dying.setattr(durable, "write_file", crash)
        with pytest.raises(KeyboardInterrupt):
            seals.seal(sealed, LATER, seals.Occasion.LATE_TAGS)
    assert any("seal 3 is missing" in problem for problem in words_of(check(sealed.path).problems))
    seals.seal(sealed, LATER, seals.Occasion.LATE_TAGS)
    report = check(sealed.path)
    assert words_of(report.problems) == ()
    assert words_of(report.notes) == ("seal 3 was never written: its work was interrupted",)


def test_the_next_flight_seals_one_that_was_closed_and_not_sealed(
    flight: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as dying:
        dying.setattr(seals, "seal", lambda *_: None)
        dying.setattr(flight.index, "take_in", lambda *_, **__: [])
        folder = fly(flight)
    assert check(folder.path).vouched == "not sealed"
    recording.begin(folder.path.parent, LATER).close()
    report = check(folder.path)
    assert (words_of(report.problems), report.vouched) == ((), "not signed")
    last = seals.read(folder).last
    assert last is not None
    assert last.why == seals.Occasion.RECOVERED


def test_an_open_flight_is_not_sealed(flight: Recording) -> None:
    with seals.reopened(flight.folder, LATER, seals.Occasion.GEOTAG):
        pass
    seals.seal(flight.folder, LATER, seals.Occasion.GEOTAG)
    assert not flight.folder.seals.exists()
    assert check(flight.folder.path).vouched == "not sealed"


def test_a_key_tells_a_genuine_seal_from_one_made_anew(flights: Path, tmp_path: Path) -> None:
    key, other = (seal_key.load(key_file(tmp_path, name)) for name in ("seal.key", "other.key"))
    folder = fly(recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=key))
    genuine = folder.seals.read_bytes()
    report = check(folder.path, key)
    assert (words_of(report.problems), report.vouched) == ((), "signed")
    assert (report.verdict.code, report.verdict.facts) == (Code.SEAL_SIGNED, {"key": key.name})
    assert check(folder.path).vouched == check(folder.path, other).vouched == "not verified"

    reseal(folder, why="geotag")  # its digests fit; its signature doesn't
    assert words_of(check(folder.path).problems) == ()
    assert words_of(check(folder.path, key).problems) == (
        f"the signature of seal 1 is wrong: key {key.name} did not make it",
    )
    reseal(folder, key=None, mac=None)
    assert check(folder.path, key).vouched == "not signed"

    folder.seals.write_bytes(genuine)
    with seals.reopened(folder, LATER, seals.Occasion.GEOTAG):
        pass
    report = check(folder.path, key)
    assert words_of(report.problems) == ()
    assert (report.verdict.code, report.verdict.facts) == (Code.SEAL_SIGNED_UNTIL, {"key": key.name, "seal": 1})


def test_a_key_is_derived_for_seals_alone(tmp_path: Path) -> None:
    """RFC 5869 by its own words."""
    path = key_file(tmp_path)
    secret = bytes.fromhex(path.read_text().strip())
    key = seal_key.load(path)
    extracted = hashlib.sha256()  # HMAC spelled out: H(salt ^ opad, H(salt ^ ipad, key))
    block = b"dappled".ljust(64, b"\0")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in block) + secret).digest()
    extracted.update(bytes(b ^ 0x5C for b in block) + inner)
    assert secret not in (key.secret, extracted.digest())
    block = extracted.digest().ljust(64, b"\0")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in block) + b"dappled flight seal 1\x01").digest()
    assert key.secret == hashlib.sha256(bytes(b ^ 0x5C for b in block) + inner).digest()
    assert secret.hex() not in repr(key)


def test_a_signature_counts_whole(tmp_path: Path) -> None:
    key = seal_key.load(key_file(tmp_path))
    right = key.sign(b"seal")
    assert key.signed(b"seal", right)
    for at in range(len(right)):
        other = "0" if right[at] != "0" else "1"
        assert not key.signed(b"seal", right[:at] + other + right[at + 1 :])
    assert not key.signed(b"seal", right[:-1])
    assert not key.signed(b"seal", right + "0")


def test_a_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(DappledError, match="exists already"):
        seal_key.make(path)
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        seal_key.load(path)
    path.chmod(0o600)
    path.write_text("short")
    with pytest.raises(KeyFileError, match="64 hexadecimal digits"):
        seal_key.load(path)
    with pytest.raises(KeyFileError, match="dappled keys seal"):
        seal_key.load(tmp_path / "missing")


def test_a_flight_is_sealed_beside_a_reader_and_under_another_name(sealed: FlightFolder) -> None:
    copy = FlightFolder(sealed.path.with_name("renamed"))
    shutil.copytree(sealed.path, copy.path)
    with LedgerReader.open(copy.ledger) as reader:
        assert reader.shots()
        with seals.reopened(copy, LATER, seals.Occasion.GEOTAG):
            pass
        assert words_of(check(copy.path).problems) == ()
    said = f"the folder is called renamed, and the flight was recorded as {sealed.name}"
    assert (words_of(check(copy.path).problems), words_of(check(copy.path).notes)) == ((), (said,))


def test_a_ledger_that_can_not_be_folded_is_not_sealed(sealed: FlightFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """A seal of a file that SQLite has still to change would be wrong later."""
    monkeypatch.setattr("dappled.flight.ledger.BUSY_S", 0.05)
    with attacked(sealed) as reader, Ledger(sealed.ledger, LATER) as writer:
        writer.add_event("camera", CARD_FULL)
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM events").fetchone()
        with pytest.raises(FlightError, match="another program holds it"):
            seals.seal(sealed, LATER, seals.Occasion.LATE_TAGS)
    seals.seal(sealed, LATER, seals.Occasion.LATE_TAGS)
    assert words_of(check(sealed.path).problems) == ()


def test_a_record_that_was_rewritten_with_links_and_a_seal_of_its_own_is_named(flights: Path, tmp_path: Path) -> None:
    """Whoever edits without the key can only go on from the signed seal; what was recorded can't be changed so."""
    key = seal_key.load(key_file(tmp_path))
    folder = fly(recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=key))
    flip(folder.frames / "000001.cr2", 5)
    flip(folder.telemetry, 30)
    with Ledger(folder.ledger, LATER) as writer:
        writer.set_fact("telemetry_sha256", durable.hash_file(folder.telemetry))
        with writer._transaction():
            writer._db.execute(
                "UPDATE frames SET sha256 = ? WHERE idx = 1", (durable.hash_file(folder.frames / "000001.cr2"),)
            )
            writer._written["frames", (1,)] = None
    seals.seal(folder, LATER, seals.Occasion.LATE_TAGS)
    problems = words_of(check(folder.path, key).problems)
    assert "the row of frames 1 was written again, which dappled never does" in problems
    for name in ("frames/000001.cr2", "telemetry.tlog"):
        assert f"seal 2 holds another digest of {name} than seal 1: it was changed in between" in problems


def test_later_work_is_signed_where_the_key_signed_all_before_it(flights: Path, tmp_path: Path) -> None:
    key = seal_key.load(key_file(tmp_path))
    folder = fly(recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=key))
    with seals.work(folder, LATER, seals.Occasion.GEOTAG, "geotags flights in", key):
        (folder.frames / "000000.cr2.xmp").write_bytes(b"<x:xmpmeta/>")
    assert check(folder.path, key).verdict.code is Code.SEAL_SIGNED


def added_row(folder: FlightFolder) -> None:
    with Ledger(folder.ledger, LATER) as ledger:
        ledger.set_fact("utc_correction", {"correction_ns": 86_400 * 10**9})


def changed_sidecar(folder: FlightFolder) -> None:
    (folder.frames / "000000.cr2.xmp").write_bytes(b"<x:forged/>")


def missing_sidecar(folder: FlightFolder) -> None:
    (folder.frames / "000000.cr2.xmp").unlink()


def unsigned_seal(folder: FlightFolder) -> None:
    seals.seal(folder, LATER, seals.Occasion.GEOTAG)


def unused_bytes(folder: FlightFolder) -> None:
    """A change of the ledger's bytes that changes no row."""
    vacuum(folder)


@pytest.mark.parametrize("attack", [added_row, changed_sidecar, missing_sidecar, unsigned_seal, unused_bytes])
def test_later_work_does_not_sign_what_somebody_else_did_before_it(
    flights: Path, tmp_path: Path, attack: Callable[[FlightFolder], None]
) -> None:
    key = seal_key.load(key_file(tmp_path))
    folder = fly(recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=key))
    with seals.reopened(folder, LATER, seals.Occasion.GEOTAG, key):
        (folder.frames / "000000.cr2.xmp").write_bytes(b"<x:xmpmeta/>")
    attack(folder)
    with seals.reopened(folder, LATER, seals.Occasion.LATE_TAGS, key):
        pass
    report = check(folder.path, key)
    assert report.vouched == "not signed"
    assert (report.verdict.code, report.verdict.facts) == (Code.SEAL_SIGNED_UNTIL, {"key": key.name, "seal": 2})


@pytest.mark.parametrize(
    ("attack", "names"), [(unused_bytes, "flight.sqlite"), (changed_sidecar, "frames/000000.cr2.xmp")]
)
def test_what_was_changed_between_two_works_stays_known(
    sealed: FlightFolder, attack: Callable[[FlightFolder], None], names: str
) -> None:
    """Without a key too: the next seal covers what is there, and the ledger tells that something else made it."""
    attack(sealed)
    with seals.reopened(sealed, LATER, seals.Occasion.LATE_TAGS):
        pass
    report = check(sealed.path)
    assert words_of(report.problems) == ()
    assert words_of(report.notes) == (f"changed, added or removed by something else after seal 2: {names}",)


@pytest.mark.parametrize("name", ["shots.jsonl", "seals.jsonl", "offloaded.jsonl", "telemetry.tlog"])
def test_a_file_of_holes_is_judged_before_it_is_read(sealed: FlightFolder, name: str) -> None:
    with (sealed.path / name).open("ab") as file:
        file.truncate(1 << 40)
    problems = words_of(check(sealed.path).problems)
    assert any("its content would take" in problem and name in problem for problem in problems), problems


def test_a_value_that_no_ledger_holds_is_refused_before_it_is_read(sealed: FlightFolder) -> None:
    with attacked(sealed) as db:
        db.execute("UPDATE events SET text = hex(zeroblob(10000000)) WHERE number = 1")
    assert any("a value in it takes more than 16 MB" in problem for problem in words_of(check(sealed.path).problems))


def test_the_start_of_a_daemon_does_not_sign_what_somebody_added(flights: Path, tmp_path: Path) -> None:
    """A flight that the index does not call sealed is looked at, and sealed again where its chain goes on."""
    key = seal_key.load(key_file(tmp_path))
    folder = fly(recording.begin(flights, RecordedClock(START_UTC_NS), seal_key=key))
    added_row(folder)
    with closing(sqlite3.connect(flights / "index.sqlite")) as index, index:
        index.execute("UPDATE flights SET sealed = 0")
    recording.begin(flights, LATER, seal_key=key).close()
    report = check(folder.path, key)
    assert report.vouched == "not signed"
    assert (report.verdict.code, report.verdict.facts) == (Code.SEAL_SIGNED_UNTIL, {"key": key.name, "seal": 1})


@pytest.mark.parametrize("name", ["flight.toml", "shots.jsonl", "seals.jsonl", "telemetry.tlog"])
@pytest.mark.timeout(60)
def test_a_pipe_in_place_of_a_file_is_not_waited_for(sealed: FlightFolder, name: str) -> None:
    (sealed.path / name).unlink()
    os.mkfifo(sealed.path / name)
    try:
        problems = words_of(check(sealed.path).problems)
    except FlightError as error:
        problems = (str(error),)
    assert any(name in text for text in problems)
