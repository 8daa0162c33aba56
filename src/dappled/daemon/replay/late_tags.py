"""Tag the frames that a crash left safe but without a tag: replay the flight, undecoded.

Trigger calls, telemetry and frames are all in the record, so the tag is the one that a replay makes.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from dappled.clock import Clock
from dappled.config import settings as configuration
from dappled.daemon.navigation import BodyLatency, ExposureTime, recorded_doubt, recorded_vehicles
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.replay import playback, replay
from dappled.daemon.replay.playback import FlownWith
from dappled.daemon.replay.replay import RecordedFlight, RecordedTelemetry, ReplayProgress
from dappled.daemon.replay.vehicle_choice import VehicleError, vehicle_of
from dappled.daemon.replay.verifier import ReplayVerifier
from dappled.drivers.camera import Blob
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, finding
from dappled.flight import FlightFolder, Frame, Ledger, LedgerReader, Tag, is_closed, layout, seals
from dappled.flight.seal_key import SealKey


class MissingTagWriter(ReplayVerifier):
    """Writes the tags that the ledger lacks and the events of their frames; all others stay as they are."""

    def __init__(self, recording: RecordedFlight, ledger: Ledger) -> None:
        super().__init__(recording.root, recording.expected)
        self._ledger = ledger
        self.added: list[int] = []

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe; when this returns it is. `flight check` verifies the bytes."""
        frame = None if index is None else self.frame(index)
        if frame is None:
            raise DappledError(f"{name} belongs to no recorded frame")
        return frame

    def tagged(self, tag: Tag) -> None:
        super().tagged(tag)
        if self._lacks(tag.index):
            self._ledger.add_tag(tag)
            self.added.append(tag.index)

    def event(self, kind: str, found: Finding, index: int | None = None) -> None:
        if index is not None and self._lacks(index) and kind not in self._expected[index].events:
            self._ledger.add_event(kind, found, index)

    def _lacks(self, index: int) -> bool:
        one = self._expected[index]
        return one.frame is not None and one.tag_sha256 is None


def add_missing(flight: Path, clock: Clock, key: SealKey | None, vehicle: int | None = None) -> list[int]:
    """Tag the frames of a closed flight that have no tag; their image indices. `key` signs the seal after it. By the
    telemetry of `vehicle` (its system id), where one is given.

    Raises DappledError where that can't be done now: a flight that is still recorded, a record that can't be written.
    """
    folder = layout.open_folder(flight)
    if not _untagged(folder):
        return []
    if not is_closed(folder.ledger):
        raise DappledError(f"{flight} is still being recorded, or was never closed: the next `dappled run` repairs it")
    facts = layout.read_facts(folder)
    if "settings" not in facts or "names" not in facts:
        raise DappledError(f"{folder.settings} lacks the settings that the flight was flown with")
    settings = configuration.of_tables(facts["settings"], str(folder.settings))
    flown = FlownWith(Names(**facts["names"]), BodyLatency.of(settings.camera), settings)
    with ExitStack() as stack:
        stack.enter_context(seals.work(folder, clock, seals.Occasion.LATE_TAGS, "tags frames in", key))
        last = max(_untagged(folder), default=-1)  # another process may have tagged them meanwhile
        recording = replay.of_flight(flight)
        followed = {system for _, system in recording.vehicles}
        if followed != {vehicle} and not (followed and vehicle is None):
            vehicle, _ = _logged(folder, vehicle)
        if vehicle is not None:
            recording = replace(recording, vehicles=[(0, vehicle)])
        recording = replace(recording, shots=[shot for shot in recording.shots if shot.index <= last])
        ledger = stack.enter_context(Ledger(folder.ledger, clock))
        writer = MissingTagWriter(recording, ledger)
        playback.run(recording, writer, ReplayProgress(), flown)
        for index in writer.added:
            ledger.add_event("tagged late", finding(Code.FRAME_TAGGED_LATE, FRAME), index)
    return writer.added


def by_vehicle(flight: Path, wanted: int | None) -> tuple[dict[int, Tag] | None, list[Finding]]:
    """A flight's tags with the positions of the vehicle that is `wanted`, and what is to be said of it; None where the
    tags are of that vehicle. Where the flight never knew whose the camera was, evidence decides (see `vehicle_of`).

    Raises VehicleError and FlightError.
    """
    folder = layout.open_folder(flight)
    with LedgerReader.open(folder.ledger) as reader:
        followed, tags = {system for _, system in recorded_vehicles(reader)}, reader.tags()
        doubt = recorded_doubt(reader)
    if followed == {wanted} or (followed and wanted is None):
        return None, []
    system, told = _logged(folder, wanted)
    if system is None or (wanted is None and not told):
        return None, []
    facts = layout.read_facts(folder)
    settings = configuration.of_tables(facts.get("settings", {}), str(folder.settings))
    telemetry = RecordedTelemetry(settings, folder.telemetry, {}, [(0, system)], doubt=doubt)
    made = {}
    for tag in sorted(tags.values(), key=lambda one: one.utc_ns):
        exposure = ExposureTime(tag.utc_ns, tag.utc_sigma_ns, tag.time_source)
        made[tag.index] = replace(tag, pose=telemetry.pose(tag.index, exposure)[1])
    return made, told


def _logged(folder: FlightFolder, wanted: int | None) -> tuple[int | None, list[Finding]]:
    """The vehicle that carried the camera; None without telemetry. Raises VehicleError and FlightError."""
    if folder.telemetry.is_file():
        return vehicle_of(folder.telemetry, wanted)
    if wanted is None:
        return None, []
    raise VehicleError(
        f"{folder.telemetry} is missing, so there are no positions of vehicle {wanted}: leave out --vehicle"
    )


def _untagged(folder: FlightFolder) -> set[int]:
    """The image indices of the frames that have no tag. Raises FlightError."""
    with LedgerReader.open(folder.ledger) as reader:
        return {frame.index for frame in reader.frames()} - reader.tags().keys()
