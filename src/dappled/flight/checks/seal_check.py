"""Compare the files of a flight with its newest seal, and say what the seals vouch for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from dappled import durable
from dappled.findings import Code, Finding, Level, finding
from dappled.flight import layout, provenance, seals
from dappled.flight.chain import ChainLink
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader
from dappled.flight.provenance import HeldDigests
from dappled.flight.seal_key import SealKey
from dappled.flight.seals import SEAL, Seal

Vouched = Literal["signed", "not verified", "not signed", "not sealed"]


@dataclass(frozen=True, slots=True)
class LedgerBytes:
    """The ledger's file as it was before anything opened it: size, SHA-256, and the bytes of its WAL."""

    size: int
    sha256: str
    wal_size: int

    @classmethod
    def of(cls, folder: FlightFolder) -> LedgerBytes:
        """Read them; zeros without a file. Raises OSError."""
        if not folder.ledger.is_file():
            return cls(0, "", 0)
        wal = folder.ledger.with_name(folder.ledger.name + "-wal")
        wal_size = wal.stat().st_size if wal.exists() else 0
        return cls(folder.ledger.stat().st_size, durable.hash_file(folder.ledger), wal_size)


@dataclass(frozen=True, slots=True)
class SealFindings:
    """What the seals show: `found`, problems and notes. `verdict` says what they vouch for where nothing is wrong;
    `unsealed` counts the links of the chain after the newest seal."""

    vouched: Vouched
    verdict: Finding
    found: tuple[Finding, ...] = ()
    unsealed: int = 0


def compare(
    folder: FlightFolder,
    ledger: LedgerReader,
    links: Mapping[int, ChainLink],
    before: LedgerBytes,
    key: SealKey | None,
) -> SealFindings:
    """Compare seals, chain and files. `links` is the chain; `key` verifies signatures. Raises
    FlightError and OSError."""
    file, facts = seals.read(folder), ledger.facts()
    found = [*file.problems, *_numbers(file.seals, links, facts), *_heads(file.seals, links, facts)]
    found += [*_signatures(file.seals, key), *_rewritten(file.seals)]
    found += [finding(Code.SEAL_UNWRITTEN, SEAL, seal=number) for number in seals.announced(facts)[1]]
    owned = [one for one in file.seals.values() if one.why == seals.Occasion.OWNER]
    found += [finding(Code.SEAL_BY_OWNER, SEAL, seal=one.seal, key=one.key) for one in owned]
    found += ledger.found(seals.CHANGED)
    last = file.last
    if last is None:
        return SealFindings("not sealed", finding(Code.SEAL_NONE, SEAL), tuple(found))
    unsealed = max(0, len(links) - last.links)
    if unsealed:
        found.append(finding(Code.SEAL_UNSEALED, SEAL, seal=last.seal, work=last.why, links=unsealed))
    for wrong, one in _files(folder, last, provenance.held(ledger), unsealed=unsealed > 0):
        found.append(replace(one, level=Level.STOP if wrong else Level.NOTE))
    if not unsealed:
        found += _ledger_file(last, before)
    return SealFindings(*_verdict(file.seals, last, key, unsealed), tuple(found), unsealed)


def _numbers(found: Mapping[int, Seal], links: Mapping[int, ChainLink], facts: Mapping[str, Any]) -> Iterator[Finding]:
    """Seals that the ledger tells of and that are not there, and the other way round."""
    count, missing = seals.announced(facts)
    if count > len(links):  # each seal begins with a link
        yield finding(Code.SEAL_MORE_THAN_LINKS, SEAL, seals=count, links=len(links))
        return
    for number in sorted(set(range(1, count + 1)) - missing - found.keys()):
        yield finding(Code.SEAL_LOST, SEAL, seal=number)
    for number in sorted(found.keys() - set(range(1, count + 1))):
        yield finding(Code.SEAL_UNKNOWN, SEAL, seal=number)


def _heads(found: Mapping[int, Seal], links: Mapping[int, ChainLink], facts: Mapping[str, Any]) -> Iterator[Finding]:
    """Seals that contradict the chain."""
    for number, seal in found.items():
        if seal.flight != seals.of_flight(facts):
            yield finding(Code.SEAL_ANOTHER_FLIGHT, SEAL, seal=number, flight=seal.flight)
        link = links.get(seal.links)
        if link is None or link.link != seal.head:
            yield finding(Code.SEAL_CONTRADICTS_CHAIN, SEAL, seal=number, link=seal.links)


