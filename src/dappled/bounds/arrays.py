"""Read NPY and NPZ files whose claims were judged first: shape, type, and what their bytes can unpack to."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from dappled import durable
from dappled.bounds import claims
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import check_stored

_HEADER_BYTES = 10_000  # as numpy's own limit, which it looks at too late
_READERS = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0}
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_npy(file: IO[bytes], stored: int, what: str) -> NDArray[Any]:
    """Read an array from an open NPY file of `stored` bytes. Raises ClaimError, ValueError and OSError."""
    claims.check_size(_claimed(file, what), stored, what)
    file.seek(0)
    return np.asarray(npy.read_array(file, allow_pickle=False))


def read_npz(path: Path, names: Collection[str], *, also: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Read these arrays of an NPZ file, `also` those where they are there. Raises ClaimError, KeyError where one of
    `names` is missing, and what zipfile raises."""
    with open(path, "rb", opener=durable.plain_file) as raw, zipfile.ZipFile(raw) as archive:
        names = [*names, *(name for name in also if f"{name}.npy" in archive.namelist())]
        if missing := {f"{name}.npy" for name in names}.difference(archive.namelist()):
            raise KeyError(min(missing).removesuffix(".npy"))  # zipfile's own error has a sentence of its own
        members = {name: archive.getinfo(f"{name}.npy") for name in names}
        claimed = 0
        for name, member in members.items():
            if member.compress_type not in _METHODS:
                raise ClaimError(f"its {name} is packed by neither deflate nor nothing: write it with numpy")
            with archive.open(member) as file:
                claimed += _claimed(file, name)
        claims.check_size(claimed, check_stored(raw.fileno()), "arrays")
        found = {}
        for name, member in members.items():
            with archive.open(member) as file:
                found[name] = np.asarray(npy.read_array(file, allow_pickle=False))
    return found


def _claimed(file: IO[bytes], what: str) -> int:
    """Read a header, from the file's beginning, and return the bytes that its array would take."""
    version, _ = npy.read_magic(file)
    width = 2 if version == 1 else 4
    if version not in _READERS:
        raise ValueError(f"its {what} is of NPY's version {version}; known are 1 and 2")
    length = file.read(width)
    size = int.from_bytes(length, "little")
    if size > _HEADER_BYTES:
        raise ClaimError(f"the header of its {what} claims {claims.in_words(size)}: it is damaged; write it with numpy")
    try:
        shape, _, dtype = _READERS[version](io.BytesIO(length + file.read(size)))
    except Exception as error:  # numpy evaluates it as Python, whose parser raises anything
        raise ValueError(f"the header of its {what} can't be read") from error
    if dtype.kind not in "biufcU":
        raise ClaimError(f"its {what} is of the type {str(dtype)[:40]}, not numbers or text: write it with numpy")
    return max(claims.count(shape, what), 1) * dtype.itemsize
