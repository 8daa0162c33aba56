"""Keep names that stand in a ledger, an index, a manifest or a light field inside the folder that they belong to.

A flight may come from another computer, and anybody may have edited it. A name in it is relative, has no "..", and no
part of it is a link; otherwise a command could read, overwrite or delete a file elsewhere.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from dappled.errors import DappledError


class OutsideError(DappledError):
    """A name does not stay inside its folder."""


def parts(name: str, folder: Path, where: str) -> tuple[str, ...]:
    """The parts of a relative name: "frames/000042.cr2" has two. `where` is what holds the name, for the error.

    Raises OutsideError for a name that is empty, absolute, or has a part "", "." or "..".
    """
    found = tuple(name.split("/"))
    if not all(found) or "\0" in name or not {".", ".."}.isdisjoint(found):
        raise OutsideError(
            f"{where} names {name!r}, which does not stay inside {folder}: nothing was touched; "
            "somebody edited it, use another copy"
        )
    return found


def path(folder: Path, name: str, where: str) -> Path:
    """The path of a name inside `folder`, whether or not there is such a file. `where` is what holds the name.

    Raises OutsideError where the name leads out of the folder or over a link, or where that can't be found out.
    """
    here = folder
    for part in parts(name, folder, where):
        here = here / part
        _refuse_link(here, name, where)
    return here


def refuse_links(tree: Path, where: str) -> None:
    """Raise OutsideError where something below the folder `tree` is a link; `where` says what the folder is."""
    for place, folders, names in os.walk(tree):
        for name in (*folders, *names):
            inner = Path(place, name)
            _refuse_link(inner, str(inner.relative_to(tree)), where)


def _refuse_link(here: Path, name: str, where: str) -> None:
    try:
        mode = here.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return  # whoever opens it will say so
    except OSError as error:
        raise OutsideError(f"{where} names {name!r}, but {here} can't be looked at: {error.strerror}") from error
    if stat.S_ISLNK(mode):
        raise OutsideError(
            f"{where} holds {name!r}, but {here} is a link: it is not followed, and nothing was touched; "
            "put the file itself there"
        )
