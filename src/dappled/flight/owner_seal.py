"""Sign a closed flight with its owner's key as it stands: one that was recorded or worked on without the key.

Recovery and later work sign only what the key had signed before. Here a person says that the flight is to be vouched
for from now on; `flight check` goes on saying from which seal.
"""

from __future__ import annotations

from pathlib import Path

from dappled.clock import Clock
from dappled.findings import text
from dappled.flight import layout, seals
from dappled.flight.checks import flight_check
from dappled.flight.checks.flight_check import CheckReport
from dappled.flight.errors import FlightError
from dappled.flight.ledger import Ledger, is_closed
from dappled.flight.seal_key import SealKey


def sign(flight: Path, clock: Clock, key: SealKey) -> CheckReport:
    """Check a whole flight and, where nothing is wrong, add a seal by this key; none where the newest one is its
    already. What the check notes becomes an event, which `flight check` repeats: a signature does not hide it.
    Returns what a check then says.

    Raises FlightError: the flight is open or not intact, another process works there, a disk refuses.
    """
    folder = layout.open_folder(flight)
    with layout.work_lock(folder.path.resolve().parent, "seals flights in"):
        if not is_closed(folder.ledger):
            raise FlightError(f"{flight} was never closed, and can't be sealed: the next `dappled run` closes it")
        found = flight_check.check(folder.path, key)
        if found.problems:
            raise FlightError(
                f"{flight} is not intact ({text(found.problems[0])}) and was not signed: "
                f"run `dappled flight check {flight}`"
            )
        if found.vouched == "signed":
            return found
        opened = seals.reopened(folder, clock, seals.Occasion.OWNER, key, judged=True)
        with opened, Ledger(folder.ledger, clock) as ledger:
            known = ledger.found(seals.CHANGED)
            for one in found.notes:
                if one not in known:
                    ledger.add_event(seals.CHANGED, one)
    return flight_check.check(folder.path, key)
