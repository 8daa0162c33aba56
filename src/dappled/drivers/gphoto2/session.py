"""libgphoto2's face: fire an open body, drain its events, read its files. Only the camera's own process imports this;
every call may block for as long as libgphoto2 waits for a silent camera (up to 10 s), with the GIL held.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from typing import Any

import gphoto2 as gp

from dappled.drivers.camera import Blob, Identity, Setting, SettingName
from dappled.drivers.gphoto2 import widgets
from dappled.drivers.gphoto2.errors import LOST, sentence, translated
from dappled.drivers.gphoto2.protocol import (
    CameraFile,
    CameraNews,
    CaptureComplete,
    Fetched,
    FileAdded,
    LostError,
    RefusedError,
    SessionError,
)
from dappled.drivers.gphoto2.settings import CaptureTarget

_CHUNK_BYTES = 1 << 20
_FOLDERS = 256
"""More folders than a card has; a bound for the walk."""
_DRAIN = 64
"""Events taken at one go, so that a chattering camera can't keep the process from its commands."""


class GPhoto2Session:
    """An open camera."""

    def __init__(self, camera: Any, port: str, target: CaptureTarget) -> None:
        self._camera = camera
        printed = widgets.text(camera, "eosserialnumber")  # what stands on the body; the PTP number is another
        reported = widgets.text(camera, "serialnumber")
        self.serials = {text for text in (printed, reported, reported.lstrip("0")) if text}
        self.identity = Identity(
            make=widgets.text(camera, "manufacturer"),
            model=widgets.text(camera, "cameramodel"),
            serial=printed or reported,
            port=port,
        )
        self._in_pieces = True
        self.keeps_files = not (widgets.set_target(camera, target) and target == "ram")

    def trigger(self) -> None:
        """Release the shutter."""
        try:
            self._camera.trigger_capture()
        except gp.GPhoto2Error as error:
            raise translated(error, "release the shutter") from error

    def news(self) -> list[CameraNews]:
        """All that happened since the last call, at most 64 events of it."""
        news: list[CameraNews] = []
        try:
            for _ in range(_DRAIN):
                kind, data = self._camera.wait_for_event(0)
                if kind == gp.GP_EVENT_TIMEOUT:
                    break
                if kind == gp.GP_EVENT_FILE_ADDED:
                    news.append(FileAdded(CameraFile(data.folder, data.name)))
                elif kind == gp.GP_EVENT_CAPTURE_COMPLETE:
                    news.append(CaptureComplete())
        except gp.GPhoto2Error as error:
            if not news:
                raise LostError(sentence(error, "report what happens")) from error
        return news

    def fetch(self, file: CameraFile) -> Fetched:
        """A file's bytes; from the card in pieces of 1 MiB straight into a memory file."""
        fd = os.memfd_create("camera file", os.MFD_CLOEXEC)  # a name of the camera's own may be too long for one
        try:
            size, taken_s = self._fill(fd, file)
        except gp.GPhoto2Error as error:
            os.close(fd)
            raise translated(error, f"send {file.name}") from error
        except SessionError:
            os.close(fd)
            raise
        return Fetched(Blob(fd, size), taken_s)

    def _fill(self, fd: int, file: CameraFile) -> tuple[int, int | None]:
        if file.in_memory:
            # libgphoto2 fetched it whole with the event, and keeps it until it is deleted.
            size = self._whole(fd, file)
            self._camera.file_delete(file.folder, file.name)
            return size, None
        info = self._camera.file_get_info(file.folder, file.name).file
        announced: int = info.size
        taken_s = _time(info)
        if not announced:
            raise RefusedError(f"the camera announced 0 bytes of {file.name}")
        got = self._pieces(fd, file, announced) if self._in_pieces else None
        if got is None:
            self._in_pieces = False
            got = self._whole(fd, file)
        if got != announced:
            raise RefusedError(f"the camera announced {announced} bytes of {file.name} and sent {got}")
        return got, taken_s

    def _pieces(self, fd: int, file: CameraFile, size: int) -> int | None:
        """Read piece by piece; None where the body can't."""
        os.ftruncate(fd, size)
        offset = 0
        with mmap.mmap(fd, size) as whole, memoryview(whole) as view:
            while offset < size:
                with view[offset : offset + _CHUNK_BYTES] as piece:
                    wanted = len(piece)
                    try:
                        got = self._camera.file_read(file.folder, file.name, gp.GP_FILE_TYPE_NORMAL, offset, piece)
                    except gp.GPhoto2Error as error:
                        if error.code == gp.GP_ERROR_NOT_SUPPORTED and offset == 0:
                            return None
                        raise
                offset += got
                if got != wanted:
                    break
        return offset

    def _whole(self, fd: int, file: CameraFile) -> int:
        held = self._camera.file_get(file.folder, file.name, gp.GP_FILE_TYPE_NORMAL)
        with memoryview(held.get_data_and_size()) as view:
            offset = 0
            while offset < len(view):
                offset += os.pwrite(fd, view[offset:], offset)
            return len(view)

    def taken_s(self, file: CameraFile) -> int | None:
        """When it was made, by the body's clock; None also for a file that is gone."""
        try:
            return _time(self._camera.file_get_info(file.folder, file.name).file)
        except gp.GPhoto2Error as error:
            if error.code in LOST:
                raise LostError(sentence(error, f"tell of {file.name}")) from error
            return None

    def about(self, file: CameraFile) -> tuple[int, int | None]:
        """(size in bytes, when it was made by the body's clock) of a file on the card. Raises SessionError."""
        try:
            info = self._camera.file_get_info(file.folder, file.name).file
        except gp.GPhoto2Error as error:
            raise translated(error, f"tell of {file.name}") from error
        return info.size, _time(info)

    def delete(self, file: CameraFile) -> None:
        """Delete a file on the card."""
        try:
            self._camera.file_delete(file.folder, file.name)
        except gp.GPhoto2Error as error:
            raise translated(error, f"delete {file.name}") from error

    def files(self) -> frozenset[CameraFile]:
        """All files on the card, from libgphoto2's memory where it has them."""
        found: set[CameraFile] = set()
        folders = ["/"]
        try:
            for folder in folders:
                found.update(CameraFile(folder, name) for name in _names(self._camera.folder_list_files(folder)))
                inner = _names(self._camera.folder_list_folders(folder))
                folders.extend(f"{folder.rstrip('/')}/{name}" for name in inner[: _FOLDERS - len(folders)])
        except gp.GPhoto2Error as error:
            raise LostError(sentence(error, "list its card")) from error
        return frozenset(file for file in found if not file.in_memory)

    def settings(self) -> tuple[Setting, ...]:
        """What can be read of the camera, by the first of its maker's names for each that the body knows."""
        return widgets.read(self._camera)

    def change(self, name: SettingName, value: str) -> None:
        """Set one of them."""
        widgets.change(self._camera, name, value)
        if name == "capture_target":
            self.keeps_files = "ram" not in value.lower()

    def close(self) -> None:
        """End the session."""
        let_go(self._camera)


def _time(info: Any) -> int | None:
    return info.mtime if info.fields & gp.GP_FILE_INFO_MTIME and info.mtime > 0 else None


def _names(found: Any) -> list[str]:
    return [found.get_name(index) for index in range(found.count())]


def let_go(camera: Any) -> None:
    """End a session; never raises."""
    with contextlib.suppress(gp.GPhoto2Error):  # it is being let go; a broken link can't be closed properly
        camera.exit()
