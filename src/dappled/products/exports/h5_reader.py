"""Read an HDF5 light field in a process of its own, because libhdf5 can hang or crash on a damaged file.

That process judges the file first (see `packed_arrays`): `python -m dappled.products.exports.h5_reader`, as
`reader_process` calls it, with the names of a text and of arrays. One with a question mark behind it may be missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from dappled.bounds.claims import ClaimError
from dappled.drivers import reader_process
from dappled.drivers.reader_process import Budget, ReadArrays
from dappled.products.exports import packed_arrays

_BUDGET = Budget(bytes_a_second=20e6)  # of a slow disk
_MODULE = "dappled.products.exports.h5_reader"
_MAY_LACK = "?"


def read(
    path: Path, names: Sequence[str], text_name: str, *, also: Sequence[str] = ()
) -> tuple[dict[str, NDArray[Any]], str]:
    """Return the arrays of these names, `also` those where they are there, and the text of the attribute `text_name`.

    Raises as `reader_process.read` does.
    """
    words = (text_name, *names, *(f"{name}{_MAY_LACK}" for name in also))
    return reader_process.read(_MODULE, path, words, library="HDF5", budget=_BUDGET)


def _answer(path: str, words: Sequence[str]) -> ReadArrays:
    import h5py  # noqa: PLC0415  # only the child process loads it

    text_name, *names = words
    file = h5py.File(path, "r")  # closed with the process
    names = [
        one.removesuffix(_MAY_LACK)
        for one in names
        if not one.endswith(_MAY_LACK) or one.removesuffix(_MAY_LACK) in file
    ]
    packed_arrays.check_h5(file, names, text_name)
    text = file.attrs[text_name]
    if not isinstance(text, str):
        raise ClaimError(f"its {text_name} are not a text: make it anew")
    return ((name, file[name][()]) for name in names), text


if __name__ == "__main__":
    reader_process.serve(_answer, "h5py")
