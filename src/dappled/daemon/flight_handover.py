"""Change settings while the daemon runs: some at once, after SIGHUP; mask and carrier law with the next flight.

What frames are decoded by belongs to a flight: its record, its replay and every product of it have one recipe. So a
ground station's choice of another one ends the flight in order, between two frames, and begins the next one with it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace

from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.parameters import OwnParameter
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.recipes import Names
from dappled.decode.optics import LAWS
from dappled.errors import DappledError, sentence

log = logging.getLogger(__name__)
NONE = "none"  # no mask: frames are kept, not decoded
BY_BODY = "by body"  # no law is named: the first frame shows which body it is, and so which law
# Settings that are read each time they are used, and that change no record that has begun.
CHANGES_IN_FLIGHT = frozenset({("pose", "wait_ms"), ("record", "min_free_mb")})


class LiveSettings:
    """The settings in force: `now`."""

    def __init__(self, now: Settings) -> None:
        self.now = now

    def reload(self, wanted: Settings) -> list[str]:
        """Take over what may change in flight. Returns a sentence for each difference: taken, or refused."""
        changes: list[str] = []
        tables = {}
        for table in fields(Settings):
            old, new = getattr(self.now, table.name), getattr(wanted, table.name)
            taken = {}
            for key in fields(old):
                before, after = getattr(old, key.name), getattr(new, key.name)
                if before == after:
                    continue
                name = f"{table.name}.{key.name}"
                if (table.name, key.name) in CHANGES_IN_FLIGHT:
                    taken[key.name] = after
                    changes.append(f"{name} is {after!r} now (was {before!r})")
                else:
                    changes.append(f"{name} stays {before!r}: {after!r} takes a restart")
            tables[table.name] = replace(old, **taken)
        self.now = Settings(**tables)
        return changes


class FlightHandover:
    """What the next flight will be flown with, once a ground station has set it.

    `configured` are the settings of the file: their calibration holds for their mask and law only. `next` is written
    by the thread that serves the ground station, and read by the one that ends the flight. `began`: the flight before
    it was opened completely. Raises DappledError when the named camera profile isn't right.
    """

    def __init__(self, configured: Settings) -> None:
        self._configured = configured
        self._mask, self._law = words(recipes.called(configured))
        self.began = False
        self.next: Settings | None = None

    def masks(self) -> tuple[str, ...]:
        """What LF_MASK can be: the shipped masks, the configured one, and none. Nothing beside lenslets."""
        if self._mask == profiles.LENSLET:
            return ()
        shipped = profiles.shipped("masks")
        return (*shipped, *([self._mask] if self._mask not in (*shipped, NONE) else []), NONE)

    def laws(self) -> tuple[str, ...]:
        """What LF_LAW can be. Nothing with lenslets, which follow none."""
        if self._mask == profiles.LENSLET:
            return ()
        return (*LAWS, *([BY_BODY] if self._law == BY_BODY else []))

    def with_mask(self, now: Settings, word: str) -> Settings:
        """The settings of now with this mask."""
        profile = self._configured.mask.profile if word == self._mask else "" if word == NONE else word
        return self._calibrated(replace(now, mask=replace(now.mask, profile=profile)))

    def with_law(self, now: Settings, word: str) -> Settings:
        """The settings of now with this carrier law."""
        law = self._configured.decode.law if word == self._law else word
        return self._calibrated(replace(now, decode=replace(now.decode, law=law)))

    def _calibrated(self, wanted: Settings) -> Settings:
        own = self._configured
        same = (wanted.mask.profile, wanted.decode.law) == (own.mask.profile, own.decode.law)
        return replace(wanted, decode=replace(wanted.decode, calibration=own.decode.calibration if same else ""))


def words(names: Names) -> tuple[str, str]:
    """LF_MASK and LF_LAW of a flight with these names."""
    return names.mask or NONE, names.law or BY_BODY


def parameters(
    flown: Names, after: FlightHandover | None, settings: LiveSettings, ask: Callable[[Settings, str], None]
) -> tuple[OwnParameter, OwnParameter]:
    """LF_MASK and LF_LAW of a flight; read-only where no flight can come `after` it.

    `ask` takes the next flight's settings and a sentence; it raises CameraError where that must wait. Once it has
    taken them, the parameters show those of the next flight: this one takes no more frames.
    """
    mask, law = words(flown)
    if after is None:
        return OwnParameter("LF_MASK", "Mask", lambda: mask), OwnParameter("LF_LAW", "Carrier law", lambda: law)

    def change_mask(word: str) -> None:
        nonlocal mask
        ask(after.with_mask(after.next or settings.now, word), f"mask {word}")
        mask = word

    def change_law(word: str) -> None:
        nonlocal law
        ask(after.with_law(after.next or settings.now, word), f"carrier law {word}")
        law = word

    return (
        OwnParameter("LF_MASK", "Mask", lambda: mask, after.masks(), change_mask),
        OwnParameter("LF_LAW", "Carrier law", lambda: law, after.laws(), change_law),
    )


def flights(settings: Settings, fly: Callable[[Settings, FlightHandover], bool]) -> None:
    """Fly one flight after the other, until no further one was asked for.

    `fly` runs a flight from its start to its end; False: the daemon was stopped, and no flight follows. Where a next
    flight can't begin, that is logged, and one with the settings before it is begun. Raises what the first flight
    raises, and what goes wrong in flight.
    """
    before: Settings | None = None
    now = settings
    while True:
        after = FlightHandover(settings)
        try:
            goes_on = fly(now, after)
        except DappledError as error:
            if before is None or after.began:
                raise
            log.warning("the next flight can't begin, so all stays as it was: %s", sentence(error))
            now, before = before, None
            continue
        if not goes_on or after.next is None:
            return
        before, now = now, after.next
