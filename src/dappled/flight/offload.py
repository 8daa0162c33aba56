"""Copy a flight to another disk, prove the copy, and on request remove the frames here by what was proved.

The manifest is made from the copying itself: names, sizes and the SHA-256 of the bytes that were read. Every file of
the copy is fsynced and read back past the page cache against it, also one that was there already. `prune` then removes
frames by that manifest alone, one by one, each only while it is still the file that was copied.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from dappled import durable
from dappled.clock import Clock
from dappled.findings import Code, Finding, Subject, finding, text, told
from dappled.flight import later_copy, layout, ledger_copies, places, pruning, seals
from dappled.flight.checks import flight_check
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.later_copy import Added
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader
from dappled.flight.ledger_copies import Rows, SealLines
from dappled.flight.read_back import ReadBack
from dappled.flight.records import Frame, Stray
from dappled.flight.seal_key import SealKey
from dappled.flight.trees import Tree
from dappled.flight.verified_copy import Proved, copy_of, copy_verified, hashed, prove


@dataclass(frozen=True, slots=True)
class Offloaded:
    """What was done. `copied` and `there_already` count files, `size` is their total in bytes; `pruned` counts the
    files that were removed here, `brought_home` the rows that work at the copy had added to its ledger and that are now
    here too. `file_system` is that of the copy, `read_back` how its files were read, and `doubts` are what
    this copy can't prove."""

    flight: str
    destination: Path
    copied: int
    there_already: int
    size: int
    pruned: int
    brought_home: int
    file_system: str
    read_back: tuple[ReadBack, ...]
    doubts: tuple[Finding, ...]


def offload(
    flight: Path,
    destination: Path,
    *,
    prune: bool,
    same_device: bool = False,
    clock: Clock,
    key: SealKey | None = None,
    progress: Callable[[int], object] = lambda size: None,
) -> Offloaded:
    """Copy a closed flight to `destination/<its name>`, and prove the copy. A second call finishes what the first one
    left undone. `prune` then removes the frames here; ledger, journal, telemetry, settings and inputs stay. `key` signs
    the seal that follows a removal.

    Raises FlightError: another process works in the flights folder; the flight is open or not intact; the destination
    is the same folder or, without `same_device`, on the same disk; the copy is different or, for `prune`, can't be
    proved; a disk refuses. Each frame is then here, or at the destination, or in both. `progress` gets the bytes done.
    """
    folder = layout.open_folder(flight.resolve())
    with ExitStack() as stack:
        stack.enter_context(layout.work_lock(folder.path.parent, "offloads from", needed=prune))
        _refuse_unready(folder)
        if prune:
            _finish_seal(folder, clock)
        source = stack.enter_context(Tree(folder.path))
        names = [name for name in source.walk() if _is_copied(name)]
        there = _open_copy(stack, source, destination, prune=prune, same_device=same_device)
        system = places.file_system(there.folders[""])
        if prune:
            _refuse_unprovable(there, there.path, same_device=same_device)
        copying = _Copying(folder, source, there)
        copying.copy(names, progress, anew=prune and system in places.NETWORK)
        done = copying.outcome(system)
        return copying.prune(done, clock, key) if prune else done


