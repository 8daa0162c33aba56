"""The `dappled` command: a thin face over the rooms. Verbs are stable; each lives in a module of its own here."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Sequence

import dappled
from dappled.daemon.health import systemd
from dappled.errors import DappledError

# Verb: (module of this package, one line). The module has `configure(parser)` and `run(arguments) -> exit code`.
VERBS: dict[str, tuple[str, str]] = {
    "run": ("run", "the daemon: fire, record, tag, decode, publish"),
    "replay": ("replay", "a recorded flight, or a folder of frames, through the same daemon"),
    "doctor": ("doctor", "what is missing on this machine; a test shot, and its latency"),
    "status": ("status", "how the running daemon is"),
    "watch": ("watch", "subscribe: show and save what arrives"),
    "keys": ("keys", "keys for who may subscribe over the network, and the console's token"),
    "trigger": ("trigger", "the ground station's part: ask for frames over MAVLink"),
    "mavlink": ("keys", "keys for signed MAVLink links"),
    "decode": ("decode", "frames to light fields"),
    "carriers": ("carriers", "predicted and measured carriers of a frame"),
    "calibrate": ("calibrate", "fit lattice, law and phases to frames"),
    "views": ("views", "a light field's views, slices or shifts as one picture"),
    "refocus": ("refocus", "pictures focused anew: by α, disparity or metres, on a plane, with two eyes"),
    "depth": ("depth", "disparities and distances, each with its uncertainty; point clouds"),
    "export": ("export", "light fields for other tools: hci, eslf, mat, quilt, h5 …"),
    "mask": ("mask", "the printed mask: make, table, diffraction, design, and plan a flight with it"),
    "flight": ("flight", "recorded flights: list, show, check, report, offload, pickup"),
    "geotag": ("geotag", "positions and attitudes for other programs: XMP sidecars, geo.txt, CSV, GeoJSON"),
    "georeference": ("georeference", "a flight as maps: KMZ overlay, GeoTIFF, footprints, terrain"),
    "batch": ("batch", "whole flights frame by frame, on all cores or a Dask cluster"),
    "config": ("config", "check or show settings"),
    "profiles": ("config", "shipped camera and mask profiles"),
}


def parser(wanted: str | None = None) -> argparse.ArgumentParser:
    """The whole command line; only the wanted verb's module is loaded, so that the others cost nothing."""
    top = argparse.ArgumentParser(
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a failure, 2 for a wrong call."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    wanted = next((word for word in words if not word.startswith("-")), None)
    parsed = parser(wanted).parse_args(words)
    quiet = logging.INFO if parsed.verb == "run" and "JOURNAL_STREAM" in os.environ else logging.WARNING
    logging.basicConfig(level=logging.DEBUG if parsed.debug else quiet, handlers=[systemd.handler()])
    logging.getLogger("PIL").setLevel(logging.INFO)
    try:
        code: int = parsed.run(parsed)
        sys.stdout.flush()
    except DappledError as error:
        if parsed.debug:
            raise
        print(f"dappled {parsed.verb}: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads any more: end quietly
        return 1
    except OSError as error:
        if parsed.debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        print(f"dappled {parsed.verb}: {where}{error.strerror or error}", file=sys.stderr)
        return 1
    except Exception as error:
        if parsed.debug:
            raise
        kind = type(error).__name__
        print(
            f"dappled {parsed.verb}: unexpected {kind}: {error} (run `dappled --debug {parsed.verb} …`)",
            file=sys.stderr,
        )
        return 1
    return code
