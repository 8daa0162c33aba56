"""The process that reads a log of ArduPilot with pymavlink: see `reader_process`. Its words are the wanted messages.

A format that says its messages have no bytes keeps pymavlink at the same place for ever, with more memory each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.drivers import reader_process
from dappled.drivers.reader_process import ReadArrays

WHERE = "#"
"""The field that numbers a message among all that are wanted."""


def _answer(path: str, words: Sequence[str]) -> ReadArrays:
    """The numbers of each message as `message/form/field`: a form is a list of fields, and a log may change it. A log
    that was cut short is read up to there, and the text says "cut"."""
    from pymavlink import DFReader  # noqa: PLC0415  # only the process itself loads it

    log = DFReader.DFReader_binary(path)
    forms: dict[tuple[str, ...], list[list[Any]]] = {}
    number = 0
    while (message := log.recv_match(type=list(words))) is not None:
        fields = {name: getattr(message, name) for name in message.get_fieldnames()}
        known = {name: value for name, value in fields.items() if isinstance(value, int | float)}
        columns = forms.setdefault((message.get_type(), WHERE, *known), [[] for _ in range(len(known) + 1)])
        for column, value in zip(columns, (number, *known.values()), strict=True):
            column.append(value)
        number += 1
    found = (
        (f"{name}/{form}/{field}", _array(column))
        for form, ((name, *fields), columns) in enumerate(forms.items())
        for field, column in zip(fields, columns, strict=True)
    )
    cut = _cut_short(log)
    log.close()
    return found, "cut" if cut else ""


def _cut_short(log: Any) -> bool:
    """Whether the last message ends after the file, or bytes follow it that are none."""
    ends = (
        at[-1] + log.formats[number].len for number, at in enumerate(log.offsets) if number in log.formats and len(at)
    )
    return max(ends, default=0) != int(log.data_len)


def _array(column: list[Any]) -> NDArray[Any]:
    """Whole numbers stay whole where 64 bits hold them."""
    whole = all(isinstance(value, int) and -(2**63) <= value < 2**63 for value in column)
    return np.array(column, dtype=np.int64 if whole else np.float64)


if __name__ == "__main__":
    reader_process.serve(_answer, "pymavlink.DFReader")
