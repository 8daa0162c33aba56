"""Sources of the files that a camera keeps: a folder or card, or a removable disk when it appears.

A source lists and opens files; it never writes. Settings and commands name it as a folder's path or `folder:DIR`, as
`storage` (the removable disk with a DCIM folder), or as a libgphoto2 port (`usb:`, `ptpip:…`; see `ptp_source`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dappled import durable, picture_order
from dappled.drivers.camera import Blob, CameraError
from dappled.drivers.raw.raw_file import read_exif
from dappled.drivers.wired.matching import seconds

RAW_SUFFIXES = (".raf", ".cr2", ".dng", ".nef", ".arw", ".crw", ".tif", ".tiff", ".npy", ".png")
SUFFIXES = (*RAW_SUFFIXES, ".jpg", ".jpeg")
MOUNTS = Path("/proc/self/mounts")
VOLUMES = Path("/dev/disk/by-uuid")
PLACES = ("/media/", "/run/media/", "/mnt")
_MANY = 100_000


@dataclass(frozen=True, slots=True)
class FoundFile:
    """A file at a source: its name there (with folders), and its size in bytes.

    `modified_ns` is the body's own time of it, `card` the id of the volume that it lies on ("" where that is unknown).
    Before its bytes are there, these four together are its identity.
    """

    name: str
    size: int
    modified_ns: int = 0
    card: str = ""

    @property
    def base(self) -> str:
        """The camera's own name for it."""
        return self.name.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The part of the name that raw file and JPEG of one exposure share."""
        return self.name.rpartition(".")[0]

    @property
    def raw(self) -> bool:
        """Whether it is a raw file, by its name."""
        return self.name.lower().endswith(RAW_SUFFIXES)


class FileSource(Protocol):
    """Files that can be picked up. A call may block for as long as a disk or a bus does, but not for ever.

    `removable`: they lie on a card or a disk, which can be changed for another.
    """

    @property
    def removable(self) -> bool: ...

    def list(self) -> list[FoundFile]:
        """List all pictures in the order of their names. Raises CameraError where the source is not there."""

    def taken_s(self, found: FoundFile) -> float | None:
        """Return the camera's time of a file, as if it were UTC; None where it has none. Raises CameraError."""

    def open(self, found: FoundFile) -> Blob:
        """Open its bytes. Raises CameraError."""

    def close(self) -> None:
        """Close the source."""


@dataclass(frozen=True, slots=True)
class FileGroup:
    """The files of one exposure: the frame, and what stands beside it."""

    main: FoundFile
    companions: tuple[FoundFile, ...] = ()


def volume_id(device: int) -> str:
    """The id of the file system on a device, such as a card's serial number; "" where the machine names none."""
    try:
        for link in VOLUMES.iterdir():
            if link.stat().st_rdev == device:
                return link.name
    except OSError:
        return ""
    return ""


def groups(found: list[FoundFile]) -> list[FileGroup]:
    """Group files by stem: those of one exposure. The raw file is the frame."""
    by_stem: dict[str, list[FoundFile]] = {}
    for one in found:
        by_stem.setdefault(one.stem, []).append(one)
    made = []
    for files in by_stem.values():
        main, *others = sorted(files, key=lambda one: (not one.raw, one.name))
        made.append(FileGroup(main, tuple(others)))
    return picture_order.by_name(made, lambda group: group.main.name)


class FolderSource:
    """All pictures under a folder, hidden ones left out."""

    removable = False

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def list(self) -> list[FoundFile]:
        """List all pictures in the order of their names."""
        try:
            if not self.folder.is_dir():
                raise CameraError(f"{self.folder} is not there: check the path, or mount the card")
            return picture_order.by_name(self._walk(), lambda one: one.name)
        except OSError as error:
            raise CameraError(f"{self.folder} can't be read: {error.strerror}") from None

    def _walk(self) -> Iterator[FoundFile]:
        count, card = 0, volume_id(self.folder.stat().st_dev)
        for place, folders, names in os.walk(self.folder, onerror=self._unreadable):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in names:
                path = Path(place) / name
                if name.startswith(".") or not name.lower().endswith(SUFFIXES):
                    continue
                count += 1
                if count > _MANY:
                    raise CameraError(f"{self.folder} holds more than {_MANY} pictures: give the folder of the flight")
                try:
                    stat = path.stat()
                except OSError:
                    continue  # gone again
                yield FoundFile(path.relative_to(self.folder).as_posix(), stat.st_size, stat.st_mtime_ns, card)

    def _unreadable(self, error: OSError) -> None:
        """Raise, so that a card that is pulled doesn't look like one with fewer files; skip folders of other users."""
        if not isinstance(error, PermissionError) or error.filename == str(self.folder):
            raise error

    def taken_s(self, found: FoundFile) -> float | None:
        """Return the camera's time of a file, as if it were UTC; None where it has none. From EXIF."""
        try:
            with open(self.folder / found.name, "rb", opener=durable.plain_file) as file:
                return seconds(read_exif(file).taken)
        except OSError as error:
            raise self._lost(found, error) from None

    def open(self, found: FoundFile) -> Blob:
        """Open its bytes."""
        try:
            fd = durable.plain_file(str(self.folder / found.name), os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise self._lost(found, error) from None
        try:
            return Blob(fd, os.fstat(fd).st_size)
        except OSError as error:
            os.close(fd)
            raise self._lost(found, error) from None

    def _lost(self, found: FoundFile, error: OSError) -> CameraError:
        return CameraError(f"{self.folder / found.name} can't be read: {error.strerror}")

    def close(self) -> None:
        """Close the source."""


class StorageSource(FolderSource):
    """The DCIM folder of a removable disk, wherever it is mounted, as soon as it is."""

    removable = True

    def __init__(self, mounts: Path | None = None, places: tuple[str, ...] | None = None) -> None:
        super().__init__(Path("/nonexistent"))
        self._mounts, self._places = mounts or MOUNTS, places or PLACES

    def list(self) -> list[FoundFile]:
        """List all pictures. Of several cards the one that was read before counts, or none."""
        unreadable, cards = "", []
        for where in self._mounted():
            try:
                if (where / "DCIM").is_dir():
                    cards.append(where / "DCIM")
            except OSError as error:
                unreadable = f"; {where} can't be read: {error.strerror}"
        if not cards:
            raise CameraError(f"no card and no camera as mass storage is mounted: connect it{unreadable}")
        if len(cards) > 1 and self.folder not in cards:
            names = " and ".join(str(one.parent) for one in cards)
            raise CameraError(f"{len(cards)} cards are mounted, {names}: unmount all but one, or name its folder")
        if self.folder not in cards:
            self.folder = cards[0]
        return super().list()

    def _mounted(self) -> Iterator[Path]:
        try:
            lines = self._mounts.read_text(errors="surrogateescape").splitlines()
        except OSError as error:
            raise CameraError(f"{self._mounts} can't be read: {error.strerror}") from None
        places = [line.split(" ")[1].replace("\\040", " ") for line in lines if " " in line]
        return (Path(place) for place in places if place.startswith(self._places))


def parse_source(text: str, ptp: Callable[[str], FileSource]) -> FileSource:
    """Return the source that a setting or an argument names; `ptp` opens a libgphoto2 port."""
    if text == "storage":
        return StorageSource()
    if text.startswith(("usb:", "ptpip:")):
        return ptp(text)
    return FolderSource(Path(text.removeprefix("folder:")).expanduser())
