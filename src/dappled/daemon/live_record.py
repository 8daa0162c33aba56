"""A live flight's record: begun with what it is flown with, and closed; a start that fails leaves none behind."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import dappled
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.pending_shot import Names
from dappled.drivers.raw.darkroom import Recipe
from dappled.flight import FlightFolder, Recording
from dappled.flight import recording as flights

log = logging.getLogger(__name__)


def begin(settings: Settings, utc_ns: Callable[[], int], names: Names, *, decodes: bool, utc_known: bool) -> Recording:
    """A new flight below `record.directory`. Raises FlightError where the disk refuses, or another daemon records."""
    facts = _facts(settings, names, decodes)
    return flights.begin(Path(settings.record.directory), utc_ns, facts, utc_known=utc_known)


def keep_inputs(recording: Recording, recipe: Recipe) -> Recipe:
    """The same recipe from copies in the flight, which `flight check` compares from now on. Raises DappledError."""
    kept = recipes.keep(recipe, recording.folder.path)
    recording.note_inputs(recipes.FOLDER)
    return kept


def close(recording: Recording) -> None:
    """End the flight; what had to be put in order is told in the log."""
    for text in recording.close():
        log.warning("%s", text)


def remove_litter(folder: FlightFolder) -> None:
    """After a start that failed: no flight without a shot is left behind."""
    if folder.journal.exists() and folder.journal.stat().st_size == 0:
        shutil.rmtree(folder.path, ignore_errors=True)


def _facts(settings: Settings, names: Names, decodes: bool) -> Mapping[str, Any]:
    return {
        "software": {"dappled": dappled.__version__, **recipes.versions()},
        "settings": configuration.to_tables(settings),
        "names": asdict(names),
        "decode_in_flight": decodes,
    }
