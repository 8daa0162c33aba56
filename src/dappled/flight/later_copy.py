"""Bring home what work at a copy has added to a flight, before a prune adds rows of its own here.

Otherwise each of the two ledgers would hold rows that the other lacks, and the next offload would refuse. Rows come
with the links that they have there, and seals as they are; sidecars, lists and the inputs of runs come with them. Files
that came to the copy alone (a pickup there) stay there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from dappled import durable
from dappled.clock import Clock
from dappled.errors import counted
from dappled.flight import layout
from dappled.flight.chain import Column
from dappled.flight.errors import FlightError
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger
from dappled.flight.pruning import Proved
from dappled.flight.records import Frame, Stray
from dappled.flight.trees import FileIdentity, Tree
from dappled.shown import printable

_FOLDERS = ("geotags/", "inputs/")

Rows = Mapping[str, Sequence[Sequence[Column]]]


@dataclass(frozen=True, slots=True)
class Added:
    """What work at a copy added: `rows` of its ledger by table, `files` that came to it alone and were read back there,
    and whether it has seals that we lack."""

    rows: Rows
    files: Mapping[str, Proved]
    seals: bool

    def __bool__(self) -> bool:
        return bool(self.rows) or self.seals

    @property
    def count(self) -> int:
        """How many rows."""
        return sum(map(len, self.rows.values()))

    def bring_home(
        self, folder: FlightFolder, source: Tree, there: Tree, manifest: Mapping[str, Proved], clock: Clock
    ) -> None:
        """Add the rows to the ledger here, after the files and seals that go with them. `manifest` tells what the
        copy's files are, which were read back. Called again after a crash, it does the rest. Raises FlightError."""
        for name in _written_by_work(there):
            if name in manifest and manifest[name].sha256 == _sha256(source, name):
                continue
            parents = name.split("/")[:-1]
            for depth in range(1, len(parents) + 1):
                source.enter("/".join(parents[:depth]), make=True)
            _copy(there, source, name)
        if self.seals:
            _copy(there, source, folder.seals.name)
        source.sync()
        with Ledger(folder.ledger, clock) as ledger:
            text = f"{counted(self.count, 'row')} that later work added to the copy {there.path} were brought home"
            ledger.adopt(self.rows, printable(text))


def files(rows: Rows) -> list[Frame | Stray]:
    """The frames, companions and strays among the rows of a ledger. Raises FlightError for what is none."""
    try:
        frames = [Frame(*row) for row in rows.get("frames", ())]  # type: ignore[arg-type]  # as the columns are
        # idx stands second in the row of a companion
        companions = [Frame(row[1], row[0], *row[2:]) for row in rows.get("companions", ())]  # type: ignore[arg-type]  # likewise
        strays = [Stray(*row) for row in rows.get("strays", ())]  # type: ignore[arg-type]  # likewise
    except TypeError as error:
        raise FlightError(f"a row in the ledger of the copy can't be read: {error}") from error
    found: list[Frame | Stray] = [*frames, *companions, *strays]
    if not all(isinstance(row.name, str) and isinstance(row.sha256, str) for row in found):
        raise FlightError("a row in the ledger of the copy can't be read: its columns have other types")
    return found


def _written_by_work(there: Tree) -> Iterator[str]:
    """The files of a copy that later work writes or adds, apart from frames."""
    for name in there.walk():
        if durable.is_temporary(name.rpartition("/")[2]):
            continue
        if name.startswith(_FOLDERS) or (name.startswith("frames/") and name.endswith(layout.SIDECAR)):
            yield name


def _sha256(tree: Tree, name: str) -> str:
    with tree.reading(name) as fd:
        return durable.hash_descriptor(fd, FileIdentity.of_fd(fd).size)


def _copy(origin: Tree, goal: Tree, name: str) -> None:
    with origin.reading(name) as fd:
        goal.write(name, durable.pieces(fd, FileIdentity.of_fd(fd).size))
