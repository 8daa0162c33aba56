"""Sign and verify MAVLink 2 packets: key files, replay protection, and a signing time that never goes back.

A signature is the first 6 bytes of SHA-256 over key, packet, link id and a timestamp in units of 10 µs since 2015. A
packet is accepted once: its timestamp must be later than the last one of its stream (system, component, link id). In a
stream that is heard for the first time it may be at most a minute older than the latest accepted one. Only accepted
packets advance the time.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import secrets
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dappled import durable, key_files
from dappled.clock import Clock
from dappled.drivers.mavlink.framing import SIGNATURE_BYTES, is_signed, mavlink, message_of, packet_length
from dappled.errors import DappledError

log = logging.getLogger(__name__)
Unsigned = Literal["refuse", "listen", "allow"]
Trust = Literal["obey", "hear", "refuse"]
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01
UNITS_PER_S = 100_000
NEW_STREAM_UNITS = 60 * UNITS_PER_S
AHEAD_UNITS = 10 * UNITS_PER_S
_STREAMS = 256
_KEEP_S = 1.0
_LATEST = 2**48 - 1


class SigningError(DappledError):
    """A key or the signing time can't be read or written: one sentence with the file and what to do."""


def make_key(path: Path, passphrase: str | None = None) -> None:
    """Write a new key file (64 hexadecimal digits, mode 0600): random, or SHA-256 of a passphrase as QGroundControl,
    Mission Planner and MAVProxy make it. Raises SigningError, also where the file exists already."""
    key = (
        secrets.token_bytes(key_files.KEY_BYTES) if passphrase is None else hashlib.sha256(passphrase.encode()).digest()
    )
    try:
        key_files.write_new(path, key.hex() + "\n")
    except FileExistsError:
        raise SigningError(f"{path} exists already; keys are not overwritten: name another file") from None
    except OSError as error:
        raise SigningError(f"cannot write the key {path}: {error.strerror or error}; check its folder") from error


def read_key(path: Path) -> bytes:
    """Read a key from a file that only this user can read or change. Raises SigningError."""
    try:
        file = key_files.read(path)
    except OSError as error:
        raise SigningError(
            f"cannot read the signing key {path}: {error.strerror or error}; make one with dappled mavlink key"
        ) from error
    if not file.own:
        raise SigningError(f"the signing key {path} belongs to another user; give it to this one with chown")
    if not file.private:
        raise SigningError(f"the signing key {path} can be used by others; run: chmod 600 {path}")
    key = key_files.key_in(file.data)
    if key is None:
        raise SigningError(f"the signing key {path} is not 64 hexadecimal digits; make one with dappled mavlink key")
    return key


