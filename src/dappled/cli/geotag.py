"""`dappled geotag`: write where each frame was taken, for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli import paths, sealing
from dappled.cli.placing import Mounted, check_geoid
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Report, SettingsArgument, Verb, argument, flag, of_setting, option
from dappled.clock import TimeOfDayClock
from dappled.config.settings import PoseSettings
from dappled.decode.geometry import Vector3
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Code, Finding, Subject, above_note, finding
from dappled.shown import few

if not words_only:
    from dappled.daemon.replay import late_tags
    from dappled.daemon.replay.vehicle_choice import VehicleError
    from dappled.flight import Tag, layout, seals
    from dappled.flight.layout import LockHeldError
    from dappled.flight.seal_key import SealKey
    from dappled.products.geotags import geotags, marks
    from dappled.products.geotags.geotags import PlacedBy
    from dappled.products.maps import earth
    from dappled.products.maps.earth import EarthError, Geoid
    from dappled.products.mounting import Mounting


@dataclass(frozen=True, kw_only=True)
class MarkArguments(Mounted):
    """--pos and --mark-lever-arm."""

    pos: Path | None = option(
        "--pos", "positions of the camera's marks after PPK (*_events.pos of RTKLIB or Emlid Studio), in place of "
        "the autopilot's; of one FLIGHT", None, there=True,
    )  # fmt: skip
    mark_lever_arm: Vector3 | None = option(
        "--mark-lever-arm", "with --pos: its antenna to camera, metres forward, right, down", None,
        metavar=("F", "R", "D"), otherwise="the autopilot's lever arm",
    )  # fmt: skip

    def mark_arm(self, mounting: Mounting, output: Output) -> Vector3:
        """From the autopilot's antenna to that of the marks; says so where the two were taken to be one."""
        forward, right, down = mounting.lever_m
        if self.mark_lever_arm is None:
            arm = f"({forward:g}, {right:g}, {down:g}) m, as of the autopilot's antenna"
            output.remark(f"lever arm of the marks' antenna: {arm}; another is given with --mark-lever-arm")
            return (0.0, 0.0, 0.0)
        own = self.mark_lever_arm
        return (forward - own[0], right - own[1], down - own[2])


