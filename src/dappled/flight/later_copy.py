"""Bring home what work at a copy has added to a flight, before a prune adds rows of its own here.

Otherwise each of the two ledgers would hold rows that the other lacks, and the next offload would refuse. Rows come
with the links that they have there, and seals as they are; sidecars, lists and the inputs of runs come with them. Files
that came to the copy alone (a pickup there) stay there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dappled import durable
from dappled.clock import Clock
from dappled.findings import Code, Subject, finding
from dappled.flight import layout
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger
from dappled.flight.ledger_copies import Rows
from dappled.flight.trees import FileIdentity, Tree
from dappled.flight.verified_copy import Proved, copy_verified, hashed
from dappled.shown import printable

_FOLDERS = ("geotags/", "inputs/")


def written_by_work(there: Tree) -> dict[str, tuple[FileIdentity, str]]:
    """The files of a copy that later work writes or adds, apart from frames, with their SHA-256. Raises FlightError."""
    return {
        name: hashed(there, name)
        for name in there.walk()
        if not durable.is_temporary(name.rpartition("/")[2])
        and (name.startswith(_FOLDERS) or (name.startswith("frames/") and name.endswith(layout.SIDECAR)))
    }


@dataclass(frozen=True, slots=True)
class Added:
    """What work at a copy added: `rows` of its ledger by table, `frames` that came to it alone and were read back
    there, the `files` that it wrote as they were when the copy was checked, and whether it has seals that we lack."""

    rows: Rows
    frames: Mapping[str, Proved]
    files: Mapping[str, tuple[FileIdentity, str]]
    seals: bool

    def __bool__(self) -> bool:
        return bool(self.rows) or self.seals

    @property
    def count(self) -> int:
        """How many rows."""
        return sum(map(len, self.rows.values()))

    def bring_home(self, folder: FlightFolder, source: Tree, there: Tree, clock: Clock) -> None:
        """Add the rows to the ledger here, after the files and seals that go with them. Called again after a crash, it
        does the rest. Raises FlightError, also where a file is not the one any more that was checked."""
        for name, (identity, sha256) in self.files.items():
            parents = name.split("/")[:-1]
            for depth in range(1, len(parents) + 1):
                source.enter("/".join(parents[:depth]), make=True)
            if source.stat(name) is None or hashed(source, name)[1] != sha256:
                copy_verified(there, source, name, identity)
        if self.seals:
            copy_verified(there, source, folder.seals.name)
        source.sync()
        with Ledger(folder.ledger, clock) as ledger:
            copy = printable(str(there.path))
            ledger.adopt(self.rows, finding(Code.FLIGHT_BROUGHT_HOME, Subject("flight"), rows=self.count, copy=copy))