class _Copying:
    """One offload, between two open folders."""

    def __init__(self, folder: FlightFolder, source: Tree, there: Tree) -> None:
        self._folder, self._source, self._there = folder, source, there
        self._proved: dict[str, Proved] = {}  # what the copy has by now of what is here
        self._elsewhere: dict[str, Proved] = {}  # and what it alone has
        self._added = Added({}, {}, {}, seals=False)

    def copy(self, names: list[str], progress: Callable[[int], object], *, anew: bool) -> None:
        """Copy, read back, make durable, and check. `anew`: what stands on another machine can't be told apart from the
        source, so it is written anew, which shows."""
        seal_lines = SealLines(self._source, self._there, self._folder.seals.name)
        for name in names:
            self._proved[name] = self._bring(name, seal_lines, anew=anew and seals.never_changes(name))
            progress(self._proved[name].identity.size)
        later = self._bring_ledger()
        self._there.sync()
        self._unmark()
        self._there.sync_above()
        rows = self._acknowledged()
        self._elsewhere = self._prove_elsewhere(rows)
        files = later_copy.written_by_work(self._there) if later or seal_lines.copy_is_later else {}
        self._check()
        frames = {name: one for name, one in self._elsewhere.items() if name not in rows}
        self._added = Added(later, frames, files, seal_lines.copy_is_later)
        self._write_sums()

    def outcome(self, system: str) -> Offloaded:
        """What was copied, and what this copy can't prove."""
        ways = tuple(sorted({one.how for one in self._proved.values()}))
        doubts = tuple(_doubts(self._there.path, system, ways))
        size = sum(one.identity.size for one in self._proved.values())
        copied = len(self._proved.keys() & self._there.written)
        already = len(self._proved) - copied
        return Offloaded(self._folder.name, self._there.path, copied, already, size, 0, 0, system, ways, doubts)

    def prune(self, done: Offloaded, clock: Clock, key: SealKey | None) -> Offloaded:
        """Remove what was copied and is in a row of the ledger, once it is written down and sealed; see `offload`."""
        if "page cache" in done.read_back:
            raise FlightError(
                f"{told(done.doubts[0])}: nothing was removed; offload without --prune, or to another disk"
            )
        proved = {name: one for name, one in self._proved.items() if name.startswith("frames/")}
        rows = self._acknowledged()
        sure = {name: one for name, one in proved.items() if name in rows and one.sha256 == rows[name].sha256}
        if not sure:
            self._source.remove_part(pruning.RECORD)  # of an attempt that was cut short
            return done
        self._write_down(sure, clock, key)
        self._write_sums()
        pruned = pruning.remove(self._source, self._there, sure)
        return replace(done, pruned=pruned, brought_home=self._added.count)

    def _bring(self, name: str, seal_lines: SealLines, *, anew: bool) -> Proved:
        """Copy a file, or prove that the copy has it. Of one that later work wrote anew the later one counts. `anew`:
        write it also where it is there already. Raises FlightError where another file is there."""
        self._refuse_in_the_way(name)
        if self._there.stat(name) is not None:
            before, sha256 = hashed(self._source, name)
            theirs = hashed(self._there, name)[1] if anew or seal_lines.differ(name) else sha256
            goal, origin = self._there.path / name, self._source.path / name
            wrong = f"{goal} is there already and differs from {origin}: move it away first"
            if anew and theirs != sha256:
                raise FlightError(wrong)
            if seal_lines.copy_is_later and seal_lines.has(name, sha256):
                sha256 = theirs
            if not anew and not (seal_lines.source_is_later and theirs != sha256 and seal_lines.has(name, theirs)):
                return prove(self._there, name, sha256, wrong, before)
        self._mark()
        return copy_verified(self._source, self._there, name)

    def _bring_ledger(self) -> Rows:
        """Copy ledger and seals. Returns the rows that the copy's ledger has and ours lacks."""
        ledger, seal_file = self._folder.ledger.name, self._folder.seals.name
        for name in (ledger, seal_file):
            self._refuse_in_the_way(name)
        self._proved[ledger], later = ledger_copies.bring(self._source, self._there, ledger)
        self._proved |= SealLines(self._source, self._there, seal_file).bring()
        return later

    def _write_down(self, sure: Mapping[str, Proved], clock: Clock, key: SealKey | None) -> None:
        """Before anything is removed: bring home what was added at the copy, write down what will go, seal the flight
        here, and bring the copy its ledger again, so that work there goes on from it. Raises FlightError."""
        for name in (self._folder.ledger.name, self._folder.seals.name):
            held = self._proved.get(name)
            if copy_of(self._there, name) != (held and held.copy):
                raise FlightError(
                    f"{self._there.path / name} changed while it was checked: nothing was removed; try again"
                )
        added = self._added
        both = [self._folder, *([FlightFolder(self._there.path)] if added else [])]
        signs = key if key is not None and all(seals.standing(one).signed_by(key) for one in both) else None
        if added:
            added.bring_home(self._folder, self._source, self._there, clock)
        known = {**self._proved, **self._acknowledged()}
        with seals.reopened(self._folder, clock, seals.Occasion.PRUNE, signs, judged=True):
            pruning.note(self._folder, self._there.path, sure, added.frames, clock)
        if self._acknowledged().keys() <= known.keys():  # else a file came meanwhile: the next offload brings both
            self._bring_ledger()
            self._there.sync()

    def _refuse_in_the_way(self, name: str) -> None:
        """Raise FlightError where something in the copy is the source's own file."""
        mine, other = self._source.stat(name), self._there.stat(name)
        if mine is not None and other is not None and os.path.samestat(mine, other):
            raise FlightError(
                f"{self._there.path / name} is the same file as {self._source.path / name} under another name: nothing "
                "was removed; give a folder on another disk"
            )

    def _mark(self) -> None:
        """Mark the copy as unfinished, durably: a daemon that records there would repair it, and work there be lost."""
        if self._there.stat(layout.UNFINISHED) is None:
            self._there.write(layout.UNFINISHED, [os.fsencode(f"offloaded from {self._source.path}\n")])
            self._there.sync()

    def _unmark(self) -> None:
        if self._there.stat(layout.UNFINISHED) is not None:
            self._there.unlink(layout.UNFINISHED)
            self._there.sync()

    def _acknowledged(self) -> dict[str, Frame | Stray]:
        with LedgerReader.open(self._folder.ledger) as ledger:
            return {row.name: row for row in ledger.files()}

    def _prove_elsewhere(self, rows: Mapping[str, Frame | Stray]) -> dict[str, Proved]:
        """Read back the files that the copy alone has: an earlier prune removed them here, or work there brought them.
        Raises FlightError where one is missing, or isn't what the ledger says: ours, of what was here."""
        gone = pruning.removed(self._folder)
        proved: dict[str, Proved] = {}
        with LedgerReader.open(self._there.path / self._folder.ledger.name) as ledger:
            theirs = {row.name: row for row in ledger.files()}
        for name, row in {**theirs, **rows}.items():
            if name in self._proved or (name in rows and name not in gone):
                continue  # what is missed here the check of the copy tells
            self._folder.file(name)  # confined
            there = name.startswith("frames/") and name.count("/") == 1 and self._there.stat(name) is not None
            if not there and name in gone:
                raise FlightError(
                    f"{name} was offloaded to {gone[name].destination} and removed here, and {self._there.path} lacks "
                    "it: nothing was removed; give that destination, or copy its frames here first"
                )
            if not there:
                raise FlightError(f"the ledger of {self._there.path} names {name}, which is no frame there")
            wrong = f"{self._there.path / name} differs from what the ledger says: nothing was removed"
            proved[name] = prove(self._there, name, row.sha256, wrong)
        return proved

    def _write_sums(self) -> None:
        """Write the manifest beside the copy, as `sha256sum --check` reads it. Raises FlightError."""
        copy = self._there.path
        path, manifest = copy.with_name(f"{copy.name}.sha256"), {**self._proved, **self._elsewhere}
        lines = [_sum(one.sha256, f"{copy.name}/{name}") for name, one in sorted(manifest.items())]
        with disk_errors("write", path):
            durable.write_file(path, b"".join(lines))

    def _check(self) -> None:
        found = flight_check.check(self._there.path)
        if found.problems:
            raise FlightError(
                f"the copy {self._there.path} is not intact ({text(found.problems[0])}): nothing was removed; "
                f"run `dappled flight check {self._folder.path}`"
            )


