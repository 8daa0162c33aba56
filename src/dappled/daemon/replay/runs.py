"""Decode a recorded flight again by another recipe: a named run, with results of its own beside those of the flight.

A run's name, recipe and versions are a fact of the ledger ("run:NAME"); its files are kept in `inputs/NAME/`, so that
it can be verified and repeated. What was recorded, and what other runs found, is never touched.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.clock import Clock
from dappled.closing import Closing
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.recipes import Names
from dappled.drivers.raw.recipe import FILES, Recipe
from dappled.errors import DappledError
from dappled.flight import LIVE, Ledger, LedgerReader, Result, is_closed, layout, provenance, seals
from dappled.flight.seal_key import SealKey

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Run:
    """What a run was made with. Paths of the recipe lead into the flight."""

    name: str
    recipe: Recipe
    names: Names


class RunWriter(Closing):
    """Writes one run's results into a closed flight's ledger."""

    def __init__(self, flight: Path, run: Run, clock: Clock, key: SealKey | None = None) -> None:
        """Begin a run: its inputs are copied, and the ledger says what it is. The flights' lock is held until its end;
        then the flight is sealed again, signed by `key`. Raises DappledError: no such name, one that is there already,
        a flight that is still recorded, another process that works there, a disk that refuses."""
        folder = layout.open_folder(flight)
        if not _NAME.fullmatch(run.name) or run.name == LIVE:
            raise DappledError(f"{run.name!r} can't name a run: use letters, digits, dots and dashes, not {LIVE!r}")
        if not is_closed(folder.ledger):
            held = layout.is_locked(flight.absolute().parent)
            what = (
                "is still being recorded: wait for its end"
                if held
                else "was never closed: the next `dappled run` closes it"
            )
            raise DappledError(f"{flight} {what}, or replay it without another recipe")
        with ExitStack() as stack:
            stack.enter_context(layout.work_lock(flight.resolve().parent, "stores a run in"))
            with LedgerReader.open(folder.ledger) as ledger:
                known = run.name in ledger.runs() or _fact(run.name) in ledger.facts()
            if known:
                raise DappledError(f"{flight} has a run {run.name!r} already: give another name with --run")
            stack.enter_context(seals.reopened(folder, clock, seals.Occasion.RUN, key))
            kept = recipes.keep(run.recipe, flight, run.name)
            self.run = replace(run, recipe=kept)
            self._ledger = stack.enter_context(Ledger(folder.ledger, clock))
            provenance.note(folder, self._ledger, f"{recipes.FOLDER}/{run.name}")
            kept_as = {"recipe": _relative(kept, flight), "names": run.names, "software": recipes.versions()}
            self._ledger.set_fact(_fact(run.name), {**kept_as, "utc_ns": clock.utc_ns()})
            self._opened = stack.pop_all()

    def close(self) -> None:
        self._opened.close()

    def decoded(self, result: Result) -> None:
        """What came out of one frame."""
        self._ledger.add_result(replace(result, run=self.run.name))


def of_flight(flight: Path, name: str) -> Run:
    """A run that was made. Raises DappledError where there is none of this name."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        facts = ledger.facts()
    fact = facts.get(_fact(name))
    if fact is None:
        runs = sorted(key.removeprefix("run:") for key in facts if key.startswith("run:"))
        raise DappledError(f"{flight} has no run {name!r}; it has {', '.join(runs) or 'only the flight itself'}")
    try:
        recipe = codec.read(Recipe, {**fact["recipe"], **_absolute(fact["recipe"], flight)})
        return Run(name, recipe, codec.read(Names, fact["names"]))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DappledError(
            f"the run {name!r} of {flight} can't be read: {error}; run it anew under another name"
        ) from None


def _fact(name: str) -> str:
    return f"run:{name}"


def _relative(recipe: Recipe, flight: Path) -> dict[str, Any]:
    """The recipe as JSON values; its files relative to the flight, which may be copied elsewhere."""
    top = f"{flight}/"
    values = codec.plain(recipe)
    return {k: v.removeprefix(top) if isinstance(v, str) and v.startswith(top) else v for k, v in values.items()}


def _absolute(values: Mapping[str, Any], flight: Path) -> dict[str, str]:
    """The files of a recipe, inside the flight. Raises OutsideError for one that leads out of it."""
    folder = layout.FlightFolder(flight)
    profiles = {name for name in ("camera", "mask") if str(values.get(name, "")).endswith(".toml")}
    return {name: str(folder.file(values[name])) for name in {*FILES, *profiles} if values.get(name)}
