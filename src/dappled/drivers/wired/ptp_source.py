"""Files of a camera in PTP mode, through libgphoto2 in a process of its own that only lists and fetches.

When the body sleeps or is unplugged, only this process is lost; the next call starts another one.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

from dappled import picture_order
from dappled.drivers.camera import Blob, CameraError
from dappled.drivers.child_process import (
    ChannelError,
    ChannelMessage,
    ProcessChannel,
    die_with_parent,
    end_child,
    start_child,
)
from dappled.drivers.gphoto2.intake import Intake
from dappled.drivers.gphoto2.protocol import CameraFile, Session, SessionError
from dappled.drivers.gphoto2.settings import NO_HOME, GPhoto2Settings
from dappled.drivers.wired.sources import SUFFIXES, FoundFile
from dappled.shown import guard_output

_ANSWER_S = 60.0
_SEND_S = 5.0
_REST_S = 0.5
"""After this long without a question the camera is closed, so that other programs can open it."""


class PtpSource:
    """A FileSource (see `sources`). One thread calls it."""

    removable = True

    def __init__(self, port: str) -> None:
        self._port = port
        self._child: tuple[subprocess.Popen[bytes], ProcessChannel] | None = None
        self._taken_s: dict[str, int | None] = {}

    def list(self) -> list[FoundFile]:
        """List all pictures. Each call opens the camera anew: libgphoto2 remembers what it listed."""
        (fd,) = self._ask({"do": "list"}).fds
        with os.fdopen(fd, "rb") as file:
            file.seek(0)
            rows = json.load(file)
        self._taken_s = {name: taken_s for name, _, taken_s in rows}
        return [FoundFile(name, size, round((taken_s or 0) * 1e9)) for name, size, taken_s in rows]

    def taken_s(self, found: FoundFile) -> float | None:
        """The body's own note of when the file was made, as if it were UTC; None where it has none."""
        return self._taken_s.get(found.name)

    def open(self, found: FoundFile) -> Blob:
        """Open its bytes."""
        answer = self._ask({"do": "fetch", "name": found.name})
        return Blob(answer.fds[0], answer.body["size"], answer.body["sha256"])

    def close(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        process, channel = child
        channel.close()
        end_child(process)

    def _ask(self, question: Mapping[str, Any]) -> ChannelMessage:
        try:
            _, channel = self._child = self._child or start_child(
                "dappled.drivers.wired.ptp_source", self._port, environment=NO_HOME, quiet=True
            )
        except OSError as error:  # no memory, no descriptors
            raise CameraError(
                f"no process can be started for the camera at {self._port}: {error.strerror}; try again"
            ) from None
        try:
            channel.send(question, timeout_s=_SEND_S)
            answer = channel.receive(_ANSWER_S)
            while answer is not None and "coming" in answer.body:
                answer = channel.receive(_ANSWER_S)
        except ChannelError as error:
            self.close()
            raise CameraError(f"the camera at {self._port} was lost ({error}): connect it again") from None
        if answer is None:
            self.close()
            raise CameraError(f"the camera at {self._port} did not answer for {_ANSWER_S:g} s: switch it off and on")
        if "error" in answer.body:
            raise CameraError(str(answer.body["error"]))
        if answer.lost:
            raise CameraError(f"a file of the camera at {self._port} could not be received: {answer.lost}")
        return answer


# --- the process ----------------------------------------------------------------------------------------------------


class _Files:
    """The files of the camera at a port. libgphoto2 is imported here, in the child, and nowhere else."""

    def __init__(self, port: str) -> None:
        from dappled.drivers.gphoto2.session import open_session  # noqa: PLC0415  # reason above

        self._open = open_session
        self._settings = GPhoto2Settings(port=None if port == "usb:" else port)
        self._session: Session | None = None
        self._intake = Intake()

    def answer(self, question: Mapping[str, Any], alive: Callable[[], None]) -> Blob | str:
        """Return what was requested, or a sentence why it is not available. `alive` is called as bytes come."""
        try:
            return self._list() if question["do"] == "list" else self._fetch(question["name"], alive)
        except SessionError as error:
            self.rest()  # the next question opens it again
            return str(error)

    def rest(self) -> None:
        """Close the camera."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def _list(self) -> Blob:
        self.rest()
        session = self._session = self._open(self._settings)
        rows = [
            (f"{file.folder}/{file.name}", *session.about(file))
            for file in picture_order.by_name(session.files(), lambda file: f"{file.folder}/{file.name}")
            if file.name.lower().endswith(SUFFIXES)
        ]
        return Blob.of(json.dumps(rows).encode(), "listing")

    def _fetch(self, path: str, alive: Callable[[], None]) -> Blob:
        session = self._session = self._session or self._open(self._settings)
        folder, _, name = path.rpartition("/")
        return session.fetch(CameraFile(folder, name), self._intake, alive).blob


def _serve(channel: ProcessChannel, files: _Files) -> None:
    def alive() -> None:
        channel.send({"coming": True}, timeout_s=_SEND_S)

    while True:
        question = channel.receive(_REST_S)
        if question is None:
            files.rest()
            continue
        answer = files.answer(question.body, alive)
        if isinstance(answer, str):
            channel.send({"error": answer}, timeout_s=_SEND_S)
            continue
        channel.send({"size": answer.size, "sha256": answer.sha256}, (answer.fd,), timeout_s=_SEND_S)
        answer.close()


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id, the port."""
    fd, parent, port = sys.argv[1:]
    die_with_parent(int(parent))
    guard_output()
    with contextlib.suppress(ChannelError):  # the parent is gone, or has closed
        _serve(ProcessChannel(socket.socket(fileno=int(fd))), _Files(port))


if __name__ == "__main__":
    main()