def _signatures(found: Mapping[int, Seal], key: SealKey | None) -> Iterator[Finding]:
    for number, seal in found.items():
        if (seal.key is None) != (seal.mac is None):
            yield finding(Code.SEAL_SIGNED_IN_PART, SEAL, seal=number)
        elif key is not None and seal.key == key.name and not key.signed(seal.signed_part(), seal.mac or ""):
            yield finding(Code.SEAL_SIGNATURE_WRONG, SEAL, seal=number, key=key.name)


def _rewritten(found: Mapping[int, Seal]) -> Iterator[Finding]:
    """What was recorded never changes from one seal to the next, whoever made that one."""
    first: dict[str, tuple[int, tuple[int, str]]] = {}
    for number, seal in sorted(found.items()):
        for name, digest in seal.files.items():
            if not seals.never_changes(name):
                continue
            before, was = first.setdefault(name, (number, digest))
            if was != digest:
                yield finding(Code.SEAL_REWRITTEN, SEAL, seal=number, before=before, file=name)


def _files(
    folder: FlightFolder, last: Seal, held: Mapping[str, HeldDigests], *, unsealed: bool
) -> Iterator[tuple[bool, Finding]]:
    """(whether that is wrong, what it is) of files that are not those which the newest seal covers. Where work was not
    sealed, only what was recorded can't be the work's. Those that the ledger holds are compared with it elsewhere."""
    present = seals.sealed_paths(folder)
    for name in sorted((last.files.keys() | present.keys()) - {folder.ledger.name}):
        noted, known, code = last.files.get(name), held.get(name), None
        wrong = not unsealed or seals.never_changes(name)
        try:
            if known is not None and len(known.right) == 1:
                if noted is not None and (known.size not in (noted[0], None) or known.right[0] != noted[1]):
                    code = Code.SEAL_DIGESTS_DIFFER
            elif name not in present:
                code = Code.SEAL_FILE_MISSING
            elif noted is not None:
                code = None if seals.digest(present[name]) == noted else Code.SEAL_FILE_CHANGED
            elif name.startswith("inputs/"):
                code, wrong = Code.SEAL_INPUT_ADDED, not unsealed
            elif not name.startswith("frames/") or name.endswith(layout.SIDECAR):  # others are missed in the ledger
                code, wrong = Code.SEAL_FILE_ADDED, False
        except OSError as error:
            yield wrong, finding(Code.SEAL_FILE_UNREADABLE, SEAL, file=name, why=error)
        if code is not None:
            yield wrong, finding(code, SEAL, seal=last.seal, file=name)


def _ledger_file(last: Seal, before: LedgerBytes) -> Iterator[Finding]:
    """The ledger's bytes, free pages too; its rows are compared with the chain."""
    if before.wal_size:
        yield finding(Code.SEAL_UNCOVERED, SEAL, bytes=before.wal_size)
    if last.files.get("flight.sqlite") != (before.size, before.sha256):
        yield finding(Code.SEAL_LEDGER_CHANGED, SEAL, seal=last.seal)


def _verdict(found: Mapping[int, Seal], last: Seal, key: SealKey | None, unsealed: int) -> tuple[Vouched, Finding]:
    """What the seals vouch for; of `unsealed` links after the newest one they vouch for nothing."""
    if last.key is None or unsealed:
        signed = [number for number, seal in found.items() if key is not None and seal.key == key.name]
        if key is not None and signed:
            return "not signed", finding(Code.SEAL_SIGNED_UNTIL, SEAL, key=key.name, seal=max(signed))
        return "not signed", finding(Code.SEAL_NOT_SIGNED, SEAL)
    if key is None:
        return "not verified", finding(Code.SEAL_UNVERIFIED, SEAL, key=last.key)
    if key.name != last.key:
        return "not verified", finding(Code.SEAL_OTHER_KEY, SEAL, key=last.key, given=key.name)
    return "signed", finding(Code.SEAL_SIGNED, SEAL, key=last.key)
