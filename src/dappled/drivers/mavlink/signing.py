"""Sign and verify MAVLink 2 packets: key files, replay protection, and a signing time that never goes back.

A signature is the first 6 bytes of SHA-256 over key, packet, link id and a timestamp in units of 10 µs since 2015. A
packet is accepted once (`signature_book`). Only accepted packets advance the time.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import secrets
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from dappled import durable, key_files
from dappled.clock import Clock
from dappled.drivers.mavlink.framing import SIGNATURE_BYTES, is_signed, mavlink, message_of, packet_length
from dappled.drivers.mavlink.log_budget import Rate
from dappled.drivers.mavlink.signature_book import NEW_STREAM_UNITS, UNITS_PER_S, SignatureBook, Stream
from dappled.errors import DappledError
from dappled.findings import Finding

log = logging.getLogger(__name__)
Unsigned = Literal["refuse", "listen", "allow"]
Streams: TypeAlias = dict[str, dict[Stream, int]]  # by the name of the key
Trust = Literal["obey", "copy", "hear", "refuse"]
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01
NS_A_UNIT = 10_000
AHEAD_UNITS = 10 * UNITS_PER_S
MOST_AHEAD_UNITS = 86_400 * UNITS_PER_S
_KEEP_S = 1.0
_RADIO_A_S = 5
_RADIO_SIFTED_A_S = 20  # before their checksum is known
_LATEST = 2**48 - 1


class SigningError(DappledError):
    """A key or the signing time can't be read or written: one sentence with the file and what to do."""


def make_key(path: Path, passphrase: str | None = None) -> None:
    """Write a new key file (64 hexadecimal digits, mode 0600): random, or SHA-256 of a passphrase as QGroundControl,
    Mission Planner and MAVProxy make it. Raises DappledError, also where the file exists already."""
    key = (
        secrets.token_bytes(key_files.KEY_BYTES) if passphrase is None else hashlib.sha256(passphrase.encode()).digest()
    )
    key_files.make(path, key.hex() + "\n")


def read_key(path: Path) -> bytes:
    """Read a key from a file that only this user can read or change. Raises KeyFileError."""
    return key_files.read_key(path, "a signing key (dappled mavlink key makes one)")