class SigningTime:
    """The signing times of all links of this machine, kept over restarts.

    The file holds two times: one later than every time signed with, and one later than every time accepted. So no
    packet from before a restart is accepted after it. After a crash they are up to 10 s ahead, and genuine packets are
    refused for as long; after an orderly end they are exact. `keep` may wait for the disk; all other calls answer from
    memory.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        """Raises SigningError where the file can't be read or written."""
        self._path = path
        self._clock = clock
        self._lock = threading.Lock()
        self._used, self._accepted = self._kept = self._stored()
        self._floor = self._accepted
        self.keep()

    def oldest(self) -> int:
        """Return the time that a stream heard for the first time must be later than."""
        with self._lock:
            return max(self._floor, max(self._used, self._accepted, self._now()) - NEW_STREAM_UNITS)

    def next(self) -> int:
        """Return a timestamp to sign with, later than every one before."""
        with self._lock:
            self._used = min(_LATEST, max(self._used + 1, self._accepted, self._now()))
            return self._used

    def accepted(self, timestamp: int) -> None:
        """Take note of an accepted packet's timestamp."""
        with self._lock:
            self._accepted = max(self._accepted, timestamp)

    def keep(self, *, ending: bool = False) -> None:
        """Write the times to the file, 10 s ahead; exactly where `ending`. Raises SigningError."""
        with self._lock:
            times = (self._used, self._accepted)
        margin = 0 if ending else AHEAD_UNITS
        if not ending and all(now + margin // 2 <= kept for now, kept in zip(times, self._kept, strict=True)):
            return
        used, accepted = (min(_LATEST, each + margin) for each in times)
        try:
            durable.write_file(self._path, f"{used} {accepted}\n".encode(), 0o600)
        except OSError as error:
            raise SigningError(
                f"cannot keep the signing times in {self._path}: {error.strerror or error}; check its folder"
            ) from error
        self._kept = (used, accepted)

    def run(self, stop: threading.Event) -> None:
        """Keep the times until `stop` is set, and then exactly. A file that can't be written is logged once."""
        failed = False
        while True:
            ending = stop.wait(_KEEP_S)
            try:
                self.keep(ending=ending)
                failed = False
            except SigningError as error:  # the links go on
                if not failed:
                    log.warning("%s", error)
                failed = True
            if ending:
                return

    def _now(self) -> int:
        return max(0, self._clock.utc_ns() // 10_000 - EPOCH_UNIX_S * UNITS_PER_S)

    def _stored(self) -> tuple[int, int]:
        try:
            used, accepted = (int(word) for word in self._path.read_text("ascii").split())
        except FileNotFoundError:
            return 0, 0
        except (OSError, ValueError) as error:
            raise SigningError(
                f"cannot read the signing times in {self._path} ({error}): old packets could be sent again; change the "
                "keys and remove the file"
            ) from error
        return min(max(used, 0), _LATEST), min(max(accepted, 0), _LATEST)


@dataclass(frozen=True, slots=True)
class SigningStatistics:
    """How many packets of a link with a key were accepted and refused, by reason."""

    good: int
    forged: int
    replayed: int
    unsigned_taken: int
    unsigned_refused: int

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
    ("allow"). RADIO_STATUS, which radios insert themselves, is always heard.
    """

    def __init__(self, key: bytes, link_id: int, time: SigningTime, unsigned: Unsigned = "refuse") -> None:
        self._key = key
        self._link_id = link_id
        self._time = time
        self._unsigned = unsigned
        self._streams: dict[tuple[int, int, int], int] = {}
        self._good = self._forged = self._replayed = self._taken = self._refused = 0

    def judge(self, raw: bytes, system: int, component: int, message_id: int) -> Trust:
        """Return whether to obey a sound packet, only hear it, or refuse it."""
        if not is_signed(raw):
            return self._judge_unsigned(message_id)
        if not self._rightly_signed(raw):
            self._forged += 1
            return "refuse"
        timestamp = timestamp_of(raw)
        stream = (system, component, raw[-SIGNATURE_BYTES])
        last = self._streams.get(stream)
        if timestamp <= (self._time.oldest() if last is None else last):
            self._replayed += 1
            return "refuse"
        self._streams.pop(stream, None)
        self._streams[stream] = timestamp
        if len(self._streams) > _STREAMS:
            self._streams.pop(next(iter(self._streams)))
        self._time.accepted(timestamp)
        self._good += 1
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
                if self._rightly_signed(raw):
                    kept.append(raw)
                else:
                    self._forged += 1
            elif self._unsigned != "refuse" or message_of(raw) == mavlink.MAVLINK_MSG_ID_RADIO_STATUS:
                kept.append(raw)
            else:
                self._refused += 1
        return Sifted(b"".join(kept), 0)

    def prepare(self, packer: mavlink.MAVLink) -> None:
        """Let the next message that `packer` packs be signed, with a timestamp of its own."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id = True, self._key, self._link_id
        signing.timestamp = self._time.next()

    def statistics(self) -> SigningStatistics:
        """Counters."""
        return SigningStatistics(self._good, self._forged, self._replayed, self._taken, self._refused)

    def _judge_unsigned(self, message_id: int) -> Trust:
        if self._unsigned == "refuse" and message_id != mavlink.MAVLINK_MSG_ID_RADIO_STATUS:
            self._refused += 1
            return "refuse"
        self._taken += 1
        return "obey" if self._unsigned == "allow" else "hear"

    def _rightly_signed(self, raw: bytes) -> bool:
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
    """Read each link's key file, where it has one; None where no link has. Raises SigningError."""
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
