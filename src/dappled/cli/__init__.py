"""The `dappled` command. Each verb has a module or folder here, which is loaded only when the verb is called."""

from __future__ import annotations

import argparse
import difflib
import importlib
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

import dappled
from dappled.daemon.health import systemd
from dappled.errors import DappledError
from dappled.shown import printable

# Verb: (module, its line in --help). The module has `configure(parser)` and `run(arguments) -> exit code`.
VERBS: dict[str, tuple[str, str]] = {
    "run": ("run", "run the daemon: fire, record, tag, decode, publish"),
    "replay": ("replay", "run a recorded flight, or a folder of frames, through the same pipeline"),
    "doctor": ("doctor", "say what is missing on this machine; fire a test shot; measure latency"),
    "status": ("status", "show the state of the running daemon"),
    "open": ("open", "look at a recorded flight or a light field in the browser"),
    "watch": ("watch", "subscribe to the stream: show and save what arrives"),
    "keys": ("keys", "make keys for subscribers on the network, and the console's token"),
    "trigger": ("trigger", "ask for frames over MAVLink, as a ground station does"),
    "mavlink": ("keys", "make keys for signed MAVLink links"),
    "decode": ("decode", "decode frames to light fields"),
    "picture": ("picture", "make photographs without the mask's shadow, at the sensor's own resolution"),
    "carriers": ("carriers", "show the predicted and the measured carriers of a frame"),
    "calibrate": ("calibrate", "fit lattice, law and phases to calibration frames"),
    "views": ("views", "draw a light field's views, slices or shifts as one picture"),
    "refocus": ("refocus", "refocus a light field: by α, disparity or metres, on a plane, as a stereo pair"),
    "depth": ("depth", "measure disparities and distances with their uncertainty; write point clouds"),
    "export": ("export", "write light fields for other tools: hci, eslf, mat, quilt, h5 …"),
    "mask": ("mask", "the printed mask: make, table, diffraction, design, and plan a flight with it"),
    "plan": ("mask.plan", "plan a flight: interval, motion blur, frame rate and disk space"),
    "flight": ("flight", "recorded flights: list, show, check, report, coverage, offload, pickup"),
    "geotag": ("geotag", "write positions and attitudes for other programs: XMP, geo.txt, CSV, GeoJSON"),
    "georeference": ("georeference", "make maps of a flight: KMZ overlay, GeoTIFF, footprints, terrain"),
    "batch": ("batch", "process whole flights frame by frame, on all cores or a Dask cluster"),
    "hand-over": ("hand_over", "give pictures to OpenDroneMap (NodeODM), and fetch the model"),
    "config": ("config", "check or show settings"),
    "init": ("init", "write a settings file: finds what is plugged in, and asks"),
    "completion": ("completion", "print a completion script for bash, zsh or fish"),
    "profiles": ("config", "list the shipped camera and mask profiles"),
}

_FLIGHTS = ("run", "replay", "flight", "geotag")
"""Verbs that write flights, which hold pictures and where they were taken."""


def parser(wanted: str | None = None) -> argparse.ArgumentParser:
    """The whole command line. Only the module of the wanted verb is loaded."""
    top = SuggestingParser(
        prog="dappled",
        description="Acquisition daemon for masked light-field cameras that fly.",
        epilog="example: dappled run --simulate --frames 8",
    )
    top.add_argument("--version", action="version", version=f"dappled {dappled.__version__}")
    top.add_argument("--debug", action="store_true", help="show tracebacks and the log's details")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, (module, line) in VERBS.items():
        one = verbs.add_parser(
            name, help=line, description=line[0].upper() + line[1:] + ".", formatter_class=argparse.RawTextHelpFormatter
        )
        if name == wanted:
            loaded = importlib.import_module(f"dappled.cli.{module}")
            loaded.configure(one)
            one.set_defaults(run=loaded.run)
    return top


class SuggestingParser(argparse.ArgumentParser):
    """A parser that names the nearest of the words that it knows."""

    def error(self, message: str) -> NoReturn:
        """Print usage and what is wrong, and exit with 2."""
        wrong = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        near = difflib.get_close_matches(wrong[1], re.findall(r"[\w.-]+", wrong[2]), 1, 0.5) if wrong else []
        super().error(f"there is no {wrong[1]!r} here; did you mean {near[0]!r}?" if wrong and near else message)


def main(arguments: Sequence[str] | None = None, *, loaded: Callable[[], object] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a failure, 2 for a wrong call, 130 when interrupted.

    `loaded` is called when all modules are there and the verb begins.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    wanted = next((word for word in words if not word.startswith("-")), None)
    parsed = parser(wanted).parse_args(words)
    quiet = logging.INFO if parsed.verb == "run" and "JOURNAL_STREAM" in os.environ else logging.WARNING
    logging.basicConfig(level=logging.DEBUG if parsed.debug else quiet, handlers=[systemd.handler()])
    logging.getLogger("PIL").setLevel(logging.INFO)
    logging.captureWarnings(True)  # of libraries, about arithmetic or their future: for the log, not for a person
    logged = parsed.debug or quiet < logging.WARNING
    logging.getLogger("py.warnings").setLevel(logging.NOTSET if logged else logging.ERROR)
    try:
        if loaded is not None:
            loaded()
        with _own_files(parsed.verb):
            code: int = parsed.run(parsed)
        sys.stdout.flush()
    except DappledError as error:
        if parsed.debug:
            raise
        return _failed(parsed, error.sentences, error.exit_code)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader is gone: end quietly
        return 1
    except OSError as error:
        if parsed.debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _failed(parsed, [f"{where}{error.strerror or error}"], 1)
    except Exception as error:
        if parsed.debug:
            raise
        said = f"unexpected {type(error).__name__}: {error} (run `dappled --debug {parsed.verb} …`)"
        if isinstance(error, MemoryError):
            wanted = f" ({error})" if str(error) else ""
            said = f"not enough memory{wanted}: close other programs, or use a machine with more memory"
        return _failed(parsed, [said], 1)
    return code


@contextmanager
def _own_files(verb: str) -> Iterator[None]:
    """Context in which a verb that writes flights makes no file that every user may read."""
    before = os.umask(0o077)
    os.umask(before | 0o007 if verb in _FLIGHTS else before)
    try:
        yield
    finally:
        os.umask(before)


def _failed(parsed: argparse.Namespace, sentences: Sequence[str], code: int) -> int:
    """Say what went wrong, a line for each sentence: a person on standard error, and with --json a program too, as
    {"error": …}."""
    shown = "\n".join(map(printable, sentences))
    print(f"dappled {parsed.verb}: {shown}", file=sys.stderr)
    if getattr(parsed, "json", False):
        print(json.dumps({"error": "\n".join(sentences)}))
    return code
