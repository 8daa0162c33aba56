"""`dappled mavlink key`: keys for signed links."""

from __future__ import annotations

import argparse
import getpass
import sys
from pathlib import Path

from dappled.cli.actions import Actions
from dappled.drivers.mavlink.signing import SigningError, make_key


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n  dappled mavlink key radio.key\n  dappled mavlink key radio.key --passphrase"
    key = Actions.of(parser).add(
        "key",
        "make a key file for a signed link (see mavlink.keys)",
        "dappled mavlink key /etc/dappled/radio.key --passphrase",
    )
    key.add_argument("file", type=Path, metavar="FILE", help="where to write it; never overwritten")
    key.add_argument(
        "--passphrase",
        action="store_true",
        help="ask for the passphrase that the ground station was given (default: a random key)",
    )


def run(arguments: argparse.Namespace) -> int:
    make_key(arguments.file, _passphrase() if arguments.passphrase else None)
    print(f'{arguments.file}: a key for this user alone; set keys = ["{arguments.file.absolute()}"] in [mavlink]')
    return 0


def _passphrase() -> str:
    """Asked for on a terminal, else the first line of standard input."""
    text = getpass.getpass("passphrase: ") if sys.stdin.isatty() else sys.stdin.readline().rstrip("\n")
    if not text:
        raise SigningError("an empty passphrase is no key; type the one that the ground station was given")
    return text
