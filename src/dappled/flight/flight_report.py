"""Report what is in a flight, which shots became frames, and how each source's capture requests ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dappled.findings import FRAME, Code, Finding, Subject, finding
from dappled.flight import layout
from dappled.flight.errors import FlightError
from dappled.flight.flight_mask import FlightMask
from dappled.flight.ledger import LedgerReader
from dappled.flight.records import (
    BEGAN,
    CUT_SHORT,
    DOUBT,
    ENDED,
    LATER_DOUBT,
    LOST,
    NOTICED,
    REFUSED,
    Frame,
    Judgement,
    LedgerEvent,
    Result,
    ShotRow,
    Stray,
    Tag,
)


@dataclass(frozen=True, slots=True)
class StoodFinding:
    """A finding of the service above a note, and from when to when it stood; None: until the recording ended, or where
    UTC was never known."""

    finding: Finding
    began_utc_ns: int | None
    ended_utc_ns: int | None


@dataclass(frozen=True, slots=True)
class Balance:
    """The numbers of a flight. Every shot (`wishes`) is safe, failed or open; `refused` requests became no shot, and
    neither did the autopilot's triggers in `lost_triggers` (one for each run of its numbers, `lost` in all).

    `by_source` counts shots, `following` the failed ones whose files are still on the camera, `companions` files beside
    frames. `began_utc_ns` is None where UTC was never known. `judged` counts frames by their verdict in flight (a frame
    without one is unknown; empty where none was judged), `bad` says of each bad one why, `unknown` of each unknown one.
    `doubts` says of each frame that may be another shot's why, `card` what happened to the camera's card, and what
    stays on it. `stood` is what the service found, above notes, in the order of its beginning. `cut_short` says what
    the numbers may lack, where the recording was not ended in order. `mask` says in how many decoded frames the mask is
    seen; None where none tells.
    """

    flight: str
    wishes: int
    safe: int
    failed: int
    open: int
    frames: int
    tagged: int
    decoded: int
    strays: int
    size: int
    by_source: Mapping[str, int]
    closed: bool
    refused: int = 0
    following: int = 0
    companions: int = 0
    began_utc_ns: int | None = None
    lost: int = 0
    lost_triggers: tuple[Finding, ...] = ()
    judged: Mapping[str, int] = field(default_factory=dict)
    bad: tuple[Finding, ...] = ()
    unknown: tuple[Finding, ...] = ()
    doubts: tuple[Finding, ...] = ()
    card: tuple[Finding, ...] = ()
    stood: tuple[StoodFinding, ...] = ()
    cut_short: Finding | None = None
    mask: Finding | None = None

    @property
    def balanced(self) -> bool:
        """Whether requests, frames and the autopilot's triggers add up; in a closed flight nothing is open."""
        settled = self.wishes == self.safe + self.failed + self.open and self.frames == self.safe
        within = self.tagged <= self.frames and self.decoded <= self.frames
        return settled and within and self.lost == 0 and (not self.closed or self.open == 0)


@dataclass(frozen=True, slots=True)
class ShotLine:
    """All that is known of one shot."""

    row: ShotRow
    frame: Frame | None
    tag: Tag | None
    result: Result | None


@dataclass(frozen=True, slots=True)
class FlightContents:
    """Everything in a flight: settings, facts, a line for every shot, strays and events. `utc_correction_ns` is to be
    added to every `utc_ns`; None where UTC was never known. `runs` counts the results of each run."""

    name: str
    settings: Mapping[str, Any]
    facts: Mapping[str, Any]
    lines: tuple[ShotLine, ...]
    strays: tuple[Stray, ...]
    events: tuple[LedgerEvent, ...]
    utc_correction_ns: int | None
    runs: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class ListedFlight:
    """One flight of a list: its balance, or a sentence that says why it can't be read."""

    name: str
    path: Path
    balance: Balance | None
    problem: Finding | None


def balance(path: Path) -> Balance:
    """The balance of a flight, also while it is recorded. Raises FlightError."""
    folder = layout.open_folder(path)
    with LedgerReader.open(folder.ledger) as ledger:
        shots, frames, facts = ledger.shots(), ledger.frames(), ledger.facts()
        correction_ns, began_utc_ns = ledger.utc_correction_ns(), ledger.began_utc_ns()
        cut_short = ledger.fact(dict[str, float], CUT_SHORT)
        results = ledger.results()
        judged = {index: found for index, one in results.items() if (found := one.verdict)}
        lost = ledger.found(LOST)
        states = Counter(row.state for row in shots)
        return Balance(
            flight=folder.name,
            wishes=len(shots),
            safe=states["safe"],
            failed=states["failed"],
            open=states["wished"] + states["fired"],
            frames=len(frames),
            tagged=len(ledger.tags()),
            decoded=len(results),
            strays=len(ledger.strays()),
            size=sum(frame.size for frame in frames),
            by_source=dict(sorted(Counter(row.shot.cause.source for row in shots).items())),
            closed="closed_utc_ns" in facts,
            following=len(ledger.following()),
            companions=len(ledger.companions()),
            refused=_refused(ledger).total(),
            lost=sum(one.number("triggers") for one in lost),
            lost_triggers=tuple(lost),
            began_utc_ns=None if correction_ns is None or began_utc_ns is None else began_utc_ns + correction_ns,
            judged=_by_verdict(judged, len(frames)),
            bad=_reasons("bad", judged, frames),
            unknown=_reasons("unknown", judged, frames),
            doubts=tuple(ledger.found(DOUBT, LATER_DOUBT)),
            card=tuple(ledger.found(NOTICED)),
            stood=_stood(ledger.events(), correction_ns),
            cut_short=None
            if cut_short is None
            else finding(
                Code.FLIGHT_CUT_SHORT,
                Subject("flight"),
                shots_s=cut_short.get("shots_s"),
                refusals_s=cut_short.get("refusals_s"),
            ),
            mask=_mask(results),
        )


