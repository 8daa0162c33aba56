"""`dappled keys` and `dappled mavlink`: key files for subscribers, the console, seals and signed MAVLink links."""

from __future__ import annotations

import argparse
import getpass
import json
import secrets
import sys
from pathlib import Path

from dappled import key_files
from dappled.cli.arguments import Actions
from dappled.daemon.stream import curve
from dappled.drivers.mavlink import SigningError, make_key
from dappled.errors import DappledError
from dappled.flight import seal_key

HOME = Path("~/.config/dappled/keys")


def configure(parser: argparse.ArgumentParser) -> None:
    if parser.prog.endswith("mavlink"):
        _configure_mavlink(parser)
        return
    parser.epilog = (
        "example, a laptop that watches a vehicle:\n"
        "  vehicle$ dappled keys make vehicle\n"
        "  laptop$  dappled keys make laptop        # carry laptop.key to the vehicle's folder of clients\n"
        "  laptop$  dappled watch tcp://10.0.0.7:5555 --keys laptop.key_secret --server-key vehicle.key"
    )
    actions = Actions.of(parser)
    make = actions.add(
        "make", "make a pair: NAME.key to give away, NAME.key_secret to keep", "dappled keys make laptop"
    )
    make.add_argument("name", metavar="NAME", help="name of the owner: letters, digits, dot, dash, underscore")
    make.add_argument("-o", "--folder", type=Path, default=HOME, help=f"folder to write to (default: {HOME})")
    show = actions.add("show", "show the public key in a file", "dappled keys show laptop.key")
    show.add_argument("file", type=Path, metavar="FILE", help="NAME.key or NAME.key_secret")
    token = actions.add("token", "make a token for the console", "dappled keys token /etc/dappled/console.token")
    token.add_argument("file", type=Path, metavar="FILE", help="file to write; must not exist yet")
    seal = actions.add("seal", "make a key that signs the seals of flights", "dappled keys seal /etc/dappled/seal.key")
    seal.add_argument("file", type=Path, metavar="FILE", help="file to write; must not exist yet")
    for one in actions.all:
        one.add_argument("--json", action="store_true", help="print JSON")


def _configure_mavlink(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n  dappled mavlink key radio.key\n  dappled mavlink key radio.key --passphrase"
    key = Actions.of(parser).add(
        "key",
        "make a key file for a signed link (see mavlink.keys)",
        "dappled mavlink key /etc/dappled/radio.key --passphrase",
    )
    key.add_argument("file", type=Path, metavar="FILE", help="file to write; never overwritten")
    key.add_argument(
        "--passphrase",
        action="store_true",
        help="ask for the passphrase that the ground station was given (default: a random key)",
    )
    key.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.verb == "mavlink":
        make_key(arguments.file, _passphrase() if arguments.passphrase else None)
        words = f'{arguments.file}: a key for this user alone; set keys = ["{arguments.file.absolute()}"] in [mavlink]'
        print(json.dumps({"key_file": str(arguments.file)}) if arguments.json else words)
        return 0
    match arguments.action:
        case "make":
            public, secret = curve.make(arguments.folder.expanduser(), arguments.name)
            facts = {"public": str(public), "secret": str(secret)}
            words = f"{public}  to give away\n{secret}  to keep: name it in publish.keys, or after --keys"
        case "show":
            key = curve.load_public(arguments.file).decode()
            facts, words = {"public_key": key}, key
        case "seal":
            seal_key.make(arguments.file.expanduser())
            facts = {"seal_key_file": str(arguments.file)}
            words = f"{arguments.file}  name it in record.seal_key, and keep a copy where flights are checked"
        case _:
            facts, words = {"token_file": str(arguments.file)}, _token(arguments.file)
    print(json.dumps(facts) if arguments.json else words)
    return 0


def _token(path: Path) -> str:
    try:
        key_files.write_new(path.expanduser(), secrets.token_urlsafe(24) + "\n")
    except FileExistsError:
        raise DappledError(f"{path} is there already: choose another name, or move it away") from None
    except OSError as error:
        raise DappledError(f"{path} can't be written: {error.strerror}") from None
    return f"{path}  name it in console.token; anyone who knows its content may use the console"


def _passphrase() -> str:
    """Ask on a terminal, else read the first line of standard input."""
    text = getpass.getpass("passphrase: ") if sys.stdin.isatty() else sys.stdin.readline().rstrip("\n")
    if not text:
        raise SigningError("the passphrase is empty: type the one that the ground station was given")
    return text
