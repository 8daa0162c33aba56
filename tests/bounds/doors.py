"""Open inputs at one door after the other, in a process of its own whose memory is capped.

`python -m tests.bounds.doors FOLDER`: in the folder is one for each door, and in that one an input a name. The first
input of a door is honest and warms it up; then the cap is set. Lines on standard output: "> door/name" before an input,
and "< outcome" after it: "ok", "refused: sentence", or "unexpected: what".
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import logging
import re
import resource
import shutil
import socket
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import uvicorn

from dappled.config import profiles, settings
from dappled.daemon.console.__main__ import configuration
from dappled.daemon.console.access import Access
from dappled.daemon.console.app import ConsoleApp
from dappled.daemon.console.connection import Connection
from dappled.daemon.console.feed import Feed, FeedState, Hub
from dappled.daemon.console.placement import load_background
from dappled.daemon.console.process import DaemonChannel
from dappled.daemon.console.studio import Studio
from dappled.daemon.replay import replay
from dappled.daemon.stream import wire
from dappled.decode.geometry import camera_pose
from dappled.drivers.child_process import ProcessChannel
from dappled.drivers.raw import calibration_files, reading
from dappled.errors import DappledError
from dappled.flight import FlightError, ImageIndex, flight_report, layout, log_reading, pruning, seals
from dappled.flight.checks import flight_check
from dappled.products import opened
from dappled.products.batch.batch import Manifest
from dappled.products.exports import mask_files, view_folders
from dappled.products.geotags import sidecars
from dappled.products.maps import ground
from dappled.products.maps.earth import Projection
from dappled.products.maps.references import BaseMap, read_control_points

CAP_BYTES = 1_500_000_000  # more than the process has when it is warm
PATIENCE_S = 60.0  # for one input, on a busy machine
_MAP = Projection("EPSG:32615")
_PLACE = (620_000.0, 4_610_000.0)  # east, north: what tests/bounds/samples.py places its rasters around


def main(folder: Path) -> None:
    """Open everything in the folder."""
    warnings.simplefilter("ignore")  # of the libraries, on damaged files
    logging.disable(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        doors = _doors(stack)
        names = sorted(one.name for one in folder.iterdir())
        for name in names:
            first = min((folder / name).iterdir())
            if (outcome := _outcome(doors[name], first)) != "ok":
                raise SystemExit(f"the honest input {first} is {outcome}")
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + CAP_BYTES, used + CAP_BYTES))
        for name in names:
            for one in sorted((folder / name).iterdir())[1:]:
                _say(f"> {name}/{one.name}")
                faulthandler.dump_traceback_later(PATIENCE_S, exit=True)
                _say(f"< {' / '.join(_outcome(doors[name], one).splitlines())}")  # several sentences are several lines
        faulthandler.cancel_dump_traceback_later()


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _outcome(door: Callable[[Path], object], path: Path) -> str:
    try:
        door(path)
    except DappledError as error:
        text, cause = str(error), error.__cause__
        if isinstance(cause, MemoryError):
            return f"unexpected: out of memory ({text[:200]})"
        if any("\n" in one or len(one) > 1000 for one in error.sentences) or re.search(r"unexpected \w+Error", text):
            return f"unexpected: not a sentence: {text[:1000]!r}"
        return f"refused: {text}"
    except BaseException as error:  # noqa: BLE001  # whatever it is, it is what the test looks for
        return f"unexpected: {type(error).__name__}: {str(error)[:300]!r}"
    return "ok"


def _doors(stack: contextlib.ExitStack) -> dict[str, Callable[[Path], object]]:
    console = _Console(stack)
    return {
        "zarr": _light_field,
        "npz": _light_field,
        "h5": _light_field,
        "settings": settings.load,
        "profile": lambda path: profiles.camera(str(path)),
        "calibration": calibration_files.load,
        "calibration-npz": calibration_files.load,
        "facts": lambda path: layout.read_facts(layout.FlightFolder(path)),
        "journal": log_reading.read_journal,
        "flight": _flight,
        "index": _index,
        "telemetry": lambda path: list(replay.packets(path)),
        "dng": _frame,
        "lfp": _frame,
        "lytro-raw": lambda path: _frame(path / "a.raw"),
        "tiff": _frame,
        "png": _frame,
        "jpeg": _frame,
        "npy": _frame,
        "views": view_folders.read,
        "mask-png": mask_files.read,
        "mask-tiff": mask_files.read,
        "density": mask_files.read_density_curve,
        "terrain": _terrain,
        "base-map": _base_map,
        "control-points": lambda path: read_control_points(path, _MAP),
        "background": lambda path: load_background(path / "map.png"),
        "manifest": _manifest,
        "sidecar": _sidecar,
        "question": _question,
        "message": _message,
        "console": console.ask,
    }


def _light_field(path: Path) -> None:
    """Open a light field, and calculate with what its attributes say."""
    found = opened.light_field(path)
    with contextlib.suppress(DappledError):
        found.metres()
    opened.lens_ranging(found.field, 5.0)


def _frame(path: Path) -> None:
    with contextlib.suppress(DappledError):
        reading.read_metadata(path)
    reading.read(path)


def _bounds() -> tuple[float, float, float, float]:
    east, north = _PLACE
    return east - 50, north - 50, east + 50, north + 50


def _terrain(path: Path) -> None:
    ground.load(path, _MAP, _bounds())


def _base_map(path: Path) -> None:
    one = BaseMap(path, _MAP, 1.0)
    points = np.array([_bounds()[:2], _bounds()[2:]])
    one.check(points)
    one.window(points, 20.0)


def _manifest(path: Path) -> None:
    with Manifest(path):
        pass


def _sidecar(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        sidecars.write(Path(shutil.copy(path, folder)), "content")


def _flight(path: Path) -> None:
    """What `dappled flight check`, `show` and `report` read: ledger, seals, the record of what was removed …"""
    flight_check.check(path)
    folder = layout.open_folder(path)
    seals.read(folder)
    pruning.removed(folder)
    flight_report.show(path)
    flight_report.balance(path)
    flight_report.by_source(path)


def _index(path: Path) -> None:
    with ImageIndex(path) as one:
        one.flights()
        one.highest()
        one.sealed()
        for number in one.unreported():
            one.lookup(number)


def _question(path: Path) -> None:
    wire.encode({"asked": wire.parse_question([path.read_bytes()])})


def _message(path: Path) -> None:
    header, _, body = path.read_bytes().partition(b"\n")
    message = wire.decode([b"slices", header, body])
    message.arrays()


class _Console:
    """The console, served as it ships; its daemon refuses everything. An input is the bytes of one request."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        here, there = ProcessChannel.pair()
        studio = Studio(None, camera_pose.NADIR.ravel().tolist())
        feed = Feed(f"ipc://{tempfile.mkdtemp()}/s", "", Hub(), studio)
        feed.frames[4] = FeedState({"frame": 4}, thumb=np.zeros((3, 4), np.uint8))
        app = ConsoleApp(feed, studio, DaemonChannel(ProcessChannel(there)), Access(""), None)
        Connection.request_s = 0.5  # for requests that are cut short
        listener = socket.create_server(("127.0.0.1", 0))
        self._address = listener.getsockname()
        server = uvicorn.Server(configuration(app.asgi()))
        threads = [
            threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True),
            threading.Thread(target=_refuse_all, args=[here], daemon=True),
        ]
        for thread in threads:
            thread.start()

    def ask(self, path: Path) -> None:
        """Send a request; its status must not be 500."""
        with socket.create_connection(self._address, timeout=PATIENCE_S) as one:
            with contextlib.suppress(OSError):  # refused before it was sent
                one.sendall(path.read_bytes())
            try:
                status = one.recv(12)
            except ConnectionResetError:
                status = b""
        if status.startswith(b"HTTP/1.1 5") and not status.startswith((b"HTTP/1.1 503", b"HTTP/1.1 504")):
            raise AssertionError(f"it answered {status!r}")
        if status[9:10] in (b"4", b""):
            raise FlightError(f"refused with {status!r}")


def _refuse_all(channel: ProcessChannel) -> None:
    while (question := channel.receive(3600)) is not None:
        channel.send({"ok": False, "error": "no", "lines": [], "number": question.body["number"]})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
