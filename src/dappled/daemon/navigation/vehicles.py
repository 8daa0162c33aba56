"""Whose telemetry the poses of a flight are of: decided while it flies, noted, and read again for a replay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dappled.daemon.navigation.telemetry import Telemetry
from dappled.flight import LedgerReader

FACT = "vehicles"


class Vehicles:
    """Turns telemetry to the vehicle that the camera belongs to, and notes each turn: `note` gets all of them."""

    def __init__(self, telemetry: Telemetry, note: Callable[[str, Sequence[Sequence[int]]], Any]) -> None:
        self._telemetry, self._note = telemetry, note
        self._turns: list[list[int]] = []
        self._noted = 0

    def look(self, system_id: int | None) -> None:
        """Which system the camera belongs to now; None while that is open.

        Raises DappledError when a turn can't be noted; the next look tries again.
        """
        if system_id is not None and (not self._turns or self._turns[-1][1] != system_id):
            self._turns.append([self._telemetry.follow(system_id), system_id])
        if self._noted != len(self._turns):
            self._note(FACT, self._turns)
            self._noted = len(self._turns)


def of_flight(ledger: LedgerReader) -> list[tuple[int, int]]:
    """(number of the first telemetry packet, system id) of each turn, as `Telemetry` takes them."""
    return [(packet, system_id) for packet, system_id in ledger.facts().get(FACT, [])]
