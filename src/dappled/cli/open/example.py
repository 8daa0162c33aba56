"""Make the example that `dappled open` shows without a name: a flight of the simulated world, with its truth."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import dappled
from dappled.cli import run as flying
from dappled.config import settings as configuration
from dappled.config.settings import PublishSettings
from dappled.daemon import settings_check
from dappled.errors import DappledError
from dappled.flight import layout
from dappled.shown import say

_FRAMES, _PATIENCE_S = 3, 120.0
_SCALE = 0.25  # of the reference camera's sensor: all of it in 5 MB


def flight() -> Path:
    """The simulated flight of this version in the user's cache; it is flown the first time. Raises DappledError."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dappled"
    folder = cache / f"example-{dappled.__version__}"
    if not folder.is_dir():
        from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # loaded to fly the example only

        say(f"making the example flight in {folder}, once", error=True)
        cache.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix=".example-", dir=cache) as kept,
            tempfile.TemporaryDirectory(prefix="dappled-") as scratch,  # its sockets' names must be short
        ):
            made = Path(kept) / "made"
            (made / "truth").mkdir(parents=True)
            world = World(seed=2, scale=_SCALE, truth=made / "truth")
            plain = configuration.Settings()
            ends = PublishSettings(slices=f"ipc://{scratch}/slices", ask=f"ipc://{scratch}/ask")
            own = replace(plain, record=replace(plain.record, directory=str(made)), publish=ends)
            simulation = Simulation(world, own, Path(scratch))
            with simulation as simulated, contextlib.redirect_stdout(sys.stderr):
                file = replace(configuration.examine_file(None), settings=simulated)
                flown = settings_check.checked(file, starting=True)
                if flying.serve(flown, flying.RunPlan(_FRAMES, _PATIENCE_S), simulation) != 0:
                    raise DappledError("the example flight could not be made: try `dappled run --simulate --frames 3`")
            flown_there = layout.flights(made)
            if not flown_there or len(list((flown_there[-1].path / "frames").iterdir())) < _FRAMES:  # interrupted
                raise DappledError("the example flight was not flown to its end: call it again")
            _without_views(made / "truth")
            made.rename(folder)
    flights = layout.flights(folder)
    if not flights:
        raise DappledError(f"{folder} holds no flight: remove it, and it will be made again")
    return flights[-1].path


def _without_views(truth: Path) -> None:
    """Leave the true views out of the true values of each shot: they are ten times as large as all else."""
    for path in truth.glob("*.npz"):
        with np.load(path) as values:
            kept = {name: values[name] for name in values.files if name != "views"}
        np.savez_compressed(path, **kept)