def _is_copied(name: str) -> bool:
    """Whether a file is copied as it is: not the ledger's, the record of what was removed, or half-written."""
    half = durable.is_temporary(name.rpartition("/")[2])
    return not (ledger_copies.is_part(name) or name == pruning.RECORD or half)


def _refuse_unready(folder: FlightFolder) -> None:
    """Raise FlightError for a flight that is not closed, and OutsideError where the ledger names a file outside it."""
    with LedgerReader.open(folder.ledger) as ledger:
        facts = ledger.facts()
        for row in ledger.files():
            folder.file(row.name)
    if "closed_utc_ns" not in facts:
        raise FlightError(
            f"{folder.path} is still being recorded, or was never closed: stop the daemon, or start it once to close it"
        )


def _finish_seal(folder: FlightFolder, clock: Clock) -> None:
    """Seal a flight again where a prune was cut short between announcing a seal and writing it, unsigned: nobody knows
    what was done in between. Raises FlightError."""
    with LedgerReader.open(folder.ledger) as ledger:
        count, missing = seals.announced(ledger.facts())
        opened = ledger.found(seals.OPENED)
    last = seals.read(folder).last
    written = 0 if last is None else last.seal
    if opened and opened[-1].facts.get("work") == seals.Occasion.PRUNE and count > written and count not in missing:
        seals.seal(folder, clock, seals.Occasion.PRUNE)


