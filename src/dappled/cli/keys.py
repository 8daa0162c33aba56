"""`dappled keys` and `dappled mavlink`: key files for subscribers, the console, seals and signed MAVLink links."""

from __future__ import annotations

import getpass
import secrets
import sys
from dataclasses import dataclass
from pathlib import Path

from dappled import key_files
from dappled.cli import paths
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument, flag, option, refuse_no_folder
from dappled.errors import CallError

if not words_only:
    from dappled.daemon.stream import curve
    from dappled.drivers.mavlink import SigningError, make_key
    from dappled.flight import seal_key

_HOME = Path("~/.config/dappled/keys")


@dataclass(frozen=True, kw_only=True)
class MakeKeys(Verb):
    """Make a pair of keys."""

    examples = ("dappled keys make laptop",)
    notes = (
        "a laptop that watches a vehicle:\n"
        "  vehicle$ dappled keys make vehicle\n"
        "  laptop$  dappled keys make laptop        # carry laptop.key to the vehicle's folder of clients\n"
        "  laptop$  dappled watch tcp://10.0.0.7:5555 --keys laptop.key_secret --server-key vehicle.key"
    )

    name: str = argument("NAME", "name of the owner: letters, digits, dot, dash, underscore")
    folder: Path = option("-o --folder", "folder to write to", _HOME, metavar="DIR")

    def check(self) -> None:
        if wrong := curve.not_a_name(self.name):
            raise CallError(wrong)

    def run(self, output: Output) -> Report:
        public, secret = curve.make(self.folder.expanduser(), self.name)
        lines = [f"{public}  to give away", f"{secret}  to keep: name it in publish.keys, or after --keys"]
        return Report({"public": str(public), "secret": str(secret)}, lines)


@dataclass(frozen=True, kw_only=True)
class ShowKey(Verb):
    """Show a public key."""

    examples = ("dappled keys show laptop.key",)

    file: Path = argument("FILE", "NAME.key or NAME.key_secret", there=paths.file)

    def run(self, output: Output) -> Report:
        key = curve.load_public(self.file).decode()
        return Report({"public_key": key}, [key])


@dataclass(frozen=True, kw_only=True)
class _NewFile(Verb):
    file: Path = argument("FILE", "file to write; must not exist yet")

    def check(self) -> None:
        refuse_no_folder(self.file.expanduser())


class MakeToken(_NewFile):
    """Make a token for the console."""

    examples = ("dappled keys token /etc/dappled/console.token",)

    def run(self, output: Output) -> Report:
        key_files.make(self.file.expanduser(), secrets.token_urlsafe(24) + "\n")
        said = f"{self.file}  name it in console.token; anyone who knows its content may use the console"
        return Report({"token_file": str(self.file)}, [said])


class MakeSealKey(_NewFile):
    """Make a key that signs the seals of flights."""

    examples = ("dappled keys seal /etc/dappled/seal.key",)

    def run(self, output: Output) -> Report:
        seal_key.make(self.file.expanduser())
        said = f"{self.file}  name it in record.seal_key, and keep a copy where flights are checked"
        return Report({"seal_key_file": str(self.file)}, [said])


@dataclass(frozen=True, kw_only=True)
class MakeLinkKey(_NewFile):
    """Make a key for a signed link."""

    examples = ("dappled mavlink key radio.key", "dappled mavlink key /etc/dappled/radio.key --passphrase")

    passphrase: bool = flag(
        "--passphrase", "ask for the passphrase that the ground station was given (default: a random key)"
    )

    def run(self, output: Output) -> Report:
        make_key(self.file, _passphrase() if self.passphrase else None)
        said = f'{self.file}: a key for this user alone; set keys = ["{self.file.absolute()}"] in [mavlink]'
        return Report({"key_file": str(self.file)}, [said])


def _passphrase() -> str:
    """Ask on a terminal, else read the first line of standard input."""
    text = getpass.getpass("passphrase: ") if sys.stdin.isatty() else sys.stdin.readline().rstrip("\n")
    if not text:
        raise SigningError("the passphrase is empty: type the one that the ground station was given")
    return text