def _mask(results: Mapping[int, Result]) -> Finding | None:
    """What a flight's results tell of its mask."""
    mask = FlightMask()
    for index, one in sorted(results.items()):
        mask.add(index, one.mask_nats)
    return mask.told


def _stood(events: Iterable[LedgerEvent], correction_ns: int | None) -> tuple[StoodFinding, ...]:
    """From when to when each finding of the service stood. One that rose goes on as what it has become."""
    stood: list[StoodFinding] = []
    lasting: dict[tuple[Code, Subject], int] = {}
    for event in events:
        if event.kind not in (BEGAN, ENDED) or (one := event.finding) is None:
            continue
        at_ns = None if correction_ns is None else event.utc_ns + correction_ns
        place = lasting.pop(one.kind, None) if event.kind == ENDED else lasting.get(one.kind)
        if event.kind == ENDED and place is not None:
            stood[place] = replace(stood[place], ended_utc_ns=at_ns)
        elif event.kind == BEGAN and place is not None:
            stood[place] = replace(stood[place], finding=one)
        elif event.kind == BEGAN:
            lasting[one.kind] = len(stood)
            stood.append(StoodFinding(one, at_ns, None))
    return tuple(stood)


def _reasons(wanted: str, judged: Mapping[int, Judgement], frames: Sequence[Frame]) -> tuple[Finding, ...]:
    """Why each frame has this verdict; none where the flight's frames were not judged."""
    if not judged:
        return ()
    none = Judgement("unknown", (finding(Code.FRAME_UNJUDGED, FRAME),))
    return tuple(
        replace(one, subject=Subject("frame", frame.index))
        for frame in frames
        if (found := judged.get(frame.index, none)).state == wanted
        for one in found.reasons
    )


def _by_verdict(judged: Mapping[int, Judgement], frames: int) -> dict[str, int]:
    """How many frames have each verdict; empty where the flight's frames were not judged."""
    if not judged:
        return {}
    states = Counter(one.state for one in judged.values())
    return {
        "good": states["good"],
        "usable": states["usable"],
        "bad": states["bad"],
        "unknown": frames - states["good"] - states["usable"] - states["bad"],
    }


def show(path: Path) -> FlightContents:
    """Everything in a flight's ledger. Raises FlightError."""
    folder = layout.open_folder(path)
    with LedgerReader.open(folder.ledger) as ledger:
        frames = {frame.index: frame for frame in ledger.frames()}
        tags, results = ledger.tags(), ledger.results()
        lines = tuple(
            ShotLine(row, frames.get(row.shot.index), tags.get(row.shot.index), results.get(row.shot.index))
            for row in ledger.shots()
        )
        return FlightContents(
            name=folder.name,
            settings=layout.read_facts(folder),
            facts=ledger.facts(),
            lines=lines,
            strays=tuple(ledger.strays()),
            events=tuple(ledger.events()),
            utc_correction_ns=ledger.utc_correction_ns(),
            runs=ledger.runs(),
        )


def list_flights(root: Path) -> list[ListedFlight]:
    """All flights under `root`, renamed ones too; one that can't be read is listed with the reason. Raises FlightError
    for no folder."""
    if not root.is_dir():
        raise FlightError(f"there is no flights folder {root}; check record.directory")
    listed = []
    for folder in layout.held_flights(root):
        try:
            listed.append(ListedFlight(folder.name, folder.path, balance(folder.path), None))
        except FlightError as error:
            why = finding(Code.FLIGHT_UNREADABLE, Subject("flight", folder.name), why=error)
            listed.append(ListedFlight(folder.name, folder.path, None, why))
    return listed


@dataclass(frozen=True, slots=True)
class SourceReport:
    """What became of one source's capture requests ("mavlink:1/1", "console" …).

    wishes (requests) = refused + shots; shots = safe + failed + open.
    """

    source: str
    wishes: int
    refused: int
    shots: int
    safe: int
    failed: int
    open: int
    tagged: int
    decoded: int


def by_source(path: Path) -> tuple[SourceReport, ...]:
    """A report for each source, by name. Raises FlightError."""
    with LedgerReader.open(layout.open_folder(path).ledger) as ledger:
        rows, tags, results = ledger.shots(), ledger.tags(), ledger.results()
        refused = _refused(ledger)
    counts: dict[str, Counter[str]] = {source: Counter(refused=count) for source, count in refused.items()}
    for row in rows:
        mine = counts.setdefault(row.shot.cause.source, Counter())
        mine["shots"] += 1
        mine[row.state if row.state in ("safe", "failed") else "open"] += 1
        mine["tagged"] += row.shot.index in tags
        mine["decoded"] += row.shot.index in results
    names = ("refused", "shots", "safe", "failed", "open", "tagged", "decoded")
    return tuple(
        SourceReport(source, mine["refused"] + mine["shots"], *(mine[name] for name in names))
        for source, mine in sorted(counts.items())
    )


def _refused(ledger: LedgerReader) -> Counter[str]:
    """Refused requests by source. A flood is one event with a count a minute."""
    found: Counter[str] = Counter()
    for one in ledger.found(REFUSED):
        found[str(one.subject.which)] += one.number("times")
    return found
