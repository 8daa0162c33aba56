"""Read an HDF5 light field in a process of its own, because libhdf5 can hang or crash on a damaged file.

The child process judges the file first (see `packed_arrays`), writes the arrays end to end into a temporary file, and
an answer in JSON to its standard output: `{"arrays": [[name, dtype, shape], …], "text": …}`, or `{"kind": …, "words":
…}` for a file that is refused. `python -m dappled.products.exports.h5_reader FILE OUT TEXT NAME…`, where a name with a
question mark behind it may be missing.
"""

from __future__ import annotations

import json
import math
import mmap
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import parse_json
from dappled.drivers.child_process import python_module
from dappled.errors import first_line
from dappled.products.exports import packed_arrays

_PATIENCE_S, _BYTES_A_SECOND = 20.0, 20e6  # of a slow disk; a loaded machine takes seconds to start Python
_MODULE = "dappled.products.exports.h5_reader"
_MAY_LACK = "?"
_ANSWER_BYTES = 8 << 20  # twice the longest text, for JSON's escapes
_RAISED: dict[str, type[Exception]] = {
    "claim": ClaimError,
    "key": KeyError,
    "damage": ValueError,
    "memory": MemoryError,
}


def read(
    path: Path, names: Sequence[str], text_name: str, *, also: Sequence[str] = ()
) -> tuple[dict[str, NDArray[Any]], str]:
    """Return the arrays of these names, `also` those where they are there, and the text of the attribute `text_name`.

    Raises ClaimError for a file that claims too much, KeyError for what is missing, ValueError for a damaged file,
    MemoryError, and OSError.
    """
    with tempfile.TemporaryDirectory(prefix="dappled-", ignore_cleanup_errors=True) as folder:
        out = Path(folder, "arrays")
        wanted = (*names, *(f"{name}{_MAY_LACK}" for name in also))
        try:
            done = subprocess.run(
                python_module(_MODULE, str(path), str(out), text_name, *wanted),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_PATIENCE_S + path.stat().st_size / _BYTES_A_SECOND,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ValueError("the HDF5 library did not come to an end with it") from None
        if done.returncode != 0:
            raise ValueError("the HDF5 library failed on it")
        answer = parse_json(done.stdout, _ANSWER_BYTES)
        if "kind" in answer:
            _refuse(answer)
        return _mapped(out, answer["arrays"]), answer["text"]


def _refuse(answer: dict[str, str]) -> NoReturn:
    raise _RAISED[answer["kind"]](answer["words"])


def _mapped(path: Path, described: list[tuple[str, str, list[int]]]) -> dict[str, NDArray[Any]]:
    """The arrays in a file. They may be written to: the pages are this process' own from then on."""
    size = path.stat().st_size
    with path.open("rb") as file:
        data = memoryview(mmap.mmap(file.fileno(), size, access=mmap.ACCESS_COPY)) if size else memoryview(bytearray())
    found, at = {}, 0
    for name, kind, shape in described:
        count = math.prod(shape)
        found[name] = np.frombuffer(data, kind, count, at).reshape(shape) if count else np.empty(shape, kind)
        at += found[name].nbytes
    return found


def _answer(path: str, target: str, text_name: str, names: Sequence[str]) -> dict[str, Any]:
    import h5py  # noqa: PLC0415  # only the child process loads it

    try:
        with h5py.File(path, "r") as file, open(target, "wb") as out:
            names = [
                one.removesuffix(_MAY_LACK)
                for one in names
                if not one.endswith(_MAY_LACK) or one.removesuffix(_MAY_LACK) in file
            ]
            packed_arrays.check_h5(file, names, text_name)
            described = []
            for name in names:
                array = np.ascontiguousarray(file[name])
                out.write(array.reshape(-1).view(np.uint8).data)
                described.append((name, array.dtype.str, list(array.shape)))
            text = file.attrs[text_name]
    except ClaimError as error:
        return {"kind": "claim", "words": str(error)}
    except KeyError as error:
        return {"kind": "key", "words": str(error.args[0])[:200]}
    except MemoryError:
        return {"kind": "memory", "words": "it needs more memory than is free"}
    except Exception as error:  # noqa: BLE001  # h5py raises anything on damaged bytes
        return {"kind": "damage", "words": first_line(error)}
    if not isinstance(text, str):
        return {"kind": "damage", "words": f"its {text_name} are not a text"}
    return {"arrays": described, "text": text}


def main() -> None:
    """Answer, in the child process."""
    path, target, text_name, *names = sys.argv[1:]
    sys.stdout.write(json.dumps(_answer(path, target, text_name, names)))


if __name__ == "__main__":
    main()