def _open_copy(stack: ExitStack, source: Tree, destination: Path, *, prune: bool, same_device: bool) -> Tree:
    """Open the flight's folder at the destination with all folders of the source, made where they are missing, and hold
    the lock of the destination: work on the flights there would take half-written files for its own. `stack` closes
    both.

    Raises FlightError where one of them is the source's, or to `prune` can't be proved there, before anything is
    written, and where others work there.
    """
    top = destination.resolve()
    existing = next(path for path in (top, *top.parents) if path.is_dir())
    with Tree(existing) as above:
        places.refuse_same_place(source, above, same_device=same_device)
        if prune and not os.path.lexists(top / source.path.name):  # no folder is made that would stay empty
            _refuse_unprovable(above, top / source.path.name, same_device=same_device)
    with disk_errors("make the folder", top):
        durable.make_folder(top)
    with Tree(top) as parent:
        places.refuse_same_place(source, parent, same_device=same_device)
        parent.enter(source.path.name, make=True)
    there = stack.enter_context(Tree(top / source.path.name))
    places.refuse_same_place(source, there, same_device=same_device)
    for name in sorted(source.folders):
        there.enter(name, make=True)
        places.refuse_same_place(source, there, same_device=same_device)
    there.enter("frames", make=True)  # also of a flight without a frame
    places.refuse_reexport(source, there)
    stack.enter_context(layout.work_lock(top, "offloads into"))  # last: of one folder under two names it is held
    return there


def _refuse_unprovable(copy: Tree, there: Path, *, same_device: bool) -> None:
    """Raise FlightError where the file system of an open folder, for a copy that is or will be `there`, is not known to
    keep what was fsynced, or its disk is not known or forgets what it holds."""
    system = places.file_system(copy.folders[""])
    if system not in places.KEEPS_FSYNC | places.NETWORK:
        raise FlightError(
            f"--prune can't be sure of {there}: its file system is {system}, of which dappled doesn't know that an "
            "fsync reaches a disk; nothing was copied; offload to ext4, xfs, btrfs, exfat or NFS, or without --prune"
        )
    volatile = places.volatile(copy.folders[""])
    if volatile:
        raise FlightError(
            f"--prune refuses {there}: {volatile}; nothing was copied; offload to another disk, or without --prune"
        )
    if not same_device and system not in places.NETWORK and not places.disks(copy.folders[""]):
        raise FlightError(
            f"--prune can't tell which disk {there} is on; nothing was copied; offload to a disk of this machine, or "
            "without --prune, or insist with --same-device"
        )


def _doubts(there: Path, system: str, ways: tuple[ReadBack, ...]) -> list[Finding]:
    """What a copy can't prove; the way of reading first."""
    found, copy = [], Subject("copy", str(there))
    if "page cache" in ways:
        found.append(finding(Code.COPY_IN_MEMORY, copy, system=system))
    if system in places.NETWORK:
        found.append(finding(Code.COPY_REMOTE, copy, system=system))
    elif system not in places.KEEPS_FSYNC:
        found.append(finding(Code.COPY_MAY_NOT_LAST, copy, system=system))
    return found


def _sum(sha256: str, name: str) -> bytes:
    """A line of the manifest; a backslash before it says that line breaks in the name are escaped."""
    escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
    return os.fsencode(f"{'' if escaped == name else chr(92)}{sha256}  {escaped}\n")