@dataclass(frozen=True, kw_only=True)
class TagFrames(SettingsArgument, Doubtable, MarkArguments, Verb):
    """Write positions and attitudes."""

    examples = (
        "dappled geotag ~/flights/20261121T101503Z-0a1b2c3d",
        "dappled geotag FLIGHT --pos rover_events.pos --mark-lever-arm 0.05 0 0.12",
    )
    notes = (
        "Writes name.ext.xmp beside each frame, and in geotags/\n"
        "geo.txt (OpenDroneMap), pix4d.csv and track.geojson.\n"
        "The frames themselves are not changed."
    )

    flight: Path = argument("FLIGHT", "flight folder", there=paths.flight)
    output: Path | None = option("-o --output", "write everything into this folder instead", None, metavar="DIR")
    lightroom: bool = flag("--lightroom", "name sidecars name.xmp instead of name.ext.xmp")
    force: bool = flag("--force", "replace sidecars that another program wrote")
    on_gimbal: bool | None = option(
        "--on-gimbal", of_setting(PoseSettings, "on_gimbal"), None, otherwise="the flight's",
    )  # fmt: skip
    geoid: str | None = option(
        "--geoid", "mean sea level above the ellipsoid: a grid, or metres", None, metavar="FILE|M",
        otherwise="PROJ's EGM grid, if installed",
    )  # fmt: skip
    copies: Path | None = option(
        "--copies", "also write copies of the frames with their position in EXIF", None, metavar="DIR",
    )  # fmt: skip
    vehicle: int | None = option(
        "--vehicle", "system id of the vehicle that carried the camera", None, metavar="SYSID", low=1, high=255,
        otherwise="the one that the flight followed",
    )  # fmt: skip

    def check(self) -> None:
        self.check_mounted()
        check_geoid(self.geoid)
        if self.mark_lever_arm is not None and self.pos is None:
            raise CallError("--mark-lever-arm goes with --pos: leave it out, or give the positions of the marks")

    def run(self, output: Output) -> Report:
        facts = layout.read_facts(layout.open_folder(self.flight))
        key = sealing.key_of(self.config)
        into_flight = self.output is None
        try:
            tagged_late = _tag_late(self.flight, key, self.vehicle, output, into_flight=into_flight)
            tags, found = self._vehicle()
        except VehicleError as error:
            raise CallError(str(error)) from None
        mounting, geoid = self.mounting(facts), geoid_or_none(self.geoid, output)
        marked = None
        if self.pos:
            marked = marks.find(self.flight, self.pos, geoid, self.mark_arm(mounting, output))
        by = PlacedBy(mounting, geoid, marked, tags)
        folder = layout.open_folder(self.flight)
        clock = TimeOfDayClock()
        work = seals.work(folder, clock, seals.Occasion.GEOTAG, "geotags flights in", key)
        with work if into_flight else nullcontext():
            written = geotags.write(
                self.flight, by, output=self.output, replace_extension=self.lightroom, force=self.force
            )
        made = {}
        if self.copies:
            with output.bar(None, "frame") as add:
                for name, copy in geotags.copies(self.flight, self.copies, by):
                    made[name] = copy
                    add(1)
        copied = [str(path) for path in made.values() if isinstance(path, Path)]
        found = [*found, *geotags.doubts(self.flight), *(marked.doubts if marked else ())]
        without_copy = {name: reason for name, reason in made.items() if isinstance(reason, str)}
        for text in marks.sentences(marked) if marked else ():
            output.remark(text)
        told = {*written.without_position, *written.without_tag}
        for said in (
            few(f"no position is known for {name}" for name in written.without_position),
            few(f"{name} was never tagged" for name in written.without_tag),
            few(f"no copy of {name}: {reason}" for name, reason in without_copy.items() if name not in told),
        ):
            for text in said:
                output.remark(text)
        values = {
            "files": [str(path) for path in written.files],
            "placed": written.placed,
            "without_position": written.without_position,
            "without_tag": written.without_tag,
            "tagged_late": tagged_late,
            "copies": copied,
            "without_copy": without_copy,
            "geoid": geoid.name if geoid else None,
            "doubts": codec.plain(above_note(found)),
            "marks": _marks_json(marked) if marked else None,
        }
        words = f"{counted(written.placed, 'frame')} placed, {counted(len(written.files), 'file')} written"
        if folders := dict.fromkeys(str(path.parent) for path in written.files):
            words += f" to {' and '.join(folders)}"
        if self.copies:
            words += f", {len(copied)} {'copy' if len(copied) == 1 else 'copies'} with EXIF"
        return Report(values, [words], findings=found)

    def mounting(self, facts: Mapping[str, Any]) -> Mounting:
        """The flight's mounting, with the values that the arguments replace."""
        made = super().mounting(facts)
        return made if self.on_gimbal is None else replace(made, on_gimbal=self.on_gimbal)

    def _vehicle(self) -> tuple[dict[int, Tag] | None, list[Finding]]:
        """The tags by another vehicle than the flight followed, where one is named or evidence says so, and what was
        found."""
        try:
            return late_tags.by_vehicle(self.flight, self.vehicle)
        except VehicleError as error:
            if self.vehicle is not None:
                raise
            return None, [finding(Code.FLIGHT_VEHICLE_UNDECIDED, Subject("flight"), why=error)]


def _tag_late(
    flight: Path, key: SealKey | None, vehicle: int | None, output: Output, *, into_flight: bool
) -> list[int]:
    """Tag the frames that a crash left untagged. If that fails, print why, and go on with the others. Raises
    LockHeldError, which no sidecar could be written under either, and VehicleError where one was named."""
    try:
        added = late_tags.add_missing(flight, TimeOfDayClock(), key, vehicle)
    except DappledError as error:
        if (into_flight and isinstance(error, LockHeldError)) or (vehicle and isinstance(error, VehicleError)):
            raise
        output.remark(f"frames without a tag stay without one: {error}")
        return []
    if added:
        output.remark(f"tagged {counted(len(added), 'frame')} that the recording had left without a tag")
    return added


def _marks_json(marked: marks.Marked) -> dict[str, Any]:
    return {
        "placed": sorted(marked.marks),
        "lost": list(marked.lost),
        "extra": codec.plain(marked.extra),
        "doubts": codec.plain(marked.doubts),
        "offset_s": marked.offset_s,
        "spread_s": marked.spread_s,
        "shift_m": None if marked.shift_m is None else dict(zip(("north", "east", "up"), marked.shift_m, strict=True)),
    }


def geoid_or_none(given: str | None, output: Output) -> Geoid | None:
    """The geoid that was named, or one of this machine's; None where it has none. Raises EarthError."""
    try:
        return earth.geoid(given)
    except EarthError as error:
        if given is not None:
            raise
        output.remark(f"heights stay above mean sea level: {error}")
        return None
