"""A Fujifilm FinePix S5200 as dappled meets it: a contact that fires it, a card that it writes RAF files on, and USB
mass storage, where that card appears when the body is connected. It knows no command and answers none.
"""

from __future__ import annotations

import io
import os
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from gpiod.line import Value
from PIL import Image


@dataclass(slots=True)
class FinePix:
    """The body. `folder` holds its card, unmounted, and a mount table that says where it is when it is `plug`ged in.

    `clock_offset_s`: how far its clock is wrong. `write_s`: how long a frame takes to be written; a contact that closes
    meanwhile is not seen. `misses`: exposures (by number, from 1) that it doesn't make though the contact closes.
    """

    folder: Path
    clock_offset_s: float = 0.0
    write_s: float = 0.05
    focal_length_mm: float = 6.3
    misses: frozenset[int] = frozenset()
    wall_s: Callable[[], float] = time.time
    pressed: int = 0
    made: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _busy_until_s: float = 0.0
    _writer: threading.Thread | None = None
    _stuck: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        (self.folder / "card" / "DCIM" / "100_FUJI").mkdir(parents=True, exist_ok=True)
        (self.folder / "media").mkdir(exist_ok=True)
        self.mounts.write_text("")

    @property
    def mounts(self) -> Path:
        """What /proc/self/mounts would be."""
        return self.folder / "mounts"

    @property
    def places(self) -> tuple[str, ...]:
        """Where removable disks are mounted."""
        return (f"{self.folder}/media/",)

    @property
    def card(self) -> Path:
        """The card as a reader would mount it."""
        return self.folder / "card"

    def plug(self) -> None:
        """The body appears as mass storage."""
        os.symlink(self.card, self.folder / "media" / "FINEPIX")
        self.mounts.write_text(f"/dev/sdb1 {self.folder}/media/FINEPIX vfat rw 0 0\n")

    def unplug(self) -> None:
        """It is gone."""
        self.mounts.write_text("")
        (self.folder / "media" / "FINEPIX").unlink(missing_ok=True)

    def contact(self, closed: bool) -> None:
        """The shutter contact: an exposure begins when it closes."""
        if not closed:
            return
        with self._lock:
            self.pressed += 1
            now_s = time.monotonic()
            if now_s < self._busy_until_s or self.pressed in self.misses:
                return
            self._busy_until_s = now_s + self.write_s
            self.made += 1
            work = [self.made, self.wall_s(), self._writer]
            self._writer = threading.Thread(target=self._write, args=work, name="finepix", daemon=True)
            self._writer.start()

    def _write(self, number: int, taken_s: float, before: threading.Thread | None) -> None:
        """Frames reach the card in the order of their exposures."""
        if before is not None:
            before.join()
        data = picture(number, self.focal_length_mm, taken_s + self.clock_offset_s)
        target = self.card / "DCIM" / "100_FUJI" / f"DSCF{number:04d}.RAF"
        part = target.with_name(f".{target.name}")
        part.write_bytes(data)
        part.rename(target)

    def request(self, chip: str, line: int, active_low: bool) -> Contact:
        """In place of `shutter_line.request_output`: a GPIO line whose wire ends at this body's contact."""
        if self._stuck.is_set():
            raise OSError(16, os.strerror(16), chip)
        return Contact(self, line, active_low)

    def hold_line(self, held: bool) -> None:
        """Another program holds the GPIO line, or lets go of it."""
        (self._stuck.set if held else self._stuck.clear)()


@dataclass(slots=True)
class Contact:
    """A requested GPIO line, as `gpiod.LineRequest` has it. libgpiod turns the level for active-low lines."""

    body: FinePix
    line: int
    active_low: bool
    levels: list[bool] = field(default_factory=list)

    def set_value(self, line: int | str, value: Value) -> None:
        """See gpiod."""
        if line != self.line:
            raise ValueError(f"line {line} was not requested")
        self.levels.append(value == Value.ACTIVE)
        self.body.contact(value == Value.ACTIVE)

    def release(self) -> None:
        """See gpiod."""


def picture(number: int, focal_length_mm: float, taken_s: float) -> bytes:
    """The RAF of the exposure with this number."""
    return raf(
        struct.pack("<I", number) * 4096,
        taken=time.strftime("%Y:%m:%d %H:%M:%S", time.gmtime(taken_s)),
        focal_length_mm=focal_length_mm,
    )


_HEADER = 160
_MAKE, _MODEL, _EXIF = 0x010F, 0x0110, 0x8769
_F_NUMBER, _ISO, _TAKEN, _EXPOSURE, _FOCAL = 0x829D, 0x8827, 0x9003, 0x829A, 0x920A


def raf(
    sensor: bytes,
    *,
    taken: str,
    focal_length_mm: float,
    model: str = "FinePix S5200",
    f_number: float = 3.2,
    exposure_s: float = 1 / 500,
) -> bytes:
    """A RAF of these sensor bytes. `taken` is EXIF's "2026:11:21 10:15:03". Layout: dcraw's parse_fuji."""
    exif = Image.Exif()
    exif[_MAKE], exif[_MODEL] = "FUJIFILM", model
    exif.get_ifd(_EXIF).update(
        {_F_NUMBER: f_number, _ISO: 64, _TAKEN: taken, _EXPOSURE: exposure_s, _FOCAL: focal_length_mm}
    )
    file = io.BytesIO()
    Image.new("L", (16, 12), 128).save(file, "JPEG", exif=exif)
    jpeg = file.getvalue()
    head = b"FUJIFILMCCD-RAW 0201FF389501" + model.encode("ascii")[:31].ljust(32, b"\0")
    at = _HEADER + len(jpeg)
    offsets = struct.pack(">IIIIII", _HEADER, len(jpeg), at, 0, at, len(sensor))
    return head.ljust(84, b"\0") + offsets.ljust(_HEADER - 84, b"\0") + jpeg + sensor
