"""The recorder: a camera's file becomes a safe frame.

Temporary name, fsync, rename, fsync of the folder, then the ledger row. Only then does `record` return; only then may
the frame be announced and the camera's own copy go.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Protocol

from dappled.flight import durable, layout
from dappled.flight.entries import Stray
from dappled.flight.errors import FlightError, disk_error
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger
from dappled.flight.records import Frame


class Bytes(Protocol):
    """A file's bytes behind a descriptor; read by position, never closed here."""

    @property
    def fd(self) -> int: ...

    @property
    def size(self) -> int: ...


class StrayFileError(FlightError):
    """The file was made safe, but it is not the frame of a shot: it stands beside the frames as `stray`."""

    def __init__(self, stray: Stray) -> None:
        super().__init__(stray.reason)
        self.stray = stray


class Recorder:
    """Writes the frames of one flight. One thread calls it."""

    def __init__(self, folder: FlightFolder, ledger: Ledger) -> None:
        self._folder = folder
        self._ledger = ledger

    def record(self, index: int, camera_name: str, blob: Bytes, *, arrived_utc_ns: int) -> Frame:
        """Make the file of shot `index` safe: when this returns, bytes, name and ledger row are durable.

        The same bytes a second time give the same Frame. Raises StrayFileError (bytes kept, under another name) for a
        second file of a shot or an unknown shot, and FlightError when the disk or the blob fails: no torn file is left
        under a final name, and the shot is noted as failed where that can still be noted.
        """
        row = self._ledger.shot(index)
        if row is None:
            reason = f"{camera_name} came for shot {index}, which was never wished for: kept as a stray"
            raise StrayFileError(self.record_stray(camera_name, blob, reason, arrived_utc_ns=arrived_utc_ns))
        first = self._ledger.frame(index)
        if first is not None:
            return self._again(first, camera_name, blob, arrived_utc_ns)
        name = layout.frame_name(index, camera_name)
        try:
            frame = Frame(index, name, camera_name, blob.size, self._write(name, camera_name, blob), arrived_utc_ns)
        except FlightError as error:
            if row.state != "failed":
                self._note_failure(index, error)
            raise
        self._ledger.safe(frame)
        return frame

    def record_companion(self, index: int, camera_name: str, blob: Bytes, *, arrived_utc_ns: int) -> Frame:
        """Make a file safe that stands beside the frame of a shot, under the same number. Raises FlightError where the
        shot has no frame, or has such a file."""
        if self._ledger.frame(index) is None:
            raise FlightError(f"{camera_name} goes with shot {index}, which has no frame: it was not recorded")
        name = layout.frame_name(index, camera_name)
        sha256 = self._write(name, camera_name, blob)
        companion = Frame(index, name, camera_name, blob.size, sha256, arrived_utc_ns)
        self._ledger.add_companion(companion)
        return companion

    def record_stray(self, camera_name: str, blob: Bytes, reason: str, *, arrived_utc_ns: int) -> Stray:
        """Make a file safe that belongs to no shot. `reason` is a sentence. Raises FlightError."""
        taken = {PurePosixPath(stray.name).stem for stray in self._ledger.strays()}
        taken |= {path.stem for path in self._folder.frames.glob("stray-*")}  # one may have lost its row to a full disk
        number = next(n for n in range(len(taken) + 1) if f"stray-{n:06d}" not in taken)
        name = f"frames/stray-{number:06d}.{layout.extension(camera_name)}"
        sha256 = self._write(name, camera_name, blob)
        stray = Stray(name, camera_name, blob.size, sha256, arrived_utc_ns, reason)
        self._ledger.add_stray(stray)
        return stray

    def _again(self, first: Frame, camera_name: str, blob: Bytes, arrived_utc_ns: int) -> Frame:
        if blob.size == first.size and durable.hash_descriptor(blob.fd, blob.size) == first.sha256:
            self._ledger.add_event("double", f"{camera_name} came again with the same bytes", first.index)
            return first
        reason = f"{camera_name} is a second file for shot {first.index}, whose frame is {first.name}: kept as a stray"
        raise StrayFileError(self.record_stray(camera_name, blob, reason, arrived_utc_ns=arrived_utc_ns))

    def _write(self, name: str, camera_name: str, blob: Bytes) -> str:
        path = self._folder.path / name
        if blob.size <= 0:
            raise FlightError(f"the camera's file {camera_name} is empty: nothing was recorded")
        if path.exists():
            raise FlightError(
                f"{path} stands there already without a ledger row; start a new flight to have it adopted"
            )
        try:
            return durable.copy_in(blob.fd, blob.size, path)
        except OSError as error:
            raise disk_error(f"record {camera_name} as", path, error) from error
        except EOFError as error:
            raise FlightError(f"the camera's file {camera_name} ended early ({error}): it was not recorded") from error

    def _note_failure(self, index: int, error: FlightError) -> None:
        try:
            self._ledger.failed(index, str(error))
        except FlightError as second:
            raise FlightError(f"{error}; nor can that be noted: {second}") from error
