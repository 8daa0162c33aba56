"""Read strangers' files in processes of their own, within a budget of time and memory.

The libraries that read them hang, crash, and take what memory there is, on bytes that somebody made for that.
The process writes arrays end to end into a temporary file, and an answer in JSON to its standard output: `{"arrays":
[[name, dtype, shape], …], "text": …}`, or `{"kind": …, "words": …}` for a file that is refused.
"""

from __future__ import annotations

import errno
import importlib
import json
import math
import mmap
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dappled.bounds import claims
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import parse_json, stored_size
from dappled.drivers.python_command import python_module
from dappled.errors import first_line

_ANSWER_BYTES = 8 << 20  # twice the longest text, for JSON's escapes
_STATM = Path("/proc/self/statm")
_RAISED: dict[str, type[Exception]] = {
    "claim": ClaimError,
    "key": KeyError,
    "damage": ValueError,
    "memory": MemoryError,
}
ReadArrays = tuple[Iterable[tuple[str, NDArray[Any]]], str]
"""Arrays with their names, of which one at a time is in memory, and a text."""


@dataclass(frozen=True, slots=True)
class Budget:
    """What reading one file may take: `patience_s`, and a second more for so many bytes of it; memory of `memory`
    bytes, and `ratio` bytes more for each of its bytes."""

    bytes_a_second: float
    patience_s: float = 20.0  # a loaded machine takes seconds to start Python
    memory: int = 2 * claims.FREE_BYTES
    ratio: int = claims.RATIO


def read(
    module: str, path: Path, words: Sequence[str], *, library: str, budget: Budget
) -> tuple[dict[str, NDArray[Any]], str]:
    """Let `python -m module` read a file: it calls `serve`. The arrays may be written to.

    Raises ClaimError for a file that claims too much, KeyError for what is missing, ValueError for a damaged file,
    MemoryError, and OSError.
    """
    with (
        tempfile.TemporaryDirectory(prefix="dappled-", ignore_cleanup_errors=True) as folder,
        tempfile.TemporaryFile() as answered,
    ):
        out, size = Path(folder, "arrays"), stored_size(path)
        memory = budget.memory + budget.ratio * size
        patience_s = budget.patience_s + size / budget.bytes_a_second
        try:
            done = subprocess.run(
                python_module(module, str(path), str(out), str(memory), str(math.ceil(patience_s)), *words),
                stdin=subprocess.DEVNULL,
                stdout=answered,
                stderr=subprocess.DEVNULL,  # a library may write there without end
                timeout=patience_s,
                check=False,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"the {library} library did not come to an end with it") from None
        if done.returncode != 0:
            most = claims.in_words(memory)  # C libraries end or crash without a word when they get none
            raise ValueError(f"the {library} library failed on it, or takes more memory than {most}")
        answered.seek(0)
        answer = parse_json(answered.read(_ANSWER_BYTES + 1), _ANSWER_BYTES)
        if "kind" in answer:
            raise _RAISED[answer["kind"]](answer["words"])
        return _mapped(out, answer["arrays"]), answer["text"]


def serve(answer: Callable[[str, Sequence[str]], ReadArrays], library: str) -> None:
    """In the process: let `answer(path, words)` read the file, and hand over what it returns or raises. The `library`'s
    module is loaded before memory is limited: what it takes itself isn't the file's."""
    path, out, memory, seconds, *words = sys.argv[1:]
    stdout = sys.stdout
    sys.stdout = sys.stderr  # libraries print
    with suppress(ImportError):  # `answer` says so
        importlib.import_module(library)
    _limit(int(memory))
    _limit_use(int(memory), int(seconds))
    stdout.write(json.dumps(_answered(answer, path, words, out, int(memory))))
    stdout.flush()


def _answered(
    answer: Callable[[str, Sequence[str]], ReadArrays], path: str, words: Sequence[str], out: str, memory: int
) -> dict[str, Any]:
    try:
        arrays, text = answer(path, words)
        with open(out, "wb") as file:
            return {"arrays": [_written(file, name, array) for name, array in arrays], "text": text}
    except ClaimError as error:
        return {"kind": "claim", "words": str(error)}
    except KeyError as error:
        return {"kind": "key", "words": str(error.args[0])[:200]}
    except (MemoryError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (errno.EFBIG, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT):
            return {"kind": "damage", "words": first_line(error)}
        error.__traceback__ = None  # its frames hold what was read
        _unlimit()
        most = claims.in_words(memory)
        return {"kind": "memory", "words": f"it takes more memory or disk to read than is free, or than {most}"}
    except Exception as error:  # noqa: BLE001  # these libraries raise anything on damaged bytes
        return {"kind": "damage", "words": first_line(error)}


def _written(file: IO[bytes], name: str, array: NDArray[Any]) -> tuple[str, str, list[int]]:
    array = np.ascontiguousarray(array)
    file.write(array.reshape(-1).view(np.uint8).data)
    return name, array.dtype.str, list(array.shape)


def _limit(memory: int) -> None:
    """Limit the memory that this process may take from now on, where the system can."""
    with suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415  # Windows has none

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        taken = int(_STATM.read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + memory, most))


def _unlimit() -> None:
    """End the limit of memory. Nothing may be opened here: that takes some."""
    with suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415  # Windows has none

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _limit_use(size: int, seconds: int) -> None:
    """Limit what this process may write to a file, as its memory, and how long it may calculate: nobody may be left to
    end it."""
    with suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415  # Windows has none

        for kind, most in ((resource.RLIMIT_FSIZE, size), (resource.RLIMIT_CPU, seconds)):
            resource.setrlimit(kind, (most, resource.getrlimit(kind)[1]))


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
