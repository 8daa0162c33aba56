"""Let a ground station choose another mask or carrier law: with it the flight ends, and the next one begins.

What frames are decoded by belongs to a flight: its record, its replay and every product of it have one recipe. So a
ground station's choice of another one ends the flight in order, between two frames, and begins the next one with it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.parameters import Parameter
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.shutter import Shutter
from dappled.decode.optics import LAWS
from dappled.drivers.camera import CameraError
from dappled.errors import DappledError, counted, sentence
from dappled.findings import Code, Finding, Subject, finding

log = logging.getLogger(__name__)
NONE = "none"  # no mask: frames are kept, not decoded
BY_BODY = "by body"  # no law is named: the first frame shows which body it is, and so which law


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


class RecipeParameters:
    """LF_MASK and LF_LAW of a flight with the names `flown`; read-only where no flight can come `after` it.

    Another value ends the flight between two frames, and the next one is flown with it; `later` takes that as an event
    of the ledger. The parameters show it from then on: this flight takes no more frames.
    """

    def __init__(
        self,
        flown: Names,
        after: FlightHandover | None,
        settings: LiveSettings,
        shutter: Shutter,
        later: Callable[[str, Finding], object],
    ) -> None:
        self._mask, self._law = words(flown)
        self._after, self._settings, self._shutter, self._later = after, settings, shutter, later

    def parameters(self) -> tuple[Parameter, Parameter]:
        masks, laws = ((), ()) if self._after is None else (self._after.masks(), self._after.laws())
        return Parameter("LF_MASK", "Mask", self._mask, masks), Parameter("LF_LAW", "Carrier law", self._law, laws)

    def set(self, name: str, value: str) -> None:
        """Fly the next flight with this mask or law. Raises CameraError where that would cut something short."""
        after = self._after
        assert after is not None, "without one there is no choice"
        now = after.next or self._settings.now
        if name == "LF_MASK":
            self._begin_next(after, after.with_mask(now, value), f"mask {value}")
            self._mask = value
        else:
            self._begin_next(after, after.with_law(now, value), f"carrier law {value}")
            self._law = value

    def _begin_next(self, after: FlightHandover, following: Settings, text: str) -> None:
        now = self._shutter.statistics()
        if now.interval_s is not None:
            raise CameraError(f"{text} would begin another flight: stop the interval first")
        if now.pending:
            raise CameraError(f"{text} would begin another flight: {counted(now.pending, 'shot')} under way, ask again")
        after.next = following
        self._later("next flight", finding(Code.FLIGHT_NEXT_SET, Subject("flight"), what=text))


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
            log.warning("the next flight can't begin, so nothing changes: %s", sentence(error))
            now, before = before, None
            continue
        if not goes_on or after.next is None:
            return
        before, now = now, after.next
