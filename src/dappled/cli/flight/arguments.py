"""Arguments that the actions of `flight` share: which flight, and the settings that say where flights are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled.cli import paths
from dappled.cli.table import words_only
from dappled.cli.verb import Output, SettingsArgument, argument
from dappled.config import settings
from dappled.errors import counted

if not words_only:
    from dappled.flight import FlightError, index, layout

EXAMPLE = "~/flights/20261121T101503Z-0a1b2c3d"


@dataclass(frozen=True, kw_only=True)
class FlightArgument(SettingsArgument):
    """The flight."""

    flight: Path | None = argument(
        "FLIGHT", "flight folder (default: the last with shots)", default=None, there=paths.flight
    )

    def chosen(self, output: Output) -> Path:
        """The flight that was named, or the last with shots; says which. Raises FlightError if there is none."""
        if self.flight is not None:
            return self.flight
        flights = folder_of_flights(self.config)
        found = index.in_order(flights)
        if not found:
            raise FlightError(f"there is no flight in {flights} yet; name one, or record one with `dappled run`")
        with_shots = [number for number, one in enumerate(found) if not _empty(one)]
        if not with_shots:
            raise FlightError(f"no flight in {flights} has a shot; name one to look at it all the same")
        chosen, skipped = found[with_shots[-1]], len(found) - 1 - with_shots[-1]
        later = f"; {counted(skipped, 'later flight')} without a shot skipped" if skipped else ""
        output.remark(f"flight {chosen.path}, the last with shots{later}")
        return chosen.path


def folder_of_flights(config: Path | None) -> Path:
    """The settings' folder. Without a file: `flights` here, where `dappled run --simulate` records, if it holds any."""
    if config is None and layout.flights(settings.SIMULATED_FLIGHTS):
        return settings.SIMULATED_FLIGHTS
    return Path(settings.load(config).record.directory)


def _empty(flight: layout.FlightFolder) -> bool:
    """Whether no shot was ever noted in a flight. False where that can't be known."""
    try:
        return flight.journal.stat().st_size == 0
    except OSError:
        return False
