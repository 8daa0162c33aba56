"""Records and bytes for tests, with nothing left to chance."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dappled.clock import SystemClock
from dappled.decode.geometry import Pose
from dappled.drivers.camera import Blob
from dappled.drivers.gphoto2.intake import Intake
from dappled.findings import Code, Finding, Subject, finding, text
from dappled.flight import Cause, Frame, Recording, Shot, Tag, TimeSource

CARD_FULL = finding(Code.BODY_CARD_FULL, Subject("card"))  # some event of a ledger


@dataclass(frozen=True, slots=True)
class Held:
    """Bytes behind a descriptor; `size` may lie."""

    fd: int
    size: int
    sha256: str | None = None


@contextmanager
def held(data: bytes, size: int | None = None) -> Iterator[Held]:
    fd = os.memfd_create("test")
    try:
        os.write(fd, data)
        yield Held(fd, len(data) if size is None else size)
    finally:
        os.close(fd)


def shot(index: int = 0, source: str = "mavlink:255/190", sequence: int | None = 7) -> Shot:
    return Shot(index, Cause(source, "IMAGE_START_CAPTURE", sequence), 1_000 + index, 2_000 + index)


def request(flight: Recording, index: int) -> None:
    """One capture request, up to a fired shot."""
    flight.journal.note(shot(index))
    flight.ledger.add_shot(shot(index))
    flight.ledger.fired(index, 10, 20)


def deliver(flight: Recording, index: int, data: bytes, name: str = "IMG_0001.CR2") -> Frame:
    with held(data) as blob:
        return flight.recorder.record(index, name, blob, arrived_utc_ns=5)


class PatientClock(SystemClock):
    """Lets a busy machine take its time."""

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        return super().wait(event, 60 * timeout_s)


def come(intake: Intake, data: bytes) -> Blob:
    """A camera's file, as the camera's process receives it."""

    def read(into: memoryview) -> int:
        piece = data[coming.size : coming.size + len(into)]
        into[: len(piece)] = piece
        return len(piece)

    with intake.begin(len(data)) as coming:
        while coming.size < len(data):
            coming.take(len(data) - coming.size, read)
        return coming.finish()


def deliver_straight(flight: Recording, index: int, data: bytes, name: str = "IMG_0001.CR2") -> Frame:
    """As `deliver`, of a file that was written to the flight's disk while it came."""
    intake = Intake(PatientClock())
    intake.folder = flight.folder.frames
    blob = come(intake, data)
    try:
        return flight.recorder.record(index, name, blob, arrived_utc_ns=5)
    finally:
        blob.close()


def pose(packets: int = 3) -> Pose:
    return Pose(
        source="interpolated",
        utc_ns=1_795_256_103_123_456_789,
        boot_us=12_000_000,
        latitude_rad=0.7266,
        longitude_rad=-1.5977,
        altitude_msl_m=215.1,
        height_above_home_m=12.1,
        velocity_ned_m_s=(1.0, -2.0, 0.1),
        attitude=(0.1, 0.2, 0.3, 0.9273618495495704),
        position_sigma_m=None,
        attitude_sigma_rad=1e-17,
        age_ms=3.25,
        telemetry_packets=packets,
    )


def tag(frame: Frame) -> Tag:
    return Tag(
        frame.index,
        9,
        10,
        TimeSource.TRIGGER_CALL,
        146.0,
        5.6,
        0.0005,
        None,
        "canon-eos-450d",
        "mask-1",
        frame.sha256,
        pose(),
    )


def hot_shoe_tag(frame: Frame, at: Pose, f_number: float = 14.8) -> Tag:
    """Of a frame of the simulated reference camera, timed by its hot shoe."""
    lens, body = (50.0, f_number, 0.001, 100.0), ("reference-36mm", "reference-5x5")
    return Tag(frame.index, at.utc_ns, 10_000, TimeSource.HOT_SHOE, *lens, *body, frame.sha256, at)


def mavlink_1(payload: bytes, sequence: int = 0) -> bytes:
    """A MAVLink 1 packet by its framing (the checksum is not looked at)."""
    return bytes((0xFE, len(payload), sequence, 1, 1, 30)) + payload + b"\x12\x34"


def mavlink_2(payload: bytes, sequence: int = 0, *, signed: bool = False) -> bytes:
    head = bytes((0xFD, len(payload), 1 if signed else 0, 0, sequence, 1, 1, 30, 0, 0))
    return head + payload + b"\x12\x34" + (b"s" * 13 if signed else b"")


def logged(stamp_us: int, packet: bytes) -> bytes:
    return struct.pack(">Q", stamp_us) + packet


def flip(path: Path, at: int) -> None:
    """Change one byte of a file."""
    data = bytearray(path.read_bytes())
    data[at] ^= 0x01
    path.write_bytes(data)


def words_of(found: Iterable[Finding]) -> tuple[str, ...]:
    """What a check found, as a person reads it."""
    return tuple(str(text(one)) for one in found)
