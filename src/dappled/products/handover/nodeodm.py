"""Hand pictures to a NodeODM server (OpenDroneMap), follow the task, and fetch what it made.

https://github.com/OpenDroneMap/NodeODM/blob/master/docs/index.adoc: a task is begun, gets its pictures one by
one, and is committed; it does nothing before that, and is removed where its pictures can't all be sent.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import shutil
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any, TypeVar

from dappled import durable, picture_order
from dappled.bounds.parsing import parse_json, read_bytes
from dappled.errors import DappledError
from dappled.products.maps.georeference import Progress
from dappled.shown import printable

PICTURES = (".jpg", ".jpeg", ".tif", ".tiff")
_TIMEOUT_S = 60.0
_COMMIT_S = 1200.0  # a server moves all pictures then, and allows itself this long
_EVERY_S = 5.0  # a task is asked about
_PATIENCE_S = 600.0  # with a server that doesn't answer meanwhile
_PAUSES_S = (2.0, 4.0, 8.0, 16.0)  # before a picture is sent again
_ANSWER_BYTES = 1 << 22
_SAID = 300  # letters of what a server says
_PIECE_BYTES = 1 << 20
_LEFT_BYTES = 10**9
_FIELDS = "application/x-www-form-urlencoded"  # the only kind of form that a task is removed by
_FAILED, _COMPLETED, _CANCELLED = 30, 40, 50
_WORDS = {10: "waits for its turn", 20: "is being processed", 30: "has failed", 40: "is done", 50: "was cancelled"}

_Answer = TypeVar("_Answer")


class NodeOdmError(DappledError):
    """The server can't be reached, or refuses; one sentence."""


class NoAnswerError(NodeOdmError):
    """The server did not answer, or not to the end: it may do so when it is asked again."""


@dataclass(frozen=True, slots=True)
class OdmTask:
    """What the server says of a task: its state in words, how much of it is done (0 to 100), and why it failed."""

    code: int
    progress: float
    error: str

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self.code in (_FAILED, _COMPLETED, _CANCELLED)

    @property
    def words(self) -> str:
        """The state in words."""
        said = _WORDS.get(self.code, f"is in state {self.code}")
        return f"{said}, {self.progress:.0f} % done" if not self.ended else said

    @property
    def completed(self) -> bool:
        """Whether its results can be fetched."""
        return self.code == _COMPLETED


def _refusal(answer: Path) -> str:
    """What a server says instead of results."""
    try:
        said = parse_json(read_bytes(answer, _ANSWER_BYTES), _ANSWER_BYTES)  # it may have sent any number
        return str(said["error"])[:_SAID]
    except (ValueError, TypeError, KeyError, DappledError):
        return "what came is no archive"


def pictures(folder: Path) -> list[Path]:
    """The pictures of a folder in order, and geo.txt where it is there. Raises NodeOdmError where there are none."""
    try:
        inside = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    except OSError as error:
        raise NodeOdmError(f"{folder} can't be read: {error.strerror}; name the folder of the pictures") from None
    found = picture_order.by_name((path for path in inside if path.suffix.lower() in PICTURES), Path.as_posix)
    if len(found) < 2:
        raise NodeOdmError(
            f"{folder} holds {len(found) or 'no'} picture{'s' * (len(found) != 1)} ({', '.join(PICTURES)}), and "
            "OpenDroneMap needs two or more: make them with `dappled batch --as photos`, and name photos/jpeg"
        )
    return found + [path for path in inside if path.name == "geo.txt"]


