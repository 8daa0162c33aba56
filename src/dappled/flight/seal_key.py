"""The key that signs seals: made in a file of its own, and derived from it for this purpose alone."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from dappled import key_files

_SALT = b"dappled"
_PURPOSE, _NAME = b"dappled flight seal 1", b"dappled flight seal name 1"


@dataclass(frozen=True, slots=True)
class SealKey:
    """A key for seals. `name` tells keys apart and gives nothing away of the key."""

    name: str
    secret: bytes = field(repr=False)

    def sign(self, data: bytes) -> str:
        """HMAC-SHA256 (hex)."""
        return hmac.new(self.secret, data, hashlib.sha256).hexdigest()

    def signed(self, data: bytes, signature: str) -> bool:
        """Whether this key made the signature."""
        return hmac.compare_digest(self.sign(data).encode(), signature.encode("utf-8", "surrogateescape"))


def make(path: Path) -> None:
    """Write a new key file: 64 hexadecimal digits, for this user alone. Raises DappledError, also where it exists."""
    key_files.make(path, secrets.token_hex(key_files.KEY_BYTES) + "\n")


def load(path: Path) -> SealKey:
    """Read a key file that only this user can read, and derive the key for seals (HKDF-SHA256, RFC 5869): a file that
    holds another program's key too gives nothing away of it. Raises KeyFileError."""
    key = key_files.read_key(path, "a key for seals (dappled keys seal makes one)")
    return SealKey(_derived(key, _NAME).hex()[:8], _derived(key, _PURPOSE))


def _derived(key: bytes, purpose: bytes) -> bytes:
    """HKDF: extract, then one block of expand."""
    extracted = hmac.new(_SALT, key, hashlib.sha256).digest()
    return hmac.new(extracted, purpose + b"\x01", hashlib.sha256).digest()
