"""From one flight to the next without a restart: another mask or carrier law, set by a ground station.

What frames are decoded by belongs to a flight: its record, its replay and every product of it have one recipe. So
another choice ends the flight in order, between two frames, and begins the next one with it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.parameters import OwnParameter
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.pending_shot import Names
from dappled.decode.optics import LAWS
from dappled.errors import DappledError, sentence

log = logging.getLogger(__name__)
NONE = "none"  # no mask: frames are kept, not decoded
BY_BODY = "by body"  # no law is named, and the body tells which one it is with its first frame


class FlightHandover:
    """What the next flight will be flown with, once that is asked for.

    `configured` are the settings that a person wrote: a calibration is of their mask and law, and counts with these
    alone. `next` is written by the thread that is asked, and read by the one that ends the flight. `began`: the flight
    before it was opened whole. Raises DappledError when the named camera profile isn't right.
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
    """What LF_MASK and LF_LAW say of a flight whose frames are called so."""
    return names.mask or NONE, names.law or BY_BODY


def parameters(
    flown: Names, after: FlightHandover | None, now: Callable[[], Settings], ask: Callable[[Settings, str], None]
) -> tuple[OwnParameter, OwnParameter]:
    """LF_MASK and LF_LAW of a flight, to be read only where nothing can come `after` it.

    `ask` takes the next flight's settings, made from those of `now`, and a sentence; a CameraError from it says why
    not at once. Once it has taken them, they say what is to come: this flight takes no frame any more.
    """
    mask, law = words(flown)
    if after is None:
        return OwnParameter("LF_MASK", "Mask", lambda: mask), OwnParameter("LF_LAW", "Carrier law", lambda: law)

    def change_mask(word: str) -> None:
        nonlocal mask
        ask(after.with_mask(after.next or now(), word), f"mask {word}")
        mask = word

    def change_law(word: str) -> None:
        nonlocal law
        ask(after.with_law(after.next or now(), word), f"carrier law {word}")
        law = word

    return (
        OwnParameter("LF_MASK", "Mask", lambda: mask, after.masks(), change_mask),
        OwnParameter("LF_LAW", "Carrier law", lambda: law, after.laws(), change_law),
    )


def flights(settings: Settings, fly: Callable[[Settings, FlightHandover], bool]) -> None:
    """One flight after the other, until one ends that nothing follows.

    `fly` takes a flight from its start to its end; False: it was told to end, whatever was to follow. A next flight
    that can't begin is told in the log, and the settings before it are flown again. Raises what the first one raises,
    and what goes wrong in flight.
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
