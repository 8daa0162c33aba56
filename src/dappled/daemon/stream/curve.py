"""Make and read CURVE keys, and judge subscribers by them: for tcp endpoints that other machines can reach.

The files are those of ZeroMQ itself (ZPL, as pyzmq's `zmq.auth` reads and writes): NAME.key holds a public key and may
be given away, NAME.key_secret both and stays here. Keys are 40 characters of Z85.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import zmq
import zmq.utils.z85

from dappled import durable, key_files
from dappled.errors import DappledError
from dappled.key_files import KeyFileError

ZAP_ENDPOINT = "inproc://zeromq.zap.01"  # ZeroMQ's RFC 27
_KEY = r'^\s*{}-key\s*=\s*"([^"\n]*)"\s*$'
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Keys:
    """One party's own pair, Z85."""

    public: bytes
    secret: bytes


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """A publisher's own pair, and the public keys that may connect, each with its owner's name."""

    own: Keys
    allowed: Mapping[bytes, str]


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """A subscriber's own pair, and the publisher's public key."""

    own: Keys
    server: bytes


def make(folder: Path, name: str) -> tuple[Path, Path]:
    """Make a pair as `folder`/NAME.key and NAME.key_secret (mode 0600); existing files are never overwritten.

    Raises DappledError.
    """
    if wrong := not_a_name(name):
        raise DappledError(wrong)
    public, secret = zmq.curve_keypair()
    public_file, secret_file = folder / f"{name}.key", folder / f"{name}.key_secret"
    head = "# A ZeroMQ CURVE key made by dappled; {}\nmetadata\ncurve\n"
    line = '    {}-key = "{}"\n'
    public_line = line.format("public", public.decode())
    public_text = head.format("public: give it to the other side") + public_line
    secret_text = head.format("SECRET: leave it where it is") + public_line + line.format("secret", secret.decode())
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        key_files.write_new(secret_file, secret_text)
        try:
            key_files.write_new(public_file, public_text, 0o644)
        except OSError:
            secret_file.unlink()  # half a pair would stop the next attempt
            raise
    except FileExistsError as error:
        raise DappledError(f"{error.filename} exists already: choose another name, or move it away") from None
    except OSError as error:
        raise DappledError(f"{error.filename or folder} can't be written: {error.strerror}") from None
    return public_file, secret_file


def not_a_name(name: str) -> str:
    """Why a pair can't have this name; "" where it can."""
    if _NAME.fullmatch(name):
        return ""
    return f"{name!r} can't be the name of a key: use letters, digits, dot, dash and underscore, 64 at most"


def load_own(path: Path) -> Keys:
    """A pair from NAME.key_secret. Raises KeyFileError, also where others could read it."""
    text = key_files.read(path, "a secret key")
    return Keys(_key(text, "public", path), _key(text, "secret", path))


def load_public(path: Path) -> bytes:
    """A public key from NAME.key (or NAME.key_secret). Raises KeyFileError."""
    try:
        text = durable.read_plain(path).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise KeyFileError(f"{path} can't be read as a public key: {why}") from None
    return _key(text, "public", path)


def load_allowed(folder: Path) -> dict[bytes, str]:
    """The public keys of a folder's *.key files by key, named by file. Raises DappledError where it is empty, holds a
    file that is not a key, or can be written by any user."""
    try:
        mode = folder.stat().st_mode
        files = sorted(folder.glob("*.key"))
    except OSError as error:
        raise DappledError(f"{folder} can't be read as a folder of clients' keys: {error.strerror}") from None
    if mode & 0o002:
        raise DappledError(f"{folder} can be written by any user, who could add a key: chmod o-w {folder}")
    if not files:
        raise DappledError(f"{folder} holds no NAME.key: put the public key of each subscriber there")
    return {load_public(path): path.stem for path in files}


def server(own: str, allowed: str) -> ServerKeys | None:
    """A publisher's keys from its two settings; None where neither is set. Raises DappledError."""
    if not own and not allowed:
        return None
    if not own or not allowed:
        raise DappledError(
            "publish.keys and publish.clients go together: your secret key, and the folder of subscribers' keys",
            setting="publish.keys" if own else "publish.clients",
        )
    return ServerKeys(load_own(Path(own)), load_allowed(Path(allowed)))


def judge(request: Sequence[bytes], allowed: Mapping[bytes, str]) -> tuple[list[bytes], str | None]:
    """The answer to one ZAP request (RFC 27), and the name of the key's owner, None when it is refused."""
    version, number = request[0], request[1]
    name = None
    if version == b"1.0" and len(request) == 7 and request[5] == b"CURVE" and len(request[6]) == 32:
        name = allowed.get(zmq.utils.z85.encode(request[6]))
    status = (b"200", b"OK") if name is not None else (b"400", b"this key is not on the list")
    return [b"1.0", number, *status, (name or "").encode(), b""], name


def _key(text: str, which: str, path: Path) -> bytes:
    found = re.search(_KEY.format(which), text, re.MULTILINE)
    if found is None:
        raise KeyFileError(f"{path} holds no {which} key: make one with `dappled keys make`")
    key = found[1].encode()
    if not _is_key(key):
        raise KeyFileError(f"{path}: its {which} key is not 40 characters of Z85")
    return key


def _is_key(text: bytes) -> bool:
    try:
        return len(text) == 40 and len(zmq.utils.z85.decode(text)) == 32
    except (ValueError, KeyError, IndexError, OverflowError, struct.error):
        return False