class NodeOdm:
    """A NodeODM server. `token` is its own, "" for none."""

    def __init__(
        self,
        url: str,
        token: str = "",
        *,
        wait: Callable[[float], None] = time.sleep,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Raises NodeOdmError for what is no address."""
        if "@" in url:  # a password there would stand in each message
            raise NodeOdmError("a NodeODM server's address holds no user and no password: give its token in a file")
        try:
            parts = urllib.parse.urlsplit(url)
        except ValueError:  # half an address of IPv6
            parts = urllib.parse.urlsplit("")
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise NodeOdmError(f"{url!r} is no address of a NodeODM server: give one as http://127.0.0.1:3000")
        self._url, self._token = url.rstrip("/"), token
        self._wait, self._now_s = wait, now_s

    def version(self) -> str:
        """The server's version. Raises NodeOdmError."""
        return printable(str(self._asked("/info").get("version", "unknown"))[:_SAID])

    def begin(self, name: str, options: Mapping[str, str]) -> str:
        """Begin a task, which waits for its pictures; returns its identity. Raises NodeOdmError."""
        wanted = json.dumps([{"name": key, "value": value} for key, value in options.items()])
        begun = self._asked("/task/new/init", _form({"name": name, "options": wanted}))
        task = str(begun.get("uuid", ""))
        if not re.fullmatch(r"[\w-]{1,100}", task):
            raise NodeOdmError(f"{self._url} began no task: is it a NodeODM server?")
        return task

    def send(self, task: str, files: Sequence[Path], progress: Progress) -> None:
        """Send a begun task's pictures, each again where the server doesn't answer, and start it.

        Raises NodeOdmError; then the server was asked to remove the task, and does not process it unless its answer to
        the start was lost and it can't be reached since.
        """
        try:
            for done, path in enumerate(files):
                progress("upload", done, len(files))
                try:
                    data = durable.read_plain(path)
                except OSError as error:
                    raise NodeOdmError(f"{path} can't be read: {error.strerror}; nothing was started") from None
                self._upload(task, _form({}, path.name, data))
            progress("upload", len(files), len(files))
            self._commit(task)
        except BaseException:
            with contextlib.suppress(NodeOdmError):
                self._asked("/task/remove", (_FIELDS, urllib.parse.urlencode({"uuid": task}).encode()))
            raise

    def task(self, task: str) -> OdmTask:
        """How a task is. Raises NodeOdmError."""
        said = self._asked(f"/task/{urllib.parse.quote(task)}/info")
        status = said.get("status")
        status = status if isinstance(status, dict) else {}
        code, done = status.get("code"), said.get("progress", 0)
        if not isinstance(code, int) or not isinstance(done, int | float):
            raise NodeOdmError(f"{self._url} does not say how task {task} is: is it a NodeODM server?")
        return OdmTask(code, float(done), str(status.get("errorMessage") or "it gave no reason")[:_SAID])

    def results(self, task: str, path: Path, progress: Progress) -> None:
        """Wait for a task's end and put all of its results under `path`, whole or not at all. A server that does not
        answer is asked again for ten minutes. Raises NodeOdmError and OSError."""
        while not (now := self._patiently(lambda: self.task(task))).ended:
            progress("process", round(now.progress), 100)
            self._wait(_EVERY_S)
        if not now.completed:
            raise NodeOdmError(f"task {task} at {self._url} has failed: {now.error}")
        self._patiently(lambda: self._fetch(task, path))

    def _upload(self, task: str, form: tuple[str, bytes]) -> None:
        """Send a picture; one of the same name takes the place of one that came half."""
        for pause_s in _PAUSES_S:
            try:
                self._asked(f"/task/new/upload/{urllib.parse.quote(task)}", form)
            except NoAnswerError:
                self._wait(pause_s)
            else:
                return
        self._asked(f"/task/new/upload/{urllib.parse.quote(task)}", form)

    def _commit(self, task: str) -> None:
        """Start a task. Where the answer is lost, the server says whether it knows the task by now."""
        try:
            self._asked(f"/task/new/commit/{urllib.parse.quote(task)}", _form({}), _COMMIT_S)
        except NoAnswerError:
            self._wait(_EVERY_S)
            self._patiently(lambda: self.task(task))

    def _patiently(self, ask: Callable[[], _Answer]) -> _Answer:
        until_s = self._now_s() + _PATIENCE_S
        while True:
            try:
                return ask()
            except NoAnswerError:
                if self._now_s() >= until_s:
                    raise
            self._wait(_EVERY_S)

    def _fetch(self, task: str, path: Path) -> None:
        """Put all results of a task under `path`, whole or not at all. Raises NodeOdmError and OSError."""
        durable.make_folder(path.parent)
        where = f"/task/{urllib.parse.quote(task)}/download/all.zip"
        with durable.replacing(path) as part:
            with self._opened(where, None) as answer, part.open("wb") as file:
                while piece := self._piece(answer):
                    if shutil.disk_usage(part.parent).free < _LEFT_BYTES:  # results may have no end
                        raise NodeOdmError(f"{part.parent} has less than 1 GB free left: free some space")
                    file.write(piece)
                size = file.tell()
                wanted = answer.headers.get("content-length")
            if wanted is not None and wanted.isdigit() and int(wanted) != size:
                raise NoAnswerError(f"{self._url} ended the transfer after {size} of {wanted} bytes")
            if not zipfile.is_zipfile(part):  # a refusal, too, comes with status 200
                raise NodeOdmError(f"{self._url} sent no results for task {task}: {_refusal(part)}")

    def _piece(self, answer: Any) -> bytes:
        try:
            piece: bytes = answer.read(_PIECE_BYTES)
        except (HTTPException, OSError) as error:
            raise NoAnswerError(f"{self._url} broke off the transfer ({error})") from None
        return piece

    def _asked(
        self, where: str, form: tuple[str, bytes] | None = None, timeout_s: float = _TIMEOUT_S
    ) -> dict[str, Any]:
        try:
            with self._opened(where, form, timeout_s) as answer:
                data = answer.read(_ANSWER_BYTES)
                length = answer.headers.get("content-length") or ""
            if length.isdigit() and len(data) < min(int(length), _ANSWER_BYTES):
                raise NoAnswerError(f"{self._url} broke off its answer to {where}")
        except (OSError, HTTPException) as error:
            raise NoAnswerError(f"{self._url} broke off its answer to {where} ({error})") from None
        try:
            said = parse_json(data, _ANSWER_BYTES)
        except ValueError:
            said = None
        if not isinstance(said, dict):
            raise NodeOdmError(f"{self._url} answers, but not as a NodeODM server does: check the address")
        if said.get("error"):
            raise NodeOdmError(f"{self._url} refuses: {str(said['error'])[:_SAID]}")
        return said

    def _opened(self, where: str, form: tuple[str, bytes] | None, timeout_s: float = _TIMEOUT_S) -> Any:
        address = self._url + where + (f"?token={urllib.parse.quote(self._token)}" if self._token else "")
        request = urllib.request.Request(address)  # noqa: S310  # http or https, see __init__
        if form is not None:
            request = urllib.request.Request(address, form[1], {"content-type": form[0]})  # noqa: S310  # as above
        try:
            return _OPENER.open(request, timeout=timeout_s)
        except urllib.error.HTTPError as error:
            hint = "; give its token: see --token-file" if error.code in (401, 403) else ""
            elsewhere = error.headers.get("location", "") if error.code in _MOVED else ""
            hint = f": name the address that it redirects to, {_public(elsewhere)}" if elsewhere else hint
            kind = NoAnswerError if error.code >= _BUSY else NodeOdmError
            raise kind(f"{self._url} answers {where} with {error.code} {error.reason}{hint}") from None
        except (urllib.error.URLError, HTTPException, OSError) as error:
            reason = getattr(error, "reason", error)
            raise NoAnswerError(
                f"no NodeODM server answers at {self._url} ({reason}): start it, or check the address"
            ) from None
        except ValueError:  # urllib reads the address before `_NoDetours` does
            raise NodeOdmError(f"{self._url} answers {where} with a redirection to what is no address") from None


def _public(address: str) -> str:
    """An address without what may be secret in it: names, passwords and questions, which hold the token."""
    parts = urllib.parse.urlsplit(address)
    return urllib.parse.urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


class _NoDetours(urllib.request.HTTPRedirectHandler):
    """A form that is redirected would arrive without its content: the redirection is an error."""

    def redirect_request(self, *_: Any) -> None:
        """Follow none."""


_OPENER = urllib.request.build_opener(_NoDetours)
_MOVED, _BUSY = (301, 302, 303, 307, 308), 500  # statuses: the first one of a server in trouble


def _form(fields: Mapping[str, str], name: str = "", data: bytes = b"") -> tuple[str, bytes]:
    """(content type, body) of a form, with one file in the field `images` where it has a name."""
    rule = f"dappled-{secrets.token_hex(16)}"
    parts = [
        f'--{rule}\r\ncontent-disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'.encode()
        for key, value in fields.items()
    ]
    if name:
        quoted = name.replace('"', "%22")
        head = f'--{rule}\r\ncontent-disposition: form-data; name="images"; filename="{quoted}"\r\n'
        parts.append(head.encode() + b"content-type: application/octet-stream\r\n\r\n" + data + b"\r\n")
    return f"multipart/form-data; boundary={rule}", b"".join(parts) + f"--{rule}--\r\n".encode()
