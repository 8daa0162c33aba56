"""`dappled open`: look at a recorded flight or a light field in the browser, on the console's page."""

from __future__ import annotations

import argparse
import json
import webbrowser
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dappled.cli.open import example
from dappled.config.settings import ConsoleSettings
from dappled.daemon.console import offline, process
from dappled.daemon.console.recorded import FlightFrames, FrameSource, LightFieldFrames
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import DappledError, counted
from dappled.flight import layout
from dappled.products import opened
from dappled.products.mounting import Mounting
from dappled.workers import Loop

_GIVEN = ("camera", "mask", "law", "calibration", "white", "dark")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled open\n"
        "  dappled open ~/flights/20261121T101503Z-0a1b2c3d\n"
        "  dappled open frame.zarr\n"
        "  dappled open frame.cr2 --mask mask-2 --calibration calibration.toml\n"
        "Without a name it opens a simulated flight, made once (in ~/.cache/dappled, with its truth)."
    )
    parser.add_argument("path", nargs="?", type=Path, metavar="FLIGHT|FILE",
                        help="recorded flight, light field (.zarr, .npz, .h5, folder of views), raw frame")  # fmt: skip
    parser.add_argument("--bind", default="127.0.0.1:0", metavar="HOST:PORT",
                        help="serve the page here, on this machine only (default: a free port)")  # fmt: skip
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    parser.add_argument("--json", action="store_true", help="print path, number of frames and address as JSON")
    for name, what in (
        ("camera", "camera profile"), ("mask", "mask profile, or lenslet"), ("law", "carrier law"),
        ("calibration", "calibration file"), ("white", "white frame"), ("dark", "dark frame"),
    ):  # fmt: skip
        parser.add_argument(f"--{name}", metavar="P", help=f"{what} of raw frames (default: the flight's)")


def run(arguments: argparse.Namespace) -> int:
    path = example.flight() if arguments.path is None else arguments.path
    given = {name: value for name in _GIVEN if (value := getattr(arguments, name)) is not None}
    with ExitStack() as stack:
        source, recipe, mount = _source(path, given, stack)
        listener, _ = process.listen(ConsoleSettings(bind=arguments.bind))
        stack.callback(listener.close)
        address = process.url(listener)
        count = len(source.frames())
        left = f" (the last {offline.MOST_FRAMES} of them)" if count > offline.MOST_FRAMES else ""
        said = f"{path}: {counted(count, 'frame')}{left} at {address}  (end with Ctrl-C)"
        facts = {"path": str(path), "frames": count, "url": address}
        print(json.dumps(facts) if arguments.json else said, flush=True)

        def show() -> None:
            webbrowser.open(address)  # one in the terminal (w3m, over SSH) returns when it is left

        def begun() -> None:
            if not arguments.no_browser:
                Loop("browser", show).start()

        offline.serve(listener, source, recipe, mount, begun)
    return 0


def _source(
    path: Path, given: Mapping[str, Any], stack: ExitStack
) -> tuple[FrameSource, Recipe | None, tuple[float, ...]]:
    """What is shown, how it is decoded, and how the camera is mounted. Raises DappledError."""
    found = opened.open(path, **given)
    if isinstance(found, opened.OpenedFlight):
        folder = layout.open_folder(found.path)
        recipe = None if found.darkroom is None else found.darkroom.recipe
        decoder = None
        if recipe is not None:
            decoder = DecodeProcess(recipe)
            stack.callback(decoder.close)
        source = FlightFrames(folder, found.record, decoder)
        if not source.frames():
            raise DappledError(f"{path} holds no tagged frames: `dappled flight show` says what became of its shots")
        return source, recipe, Mounting.of(layout.read_facts(folder)).mount
    field = found.light_field.field if isinstance(found, opened.OpenedFrame) else found.field
    size = path.stat().st_size if path.is_file() else sum(one.stat().st_size for one in path.rglob("*"))
    return LightFieldFrames(path.name, size, field), None, Mounting().mount
