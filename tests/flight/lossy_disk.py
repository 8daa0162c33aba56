"""A disk whose power can be cut: replays recorded system calls, and shows what any file system may leave of them.

`strace` records every call by which a process changes files, SQLite's too. Of a file only what was written before an
fsync of it is sure; of a folder's names only what was changed before an fsync of the folder. Everything else may be
there, or not, or in part: that is what `Left` chooses.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Left = Literal["all", "none", "data", "names", "some"]  # of what isn't sure: all, none, only data, only names, some
CALLS = (
    "openat,write,pwrite64,pwritev,sendfile,ftruncate,fsync,fdatasync,rename,renameat,renameat2,unlink,unlinkat,mkdir,"
    "mkdirat,rmdir,copy_file_range,fallocate,link,linkat,symlink"
)
_SECTOR = 512
_CALL = re.compile(r"^(\d+)\s+(\w+)\((.*)\)\s+= (-?\d+|\?)")
_STARTED = re.compile(r"^(\d+)\s+(\w+)\((.*) <unfinished \.\.\.>$")
_ENDED = re.compile(r"^(\d+)\s+<\.\.\. (\w+) resumed>(.*)\)\s+= (-?\d+|\?)")
_FD = re.compile(r"^(-?\d+|AT_FDCWD)<(.*?)>(?:\(deleted\))?$")
_TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"(\.\.\.)?')


@dataclass(frozen=True, slots=True)
class Call:
    """One successful system call. `began` is the number of calls that had ended before it began."""

    name: str
    arguments: tuple[str, ...]
    result: int
    began: int

    def path(self, place: int) -> str:
        """The file behind a descriptor."""
        match = _FD.match(self.arguments[place])
        assert match is not None, self.arguments[place]
        return _bytes(match[2]).decode() if "\\x" in match[2] else match[2]

    def data(self, place: int) -> bytes:
        """A string argument."""
        match = _TEXT.match(self.arguments[place])
        assert match is not None
        assert match[2] is None, "strace cut a string off"
        return _bytes(match[1])

    def name_at(self, place: int) -> str:
        """A path argument."""
        return self.data(place).decode()

    def name_in(self, place: int) -> str:
        """A path argument that is relative to the folder of the descriptor before it."""
        name = self.name_at(place)
        return name if name.startswith("/") else f"{self.path(place - 1)}/{name}"


def record(code: str, *arguments: str, log: Path) -> list[Call]:
    """Run Python code under strace and return the calls that succeeded, in the order of their ends."""
    command = ["strace", "-f", "--seccomp-bpf", "-y", "-xx", "-s", "10000000", "-e", f"trace={CALLS}"]
    subprocess.run(
        [*command, "-e", "signal=none", "-o", str(log), sys.executable, "-c", code, *arguments],
        cwd=Path(__file__).parents[2], check=True, timeout=300, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    calls: list[Call] = []
    open_calls: dict[str, tuple[str, int]] = {}
    with log.open() as lines:
        for line in lines:
            if started := _STARTED.match(line):
                open_calls[started[1]] = (started[3], len(calls))
                continue
            began = len(calls)
            if ended := _ENDED.match(line):
                pid, name, rest, result = ended.groups()
                first, began = open_calls.pop(pid)
                text = first + rest
            elif whole := _CALL.match(line):
                _, name, text, result = whole.groups()
            else:
                continue
            if result != "?" and int(result) >= 0:
                calls.append(Call(name, _split(text), int(result), began))
    return calls


@dataclass(slots=True)
class _File:
    """Pieces in the order they were written: (number of the call, offset, bytes; None cuts the file there)."""

    pieces: list[tuple[int, int, bytes | None]] = field(default_factory=list)
    sure: int = 0


@dataclass(slots=True)
class _Folder:
    """Changes of names in their order: (number of the call, {name: what it stands for now, or nothing})."""

    changes: list[tuple[int, dict[str, _File | _Folder | None]]] = field(default_factory=list)
    sure: int = 0


class LossyDisk:
    """What the calls made of the folder `root`, with all that is not sure yet told apart.

    `source` gives the bytes of a sendfile by the path it goes to (they don't pass through the traced process).
    """

    def __init__(self, root: Path, source: Callable[[str], bytes]) -> None:
        self._root, self._source = str(root), source
        self._top = _Folder()
        self._unnamed: dict[str, _File] = {}  # open files without a name, by the path that strace gives them
        self._number = 0

    def hold(self, *, sure: bool) -> None:
        """Take over what stands in `root` now; `sure`: durable, and not only in memory."""
        self._top = _held(Path(self._root), 0 if sure else -1)

    def apply(self, call: Call) -> bool:
        """Do what the call did; says whether it touched this disk."""
        self._number += 1
        return getattr(self, f"_{call.name}", self._unknown)(call) is not None

    def cut(self, target: Path, left: Left, seed: int = 0) -> None:
        """Write into `target` what a power cut now may leave."""
        self._lay(self._top, target, left, random.Random(seed))  # noqa: S311  chances, not secrets

    def sure_until(self, name: str) -> int:
        """The last call whose data are sure in the first file that is called so; 0 without one."""
        return next((file.sure for path, file in _walk(self._top) if path == name), 0)

    # names

    def _find(self, path: str) -> _File | _Folder | None:
        if path == self._root:
            return self._top
        if not path.startswith(self._root + "/"):
            return None
        if path.rpartition("/")[2].startswith("#"):
            return self._unnamed.setdefault(path, _File())
        here: _File | _Folder | None = self._top
        for part in path[len(self._root) + 1 :].split("/"):
            here = _names(here, len(here.changes)).get(part) if isinstance(here, _Folder) else None
        return here

    def _put(self, changes: dict[str, _File | _Folder | None]) -> bool | None:
        """One change of one folder, by whole paths."""
        done = None
        by_folder: dict[str, dict[str, _File | _Folder | None]] = {}
        for path, now in changes.items():
            folder, _, name = path.rpartition("/")
            by_folder.setdefault(folder, {})[name] = now
        for path, names in by_folder.items():
            folder_here = self._find(path)
            if isinstance(folder_here, _Folder):
                folder_here.changes.append((self._number, names))
                done = True
        return done

    # calls; each returns None where it has nothing to do with this disk

    def _unknown(self, call: Call) -> bool | None:
        assert self._root not in " ".join(call.arguments), f"{call.name} is not modelled"
        return None

    def _openat(self, call: Call) -> bool | None:
        path = call.name_in(1)
        if "O_TMPFILE" in call.arguments[2]:
            return None  # nothing that a power cut leaves
        if "O_CREAT" in call.arguments[2] and self._find(path) is None:
            return self._put({path: _File()})
        found = self._find(path)
        if "O_TRUNC" in call.arguments[2] and isinstance(found, _File):
            found.pieces.append((self._number, 0, None))
            return True
        return None

    def _write(self, call: Call) -> bool | None:
        path = call.path(0)
        file = self._find(path)
        if not isinstance(file, _File):
            return None
        data = call.data(1)[: call.result]
        end = len(_content(file.pieces))  # every plain write of ours appends
        file.pieces.append((self._number, end, data))
        return True

    def _pwrite64(self, call: Call) -> bool | None:
        file = self._find(call.path(0))
        if not isinstance(file, _File):
            return None
        file.pieces.append((self._number, int(call.arguments[3]), call.data(1)[: call.result]))
        return True

    def _sendfile(self, call: Call) -> bool | None:
        path = call.path(0)
        file = self._find(path)
        if not isinstance(file, _File):
            return None
        at = len(_content(file.pieces))
        file.pieces.append((self._number, at, self._source(path)[at : at + call.result]))
        return True

    def _ftruncate(self, call: Call) -> bool | None:
        file = self._find(call.path(0))
        if not isinstance(file, _File):
            return None
        size = int(call.arguments[1])
        old = len(_content(file.pieces))
        file.pieces.append((self._number, size, None) if size < old else (self._number, size, b""))
        return True

    def _fsync(self, call: Call) -> bool | None:
        found = self._find(call.path(0))
        if found is None:
            return None
        found.sure = max(found.sure, call.began)
        return True

    _fdatasync = _fsync

    def _rename(self, call: Call) -> bool | None:
        return self._move(call.name_at(0), call.name_at(1))

    def _renameat(self, call: Call) -> bool | None:
        return self._move(call.name_in(1), call.name_in(3))

    def _move(self, old: str, new: str) -> bool | None:
        return self._put({old: None, new: self._find(old)})

    def _linkat(self, call: Call) -> bool | None:
        """A file without a name gets one, by its descriptor."""
        assert call.arguments[4] == "AT_SYMLINK_FOLLOW"
        assert call.name_at(1).startswith("/proc/self/fd/")
        file = self._find(call.path(0))
        self._unnamed.pop(call.path(0), None)
        return self._put({call.name_in(3): file})

    def _fallocate(self, call: Call) -> bool | None:
        """Room for what follows: it holds zeros until that is written."""
        return True if self._find(call.path(0)) else None

    def _unlink(self, call: Call) -> bool | None:
        return self._put({call.name_at(0): None})

    def _unlinkat(self, call: Call) -> bool | None:
        return self._put({call.name_in(1): None})

    def _mkdir(self, call: Call) -> bool | None:
        return self._put({call.name_at(0): _Folder()})

    def _mkdirat(self, call: Call) -> bool | None:
        return self._put({call.name_in(1): _Folder()})

    # what is left

    def _lay(self, folder: _Folder, target: Path, left: Left, chosen: random.Random) -> None:
        target.mkdir(parents=True, exist_ok=True)
        kept = sum(number <= folder.sure for number, _ in folder.changes)
        if left in ("all", "names"):
            kept = len(folder.changes)
        elif left == "some":
            kept = chosen.randint(kept, len(folder.changes))  # file systems keep the order of a folder's changes
        for name, now in _names(folder, kept).items():
            if isinstance(now, _Folder):
                self._lay(now, target / name, left, chosen)
            elif now is not None:
                (target / name).write_bytes(_content(_survived(now, left, chosen)))


def _held(path: Path, sure: int) -> _Folder:
    """What stands in a real folder, as written before the first call."""
    names: dict[str, _File | _Folder | None] = {}
    for inner in sorted(path.iterdir()):
        names[inner.name] = _held(inner, sure) if inner.is_dir() else _File([(0, 0, inner.read_bytes())], sure)
    return _Folder([(0, names)], sure)


def _names(folder: _Folder, count: int) -> dict[str, _File | _Folder | None]:
    found: dict[str, _File | _Folder | None] = {}
    for _, names in folder.changes[:count]:
        found.update(names)
    return found


def _survived(file: _File, left: Left, chosen: random.Random) -> list[tuple[int, int, bytes | None]]:
    """The pieces that are left, whole or up to some sector; before later ones that are left there are zeros."""
    if left in ("all", "data"):
        return file.pieces
    kept: list[tuple[int, int, bytes | None]] = []
    for number, at, data in file.pieces:
        if number <= file.sure or (left == "some" and chosen.random() < 0.5):
            kept.append((number, at, data))
        elif left == "some" and data:
            kept.append((number, at, data[: chosen.randrange(0, len(data) + 1, _SECTOR)]))
    return kept


def _walk(folder: _Folder) -> Iterator[tuple[str, _File]]:
    for name, now in _names(folder, len(folder.changes)).items():
        if isinstance(now, _Folder):
            yield from _walk(now)
        elif now is not None:
            yield name, now


def _content(pieces: list[tuple[int, int, bytes | None]]) -> bytes:
    content = bytearray()
    for _, at, data in pieces:
        if data is None:
            del content[at:]
        else:
            content.extend(bytes(max(0, at - len(content))))
            content[at : at + len(data)] = data
    return bytes(content)


def _bytes(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))


def _split(text: str) -> tuple[str, ...]:
    """Arguments; no string of hex digits holds a comma."""
    return tuple(part.strip() for part in text.split(", "))


def listing(folder: Path) -> frozenset[tuple[str, bytes]]:
    """A folder's whole content, to tell states apart."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return frozenset((str(path.relative_to(folder)), path.read_bytes()) for path in paths)
