"""`dappled open`: look at a recorded flight or a light field in the browser, on the console's page."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled.cli import paths
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument, flag, option
from dappled.config.settings import LAW_NAMES, ConsoleSettings
from dappled.errors import CallError, counted
from dappled.workers import Loop

if not words_only:
    from dappled.cli.open import example
    from dappled.daemon.console import offline, process
    from dappled.daemon.console.recorded import FlightFrames, FrameSource, LightFieldFrames
    from dappled.daemon.pipeline.decode_process import DecodeProcess
    from dappled.drivers.raw.picture_maker import PictureMaker
    from dappled.drivers.raw.recipe import Recipe
    from dappled.flight import layout
    from dappled.products import opened
    from dappled.products.mounting import Mounting

_GIVEN = ("camera", "mask", "law", "calibration", "white", "dark")
_OWN = "the flight's"


@dataclass(frozen=True, kw_only=True)
class OpenInBrowser(Verb):
    """Look at a flight or a light field."""

    examples = (
        "dappled open",
        "dappled open ~/flights/20261121T101503Z-0a1b2c3d",
        "dappled open frame.zarr",
        "dappled open frame.cr2 --mask mask-2 --calibration calibration.toml",
    )
    notes = "Without a name it opens a simulated flight, made once (in ~/.cache/dappled, with its truth)."

    path: Path | None = argument(
        "FLIGHT|FILE", "recorded flight, light field (.zarr, .npz, .h5, folder of views), raw frame", default=None,
        there=paths.opened,
    )  # fmt: skip
    bind: str = option(
        "--bind", "serve the page here, on this machine only", "127.0.0.1:0", metavar="HOST:PORT",
        otherwise="a free port",
    )  # fmt: skip
    no_browser: bool = flag("--no-browser", "only print the address")
    camera: str | None = option("--camera", "camera profile of raw frames", None, otherwise=_OWN)
    mask: str | None = option("--mask", "mask profile, or lenslet, of raw frames", None, otherwise=_OWN)
    law: str | None = option("--law", "carrier law of raw frames", None, choices=LAW_NAMES, otherwise=_OWN)
    calibration: str | None = option(
        "--calibration", "calibration of raw frames", None, metavar="FILE", there=True, otherwise=_OWN,
    )  # fmt: skip
    white: str | None = option("--white", "white frame of raw frames", None, metavar="FILE", there=True, otherwise=_OWN)
    dark: str | None = option("--dark", "dark frame of raw frames", None, metavar="FILE", there=True, otherwise=_OWN)

    def run(self, output: Output) -> Report:
        path = example.flight() if self.path is None else self.path
        given = {name: value for name in _GIVEN if (value := getattr(self, name)) is not None}
        with ExitStack() as stack:
            source, recipe, mount = _source(path, given, stack)
            listener, _ = process.listen(ConsoleSettings(bind=self.bind))
            stack.callback(listener.close)
            address = process.url(listener)
            count = len(source.frames())
            left = f" (the last {offline.MOST_FRAMES} of them)" if count > offline.MOST_FRAMES else ""
            said = f"{path}: {counted(count, 'frame')}{left} at {address}  (end with Ctrl-C)"
            output.row({"path": str(path), "frames": count, "url": address}, said)

            def show() -> None:
                webbrowser.open(address)  # one in the terminal (w3m, over SSH) returns when it is left

            def begun() -> None:
                if not self.no_browser:
                    Loop("browser", show).start()

            offline.serve(listener, source, recipe, mount, begun)
        return Report()


def _source(
    path: Path, given: Mapping[str, Any], stack: ExitStack
) -> tuple[FrameSource, Recipe | None, tuple[float, ...]]:
    """What is shown, how it is decoded, and how the camera is mounted. Raises DappledError."""
    found = opened.open(path, **given)
    if isinstance(found, opened.OpenedFlight):
        folder = layout.open_folder(found.path)
        recipe = None if found.darkroom is None else found.darkroom.recipe
        decoder = maker = None
        if recipe is not None:
            decoder, maker = DecodeProcess(recipe), PictureMaker(recipe)
            stack.callback(decoder.close)
        source = FlightFrames(folder, found.record, decoder, maker)
        if not source.frames():
            raise CallError(f"{path} holds no tagged frames: `dappled flight show` says what became of its shots")
        return source, recipe, Mounting.of(layout.read_facts(folder)).mount
    field = found.light_field.field if isinstance(found, opened.OpenedFrame) else found.field
    size = path.stat().st_size if path.is_file() else sum(one.stat().st_size for one in path.rglob("*"))
    return LightFieldFrames(path.name, size, field), None, Mounting().mount