class SigningTime:
    """The signing times of all links of this machine, kept over restarts, and a `SignatureBook` for each key.

    The file holds a time later than every time signed with, one later than every time accepted, and those of each
    stream. So no packet from before a restart is accepted after it. After a crash they are up to 10 s ahead, and
    genuine packets are refused for as long; after an orderly end they are exact. `keep` may wait for the disk; all
    other calls answer from memory.

    While this machine doesn't know the time, the latest time accepted stands for it. Once it does (`clock_known`), no
    sender moves what is asked of the others, and it signs at most a day ahead of it.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        """Raises SigningError where the file can't be read or written."""
        self._path = path
        self._clock = clock
        self._lock = threading.Lock()
        self._correction: int | None = None
        self._used, self._accepted, self._before = self._kept = self._stored()
        self._books: dict[str, SignatureBook] = {}
        self._floor, self._started = self._accepted, self._now()
        self.keep()

    def book(self, key: bytes) -> SignatureBook:
        """The book of a key."""
        name = hashlib.sha256(b"book of " + key).hexdigest()[:16]
        if name not in self._books:
            self._books[name] = SignatureBook(self._before.get(name, {}))
        return self._books[name]

    def clock_known(self, correction_ns: int) -> None:
        """This machine's clock is right, or so much behind UTC, from now on."""
        self._correction = correction_ns // NS_A_UNIT

    def monotonic_ns(self) -> int:
        return self._clock.monotonic_ns()

    def oldest(self) -> int:
        with self._lock:
            if self._correction is not None:
                return max(min(self._floor, self._started + self._correction), self._now() - NEW_STREAM_UNITS)
            return max(self._floor, max(self._used, self._accepted, self._now()) - NEW_STREAM_UNITS)

    def ahead(self, timestamp: int) -> int:
        ahead = timestamp - self._now()
        return ahead if self._correction is not None and ahead > NEW_STREAM_UNITS else 0

    def next(self) -> int:
        """Return a timestamp to sign with, later than every one before."""
        with self._lock:
            now, heard = self._now(), self._accepted
            if self._correction is not None:
                heard = min(heard, now + MOST_AHEAD_UNITS)
            self._used = min(_LATEST, max(self._used + 1, heard, now))
            return self._used

    def accepted(self, timestamp: int) -> None:
        with self._lock:
            self._accepted = max(self._accepted, timestamp)

    def keep(self, *, ending: bool = False) -> None:
        """Write the times to the file, 10 s ahead; exactly where `ending`. Raises SigningError."""
        with self._lock:
            now = _Times(self._used, self._accepted, self._heard_streams())
        margin = 0 if ending else AHEAD_UNITS
        if not ending and now.within(self._kept, margin // 2):
            return
        kept = now.later(margin).over(self._before)
        try:
            durable.write_file(self._path, kept.text().encode(), 0o600)
        except OSError as error:
            raise SigningError(
                f"cannot keep the signing times in {self._path}: {error.strerror or error}; check its folder"
            ) from error
        self._kept = kept

    def run(self, stop: threading.Event) -> None:
        """Keep the times until `stop` is set, and then exactly. A file that can't be written is logged once."""
        failed = False
        while True:
            ending = self._clock.pause(stop, _KEEP_S)
            try:
                self.keep(ending=ending)
                failed = False
            except SigningError as error:  # the links go on
                if not failed:
                    log.warning("%s", error)
                failed = True
            if ending:
                return

    def findings(self) -> list[Finding]:
        """Whose clock is wrong, by the books."""
        return [one for book in self._books.values() for one in book.findings()]

    def _heard_streams(self) -> Streams:
        """The streams of which something was accepted since the start, by key."""
        found: Streams = {}
        for name, book in list(self._books.items()):
            before = self._before.get(name, {})
            found[name] = {one: at for one, at in book.streams().items() if at != before.get(one)}
        return found

    def _now(self) -> int:
        utc = self._clock.utc_ns() // NS_A_UNIT + (self._correction or 0)
        return max(0, utc - EPOCH_UNIX_S * UNITS_PER_S)

    def _stored(self) -> _Times:
        try:
            return _Times.of(self._path.read_text("ascii"))
        except FileNotFoundError:
            return _Times(0, 0, {})
        except (OSError, ValueError) as error:
            raise SigningError(
                f"cannot read the signing times in {self._path} ({error}): old packets could be sent again; change the "
                "keys and remove the file"
            ) from error


class _Times(NamedTuple):
    """What the file holds. Its first line has the time signed with and the time accepted; each further one a key's
    name, system, component and link id of a stream, and its time."""

    used: int
    accepted: int
    streams: Streams

    @classmethod
    def of(cls, text: str) -> _Times:
        """The times in a file's text. Raises ValueError."""
        first, *rest = text.splitlines() or [""]
        used, accepted = (int(word) for word in first.split())
        streams: Streams = {}
        for line in rest:
            name, *numbers = line.split()
            system, component, link, last = (int(word) for word in numbers)
            streams.setdefault(name, {})[system, component, link] = _bounded(last)
        return cls(_bounded(used), _bounded(accepted), streams)

    def text(self) -> str:
        """The file's text."""
        rows = [f"{name} {s} {c} {link} {at}" for name, (s, c, link), at in self._rows()]
        return "\n".join([f"{self.used} {self.accepted}", *rows, ""])

    def later(self, margin: int) -> _Times:
        """All times so much later."""
        moved: Streams = {name: {} for name in self.streams}
        for name, one, at in self._rows():
            moved[name][one] = _bounded(at + margin)
        return _Times(_bounded(self.used + margin), _bounded(self.accepted + margin), moved)

    def over(self, before: Streams) -> _Times:
        """The same, with the streams from before that were not heard since."""
        names = before.keys() | self.streams.keys()
        return self._replace(
            streams={name: {**before.get(name, {}), **self.streams.get(name, {})} for name in sorted(names)}
        )

    def within(self, kept: _Times, margin: int) -> bool:
        """Whether all of these, and so much later, are covered by what is `kept`."""
        covered = self.used + margin <= kept.used and self.accepted + margin <= kept.accepted
        return covered and all(at + margin <= kept.streams.get(name, {}).get(one, 0) for name, one, at in self._rows())

    def _rows(self) -> Iterator[tuple[str, Stream, int]]:
        for name, each in self.streams.items():
            for one, at in each.items():
                yield name, one, at


def _bounded(time: int) -> int:
    return min(max(time, 0), _LATEST)


@dataclass(slots=True)
class SigningStatistics:
    """How many packets of a link with a key were accepted and refused, by reason."""

    good: int = 0
    forged: int = 0
    replayed: int = 0
    unsigned_taken: int = 0
    unsigned_refused: int = 0
    copies: int = 0

    @property
    def refused(self) -> int:
        """Packets that were dropped."""
        return self.forged + self.replayed + self.unsigned_refused


@dataclass(frozen=True, slots=True)
class Sifted:
    """The packets of a datagram that are worth parsing, and how many places in it were no packet."""

    sound: bytes
    bad: int


class SignatureGuard:
    """Signing on one link: signs what is sent, verifies what is received. Used under the link's lock.

    `unsigned` says whether packets without a signature are refused, heard but not obeyed ("listen"), or accepted
    ("allow"). RADIO_STATUS, which radios insert themselves, is heard in any case, five a second.
    """

    def __init__(self, key: bytes, link_id: int, time: SigningTime, unsigned: Unsigned = "refuse") -> None:
        self._key = key
        self._link_id = link_id
        self._time, self._book = time, time.book(key)
        self._unsigned = unsigned
        self._radio, self._radio_sifted = Rate(_RADIO_A_S), Rate(_RADIO_SIFTED_A_S)
        self._counts = SigningStatistics()

    def judge(self, raw: bytes, system: int, component: int, message_id: int) -> Trust:
        """Return whether to obey a sound packet (a copy: as one that came over another link), only hear it, or refuse
        it."""
        if not is_signed(raw):
            return self._judge_unsigned(message_id)
        if not self.rightly_signed(raw):
            self._counts.forged += 1
            return "refuse"
        stream = (system, component, raw[-SIGNATURE_BYTES])
        verdict = self._book.judge(self._time, stream, timestamp_of(raw), raw[-6:], self._link_id)
        if verdict == "old":
            self._counts.replayed += 1
            return "refuse"
        if verdict == "copy":
            self._counts.copies += 1
            return "copy"
        self._counts.good += 1
        return "obey"

    def sift(self, datagram: bytes) -> Sifted:
        """Keep the packets of a datagram that are worth parsing: rightly signed, or unsigned where that may be heard.

        Nothing but their signature is looked at: strangers' packets are refused for some 10 µs each, parsing takes ten
        times as long.
        """
        kept, at = list[bytes](), 0
        while at < len(datagram):
            length = packet_length(datagram, at)
            if length is None:
                return Sifted(b"".join(kept), 1)
            raw = datagram[at : at + length]
            at += length
            if is_signed(raw):
                if self.rightly_signed(raw):
                    kept.append(raw)
                else:
                    self._counts.forged += 1
            elif self._unsigned != "refuse" or self._is_radio(message_of(raw), self._radio_sifted):
                kept.append(raw)
            else:
                self._counts.unsigned_refused += 1
        return Sifted(b"".join(kept), 0)

    def prepare(self, packer: mavlink.MAVLink) -> None:
        """Let the next message that `packer` packs be signed, with a timestamp of its own."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id = True, self._key, self._link_id
        signing.timestamp = self._time.next()

    def statistics(self) -> SigningStatistics:
        """Counters."""
        return replace(self._counts)

    def _judge_unsigned(self, message_id: int) -> Trust:
        if self._unsigned == "refuse" and not self._is_radio(message_id, self._radio):
            self._counts.unsigned_refused += 1
            return "refuse"
        self._counts.unsigned_taken += 1
        return "obey" if self._unsigned == "allow" else "hear"

    def _is_radio(self, message_id: int, rate: Rate) -> bool:
        """Whether it is a radio's own report, of which few are heard: anybody may say that he is the radio."""
        return message_id == mavlink.MAVLINK_MSG_ID_RADIO_STATUS and rate.takes(1, self._time.monotonic_ns())

    def rightly_signed(self, raw: bytes) -> bool:
        """Whether the signature of a signed packet was made with the key, whenever that was."""
        return hmac.compare_digest(hashlib.sha256(self._key + raw[:-6]).digest()[:6], raw[-6:])


def timestamp_of(raw: bytes) -> int:
    """Return the timestamp of a signed packet, in units of 10 µs since 2015."""
    return int.from_bytes(raw[-12:-6], "little")


@dataclass(frozen=True, slots=True)
class Signing:
    """Which links of `MavlinkLinks` are signed: a guard or None for each, and the time that they share."""

    guards: Sequence[SignatureGuard | None]
    time: SigningTime


def open_signing(
    key_files: Sequence[Path | None], time_file: Path, clock: Clock, unsigned: Unsigned = "refuse"
) -> Signing | None:
    """Read each link's key file, where it has one; None where no link has. Raises SigningError, KeyFileError."""
    keys = [None if path is None else read_key(path) for path in key_files]
    if not any(keys):
        return None
    try:
        time_file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SigningError(f"cannot make the folder {time_file.parent}: {error.strerror or error}") from error
    time = SigningTime(time_file, clock)
    return Signing(
        tuple(
            None if key is None else SignatureGuard(key, number % 256, time, unsigned)
            for number, key in enumerate(keys)
        ),
        time,
    )
