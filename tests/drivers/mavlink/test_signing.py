"""Signed links: a packet with a valid signature is accepted once; no other is accepted or advances the time."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import SystemClock
from dappled.drivers.mavlink import signing
from dappled.drivers.mavlink.framing import Framer, mavlink, pack
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from dappled.drivers.mavlink.signing import SignatureGuard, SigningError, SigningTime, Unsigned, timestamp_of
from dappled.errors import DappledError
from dappled.key_files import KeyFileError

KEY = bytes(range(32))
NOW_NS = 1_800_000_000 * 10**9


class Clock(SystemClock):
    """UTC that a test sets."""

    def __init__(self, utc_ns: int = NOW_NS) -> None:
        super().__init__(0)
        self.ns = utc_ns

    def utc_ns(self) -> int:
        return self.ns

    def monotonic_ns(self) -> int:
        return self.ns


class Peer:
    """Another machine with pymavlink's own signing: it shares no code with this project."""

    def __init__(self, key: bytes = KEY, system: int = 255, offset_s: float = 0.0) -> None:
        self.packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self.packer.signing.secret_key = key
        self.packer.signing.sign_outgoing = True
        self.packer.signing.link_id = 3
        self.packer.signing.timestamp = round((NOW_NS / 1e9 + offset_s - signing.EPOCH_UNIX_S) * UNITS_PER_S)

    def packet(self) -> bytes:
        raw: bytes = pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), self.packer, version_1=False)
        return raw


def guard_in(folder: Path, *, unsigned: Unsigned = "refuse", clock: Clock | None = None) -> SignatureGuard:
    return SignatureGuard(KEY, 0, SigningTime(folder / "time", clock or Clock()), unsigned)


def judged(guard: SignatureGuard, raw: bytes) -> str:
    (framed,) = Framer().datagram(raw)
    message = framed.message
    return guard.judge(raw, message.get_srcSystem(), message.get_srcComponent(), message.get_msgId())


def test_pymavlinks_signatures_are_accepted_once(tmp_path: Path) -> None:
    guard, peer = guard_in(tmp_path), Peer()
    first, second, third = peer.packet(), peer.packet(), peer.packet()
    assert judged(guard, first) == "obey"
    assert judged(guard, first) == "refuse"
    assert judged(guard, third) == "obey"
    assert judged(guard, second) == "refuse"  # out of order counts as replayed: the price of counting once
    counts = guard.statistics()
    assert (counts.good, counts.replayed, counts.forged) == (2, 2, 0)


def test_pymavlink_accepts_signed_packets(tmp_path: Path) -> None:
    guard, packer = guard_in(tmp_path), mavlink.MAVLink(None, srcSystem=1, srcComponent=100)
    other = mavlink.MAVLink(None)
    other.signing.secret_key = KEY
    stamps = []
    for _ in range(3):
        message = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
        guard.prepare(packer)
        raw = pack(message, packer, version_1=False)
        assert other.decode(bytearray(raw)).get_type() == "HEARTBEAT"
        stamps.append(timestamp_of(raw))
    assert other.signing.goodsig_count == 3
    assert stamps == sorted(set(stamps))


@given(st.integers(0, 200), st.integers(1, 255))
def test_a_packet_with_a_changed_byte_is_refused_and_does_not_advance_the_time(place: int, change: int) -> None:
    import tempfile  # noqa: PLC0415  # hypothesis and tmp_path do not go together

    with tempfile.TemporaryDirectory() as folder:
        guard, peer = guard_in(Path(folder)), Peer()
        before = guard._time.oldest()
        raw = bytearray(peer.packet())
        raw[place % len(raw)] ^= change
        if raw[0] == mavlink.PROTOCOL_MARKER_V2 and raw[2] & 1:
            assert guard.judge(bytes(raw), 255, 190, 0) == "refuse"
        assert guard._time.oldest() == before
        assert judged(guard, peer.packet()) == "obey"


def test_a_wrong_key_and_an_old_stream_are_refused(tmp_path: Path) -> None:
    guard = guard_in(tmp_path)
    assert judged(guard, Peer(key=bytes(32)).packet()) == "refuse"
    assert judged(guard, Peer(system=7, offset_s=-61).packet()) == "refuse"
    assert judged(guard, Peer(system=7, offset_s=-50).packet()) == "obey"
    assert guard.statistics().forged == 1


