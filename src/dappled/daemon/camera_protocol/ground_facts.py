"""What a ground station asks the camera component for: which camera, how much room, what became of an image."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dappled
from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.component import CameraFacts, Captured, Storage
from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.drivers.camera import Identity
from dappled.errors import DappledError, report
from dappled.flight import ImageIndex, LedgerReader, layout

log = logging.getLogger(__name__)
Chip = dict[str, Any]


def of_story(pending: PendingShot, utc_ns: Callable[[int], int | None]) -> Captured:
    """The 263 of a shot that has just been tagged, or has failed. `utc_ns` puts a machine's time right, where that is
    known."""
    index = pending.shot.index
    if pending.tag is not None and pending.frame is not None:
        return Captured(index, True, utc_ns(pending.tag.utc_ns), pending.tag.pose, pending.frame.name)
    if pending.where is not None:  # exposed; its file stays at the camera for now
        exposure, pose = pending.where
        return Captured(index, True, utc_ns(exposure.utc_ns), pose)
    return Captured(index, pending.frame is not None, url=pending.frame.name if pending.frame else "")


def of_record(index: int, images: ImageIndex) -> Captured | None:
    """The 263 of any recorded image, of earlier flights too; None where it is unknown or not settled."""
    try:
        entry = images.lookup(index)
        if entry is None or entry.state not in ("safe", "failed"):
            return None
        with LedgerReader.open(layout.FlightFolder(images.root / entry.flight).ledger) as ledger:
            tag = ledger.tag(index)
            ok = entry.state == "safe" or index in ledger.following()
            correction_ns = ledger.utc_correction_ns()
    except DappledError as error:  # such as an old flight that was moved away
        report(log, f"image {index} can't be looked up", error)
        return None
    if tag is None:
        return Captured(index, ok, url=entry.frame or "")
    utc_ns = None if correction_ns is None else tag.utc_ns + correction_ns
    return Captured(index, ok, utc_ns, tag.pose, entry.frame or "")


def camera(who: Identity | None, focal_length_mm: float | None, chip: Chip) -> CameraFacts:
    """CAMERA_INFORMATION's facts."""
    major, minor, patch = (int(part) for part in dappled.__version__.split(".")[:3])
    return CameraFacts(
        vendor=who.make if who else "dappled",
        model=who.model if who else "masked camera",
        firmware=(major, minor, patch),
        focal_length_mm=focal_length_mm,
        **chip,
    )


def chip(settings: Settings, model: str) -> Chip:
    """Sensor size and pixels of the camera, for CAMERA_INFORMATION; nothing where they aren't known."""
    name = settings.camera.profile
    try:
        profile = profiles.camera_for_model(model) if name == "auto" else profiles.camera(name)
    except DappledError:
        profile = None
    if profile is None:
        return {}
    sensor = profile.raw[0].sensor
    height_mm, width_mm = sensor.size_mm
    return {
        "sensor_width_mm": width_mm,
        "sensor_height_mm": height_mm,
        "columns": sensor.shape[1],
        "rows": sensor.shape[0],
    }


def storage(folder: Path) -> Storage | None:
    """STORAGE_INFORMATION's facts; None where the disk doesn't say."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return None
    return Storage(usage.total, usage.used, usage.free)
