"""Read tables of others: CSV whose first line names the columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import read_bytes
from dappled.errors import DappledError


def rows(path: Path, wanted: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row with its line's number: its texts by the columns' names in lower case, "" where it lacks one.

    Raises DappledError where the file can't be read, or lacks a column that is `wanted`.
    """
    try:
        with io.StringIO(read_bytes(path).decode("utf-8-sig"), newline="") as file:
            reader = csv.DictReader(file, restval="", skipinitialspace=True)
            reader.fieldnames = names = [name.strip().lower() for name in reader.fieldnames or ()]
            if missing := [name for name in wanted if name not in names]:
                raise DappledError(f"{path} has no column {missing[0]}: its first line must name {', '.join(wanted)}")
            for row in reader:
                yield reader.line_num, {name: row[name].strip() for name in wanted}
    except OSError as error:
        raise DappledError(f"{path} can't be read: {error.strerror or error}") from None
    except (ClaimError, UnicodeDecodeError, csv.Error) as error:
        raise DappledError(f"{path} can't be read as CSV: {error}") from None