@pytest.mark.parametrize(("rule", "verdict"), [("refuse", "refuse"), ("listen", "hear"), ("allow", "obey")])
def test_unsigned_packets_go_by_the_rule_and_a_radios_status_is_heard(
    tmp_path: Path, rule: Unsigned, verdict: str
) -> None:
    guard = guard_in(tmp_path, unsigned=rule)
    packer = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    raw = pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), packer, version_1=True)
    assert judged(guard, raw) == verdict
    radio = pack(mavlink.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1), packer, version_1=False)
    assert judged(guard, radio) in ("hear", "obey")


@pytest.mark.parametrize("orderly", [True, False])
def test_packets_from_before_a_restart_are_refused_after_it(tmp_path: Path, orderly: bool) -> None:
    clock, peer = Clock(), Peer()
    guard = guard_in(tmp_path, clock=clock)
    old = peer.packet()
    assert judged(guard, old) == "obey"
    guard._time.keep(ending=orderly)
    used = guard._time.next() if not orderly else 0
    clock.ns -= 3600 * 10**9  # and the machine's clock was lost
    again = guard_in(tmp_path, clock=clock)
    assert judged(again, old) == "refuse"
    assert again._time.next() > used
    peer.packer.signing.timestamp += 0 if orderly else signing.AHEAD_UNITS
    assert judged(again, peer.packet()) == "obey"


def test_a_key_file_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "radio.key"
    signing.make_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(signing.read_key(path)) == 32
    with pytest.raises(DappledError, match="exists already"):
        signing.make_key(path)
    signing.make_key(tmp_path / "same.key", "swordfish")
    assert signing.read_key(tmp_path / "same.key").hex().startswith("b9f195c5")  # SHA-256, as ground stations do


class Disk:
    """Record the calls to the disk in order: fsync of a file with its size, fsync of a folder, rename."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[str | int] = []
        fsync, rename = os.fsync, os.replace

        def watched_fsync(fd: int) -> None:
            facts = os.fstat(fd)
            self.calls.append("folder" if stat.S_ISDIR(facts.st_mode) else facts.st_size)
            fsync(fd)

        def watched_rename(old: Path, new: Path, **folders: int | None) -> None:
            self.calls.append("rename")
            rename(old, new, **folders)

        monkeypatch.setattr(os, "fsync", watched_fsync)
        monkeypatch.setattr(os, "replace", watched_rename)


def test_a_key_is_on_the_disk_when_it_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(monkeypatch)
    signing.make_key(tmp_path / "radio.key")
    assert disk.calls == [65, "folder"]


def test_a_key_that_could_not_be_written_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_fd: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(DappledError, match="No space left"):
        signing.make_key(tmp_path / "radio.key")
    monkeypatch.undo()
    signing.make_key(tmp_path / "radio.key")


def test_a_power_cut_brings_no_older_times_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(monkeypatch)
    SigningTime(tmp_path / "time", Clock())
    assert disk.calls == [(tmp_path / "time").stat().st_size, "rename", "folder"]


def test_a_key_that_others_can_read_or_that_is_malformed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "radio.key"
    signing.make_key(path)
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        signing.read_key(path)
    path.chmod(0o600)
    path.write_text("beef\n")
    with pytest.raises(KeyFileError, match="holds no 64 hexadecimal digits"):
        signing.read_key(path)
    with pytest.raises(KeyFileError, match="dappled mavlink key"):
        signing.read_key(tmp_path / "missing.key")


def test_a_damaged_time_is_reported_and_a_missing_one_starts_at_zero(tmp_path: Path) -> None:
    (tmp_path / "time").write_text("nonsense")
    with pytest.raises(SigningError, match="signing times"):
        guard_in(tmp_path)


def test_guards_for_links_with_and_without_a_key(tmp_path: Path) -> None:
    signing.make_key(tmp_path / "radio.key")
    assert signing.open_signing([None, None], tmp_path / "new" / "time", Clock()) is None
    made = signing.open_signing([None, tmp_path / "radio.key"], tmp_path / "new" / "time", Clock())
    assert made is not None
    assert [guard is not None for guard in made.guards] == [False, True]
