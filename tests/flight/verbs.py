"""The verbs that write into a closed or crashed flight, each on a small flight, for sweeps over power cuts and faults.

A place holds `flights/`, and where a verb needs them `disk/` (the destination of an offload) and `card/`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from dappled import durable
from dappled.clock import RecordedClock
from dappled.config import settings as configuration
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.replay import late_tags, pickup
from dappled.daemon.replay.pickup import Choice
from dappled.daemon.replay.runs import Run, RunWriter
from dappled.drivers.raw.recipe import Recipe
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.sources import parse_source
from dappled.flight import LedgerReader, Result, layout, offload, places, recording, seals
from dappled.flight.checks.flight_check import check
from dappled.products.geotags import geotags
from dappled.products.mounting import Mounting
from tests.flight.makers import deliver, mavlink_2, request, shot, tag, words_of
from tests.standing import failure

START_UTC_NS = 1_795_256_103_000_000_000
FRAME_BYTES = 20_000
Say = Callable[[str], object]  # told what a verb acknowledges while it runs
Promise = Mapping[str, str]  # "<flight>/frames/000000.cr2": SHA-256


@dataclass(frozen=True, slots=True)
class Verb:
    """`prepare` makes the place; `act` does what the command does; `settled` says what is wrong once it is through."""

    prepare: Callable[[Path], None]
    act: Callable[[Path, Say], None]
    settled: Callable[[Path], list[str]]


def clock() -> RecordedClock:
    return RecordedClock(START_UTC_NS)


def flights(place: Path) -> list[Path]:
    return [folder.path for folder in layout.flights(place / "flights")]


def flown(place: Path) -> list[Path]:
    """The flights with a shot: each start of a recorder has begun one without."""
    found = []
    for flight in flights(place):
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            found += [flight] if ledger.shots() else []
    return found


def promised(place: Path) -> dict[str, str]:
    """Every frame and stray that a ledger acknowledges, with its hash."""
    found: dict[str, str] = {}
    for flight in flights(place):
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            found |= {f"{flight.name}/{row.name}": row.sha256 for row in ledger.files()}
    return found


def lost(place: Path, promise: Promise) -> list[str]:
    """Acknowledged frames of which no copy is left."""
    return [name for name, sha256 in promise.items() if not any(_holds(path, sha256) for path in _copies(place, name))]


def _copies(place: Path, name: str) -> list[Path]:
    return [place / "flights" / name, place / "disk" / name]


def _holds(path: Path, sha256: str) -> bool:
    return path.is_file() and durable.hash_file(path) == sha256


def _recorded(place: Path, frames: int = 3) -> Path:
    flight = recording.begin(place / "flights", clock())
    for index in range(frames):
        request(flight, index)
        flight.telemetry.append(index, mavlink_2(b"x"))
        flight.ledger.add_tag(tag(deliver(flight, index, bytes([index + 1]) * FRAME_BYTES)))
    flight.close()
    return flight.folder.path


# offload


def _to_offload(place: Path) -> None:
    _recorded(place)
    (place / "disk").mkdir()


def _offloaded_before(place: Path) -> None:
    """The copy is there already: whole, and perhaps in memory only."""
    flight = _recorded(place)
    shutil.copytree(flight, place / "disk" / flight.name)


def _worked_on_at_the_copy(place: Path) -> None:
    """The copy is there already, and was geotagged there since."""
    _offloaded_before(place)
    (copy,) = layout.flights(place / "disk")
    with seals.work(copy, clock(), seals.Occasion.GEOTAG, "geotags flights in", None):
        geotags.write(copy.path, geotags.PlacedBy(Mounting()))


def _offload(place: Path, say: Say) -> None:
    places.file_system = lambda fd: "ext4"
    for flight in flown(place):
        offload.offload(flight, place / "disk", prune=True, same_device=True, clock=clock())


def _offload_settled(place: Path) -> list[str]:
    wrong = [f"{path} is left" for path in (place / "flights").glob("*/frames/*.cr2")]
    return wrong + _checked(place)


def _checked(place: Path) -> list[str]:
    every = [*flights(place), *(folder.path for folder in layout.flights(place / "disk"))]
    wrong = [text for flight in every for text in words_of(check(flight).problems)]
    return wrong + [f"{path} is left" for path in place.rglob("*.part")]


# pickup


def _to_pick_up(place: Path) -> None:
    flight = recording.begin(place / "flights", clock())
    for index in range(4):
        request(flight, index)
        if index < 2:
            flight.ledger.add_tag(tag(deliver(flight, index, bytes([index + 1]) * FRAME_BYTES)))
        else:
            flight.ledger.follows(index, failure("its file stays at the camera"))
    flight.close()
    (place / "card").mkdir()
    for index in (2, 3):
        (place / "card" / f"DSCF000{index}.RAF").write_bytes(bytes([index + 1]) * FRAME_BYTES)


def _pick_up(place: Path, say: Say) -> None:
    source = parse_source(str(place / "card"), PtpSource)
    for flight in flown(place):
        proposal = pickup.propose(flight, source, Choice(by_order=True))
        numbers = iter(proposal.pairs)

        def said(size: int, flight: Path = flight, numbers: object = numbers) -> None:
            index, group = next(numbers)  # type: ignore[call-overload]  # an iterator of pairs
            data = bytes([index + 1]) * FRAME_BYTES
            name = layout.frame_name(index, group.main.name)
            say(f"safe {flight.name}/{name} {hashlib.sha256(data).hexdigest()}")

        pickup.bring(flight, source, proposal, clock=clock(), progress=said)


def _picked_up(place: Path) -> list[str]:
    (flight,) = flown(place)
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        left = [f"shot {row.shot.index} is {row.state}" for row in ledger.shots() if row.state != "safe"]
    return left + _checked(place)


# geotag


def _to_tag(place: Path) -> None:
    _recorded(place)


def _geotag(place: Path, say: Say) -> None:
    for flight in flown(place):
        with seals.work(layout.open_folder(flight), clock(), seals.Occasion.GEOTAG, "geotags flights in", None):
            geotags.write(flight, geotags.PlacedBy(Mounting()))


def _geotagged(place: Path) -> list[str]:
    (flight,) = flown(place)
    sidecars = [f"{path.name} is cut off" for path in flight.glob("frames/*.xmp") if not _complete(path)]
    if len(list(flight.glob("frames/*.xmp"))) != 3 or not (flight / "geotags" / "track.geojson").is_file():
        sidecars.append("a sidecar or list is missing")
    return sidecars + _checked(place)


def _complete(sidecar: Path) -> bool:
    return sidecar.read_text().endswith('<?xpacket end="w"?>\n')


# late tags


def _untagged(place: Path) -> None:
    """Two of three frames lack a tag, as after a crash."""
    names = {"camera": "reference-36mm", "mask": "reference-5x5", "law": "geometric"}
    facts = {"settings": configuration.to_tables(configuration.Settings()), "names": names}
    flight = recording.begin(place / "flights", clock(), facts)
    for index in range(3):
        request(flight, index)
        flight.telemetry.append(index, mavlink_2(b"x"))
        frame = deliver(flight, index, bytes([index + 1]) * FRAME_BYTES)
        if index == 0:
            flight.ledger.add_tag(tag(frame))
    flight.close()


def _tag_late(place: Path, say: Say) -> None:
    """`dappled geotag` where tags are missing."""
    for flight in flown(place):
        late_tags.add_missing(flight, clock(), None)
    _geotag(place, say)


def _tagged_late(place: Path) -> list[str]:
    (flight,) = flown(place)
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        missing = [f"frame {frame.index} has no tag" for frame in ledger.frames() if ledger.tag(frame.index) is None]
    return missing + _checked(place)


# replay --run


def _run(place: Path, say: Say) -> None:
    """A run that was cut short keeps its name; the next one takes another."""
    recipe, names = Recipe(camera="reference-36mm", mask="reference-5x5"), Names("reference-36mm", "reference-5x5", "")
    for flight in flown(place):
        with LedgerReader.open(flight / "flight.sqlite") as ledger:
            number = sum(key.startswith("run:") for key in ledger.facts())
        with RunWriter(flight, Run(f"run-{number}", recipe, names), clock()) as writer:
            for index in range(3):
                writer.decoded(Result(index, f"{index:064x}", 12, 13, "geometric", "predicted"))


def _ran(place: Path) -> list[str]:
    (flight,) = flown(place)
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        whole = 3 in ledger.runs().values()
    return ([] if whole else ["no run has all results"]) + _checked(place)


# recovery


def _crashed(place: Path) -> None:
    """A safe frame, one without a row, a half-written one, a shot that only the journal has."""
    _recorded(place, 2)
    flight = recording.begin(place / "flights", clock())
    for index in range(2, 6):
        flight.journal.note(shot(index))
        if index < 5:
            flight.ledger.add_shot(shot(index))
            flight.ledger.fired(index, 10, 20)
    deliver(flight, 2, b"\3" * FRAME_BYTES)
    (flight.folder.frames / "000003.cr2").write_bytes(b"\4" * FRAME_BYTES)
    (flight.folder.frames / ".000004.cr2.part").write_bytes(b"\5" * 100)
    shutil.copytree(place / "flights", place / "killed")
    flight.close()
    shutil.rmtree(place / "flights")
    (place / "killed").rename(place / "flights")


def _recover(place: Path, say: Say) -> None:
    recording.begin(place / "flights", clock()).close()


VERBS = {
    "offload": Verb(_to_offload, _offload, _offload_settled),
    "offload of what is there already": Verb(_offloaded_before, _offload, _offload_settled),
    "offload after work at the copy": Verb(_worked_on_at_the_copy, _offload, _offload_settled),
    "pickup": Verb(_to_pick_up, _pick_up, _picked_up),
    "geotag": Verb(_to_tag, _geotag, _geotagged),
    "late tags": Verb(_untagged, _tag_late, _tagged_late),
    "replay --run": Verb(_to_tag, _run, _ran),
    "recovery": Verb(_crashed, _recover, _checked),
}


def run(name: str, place: Path) -> None:
    """Run a verb in a process of its own; what it acknowledges is written to its output."""
    VERBS[name].act(place, lambda text: os.write(1, text.encode()))
