"""Compare the files of a flight with its newest seal, and say what the seals vouch for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dappled import durable
from dappled.errors import counted
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import layout, provenance, seals
from dappled.flight.chain import ChainLink
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader
from dappled.flight.seal_key import SealKey
from dappled.flight.seals import Seal

Vouched = Literal["signed", "not verified", "not signed", "not sealed"]
SEAL = Subject("seal")


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
    """What the seals show. `verdict` says what they vouch for where nothing is wrong; `unsealed` counts the links of
    the chain after the newest seal."""

    vouched: Vouched
    verdict: Finding
    problems: tuple[str, ...]
    notes: tuple[str, ...]
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
    problems = [*file.problems, *_numbers(file.seals, links, facts), *_heads(file.seals, links, facts)]
    problems += [*_signatures(file.seals, key), *_rewritten(file.seals)]
    notes = [f"seal {number} was never written: its work was interrupted" for number in seals.announced(facts)[1]]
    notes += [
        f"seal {number} was signed later, by hand (flight seal): what stands in the flight since an earlier time, key "
        f"{seal.key} vouches for from then on"
        for number, seal in file.seals.items()
        if seal.why == seals.BY_OWNER
    ]
    notes += [event.text for event in ledger.events() if event.kind == seals.CHANGED]
    last = file.last
    if last is None:
        return SealFindings("not sealed", finding(Code.SEAL_NONE, SEAL), tuple(problems), tuple(notes))
    unsealed = max(0, len(links) - last.links)
    if unsealed:
        notes.append(
            f"the flight was opened again after seal {last.seal} ({last.why}): {counted(unsealed, 'link')} "
            "of the chain and the files written since are not sealed yet"
        )
    for wrong, text in _files(folder, last, _vouched_by_ledger(ledger, facts), unsealed=unsealed > 0):
        (problems if wrong else notes).append(text)
    if not unsealed:
        problems += _ledger_file(last, before)
    vouched, verdict = _verdict(file.seals, last, key, unsealed)
    return SealFindings(vouched, verdict, tuple(problems), tuple(notes), unsealed)


def _numbers(found: Mapping[int, Seal], links: Mapping[int, ChainLink], facts: Mapping[str, Any]) -> Iterator[str]:
    """Seals that the ledger tells of and that are not there, and the other way round."""
    count, missing = seals.announced(facts)
    if count > len(links):  # each seal begins with a link
        yield f"the ledger tells of {count} seals, and its chain has only {counted(len(links), 'link')}"
        return
    for number in sorted(set(range(1, count + 1)) - missing - found.keys()):
        yield (
            f"seal {number} is missing from seals.jsonl: it was cut off, or its work was interrupted; that work "
            "(dappled run, geotag, flight pickup) seals the flight again"
        )
    for number in sorted(found.keys() - set(range(1, count + 1))):
        yield f"the ledger does not tell of seal {number}"


def _heads(found: Mapping[int, Seal], links: Mapping[int, ChainLink], facts: Mapping[str, Any]) -> Iterator[str]:
    """Seals that contradict the chain."""
    for number, seal in found.items():
        if seal.flight != seals.of_flight(facts):
            yield f"seal {number} is of another flight: {seal.flight}"
        link = links.get(seal.links)
        if link is None or link.link != seal.head:
            yield f"seal {number} contradicts the chain: link {seal.links} is another one, or is missing"


def _signatures(found: Mapping[int, Seal], key: SealKey | None) -> Iterator[str]:
    for number, seal in found.items():
        if (seal.key is None) != (seal.mac is None):
            yield f"seal {number} is signed in part"
        elif key is not None and seal.key == key.name and not key.signed(seal.signed_part(), seal.mac or ""):
            yield f"the signature of seal {number} is wrong: key {key.name} did not make it"


def _rewritten(found: Mapping[int, Seal]) -> Iterator[str]:
    """What was recorded never changes from one seal to the next, whoever made that one."""
    first: dict[str, tuple[int, tuple[int, str]]] = {}
    for number, seal in sorted(found.items()):
        for name, digest in seal.files.items():
            if not seals.never_changes(name):
                continue
            before, was = first.setdefault(name, (number, digest))
            if was != digest:
                yield f"seal {number} holds another digest of {name} than seal {before}: it was changed in between"


def _vouched_by_ledger(ledger: LedgerReader, facts: Mapping[str, Any]) -> dict[str, tuple[int | None, str]]:
    """Digests of the files that are compared with the ledger elsewhere; the ledger has no size of some."""
    known: dict[str, tuple[int | None, str]] = dict(seals.recorded_files(ledger))
    return known | {name: (None, hashes[0]) for name, hashes in provenance.noted(facts).items() if len(hashes) == 1}


def _files(
    folder: FlightFolder, last: Seal, known: Mapping[str, tuple[int | None, str]], *, unsealed: bool
) -> Iterator[tuple[bool, str]]:
    """(whether that is wrong, sentence) of files that are not those which the newest seal covers. Where work was not
    sealed, only what was recorded can't be the work's."""
    for name, (size, sha256) in last.files.items():
        if name in known and known[name] not in ((size, sha256), (None, sha256)):
            yield (
                not unsealed or seals.never_changes(name),
                f"seal {last.seal} and the ledger hold different digests of {name}",
            )
    for name, what in seals.differing(folder, last, {*known, folder.ledger.name}):
        if name in known or name == folder.ledger.name:
            continue
        wrong = not unsealed or seals.never_changes(name)
        if isinstance(what, OSError):
            yield wrong, f"{name} can't be read: {what.strerror}"
        elif what == "missing":
            yield wrong, f"{name} is missing: seal {last.seal} covers it"
        elif what == "changed":
            yield wrong, f"{name} was changed since seal {last.seal}"
        elif name.startswith("inputs/"):
            yield not unsealed, f"{name} was added since seal {last.seal}"
        elif not name.startswith("frames/") or name.endswith(layout.SIDECAR):  # other frames are missed in the ledger
            yield False, f"{name} was added since seal {last.seal}: no seal covers it"


def _ledger_file(last: Seal, before: LedgerBytes) -> Iterator[str]:
    """The ledger's bytes, free pages too; its rows are compared with the chain."""
    if before.wal_size:
        yield f"flight.sqlite-wal holds {counted(before.wal_size, 'byte')} that no seal covers"
    if last.files.get("flight.sqlite") != (before.size, before.sha256):
        yield f"flight.sqlite was changed since seal {last.seal}: its SHA-256 is not the seal's"


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
